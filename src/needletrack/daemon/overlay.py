"""Overlays of the daemon: the newest pair drawn now and then, in a thread of its own, for whoever looks."""

import logging
import threading
import time
from types import TracebackType
from typing import NamedTuple, Self

import cv2

from needletrack.errors import PublishError
from needletrack.pictures.views import draw_views
from needletrack.publish.message import TrackMessage
from needletrack.publish.overlay import OverlayPublisher
from needletrack.records import NeedleTrack, StereoPair
from needletrack.rig import Rig

_log = logging.getLogger(__name__)


class _Job(NamedTuple):
    pair: StereoPair
    track: NeedleTrack
    message: TrackMessage


class Overlays:
    """A sink that publishes at most rate_hz pictures a second, none where nobody looks, and never makes tracking wait.

    published counts pictures. A failure ends the pictures, not the tracking: it is logged, and told by last_error.
    """

    def __init__(self, publisher: OverlayPublisher, rig: Rig, rate_hz: float, jpeg_quality: int) -> None:
        self._publisher, self._rig, self._jpeg_quality = publisher, rig, jpeg_quality
        self._period_s = 1 / rate_hz
        self._due_s = 0.0
        self._changed = threading.Condition()
        self._job: _Job | None = None
        self._closed = False
        self.published = 0
        self.last_error: str | None = None
        self._thread = threading.Thread(target=self._draw_all, name="needletrack-overlay", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._publisher.close()

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Leave the pair to the drawing thread, where a picture is due and somebody looks."""
        now_s = time.monotonic()
        if now_s < self._due_s or not self._publisher.has_subscriber:
            return
        # Due times are a grid: the pairs' own rate, which it need not divide, then makes no picture rarer.
        self._due_s = max(self._due_s + self._period_s, now_s)
        with self._changed:
            self._job = _Job(pair, track, message)
            self._changed.notify()

    def _draw_all(self) -> None:
        try:
            while (job := self._next()) is not None:
                drawn = draw_views(job.track, job.pair, self._rig)
                _, jpeg = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])
                self._publisher.publish(jpeg.tobytes(), job.message)
                self.published += 1
        except (PublishError, cv2.error, ValueError) as error:
            self.last_error = f"no overlays any more: {error}"
            _log.exception("no overlays any more")

    def _next(self) -> _Job | None:
        with self._changed:
            self._changed.wait_for(lambda: self._job is not None or self._closed)
            if self._closed:
                return None
            job, self._job = self._job, None
            return job
