"""How much is measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

SECTIONS = ("time", "throughput", "memory")


@dataclass(frozen=True)
class Plan:
    """Pairs of each section, and those before them that are tracked but left out (`warmup_*`).

    rounds: runs with publishing off, each followed by one with publishing on. samples: of resident memory.
    """

    smoke: bool
    sections: Sequence[str]
    timed_pairs: int
    warmup_pairs: int
    rounds: int
    pairs_per_round: int
    memory_pairs: int
    samples: int

    def changed(self, timed_pairs: int | None, memory_pairs: int | None, sections: Sequence[str]) -> "Plan":
        """The same plan with other numbers where they are given."""
        return replace(
            self,
            sections=sections,
            timed_pairs=timed_pairs or self.timed_pairs,
            memory_pairs=memory_pairs or self.memory_pairs,
        )


FULL = Plan(
    smoke=False,
    sections=SECTIONS,
    timed_pairs=300,
    warmup_pairs=10,
    rounds=3,
    pairs_per_round=150,
    memory_pairs=10_000,
    samples=200,
)
SMOKE = Plan(
    smoke=True,
    sections=SECTIONS,
    timed_pairs=4,
    warmup_pairs=1,
    rounds=1,
    pairs_per_round=4,
    memory_pairs=20,
    samples=10,
)
