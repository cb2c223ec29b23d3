"""Prometheus metrics of a running daemon, on the loopback interface alone."""

import logging
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Self

from prometheus_client import CollectorRegistry, Histogram, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from needletrack.publish.message import TrackMessage
from needletrack.records import NeedleTrack, StereoPair
from needletrack.service import Service, Surroundings

_log = logging.getLogger(__name__)

_BUCKETS_S = (0.001, 0.002, 0.004, 0.006, 0.008, 0.01, 0.0125, 0.015, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0)


class Metrics(Collector):
    """A sink that measures latencies, and a collector of the loop's own counts.

    port: on 127.0.0.1; 0 serves none. A port that is taken is a warning: tracking does not end for it.
    """

    def __init__(self, service: Service, surroundings: Callable[[], Surroundings], port: int) -> None:
        self._service, self._surroundings = service, surroundings
        self.registry = CollectorRegistry()
        self._latency = Histogram(
            "needletrack_latency_seconds",
            "From the exposure's stamp to publishing.",
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self._tracking = Histogram(
            "needletrack_tracking_seconds", "Tracking one pair.", buckets=_BUCKETS_S, registry=self.registry
        )
        self.registry.register(self)
        self._server = None
        if port:
            try:
                self._server, self._thread = start_http_server(port, "127.0.0.1", self.registry)
            except OSError as error:
                _log.warning("no metrics: port %d of 127.0.0.1: %s (daemon.metrics_port)", port, error.strerror)

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Observe one track's latency."""
        if message.latency_ms is not None:
            self._latency.observe(message.latency_ms / 1e3)
        if message.timing_ms is not None:
            self._tracking.observe(message.timing_ms["track"] / 1e3)

    def collect(self) -> Iterator[CounterMetricFamily | GaugeMetricFamily]:
        """The counts at this moment."""
        tracks = CounterMetricFamily("needletrack_tracks", "Tracks by status.", labels=["status"])
        for status, count in self._service.statuses.items():
            tracks.add_metric([status.value], count)
        yield tracks
        dropped = CounterMetricFamily("needletrack_dropped", "Frames and pairs lost by reason.", labels=["reason"])
        for reason, count in self._service.dropped.items():
            dropped.add_metric([reason.value], count)
        yield dropped
        around = self._surroundings()
        streaming = GaugeMetricFamily("needletrack_camera_streaming", "1: frames come.", labels=["camera"])
        rate = GaugeMetricFamily("needletrack_camera_rate_hz", "Frames a second.", labels=["camera"])
        restarts = CounterMetricFamily("needletrack_camera_restarts", "Started anew.", labels=["camera"])
        for side, camera in (around.cameras or {}).items():
            streaming.add_metric([side], camera.state == "streaming")
            rate.add_metric([side], camera.rate_hz or 0.0)
            restarts.add_metric([side], camera.restarts)
        yield from (streaming, rate, restarts)
        if around.skew is not None and around.skew.offset_us is not None:
            yield GaugeMetricFamily("needletrack_skew_microseconds", "Right minus left.", around.skew.offset_us)
        if around.recording is not None:
            yield CounterMetricFamily("needletrack_recorded_pairs", "Pairs recorded.", around.recording.pairs)
            yield CounterMetricFamily("needletrack_unrecorded_pairs", "Not recorded.", around.recording.dropped)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
