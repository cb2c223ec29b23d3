"""How much is measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

SECTIONS = ("steady", "searches", "time", "throughput", "handover", "memory", "start")


@dataclass(frozen=True)
class Plan:
    """Pairs of each section, and those before them that are tracked but left out (`warmup_*`).

    drawn_pairs: to be played forward and backward. steady_pairs, searched_pairs, timed_pairs: of each sequence;
    stills_pairs: of the stills. losses: of a needle, in each scene at each rate. rounds: runs with publishing off, each
    followed by one with publishing on. starts: of the daemon. samples: of resident memory.
    """

    smoke: bool
    sections: Sequence[str]
    drawn_pairs: int
    steady_pairs: int
    searched_pairs: int
    losses: int
    timed_pairs: int
    stills_pairs: int
    handover_s: float
    starts: int
    warmup_pairs: int
    rounds: int
    pairs_per_round: int
    memory_pairs: int
    samples: int

    def changed(
        self, timed_pairs: int | None, searched_pairs: int | None, memory_pairs: int | None, sections: Sequence[str]
    ) -> "Plan":
        """The same plan with other numbers where they are given."""
        return replace(
            self,
            sections=sections,
            steady_pairs=timed_pairs or self.steady_pairs,
            timed_pairs=timed_pairs or self.timed_pairs,
            searched_pairs=searched_pairs or self.searched_pairs,
            memory_pairs=memory_pairs or self.memory_pairs,
        )


FULL = Plan(
    smoke=False,
    sections=SECTIONS,
    drawn_pairs=40,
    steady_pairs=2000,
    searched_pairs=1000,
    losses=20,
    timed_pairs=2000,
    stills_pairs=300,
    handover_s=60.0,
    starts=10,
    warmup_pairs=10,
    rounds=3,
    pairs_per_round=2000,
    memory_pairs=20_000,
    samples=200,
)
SMOKE = Plan(
    smoke=True,
    sections=SECTIONS,
    drawn_pairs=3,
    steady_pairs=22,
    searched_pairs=2,
    losses=1,
    timed_pairs=4,
    stills_pairs=4,
    handover_s=0.5,
    starts=1,
    warmup_pairs=1,
    rounds=1,
    pairs_per_round=4,
    memory_pairs=20,
    samples=10,
)
