"""Steady state: the worker's time a pair on three sequences in turn; the audits of the other process apart."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import islice

import cv2

from benchmarks.measure import Lap, Stopwatch
from benchmarks.plan import Plan
from benchmarks.report import Spread, Steady, SteadySequence
from benchmarks.worker import FOLLOWED, Worker
from benchmarks.worlds import LARGE_PX, SMALL_PX, Sequence
from needletrack.auditing import AuditedTracker
from needletrack.records import NeedleTrack, StereoPair
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import audit

# Sequences take turns by so many pairs: only the one that is played has its audits made beside it.
TURN_PAIRS = 100
_AUDITED_EVERY = 40


class _Played:
    def __init__(self, sequence: Sequence, tracker: AuditedTracker) -> None:
        self.sequence, self.worker = sequence, Worker(sequence.rig, tracker)
        self.laps: list[Lap] = []
        self.reading_ms: list[float] = []
        self.to_audit: list[tuple[StereoPair, NeedleTrack]] = []
        self._pairs: Iterator[StereoPair] = sequence.play()

    def turn(self, count: int, done: Callable[[], None]) -> None:
        """Track so many pairs; after each, the floor: a pass over both images."""
        for pair in islice(self._pairs, count):
            self.laps.append(self.worker(pair))
            with Stopwatch() as reading:
                cv2.sumElems(pair.left.image)
                cv2.sumElems(pair.right.image)
            self.reading_ms.append(reading.cpu_ms)
            track = self.worker.track
            if len(self.laps) % _AUDITED_EVERY == 0 and track is not None and track.curve is not None:
                self.to_audit.append((pair, track))
            done()

    def result(self, warmup: int) -> SteadySequence:
        laps = self.laps[warmup:]
        parameters, audits = TrackingParameters(), []
        for pair, track in self.to_audit:
            with Stopwatch() as watch:
                audit(pair, self.sequence.rig, parameters, track)
            audits.append(watch.cpu_ms)
        stages = dict.fromkeys(stage for lap in laps for stage in lap.stages_ms)
        return SteadySequence(
            name=self.sequence.name,
            size_px=self.sequence.rig.left.size_px,
            wall_ms=Spread.of(lap.wall_ms for lap in laps),
            cpu_ms=Spread.of(lap.cpu_ms for lap in laps),
            followed_ms=_followed(laps),
            stages_ms={
                name: Spread.of(lap.stages_ms[name] for lap in laps if name in lap.stages_ms) for name in stages
            },
            audit_ms=Spread.of(audits) if audits else None,
            reading_ms=Spread.of(self.reading_ms[warmup:]),
            kinds=dict(Counter(str(lap.label) for lap in laps)),
            statuses=dict(Counter(status.value for status in self.worker.statuses[warmup:])),
        )


def _followed(laps: list[Lap]) -> Spread | None:
    followed = [lap.cpu_ms for lap in laps if lap.label == FOLLOWED]
    return Spread.of(followed) if followed else None


def measure_steady(sequences: list[Sequence], plan: Plan, done: Callable[[], None]) -> Steady:
    """The sequences in turn, A B C A B C, each with a second process of its own, as in the daemon."""
    with ExitStack() as opened:
        played = []
        for sequence in sequences:
            tracker = opened.enter_context(AuditedTracker(sequence.rig, TrackingParameters()))
            tracker.warm_up()
            played.append(_Played(sequence, tracker))
        wanted = plan.warmup_pairs + plan.steady_pairs
        while len(played[-1].laps) < wanted:
            for each in played:
                each.turn(min(TURN_PAIRS, wanted - len(each.laps)), done)
    results = [each.result(plan.warmup_pairs) for each in played]
    small, large = (next(result for result in results if result.size_px == size_px) for size_px in (SMALL_PX, LARGE_PX))
    return Steady(
        warmup_pairs=plan.warmup_pairs,
        sequences=results,
        size_ratio=round(large.cpu_ms.median / small.cpu_ms.median, 4),
        size_ratio_wall=round(large.wall_ms.median / small.wall_ms.median, 4),
        followed_share=round(
            sum(result.kinds.get(FOLLOWED, 0) for result in results) / sum(result.cpu_ms.count for result in results), 5
        ),
    )
