"""First detection, and how soon a needle that was lost is there again."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.measure import Stopwatch
from benchmarks.plan import Plan
from benchmarks.report import FoundAgain, Searches, SearchTimes, Spread
from benchmarks.worlds import RATE_HZ, SMALL_PX, STEERED, Sequence, rig_of, stamped, steered_world
from needletrack.auditing import AuditedTracker
from needletrack.geometry.spline import distance_from_curve
from needletrack.records import Float, NeedleTrack, StereoPair
from needletrack.synthetic.needle import Wave
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import search

RATES_HZ = (60.0, 120.0)
# Moved meanwhile, and a rod that may be taken for the needle while it is hidden.
SCENES = ((False, False), (True, False), (True, True))
SEEN_PAIRS, HIDDEN_PAIRS = 24, 12
# Then it is shown there and back.
SHOWN_PAIRS = 2 * SEEN_PAIRS - 1
# Wrong by more is another thing than the needle.
_RIGHT_MM = 1.0
# Far out of the reach of a glance: 25 mm aside.
_ELSEWHERE_MM = 25.0


def measure_searches(sequences: list[Sequence], plan: Plan, done: Callable[[], None]) -> list[SearchTimes]:
    """`search` of each pair without memory, sequences in turn pair by pair; thread's processor and wall time."""
    parameters = TrackingParameters()
    wall: dict[str, list[float]] = {sequence.name: [] for sequence in sequences}
    cpu: dict[str, list[float]] = {sequence.name: [] for sequence in sequences}
    found = dict.fromkeys(wall, 0)
    playing = [(sequence, sequence.play()) for sequence in sequences]
    for number in range(plan.warmup_pairs + plan.searched_pairs):
        for sequence, pairs in playing:
            pair = next(pairs)
            with Stopwatch() as watch:
                track = search(pair, sequence.rig, parameters)
            if number >= plan.warmup_pairs:
                wall[sequence.name].append(watch.wall_ms)
                cpu[sequence.name].append(watch.cpu_ms)
                found[sequence.name] += track.curve is not None
            done()
    return [
        SearchTimes(name=name, wall_ms=Spread.of(wall[name]), cpu_ms=Spread.of(cpu[name]), found=found[name])
        for name in wall
    ]


@dataclass(frozen=True, eq=False)
class Hiding:
    """Pairs with a needle, pairs of the same scene without one, and pairs with it again, here or elsewhere."""

    before: list[StereoPair]
    hidden: list[StereoPair]
    after: list[tuple[StereoPair, Float]]

    def play(self) -> Iterator[tuple[StereoPair, Float | None]]:
        """The pairs in order; the last ones with the true centerline (N, 3)."""
        yield from ((pair, None) for pair in [*self.before, *self.hidden])
        yield from self.after
        yield from self.after[-2::-1]


def hiding(*, moved: bool, rod: bool) -> Hiding:
    """The drawn world, whose needle is hidden for a while, and then where it was, or 25 mm aside."""
    world = steered_world(SMALL_PX)
    if not rod:
        world = replace(world, rods=())
    empty = replace(world, needle=None)
    x, y, z = STEERED.shift_mm
    aside = Wave(x.mean + _ELSEWHERE_MM, x.amplitude, x.period_s, x.phase_rad)
    back = replace(world, needle=replace(STEERED, shift_mm=(aside, y, z))) if moved else world
    hidden_s, back_s = SEEN_PAIRS / RATE_HZ, (SEEN_PAIRS + HIDDEN_PAIRS) / RATE_HZ
    return Hiding(
        [pair for pair, _ in world.pairs(RATE_HZ, SEEN_PAIRS)],
        [pair for pair, _ in empty.pairs(RATE_HZ, HIDDEN_PAIRS, hidden_s)],
        [(pair, truth.centerline_mm) for pair, truth in back.pairs(RATE_HZ, SEEN_PAIRS, back_s)],
    )


def measure_found_again(plan: Plan, done: Callable[[], None]) -> list[FoundAgain]:
    """Needles lost and found through the tracker with its second process, at paced rates."""
    results = []
    for moved, rod in SCENES:
        scene = hiding(moved=moved, rod=rod)
        for rate_hz in RATES_HZ:
            with AuditedTracker(rig_of(SMALL_PX), TrackingParameters()) as tracker:
                tracker.warm_up()
                pairs = [_lost_and_found(scene, tracker, rate_hz, done) for _ in range(plan.losses)]
            results.append(
                FoundAgain(
                    moved=moved,
                    rod=rod,
                    rate_hz=rate_hz,
                    after_pairs=Spread.of(pairs),
                    most=max(pairs),
                    never=sum(found > SHOWN_PAIRS for found in pairs),
                )
            )
    return results


def _lost_and_found(scene: Hiding, tracker: AuditedTracker, rate_hz: float, done: Callable[[], None]) -> int:
    """Pairs from the first that shows the needle again to the first right track, 1: that pair; beyond all: never."""
    previous: NeedleTrack | None = None
    shown, began_s = 0, time.monotonic()
    for number, (pair, truth_mm) in enumerate(scene.play()):
        time.sleep(max(began_s + number / rate_hz - time.monotonic(), 0.0))
        track = previous = tracker(stamped(pair, round(number * 1e9 / rate_hz), number), previous)
        done()
        if truth_mm is None:
            continue
        shown += 1
        if track.curve is not None:
            off_mm = np.median(distance_from_curve(track.curve.points_mm, truth_mm))
            if off_mm < _RIGHT_MM:
                return shown
    return SHOWN_PAIRS + 1


def searches(sequences: list[Sequence], plan: Plan, done: Callable[[], None]) -> Searches:
    """Both measurements."""
    return Searches(times=measure_searches(sequences, plan, done), found_again=measure_found_again(plan, done))
