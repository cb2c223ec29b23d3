"""Pairs per second of an every-frame replay through the service, with publishing off and on."""

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from threading import Event

from benchmarks.loopback import START_S, free_endpoint, subscribed
from benchmarks.plan import Plan
from benchmarks.report import Throughput
from benchmarks.worker import run_of
from benchmarks.worlds import Playing, Sequence
from needletrack.auditing import AuditedTracker
from needletrack.daemon.process import settle_memory
from needletrack.errors import PublishError
from needletrack.publish.message import StatusMessage, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.records import NeedleTrack, Status, StereoPair
from needletrack.replay import Published
from needletrack.service import Service, Sink
from needletrack.tracking.parameters import TrackingParameters


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


def measure_throughput(sequence: Sequence, plan: Plan, done: Callable[[], None]) -> Throughput:
    """Runs with publishing off and on in turn, the subscriber connected all the while, audits in a second process."""
    rig = sequence.rig
    run, wanted = run_of(rig), plan.warmup_pairs + plan.pairs_per_round
    with ExitStack() as opened:
        tracker = opened.enter_context(AuditedTracker(rig, TrackingParameters()))
        tracker.warm_up()

        def new_service() -> Service:
            return Service(Playing(sequence), tracker, rig, run, every_frame=True)

        service = new_service()

        def status() -> StatusMessage:
            return service.status()

        statuses: Counter[Status] = Counter()
        rates: dict[bool, list[float]] = {False: [], True: []}
        endpoint = free_endpoint()
        delivery = opened.enter_context(subscribed(rig.name, endpoint))
        with ZenohPublisher(run, status, listen=[endpoint]) as publisher:
            if not publisher.wait_for_subscriber(START_S):
                raise PublishError(f"the subscriber's process did not connect to {endpoint} in {START_S:g} s")
            settle_memory()
            for publishing in (False, True) * plan.rounds:
                stop = Event()
                meter = Meter(wanted, stop, done)
                sinks: list[Sink] = [Published(publisher), meter] if publishing else [meter]
                service = new_service()
                statuses.update(service.run(sinks, stop).statuses)
                rates[publishing].append(round(meter.pairs_per_s(plan.warmup_pairs), 3))
        received = delivery.result(START_S)
    return Throughput(
        scene=sequence.name,
        pairs_per_run=plan.pairs_per_round,
        warmup_pairs=plan.warmup_pairs,
        publishing_off=rates[False],
        publishing_on=rates[True],
        statuses={status.value: statuses[status] for status in Status},
        delivery=received,
    )
