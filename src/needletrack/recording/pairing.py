"""Which left and right frames belong together, by their stamps alone."""

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from needletrack.records import Int


def in_order(stamps_ns: Sequence[int]) -> list[int]:
    """Indices of the stamps that stay when the fewest are dropped so that the rest strictly increases.

    One stamp far in the future thus costs one frame, not all that follow it; where there is a choice, the
    earlier frames stay. (Longest increasing subsequence by patience sorting: Fredman 1975.)
    """
    run_from: list[int] = []  # how many stamps can stay from each frame on
    heads: list[int] = []  # the highest stamp that starts a run of each length, negated
    for stamp in reversed(stamps_ns):
        length = bisect_left(heads, -stamp)
        heads[length : length + 1] = [-stamp]
        run_from.append(length + 1)
    run_from.reverse()
    kept: list[int] = []
    for index, stamp in enumerate(stamps_ns):
        if run_from[index] == len(heads) - len(kept) and (not kept or stamp > stamps_ns[kept[-1]]):
            kept.append(index)
    return kept


def pair_by_stamp(left_ns: Sequence[int], right_ns: Sequence[int], tolerance_ns: int) -> list[tuple[int, int]]:
    """Indices (left, right) of frames that are each other's nearest and at most tolerance_ns apart, in order.

    Both sequences strictly increase. A frame that is missing on either side costs that pair and no other.
    """
    if not left_ns or not right_ns:
        return []
    left, right = np.asarray(left_ns, dtype=np.int64), np.asarray(right_ns, dtype=np.int64)
    nearest_right, nearest_left = _nearest(left, right), _nearest(right, left)
    mutual = nearest_left[nearest_right] == np.arange(len(left))
    close = np.abs(right[nearest_right] - left) <= tolerance_ns
    return [(int(index), int(nearest_right[index])) for index in np.flatnonzero(mutual & close)]


def _nearest(stamps: Int, others: Int) -> Int:
    """For each stamp the index of the nearest among others; of two equally near ones the earlier."""
    if len(others) == 1:
        return np.zeros(len(stamps), dtype=np.int64)
    after = np.searchsorted(others, stamps).clip(1, len(others) - 1)
    later = others[after] - stamps < stamps - others[after - 1]
    return np.where(later, after, after - 1)
