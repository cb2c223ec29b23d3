"""Time a pair: needletrack, the method of 2017 and the floor, in turn on the same frames."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from benchmarks.frames import PreloadedRecording, Scene, pairs_of
from benchmarks.measure import Lap, Subject, interleaved
from benchmarks.plan import Plan
from benchmarks.report import MethodTimes, SceneTimes, Spread
from benchmarks.subjects import Decoding, Needletrack, Reading, Reference

OURS, REFERENCE = "needletrack", "reference (2017)"
READING, DECODING = "read both images once", "decode both PNGs"


def measure_times(scene: Scene, plan: Plan, done: Callable[[], None]) -> SceneTimes:
    """Every method on the same pairs of a scene; `done` is called after each pair, warm-up included."""
    recording = PreloadedRecording(scene.folder)
    ours = Needletrack(recording.rig, independent=scene.independent)
    subjects: dict[str, Subject] = {
        OURS: ours,
        REFERENCE: Reference(recording.rig),
        READING: Reading(),
        DECODING: Decoding(recording),
    }
    pairs = list(pairs_of(recording, plan.warmup_pairs + plan.timed_pairs))
    laps = interleaved(subjects, pairs, plan.warmup_pairs, done)
    statuses = Counter(status.value for status in ours.statuses[plan.warmup_pairs :])
    return SceneTimes(
        scene=scene.name,
        size_px=recording.rig.left.size_px,
        independent=scene.independent,
        warmup_pairs=plan.warmup_pairs,
        statuses=dict(sorted(statuses.items())),
        methods={name: _times(of_method) for name, of_method in laps.items() if _found(of_method)},
        speedup=_ratio(laps[OURS], laps[REFERENCE], lambda lap: lap.wall_ms),
        cpu_speedup=_ratio(laps[OURS], laps[REFERENCE], lambda lap: lap.cpu_ms),
    )


def _times(laps: Sequence[Lap]) -> MethodTimes:
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


def _found(laps: Sequence[Lap]) -> list[Lap]:
    return [lap for lap in laps if lap.label is not None]


def _names(entries: Iterable[Iterable[str]]) -> list[str]:
    """Every name, in the order in which they first came."""
    return list(dict.fromkeys(name for names in entries for name in names))


def _outside_stages(laps: Sequence[Lap]) -> dict[str, Spread]:
    rest = [lap.wall_ms - sum(lap.stages_ms.values()) for lap in laps if lap.stages_ms]
    return {"outside the stages": Spread.of(rest)} if rest else {}


def _ratio(ours: Sequence[Lap], reference: Sequence[Lap], time_ms: Callable[[Lap], float]) -> Spread | None:
    ratios = [time_ms(b) / time_ms(a) for a, b in zip(ours, reference, strict=True) if b.label is not None]
    return Spread.of(ratios) if ratios else None
