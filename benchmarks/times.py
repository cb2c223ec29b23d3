"""Time a pair: needletrack, the method of 2017 and the floor, in turn on the same frames."""

from collections import Counter
from collections.abc import Callable, Iterable
from itertools import islice

from benchmarks.frames import SEQUENCE, PreloadedRecording, Scene, pairs_of
from benchmarks.measure import Lap, Subject, interleaved
from benchmarks.plan import Plan
from benchmarks.report import MethodTimes, SceneTimes, Spread
from benchmarks.subjects import Decoding, Reading, Reference, Searching
from benchmarks.worker import Worker
from benchmarks.worlds import Sequence
from needletrack.auditing import AuditedTracker
from needletrack.records import StereoPair
from needletrack.rig import Rig
from needletrack.tracking.parameters import TrackingParameters

OURS, REFERENCE = "needletrack", "reference (2017)"
READING, DECODING = "read both images once", "decode both PNGs"


def measure_stills(scene: Scene, plan: Plan, done: Callable[[], None]) -> SceneTimes:
    """Every method on the pairs of a recording of stills; ours without memory. `done`: after each pair."""
    recording = PreloadedRecording(scene.folder)
    pairs = pairs_of(recording, plan.warmup_pairs + plan.stills_pairs)
    return _measured(
        scene.name, recording.rig, pairs, Searching(recording.rig), Decoding.of_recording(recording), plan, done
    )


def measure_sequence(sequence: Sequence, plan: Plan, done: Callable[[], None]) -> SceneTimes:
    """Every method on the same pairs of a sequence, ours as in the live loop; `done`: after each pair."""
    if sequence.name == SEQUENCE.name:
        decoding = Decoding.of_recording(PreloadedRecording(SEQUENCE.folder))
    else:
        decoding = Decoding.of_pairs(sequence.pairs)
    with AuditedTracker(sequence.rig, TrackingParameters()) as tracker:
        tracker.warm_up()
        pairs = islice(sequence.play(), plan.warmup_pairs + plan.timed_pairs)
        return _measured(sequence.name, sequence.rig, pairs, Worker(sequence.rig, tracker), decoding, plan, done)


def _measured(
    name: str,
    rig: Rig,
    pairs: Iterable[StereoPair],
    ours: Searching | Worker,
    decoding: Decoding,
    plan: Plan,
    done: Callable[[], None],
) -> SceneTimes:
    subjects: dict[str, Subject] = {OURS: ours, REFERENCE: Reference(rig), READING: Reading(), DECODING: decoding}
    laps = interleaved(subjects, pairs, plan.warmup_pairs, done)
    return SceneTimes(
        scene=name,
        size_px=rig.left.size_px,
        independent=isinstance(ours, Searching),
        warmup_pairs=plan.warmup_pairs,
        statuses=dict(sorted(Counter(status.value for status in ours.statuses[plan.warmup_pairs :]).items())),
        methods={name: _times(of_method) for name, of_method in laps.items() if _found(of_method)},
        speedup=_ratio(laps[OURS], laps[REFERENCE], lambda lap: lap.wall_ms),
        cpu_speedup=_ratio(laps[OURS], laps[REFERENCE], lambda lap: lap.cpu_ms),
    )


def _times(laps: list[Lap]) -> MethodTimes:
    found = _found(laps)
    kinds = sorted({lap.label for lap in found if lap.label})
    return MethodTimes(
        whole_ms=Spread.of(lap.wall_ms for lap in found),
        cpu_ms=Spread.of(lap.cpu_ms for lap in found),
        kinds_ms={kind: Spread.of(lap.wall_ms for lap in found if lap.label == kind) for kind in kinds},
        stages_ms={
            stage: Spread.of(lap.stages_ms[stage] for lap in found if stage in lap.stages_ms)
            for stage in _names(lap.stages_ms for lap in found)
        }
        | _outside_stages(found),
        beside_ms={
            name: Spread.of(lap.beside_ms[name] for lap in found if name in lap.beside_ms)
            for name in _names(lap.beside_ms for lap in found)
        },
        not_found=len(laps) - len(found),
    )


def _found(laps: list[Lap]) -> list[Lap]:
    return [lap for lap in laps if lap.label is not None]


def _names(entries: Iterable[Iterable[str]]) -> list[str]:
    """Every name, in the order in which they first came."""
    return list(dict.fromkeys(name for names in entries for name in names))


def _outside_stages(laps: list[Lap]) -> dict[str, Spread]:
    rest = [lap.wall_ms - sum(lap.stages_ms.values()) for lap in laps if lap.stages_ms]
    return {"outside the stages": Spread.of(rest)} if rest else {}


def _ratio(ours: list[Lap], reference: list[Lap], time_ms: Callable[[Lap], float]) -> Spread | None:
    ratios = [time_ms(b) / time_ms(a) for a, b in zip(ours, reference, strict=True) if b.label is not None]
    return Spread.of(ratios) if ratios else None
