"""The results, as they are written to JSON and read back to compare two commits."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict

from benchmarks.machine import Load, Machine


class Part(BaseModel):
    """A frozen part of the report; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Spread(Part):
    """Median, 99th percentile and least of a number of values."""

    count: int
    median: float
    p99: float
    least: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Self:
        """The spread of one or more values."""
        sample = np.fromiter(values, dtype=np.float64)
        median, p99 = np.percentile(sample, [50, 99])
        return cls(count=len(sample), median=round(median, 4), p99=round(p99, 4), least=round(sample.min(), 4))


class MethodTimes(Part):
    """One method on one recording, in milliseconds a pair.

    whole_ms: measured outside; cpu_ms: processor time of the same; kinds_ms: whole_ms by kind of pair;
    stages_ms: over the pairs in which the stage ran; beside_ms: timed on the same pairs, no part of it.
    not_found: pairs without times, since the method found nothing on them.
    """

    whole_ms: Spread
    cpu_ms: Spread
    kinds_ms: Mapping[str, Spread]
    stages_ms: Mapping[str, Spread]
    beside_ms: Mapping[str, Spread]
    not_found: int = 0


class SceneTimes(Part):
    """All methods on one recording, interleaved pair by pair, in one run.

    speedup: the reference method's time divided by needletrack's, pair by pair; cpu_speedup: processor time.
    """

    scene: str
    size_px: tuple[int, int]
    independent: bool
    warmup_pairs: int
    statuses: Mapping[str, int]
    methods: Mapping[str, MethodTimes]
    speedup: Spread | None
    cpu_speedup: Spread | None


class Delivery(Part):
    """What the subscriber in another process got: tracks, those lost, and publishing to receiving in ms."""

    received: int
    lost: int
    overflowed: int
    transit_ms: Spread | None


class Throughput(Part):
    """Every-frame replay through the service, warm-up left out; both lists are pairs/s, one entry a run."""

    scene: str
    pairs_per_run: int
    warmup_pairs: int
    publishing_off: Sequence[float]
    publishing_on: Sequence[float]
    statuses: Mapping[str, int]
    delivery: Delivery


class Memory(Part):
    """Resident memory of a process that tracks a looped recording from memory, with its second process, and publishes.

    at_pair and resident_mb run in parallel. started_mb: before the first pair; settled_mb and end_mb: medians
    of the second and of the last tenth of the samples; growth_mb: between them; slope_mb_per_1000: Theil-Sen,
    over the same stretch. flat: growth_mb is less than flat_below_mb; None: too few pairs to tell. frames_mb: the
    frames that are kept in memory, in all of these figures. allocated_blocks_growth: of Python's allocator, between
    settled and end.
    """

    scene: str
    pairs: int
    pairs_per_s: float
    started_mb: float
    settled_mb: float
    end_mb: float
    peak_mb: float
    growth_mb: float
    slope_mb_per_1000: float
    flat: bool | None
    flat_below_mb: float
    frames_mb: float
    audit_process_mb: float
    allocated_blocks_growth: int
    at_pair: Sequence[int]
    resident_mb: Sequence[float]
    delivery: Delivery


class SteadySequence(Part):
    """The worker on one sequence: wall and the thread's processor time of tracking and message, milliseconds a pair.

    followed_ms: processor time of those that were followed, not lost. stages_ms: as the tracks tell them, and the
    message. audit_ms: of the other process, measured apart, processor time; reading_ms: the floor, a pass over both
    images. kinds and statuses: pairs of each.
    """

    name: str
    size_px: tuple[int, int]
    wall_ms: Spread
    cpu_ms: Spread
    followed_ms: Spread | None
    stages_ms: Mapping[str, Spread]
    audit_ms: Spread | None
    reading_ms: Spread
    kinds: Mapping[str, int]
    statuses: Mapping[str, int]


class Steady(Part):
    """Sequences in turn; size_ratio: of the medians at 2560x2048 and at 1280x1024, processor time, and wall time."""

    warmup_pairs: int
    sequences: Sequence[SteadySequence]
    size_ratio: float
    size_ratio_wall: float
    followed_share: float


class SearchTimes(Part):
    """A search of whole images, milliseconds a pair; found: pairs with a shape."""

    name: str
    wall_ms: Spread
    cpu_ms: Spread
    found: int


class FoundAgain(Part):
    """Pairs from the first that shows a needle again to the first right track, 1: that pair itself.

    moved: it came back elsewhere. rod: there is one beside it, which may be taken for it meanwhile. never: losses after
    which it was not found as long as the scene lasted.
    """

    moved: bool
    rod: bool
    rate_hz: float
    after_pairs: Spread
    most: int
    never: int


class Searches(Part):
    """First detection, and after a loss."""

    times: Sequence[SearchTimes]
    found_again: Sequence[FoundAgain]


class Handover(Part):
    """A frame handed over in memory to its decoded track in a subscriber's process (age_ms), at a paced rate."""

    sequence: str
    rate_hz: float
    seconds: float
    released: int
    tracked: int
    dropped: Mapping[str, int]
    received: int
    lost_on_the_way: int
    age_ms: Spread


class Start(Part):
    """Seconds from the start of a fresh interpreter to each moment; import_s: of it, loading modules."""

    to_s: Mapping[str, Spread]
    import_s: Spread


class Bar(Part):
    """A bar and what was measured against it."""

    name: str
    bar: str
    measured: float
    met: bool


class Report(Part):
    """One run of the benchmark; sections that were not asked for are empty."""

    format: Literal[2] = 2
    smoke: bool
    machine: Machine
    load: Load
    bars: Sequence[Bar] = ()
    steady: Steady | None = None
    searches: Searches | None = None
    handover: Handover | None = None
    start: Start | None = None
    scenes: Sequence[SceneTimes] = ()
    throughput: Throughput | None = None
    memory: Memory | None = None
