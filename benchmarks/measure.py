"""One pair's times, and several methods timed in turn on the same pairs."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from needletrack.records import StereoPair


@dataclass(frozen=True, slots=True)
class Lap:
    """What one pair took: wall_ms as a clock on the wall saw it, cpu_ms of this thread, and stages_ms.

    beside_ms: what was timed on the same pair and is no part of wall_ms. label: the kind of pair; None: the
    method found nothing to time.
    """

    wall_ms: float
    cpu_ms: float
    stages_ms: Mapping[str, float]
    label: str | None
    beside_ms: Mapping[str, float] = field(default_factory=dict)


Subject = Callable[[StereoPair], Lap]


class Stopwatch:
    """Wall and processor time of a `with` block, the latter of the calling thread alone."""

    def __init__(self) -> None:
        self.wall_ms = 0.0
        self.cpu_ms = 0.0

    def __enter__(self) -> Self:
        self._cpu_ns = time.thread_time_ns()
        self._wall_ns = time.perf_counter_ns()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.wall_ms = (time.perf_counter_ns() - self._wall_ns) / 1e6
        self.cpu_ms = (time.thread_time_ns() - self._cpu_ns) / 1e6


def interleaved(
    subjects: Mapping[str, Subject], pairs: Iterable[StereoPair], warmup: int, done: Callable[[], None]
) -> dict[str, list[Lap]]:
    """The laps of each subject on the same pairs, in turn A B C A B C, so that a busy spell hits all alike.

    The first `warmup` pairs are run and left out. `done` is called after each pair.
    """
    laps: dict[str, list[Lap]] = {name: [] for name in subjects}
    for number, pair in enumerate(pairs):
        for name, subject in subjects.items():
            lap = subject(pair)
            if number >= warmup:
                laps[name].append(lap)
        done()
    return laps
