"""A frame handed over in memory until its decoded track is in a subscriber's hands, in another process, at a rate."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack

from benchmarks.live import MemorySource
from benchmarks.loopback import QUEUE, START_S, free_endpoint, fresh_process
from benchmarks.plan import Plan
from benchmarks.report import Handover, Spread
from benchmarks.worker import run_of
from benchmarks.worlds import Sequence
from needletrack.auditing import AuditedTracker
from needletrack.client import Subscriber
from needletrack.daemon.process import settle_memory
from needletrack.errors import PublishError
from needletrack.publish.message import TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.records import NeedleTrack, StereoPair
from needletrack.replay import Published
from needletrack.service import Service
from needletrack.tracking.parameters import TrackingParameters

RATE_HZ = 120.0


class _Progress:
    def __init__(self, done: Callable[[], None]) -> None:
        self._done = done

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self._done()


def measure_handover(sequence: Sequence, plan: Plan, done: Callable[[], None]) -> Handover:
    """Pairs from memory at 120 a second through the live loop, the newest first, with its second process."""
    rig = sequence.rig
    run = run_of(rig)
    source = MemorySource(list(sequence.pairs), RATE_HZ, plan.handover_s)
    endpoint = free_endpoint()
    with ExitStack() as opened:
        tracker = opened.enter_context(AuditedTracker(rig, TrackingParameters()))
        service = Service(source, tracker, rig, run)
        process = opened.enter_context(fresh_process())
        arrived = process.submit(receive, rig.name, endpoint)
        with ZenohPublisher(run, service.status, listen=[endpoint]) as publisher:
            if not publisher.wait_for_subscriber(START_S):
                raise PublishError(f"the subscriber's process did not connect to {endpoint} in {START_S:g} s")
            tracker.warm_up()
            tracker(sequence.pairs[0], None)
            settle_memory()
            summary = service.run([Published(publisher), _Progress(done)], threading.Event())
        ages_ms, lost = arrived.result(START_S)
    return Handover(
        sequence=sequence.name,
        rate_hz=RATE_HZ,
        seconds=round(summary.duration_s, 2),
        released=source.released,
        tracked=summary.pairs,
        dropped={reason.value: count for reason, count in summary.dropped.items()},
        received=len(ages_ms),
        lost_on_the_way=lost,
        age_ms=Spread.of(ages_ms),
    )


def receive(rig: str, endpoint: str) -> tuple[list[float], int]:
    """The age of every track once it is decoded, by the clock that all processes of this machine share; and losses."""
    ages_ms: list[float] = []
    lost = 0
    with Subscriber(rig, [endpoint], capacity=QUEUE) as subscriber:
        subscriber.wait_for_daemon(START_S)
        settle_memory()
        gone = False
        while not gone:
            gone = subscriber.wait_until_gone(0)
            while (received := subscriber.next(0.0 if gone else 0.1)) is not None:
                ages_ms.append((time.monotonic_ns() - received.message.captured_at_ns) / 1e6)
                lost += received.missed.lost + received.missed.overflowed
    return ages_ms, lost
