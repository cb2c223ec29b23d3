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
    delivery: Delivery


class Memory(Part):
    """Resident memory of a process that replays a recording from its files through the service and publishes.

    at_pair and resident_mb run in parallel. started_mb: before the first pair; settled_mb and end_mb: medians
    of the second and of the last tenth of the samples; growth_mb: between them; slope_mb_per_1000: Theil-Sen,
    over the same stretch. flat: growth_mb is less than flat_below_mb; None: too few pairs to tell.
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
    at_pair: Sequence[int]
    resident_mb: Sequence[float]
    delivery: Delivery


class Report(Part):
    """One run of the benchmark; sections that were not asked for are empty."""

    format: Literal[1] = 1
    smoke: bool
    machine: Machine
    load: Load
    scenes: Sequence[SceneTimes] = ()
    throughput: Throughput | None = None
    memory: Memory | None = None
