"""What the figures must be, and whether they are."""

from collections.abc import Iterator
from statistics import median

from benchmarks.report import Bar, Handover, Memory, SceneTimes, Searches, Start, Steady, Throughput
from benchmarks.times import OURS

WORKER_MEDIAN_MS, WORKER_P99_MS = 2.0, 5.0
PAIRS_PER_S = 400.0
SEARCH_MS, FOUND_AFTER_PAIRS = 40.0, 3
SIZE_RATIO = 1.5
AGE_P50_MS, AGE_P99_MS = 5.0, 12.0
SPEEDUP = 50.0
RESIDENT_MB, START_S = 300.0, 2.0


def at_most(name: str, measured: float, bar: float, unit: str = "") -> Bar:
    """A figure that must not be larger."""
    return Bar(name=name, bar=f"≤ {bar:g}{unit}", measured=measured, met=measured <= bar)


def at_least(name: str, measured: float, bar: float, unit: str = "") -> Bar:
    """A figure that must not be smaller."""
    return Bar(name=name, bar=f"≥ {bar:g}{unit}", measured=measured, met=measured >= bar)


def of_steady(found: Steady) -> Iterator[Bar]:
    """Times are judged twice: as the thread's processor time, and on the wall, where others' jobs count as well."""
    for sequence in found.sequences:
        for what, spread in (("processor", sequence.cpu_ms), ("wall", sequence.wall_ms)):
            yield at_most(f"worker, {sequence.name}: median, {what}", spread.median, WORKER_MEDIAN_MS, " ms")
            yield at_most(f"worker, {sequence.name}: p99, {what}", spread.p99, WORKER_P99_MS, " ms")
    yield at_most("2560×2048 / 1280×1024, median, processor", found.size_ratio, SIZE_RATIO)
    yield at_most("2560×2048 / 1280×1024, median, wall", found.size_ratio_wall, SIZE_RATIO)


def of_searches(found: Searches) -> Iterator[Bar]:
    """First detection, and after a loss."""
    for times in found.times:
        yield at_most(f"search, {times.name}: median, processor", times.cpu_ms.median, SEARCH_MS, " ms")
        yield at_most(f"search, {times.name}: p99, processor", times.cpu_ms.p99, SEARCH_MS, " ms")
        yield at_most(f"search, {times.name}: p99, wall", times.wall_ms.p99, SEARCH_MS, " ms")
    for again in found.found_again:
        where = "elsewhere" if again.moved else "in place"
        where += ", rod" if again.rod else ""
        name = f"found again {where}, {again.rate_hz:g} pairs/s"
        yield at_most(f"{name}: median", again.after_pairs.median, FOUND_AFTER_PAIRS, " pairs")
        yield at_most(f"{name}: most", again.most, FOUND_AFTER_PAIRS, " pairs")


def of_scene(found: SceneTimes) -> Iterator[Bar]:
    """The ratio to the method of 2017, for what is followed."""
    if found.independent or found.speedup is None or found.cpu_speedup is None or OURS not in found.methods:
        return
    yield at_least(f"reference / needletrack, {found.scene}, processor", found.cpu_speedup.median, SPEEDUP)


def of_throughput(found: Throughput) -> Iterator[Bar]:
    """Sustained through the service, publishing on."""
    rate = float(median(found.publishing_on))
    yield at_least(f"{found.scene} through the service, publishing", rate, PAIRS_PER_S, " pairs/s")


def of_handover(found: Handover) -> Iterator[Bar]:
    """Latency and losses at 120 pairs/s."""
    yield at_most("frame in memory → decoded track: p50", found.age_ms.median, AGE_P50_MS, " ms")
    yield at_most("frame in memory → decoded track: p99", found.age_ms.p99, AGE_P99_MS, " ms")
    yield at_most(f"pairs lost of {found.released:,}", found.released - found.received, 0)


def of_memory(found: Memory) -> Iterator[Bar]:
    """Growth and size, without the frames that the benchmark keeps."""
    if found.flat is not None:
        yield Bar(
            name=f"resident memory over {found.pairs:,} pairs",
            bar=f"growth < {found.flat_below_mb:g} MB",
            measured=found.growth_mb,
            met=found.flat,
        )
    yield at_most("daemon's process, frames apart", round(found.peak_mb - found.frames_mb, 1), RESIDENT_MB, " MB")
    yield at_most("audit process", found.audit_process_mb, RESIDENT_MB, " MB")


def of_start(found: Start) -> Iterator[Bar]:
    """From nothing to the first track, warm file cache."""
    yield at_most("start to first track: median", found.to_s["tracked"].median, START_S, " s")
