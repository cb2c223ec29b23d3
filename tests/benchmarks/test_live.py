"""The live loop under load, for a short while: every pair is tracked or counted, and memory stays where it was."""

from pathlib import Path

import pytest
from benchmarks.live import PARTS, Load, under_load

STEER = Path(__file__).parents[1] / "data" / "recordings" / "steer-b"


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Load:
    return under_load(STEER, 20.0, 25.0, record=tmp_path_factory.mktemp("soak"))


@pytest.mark.slow
def test_every_pair_is_tracked_or_counted_with_its_reason(load: Load) -> None:
    assert load.released == 500
    assert load.unaccounted == 0
    assert load.run.pairs > 0


@pytest.mark.slow
def test_the_recorder_loses_nothing_while_tracking_runs(load: Load) -> None:
    assert (load.recorded, load.unrecorded) == (load.released, 0)


@pytest.mark.slow
def test_memory_does_not_grow(load: Load) -> None:
    # A leak of one pair of images in each would be 730 MB.
    settled = load.resident_mb[len(load.resident_mb) // 3 :]
    for which in (1, 2):
        assert settled[-1][which] - settled[0][which] < 60


@pytest.mark.slow
def test_latency_and_its_parts_are_measured_twice(load: Load) -> None:
    figures = load.figures
    for latency_ms, *parts_ms in zip(figures.latency_ms, *(figures.parts_ms[part] for part in PARTS), strict=True):
        assert sum(parts_ms) <= latency_ms + 0.01
    assert load.received.messages + load.received.lost == load.run.pairs
    assert load.received.latency_ms_p50 is not None
    assert load.received.latency_ms_p50 >= min(figures.latency_ms)
