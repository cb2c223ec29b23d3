"""Pairing as frames come in: never a wrong pair, every frame accounted for; and what the stamps say of the trigger."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from needletrack.capture.pairing import Paired, Side, SkewMonitor, StampPairer, Trigger
from needletrack.recording.pairing import pair_by_stamp
from needletrack.records import DropReason

US = 1_000
MS = 1_000_000
PERIOD_NS = 10 * MS


def run(
    frames: Sequence[tuple[Side, int]], tolerance_ns: int, *, offset_ns: int = 0, period_ns: int | None = 0
) -> tuple[list[tuple[int, int]], list[tuple[DropReason, int]]]:
    """Pairs and losses of frames in the order of their arrival; a frame is its own stamp."""
    pairer: StampPairer[int] = StampPairer(tolerance_ns, offset_ns=offset_ns, period_ns=period_ns)
    decided = [each for side, stamp in frames for each in pairer.add(side, stamp, stamp)]
    decided += pairer.flush()
    pairs = [(each.left, each.right) for each in decided if isinstance(each, Paired)]
    return pairs, [(each.reason, each.frame) for each in decided if not isinstance(each, Paired)]


def arriving(left: Sequence[int], right: Sequence[int], delay_ns: int = 0) -> list[tuple[Side, int]]:
    """Both cameras' frames in the order of arrival; the right ones come so much later than they are stamped."""
    frames: list[tuple[int, Side, int]] = [(stamp, "left", stamp) for stamp in left]
    frames += [(stamp + delay_ns, "right", stamp) for stamp in right]
    return [(side, stamp) for _, side, stamp in sorted(frames)]


jitters = st.lists(st.integers(-300 * US, 300 * US), min_size=1, max_size=40)
losses = st.sets(st.integers(0, 39))


