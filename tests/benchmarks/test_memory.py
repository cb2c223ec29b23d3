from benchmarks.memory import Course, judge
from benchmarks.report import Delivery, Memory

PAIRS = 10_000
AT_PAIR = tuple(range(50, PAIRS + 1, 50))


def judged(resident_mb: list[float]) -> Memory:
    course = Course(AT_PAIR, tuple(resident_mb), 100.0, max(resident_mb), PAIRS, 100.0, 20.0, 90.0, AT_PAIR)
    return judge("steer-b", course, Delivery(received=PAIRS, lost=0, overflowed=0, transit_ms=None))


def test_memory_that_fills_at_first_and_then_stays_is_flat() -> None:
    found = judged([100.0 + min(pair / 10, 50.0) for pair in AT_PAIR])

    assert found.flat
    # One block more each pair: nine tenths of the pairs lie between the medians' tenths, less one.
    assert found.allocated_blocks_growth == PAIRS * 0.8
    assert (found.frames_mb, found.audit_process_mb) == (20.0, 90.0)
    assert (found.settled_mb, found.growth_mb, found.slope_mb_per_1000) == (150.0, 0.0, 0.0)


def test_a_kilobyte_lost_with_each_pair_is_no_longer_flat() -> None:
    found = judged([100.0 + pair * 1e-3 for pair in AT_PAIR])

    assert not found.flat
    assert abs(found.slope_mb_per_1000 - 1.0) < 1e-6
