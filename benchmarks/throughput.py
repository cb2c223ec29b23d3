"""Pairs per second of an every-frame replay through the service, with publishing off and on."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from threading import Event

from benchmarks.frames import PreloadedRecording, Scene, looped
from benchmarks.loopback import START_S, free_endpoint, subscribed
from benchmarks.plan import Plan
from benchmarks.report import Throughput
from needletrack.errors import PublishError
from needletrack.publish.message import RunContext, Source, StatusMessage, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.records import NeedleTrack, StereoPair
from needletrack.replay import Published
from needletrack.service import Service, Sink
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import track_pair


class Meter:
    """The service's sink that notes when each pair was done and stops the run after so many."""

    def __init__(self, pairs: int, stop: Event, done: Callable[[], None]) -> None:
        self.at_s: list[float] = []
        self._pairs, self._stop, self._done = pairs, stop, done

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Note the time."""
        self.at_s.append(time.perf_counter())
        if len(self.at_s) >= self._pairs:
            self._stop.set()
        self._done()

    def pairs_per_s(self, warmup: int) -> float:
        """The rate after the first `warmup` pairs."""
        counted = self.at_s[max(warmup, 1) - 1 :]
        return (len(counted) - 1) / (counted[-1] - counted[0])


def measure_throughput(scene: Scene, plan: Plan, done: Callable[[], None]) -> Throughput:
    """Runs with publishing off and on in turn, the subscriber connected all the while."""
    recording = PreloadedRecording(scene.folder)
    rig, parameters = recording.rig, TrackingParameters()
    run = RunContext(rig.name, Source.REPLAY, config_digest="benchmark", rig_digest=rig.digest)
    wanted = plan.warmup_pairs + plan.pairs_per_round

    def tracker(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        return track_pair(pair, rig, parameters, previous)

    def new_service() -> Service:
        return Service(looped(recording, wanted), tracker, rig, run, every_frame=True, independent=scene.independent)

    service = new_service()

    def status() -> StatusMessage:
        return service.status()

    rates: dict[bool, list[float]] = {False: [], True: []}
    with ExitStack() as opened:
        endpoint = free_endpoint()
        delivery = opened.enter_context(subscribed(rig.name, endpoint))
        with ZenohPublisher(run, status, listen=[endpoint]) as publisher:
            if not publisher.wait_for_subscriber(START_S):
                raise PublishError(f"the subscriber's process did not connect to {endpoint} in {START_S:g} s")
            for publishing in (False, True) * plan.rounds:
                stop = Event()
                meter = Meter(wanted, stop, done)
                sinks: list[Sink] = [Published(publisher), meter] if publishing else [meter]
                service = new_service()
                service.run(sinks, stop)
                rates[publishing].append(round(meter.pairs_per_s(plan.warmup_pairs), 3))
        received = delivery.result(START_S)
    return Throughput(
        scene=scene.name,
        pairs_per_run=plan.pairs_per_round,
        warmup_pairs=plan.warmup_pairs,
        publishing_off=rates[False],
        publishing_on=rates[True],
        delivery=received,
    )