@given(jitters, losses, losses, st.integers(-15 * MS, 15 * MS))
def test_dropped_frames_cost_their_own_pair_and_no_other(
    jitter: list[int], lost_left: set[int], lost_right: set[int], delay_ns: int
) -> None:
    count = len(jitter)
    left = {n: n * PERIOD_NS for n in range(count) if n not in lost_left}
    right = {n: n * PERIOD_NS + jitter[n] for n in range(count) if n not in lost_right}
    pairs, lost = run(arriving(list(left.values()), list(right.values()), delay_ns), MS, period_ns=PERIOD_NS * 9 // 10)
    assert pairs == [(left[n], right[n]) for n in sorted(left.keys() & right.keys())]
    assert sorted(lost) == sorted(
        [(DropReason.UNPAIRED_LEFT, left[n]) for n in left.keys() - right.keys()]
        + [(DropReason.UNPAIRED_RIGHT, right[n]) for n in right.keys() - left.keys()]
    )


increasing = st.lists(st.integers(1, 20 * MS), min_size=1, max_size=30).map(
    lambda gaps: [int(stamp) for stamp in np.cumsum(gaps)]
)


@given(increasing, increasing, st.integers(0, 15 * MS), st.integers(-5 * MS, 5 * MS))
def test_whatever_comes_every_frame_comes_out_once_and_no_pair_is_beyond_the_limit(
    left: list[int], right: list[int], tolerance_ns: int, offset_ns: int
) -> None:
    pairs, lost = run(arriving(left, right), tolerance_ns, offset_ns=offset_ns)
    assert all(abs(right_ns - left_ns - offset_ns) <= tolerance_ns for left_ns, right_ns in pairs)
    assert sorted([pair[0] for pair in pairs] + [s for r, s in lost if r is DropReason.UNPAIRED_LEFT]) == left
    assert sorted([pair[1] for pair in pairs] + [s for r, s in lost if r is DropReason.UNPAIRED_RIGHT]) == right
    assert all(a[0] < b[0] and a[1] < b[1] for a, b in pairwise(pairs))


@given(increasing, increasing, st.integers(0, 15 * MS))
def test_frames_that_are_each_others_nearest_of_all_are_a_pair(
    left: list[int], right: list[int], tolerance_ns: int
) -> None:
    # A recording's pairing sees all frames at once; the last ones of a stream are not decided as they come.
    nearest = [(left[i], right[j]) for i, j in pair_by_stamp(left, right, tolerance_ns)]
    pairs, _ = run(arriving(left, right), tolerance_ns)
    assert set(nearest[:-1]) <= set(pairs) or _tied(left, right)


def _tied(left: list[int], right: list[int]) -> bool:
    """Two frames are equally near to one: either may be its partner."""
    gaps = [abs(r - l) for l in left for r in right]
    return len(set(gaps)) < len(gaps)


def test_a_pair_is_given_with_its_second_frame() -> None:
    pairer: StampPairer[str] = StampPairer(MS, period_ns=9 * MS)
    assert list(pairer.add("left", 0, "l0")) == []
    assert list(pairer.add("right", 200 * US, "r0")) == [Paired("l0", "r0")]


@pytest.mark.parametrize("skew_ns", [0, 200 * US, -800 * US])
def test_where_no_rate_is_configured_a_pair_does_not_wait_for_the_next_frame_either(skew_ns: int) -> None:
    pairer: StampPairer[int] = StampPairer(MS)
    for n in range(5):
        first, second = sorted([("left", n * PERIOD_NS), ("right", n * PERIOD_NS + skew_ns)], key=lambda each: each[1])
        assert list(pairer.add(*first, n)) == []  # type: ignore[arg-type]
        assert list(pairer.add(*second, n)) == [Paired(n, n)]  # type: ignore[arg-type]


@given(jitters, losses, losses)
def test_a_learnt_period_pairs_as_a_known_one(jitter: list[int], lost_left: set[int], lost_right: set[int]) -> None:
    left = [n * PERIOD_NS for n in range(len(jitter)) if n not in lost_left]
    right = [n * PERIOD_NS + jitter[n] for n in range(len(jitter)) if n not in lost_right]
    known = run(arriving(left, right), MS, period_ns=PERIOD_NS * 9 // 10)
    assert run(arriving(left, right), MS, period_ns=None) == known


def test_the_nearer_of_two_is_waited_for_where_the_first_is_beyond_half_a_period() -> None:
    frames: list[tuple[Side, int]] = [("right", 0), ("left", 6 * MS), ("right", 10 * MS), ("left", 16 * MS)]
    pairs, lost = run(frames, 8 * MS, period_ns=9 * MS)
    assert pairs == [(6 * MS, 10 * MS)]
    assert lost == [(DropReason.UNPAIRED_RIGHT, 0), (DropReason.UNPAIRED_LEFT, 16 * MS)]


def test_a_known_offset_is_taken_off() -> None:
    left = [n * PERIOD_NS for n in range(10)]
    right = [stamp + 4 * MS for stamp in left]
    assert run(arriving(left, right), MS)[0] == []
    assert len(run(arriving(left, right), MS, offset_ns=4 * MS, period_ns=9 * MS)[0]) == 10


def test_a_stalled_camera_costs_what_it_does_not_send_and_memory_stays_bounded() -> None:
    pairer: StampPairer[int] = StampPairer(MS, period_ns=9 * MS)
    lost = [each for n in range(1000) for each in pairer.add("left", n * PERIOD_NS, n)]
    assert len(lost) >= 990
    resumed = [*pairer.add("right", 1000 * PERIOD_NS, -1), *pairer.add("left", 1000 * PERIOD_NS, 1000)]
    assert resumed[-1] == Paired(1000, -1)


def test_drift_pairs_the_nearest_until_the_limit_and_again_when_the_next_is_near() -> None:
    left = [n * PERIOD_NS for n in range(1000)]
    right = [round(n * PERIOD_NS * 1.001) for n in range(1000)]
    pairs, lost = run(arriving(left, right), MS, period_ns=9 * MS)
    assert all(abs(r - l) <= MS for l, r in pairs)
    # A tenth of the time either way of being in step, which the stamps pass once in a thousand periods.
    assert len(pairs) == pytest.approx(200, abs=2)
    assert len(pairs) * 2 + len(lost) == 2000


def test_a_stamp_out_of_order_costs_its_frame_and_a_clock_set_back_is_believed_in_the_end() -> None:
    frames: list[tuple[Side, int]] = []
    for n in range(3):
        frames += [("left", n * PERIOD_NS), ("right", n * PERIOD_NS)]
    frames += [("left", PERIOD_NS), ("left", 3 * PERIOD_NS), ("right", 3 * PERIOD_NS)]
    pairs, lost = run(frames, MS, period_ns=9 * MS)
    assert len(pairs) == 4
    assert lost == [(DropReason.STAMP_OUT_OF_ORDER, PERIOD_NS)]
    for n in range(-100, -90):
        frames += [("left", n * PERIOD_NS), ("right", n * PERIOD_NS)]
    assert len(run(frames, MS, period_ns=9 * MS)[0]) == 4 + 8


def watched(left: Sequence[int], right: Sequence[int]) -> SkewMonitor:
    monitor = SkewMonitor()
    for side, stamp in arriving(left, right):
        monitor.add(side, stamp)
    return monitor


def stamps(count: int, ppm: float, offset_ns: float, seed: int) -> list[int]:
    """100 Hz by a crystal that is off by ppm, stamped to 20 us."""
    jitter = np.random.default_rng(seed).normal(0, 20 * US, count)
    return [round(value) for value in np.arange(count) * PERIOD_NS * (1 + ppm * 1e-6) + offset_ns + jitter]


@pytest.mark.parametrize("offset_us", [0.0, 350.0, -4200.0])
def test_a_constant_offset_is_found_and_looks_triggered(offset_us: float) -> None:
    report = watched(stamps(6000, 0, 0, 1), stamps(6000, 0, offset_us * US, 2)).report()
    assert report.looks is Trigger.HARDWARE
    # The median of 600 differences of 28 us each.
    assert report.offset_us == pytest.approx(offset_us, abs=5)
    assert report.spread_us == pytest.approx(1.64 * 28, rel=0.25)


@pytest.mark.parametrize("ppm", [10.0, -60.0, 900.0])
def test_two_crystals_look_free_running(ppm: float) -> None:
    report = watched(stamps(6000, 0, 0, 1), stamps(6000, ppm, 1500 * US, 2)).report()
    assert report.looks is Trigger.FREE_RUNNING
    if abs(ppm) < 100:
        assert report.drift_ppm == pytest.approx(ppm, abs=1)


def test_too_little_says_nothing() -> None:
    assert watched(stamps(20, 0, 0, 1), stamps(20, 0, 0, 2)).report().looks is Trigger.UNKNOWN
    # Half a second of 20 us stamps cannot tell crystals apart.
    assert watched(stamps(60, 0, 0, 1), stamps(60, 0, 0, 2)).report().looks is Trigger.UNKNOWN


def test_frames_lost_on_one_side_do_not_look_like_an_offset() -> None:
    right = [stamp for n, stamp in enumerate(stamps(3000, 0, 100 * US, 2)) if n % 7]
    report = watched(stamps(3000, 0, 0, 1), right).report()
    assert report.offset_us == pytest.approx(100, abs=5)
