"""How long each stage of one pair took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds spent in each stage: `with stopwatch("match"): ...` adds to elapsed_ms["match"]."""

    def __init__(self) -> None:
        self.elapsed_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time until the block's end to the stage, also where it raises."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.elapsed_ms[stage] = self.elapsed_ms.get(stage, 0.0) + (time.perf_counter() - start) * 1e3
