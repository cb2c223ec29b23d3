"""Pairing by stamps: every true pair is found, none is wrong, whatever is missing."""

from itertools import combinations, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from needletrack.recording.pairing import in_order, pair_by_stamp

INTERVAL_NS = 33_333_333
TOLERANCE_NS = 1_000_000


@given(data=st.data(), count=st.integers(0, 30))
def test_every_true_pair_is_found_and_none_is_wrong(data: st.DataObject, count: int) -> None:
    """A steady rate, each camera's stamp late by up to the tolerance, frames lost on both sides."""
    delays = st.lists(st.integers(0, TOLERANCE_NS), min_size=count, max_size=count)
    lost = st.sets(st.integers(0, max(0, count - 1)))
    left_delay, right_delay = data.draw(delays, "left delay"), data.draw(delays, "right delay")
    left_lost, right_lost = data.draw(lost, "left lost"), data.draw(lost, "right lost")
    left = {k: k * INTERVAL_NS + left_delay[k] for k in range(count) if k not in left_lost}
    right = {k: k * INTERVAL_NS + right_delay[k] for k in range(count) if k not in right_lost}

    pairs = pair_by_stamp(list(left.values()), list(right.values()), TOLERANCE_NS)

    found = [(list(left)[i], list(right)[j]) for i, j in pairs]
    assert found == [(k, k) for k in sorted(left.keys() & right.keys())]


STAMPS = st.lists(st.integers(0, 100), max_size=12, unique=True).map(sorted)


@given(left=STAMPS, right=STAMPS, tolerance=st.integers(0, 30))
def test_paired_frames_are_each_others_nearest_within_the_tolerance(
    left: list[int], right: list[int], tolerance: int
) -> None:
    pairs = pair_by_stamp(left, right, tolerance)
    for i, j in pairs:
        gap = abs(left[i] - right[j])
        assert gap <= tolerance
        assert gap == min(abs(stamp - right[j]) for stamp in left)
        assert gap == min(abs(stamp - left[i]) for stamp in right)
    assert all(a < c and b < d for (a, b), (c, d) in pairwise(pairs))


@pytest.mark.parametrize(
    ("left", "right", "pairs"),
    [
        ([], [], []),
        ([0], [], []),
        ([0], [5], [(0, 0)]),
        ([0], [6], []),
        ([0, 100, 200], [3, 203], [(0, 0), (2, 1)]),
        ([100, 200], [3, 97, 203], [(0, 1), (1, 2)]),
        ([0, 4], [5], [(1, 0)]),
    ],
)
def test_the_nearest_frames_pair(left: list[int], right: list[int], pairs: list[tuple[int, int]]) -> None:
    assert pair_by_stamp(left, right, tolerance_ns=5) == pairs


@given(stamps=st.lists(st.integers(0, 8), max_size=8))
def test_as_few_stamps_as_possible_are_dropped(stamps: list[int]) -> None:
    kept = in_order(stamps)
    assert kept == sorted(set(kept))
    assert all(stamps[a] < stamps[b] for a, b in pairwise(kept))
    longer = combinations(range(len(stamps)), len(kept) + 1)
    assert not any(all(stamps[a] < stamps[b] for a, b in pairwise(s)) for s in longer)


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([10, 20, 30], [0, 1, 2]),
        ([10, 20, 15, 30, 40], [0, 1, 3, 4]),
        ([10, 20, 20, 30], [0, 1, 3]),
        ([10, 20, 9_000, 30, 40], [0, 1, 3, 4]),
        ([10, 20, 0, 30, 40], [0, 1, 3, 4]),
    ],
)
def test_one_bad_stamp_costs_one_frame(stamps: list[int], kept: list[int]) -> None:
    assert in_order(stamps) == kept
