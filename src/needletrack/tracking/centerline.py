"""From masks of thin structures to ordered lines, followed through crossings and short gaps by their direction."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import median_filter, uniform_filter1d

from needletrack.geometry.spline import arc_length, unit
from needletrack.kernels import call
from needletrack.records import Centerline, Float, Int
from needletrack.tracking.needle import Positive
from needletrack.tracking.segment import Mask, Ridges

# Shorter pieces have no direction that could be continued; reduced px.
_MIN_PIECE_PX = 6
_END_PX = 10
# A corner is a turn within so many pixels to either side.
_CORNER_PX = 6
_WIDTH_STEP = 0.5
# Filters along a line reach at most so many pixels.
_REACH = 4
# Blur widens a line, and a skeleton's width is coarse: only what is clearly too wide is left out here.
_WIDTH_ALLOWANCE = 1.5


class CenterlineParameters(BaseModel):
    """How lines are followed through crossings and gaps."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_gap_mm: Positive = Field(
        8.0, description="Longest gap, such as a rod in front, that a line is continued across, mm."
    )
    max_turn_deg: Positive = Field(35.0, description="Greatest turn at a crossing; a long gap allows a third of it.")
    min_contrast_gray: Positive = Field(
        3.0, description="A line differs from what lies on both its sides by this many grey levels."
    )


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Unbranched stretches of skeleton: reduced pixels (N, 2) in order along each, width (N,) seen there.

    One behind the other, each from a start to before a stop, (P,).
    """

    points: Float
    width: Float
    starts: Int
    stops: Int

    def ends(self) -> tuple[Float, Float]:
        """Position and outward unit direction (2 P, 2) of the first and the last end of each."""
        first = np.repeat(self.starts, 2)
        last = np.repeat(self.stops, 2) - 1
        at = np.stack([self.starts, self.stops - 1], axis=1).ravel()
        inwards = np.tile([1, -1], len(self.starts))
        index = at[:, None] + inwards[:, None] * np.arange(_END_PX)
        valid = (index >= first[:, None]) & (index <= last[:, None])
        stretch = self.points[np.clip(index, first[:, None], last[:, None])]
        count = valid.sum(axis=1)
        centered = stretch - ((stretch * valid[..., None]).sum(axis=1) / count[:, None])[:, None]
        x, y = centered[..., 0] * valid, centered[..., 1] * valid
        # The longer axis of the points' moments.
        angle = np.arctan2(2 * (x * y).sum(axis=1), (x * x).sum(axis=1) - (y * y).sum(axis=1)) / 2
        axis = np.column_stack([np.cos(angle), np.sin(angle)])
        position = self.points[at]
        outward = position - stretch[np.arange(len(at)), count - 1]
        return position, np.where((axis * outward).sum(axis=1, keepdims=True) >= 0, axis, -axis)


def trace_centerlines(
    ridges: Ridges, max_width_px: float, px_per_mm: float, parameters: CenterlineParameters
) -> list[Centerline]:
    """Ordered lines of at most the given width, raw px, longest first; which end is the base is not known here."""
    reach = _WIDTH_ALLOWANCE * max_width_px / ridges.reduction + 1.0
    skeletons = [points for mask in (ridges.bright, ridges.dark) for points in _skeleton_pieces(mask)]
    pieces = _two_sided(skeletons, ridges, reach, parameters)
    chains = _linked(pieces, parameters.max_gap_mm * px_per_mm / ridges.reduction, parameters.max_turn_deg)
    return _centerlines(pieces, chains, ridges.reduction)


def _skeleton_pieces(mask: Mask) -> list[Float]:
    """The unbranched stretches (N, 2) of a mask's skeleton, reduced pixels in order along each."""
    rows, columns = mask.shape
    # What is scratch here is as large as the mask, of which a few percent are touched.
    points, ends = np.empty((mask.size, 2)), np.empty(mask.size, np.int64)
    count = call(
        "skeleton_pieces",
        np.ascontiguousarray(mask),
        rows,
        columns,
        _MIN_PIECE_PX,
        np.empty((rows + 2, columns + 2), np.uint8),
        np.empty((2, mask.size), np.int32),
        points,
        ends,
    )
    return [points[a:b].copy() for a, b in pairwise([0, *ends[:count].tolist()])]


def _two_sided(pieces: list[Float], ridges: Ridges, max_width: float, parameters: CenterlineParameters) -> _Pieces:
    """The stretches of all pieces that differ from both sides: an edge of something wide differs from one only.

    They end at corners too, where a skeleton goes over from the needle to the edge of its sleeve.
    """
    if not pieces:
        nothing = np.zeros(0, np.int64)
        return _Pieces(np.zeros((0, 2)), np.zeros(0), nothing, nothing)
    ends = np.cumsum([len(points) for points in pieces])
    runs = _Runs(ends - [len(points) for points in pieces], ends)
    smooth = runs.filtered(lambda x: uniform_filter1d(x, 5, axis=0), np.concatenate(pieces))
    along = unit(smooth[runs.beside(1)] - smooth[runs.beside(-1)])
    contrast, width = np.empty(len(smooth)), np.empty(len(smooth))
    image = ridges.reduced
    steps = len(np.arange(_WIDTH_STEP, max_width + 2.0, _WIDTH_STEP))
    call("two_sided", image, *image.shape, smooth, along, len(smooth), _WIDTH_STEP, steps, contrast, width)
    good = runs.filtered(lambda x: uniform_filter1d(x, 5), contrast) > parameters.min_contrast_gray
    good &= runs.filtered(lambda x: median_filter(x, 9), width) <= max_width
    good &= _turn_deg(smooth, runs) < parameters.max_turn_deg
    # A stretch is a run of good points of one piece.
    begins, stops = good.copy(), good.copy()
    begins[1:] &= ~good[:-1]
    stops[:-1] &= ~good[1:]
    begins[runs.starts] = good[runs.starts]
    stops[runs.ends - 1] = good[runs.ends - 1]
    starts, behind = np.flatnonzero(begins), np.flatnonzero(stops) + 1
    long_enough = behind - starts >= _MIN_PIECE_PX
    return _Pieces(smooth, width, starts[long_enough], behind[long_enough])


@dataclass(frozen=True, eq=False)
class _Runs:
    """Pieces one behind the other in one array, each from a start to before an end: (P,) indices."""

    starts: Int
    ends: Int

    @cached_property
    def lengths(self) -> Int:
        """Of each piece (P,)."""
        return self.ends - self.starts

    def beside(self, step: int) -> Int:
        """The point (N,) so many further along the piece; the piece's last or first one, where it ends before."""
        at = np.arange(self.ends[-1]) + step
        return np.asarray(np.clip(at, np.repeat(self.starts, self.lengths), np.repeat(self.ends - 1, self.lengths)))

    def filtered(self, along: Callable[[Float], Float], values: Float) -> Float:
        """What a filter along the first axis, of a reach of at most _REACH, makes of each piece, its ends repeated."""
        return along(values[self._padded])[self._inner]

    @cached_property
    def _padded(self) -> Int:
        first = self.starts - np.arange(len(self.starts)) * 2 * _REACH
        at = np.arange(self.ends[-1] + 2 * _REACH * len(self.starts)) - _REACH
        longer = self.lengths + 2 * _REACH
        shift = np.repeat(first - self.starts, longer)
        return np.asarray(np.clip(at + shift, np.repeat(self.starts, longer), np.repeat(self.ends - 1, longer)))

    @cached_property
    def _inner(self) -> Int:
        before = (2 * np.arange(len(self.starts)) + 1) * _REACH
        return np.asarray(np.arange(self.ends[-1]) + np.repeat(before, self.lengths))


def _turn_deg(points: Float, runs: _Runs) -> Float:
    """By how much (N,) lines turn about each of their points (N, 2); 0 near their ends."""
    before = points - points[runs.beside(-_CORNER_PX)]
    after = points[runs.beside(_CORNER_PX)] - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.degrees(np.abs(np.arctan2(cross, (before * after).sum(axis=1))))
    at = np.arange(len(points))
    inner = at - np.repeat(runs.starts, runs.lengths) >= _CORNER_PX
    inner &= np.repeat(runs.ends, runs.lengths) - at > _CORNER_PX
    return np.where(inner, turn, 0.0)


_Chain = list[tuple[int, bool]]


def _linked(pieces: _Pieces, max_gap: float, max_turn_deg: float) -> list[_Chain]:
    """Chains of pieces, and whether each is taken from its last end.

    Every end joins at most one other, the straightest and nearest continuation first.
    """
    position, outward = pieces.ends()
    gap = position[None] - position[:, None]
    near = np.triu((gap**2).sum(axis=2) < max_gap**2, 1)
    a, b = np.nonzero(near)
    of_two = a // 2 != b // 2
    a, b = a[of_two], b[of_two]
    towards = gap[a, b]
    distance = np.linalg.norm(towards, axis=1)
    towards /= np.maximum(distance, 1e-9)[:, None]
    # Across a gap of a pixel or two its direction is noise: only the turn between the pieces counts.
    far = distance > 4.0
    cosines = np.stack(
        [
            -(outward[a] * outward[b]).sum(axis=1),
            np.where(far, (outward[a] * towards).sum(axis=1), 1.0),
            np.where(far, -(outward[b] * towards).sum(axis=1), 1.0),
        ]
    )
    worst = np.degrees(np.arccos(np.clip(cosines.min(axis=0), -1, 1)))
    short = 12.0
    limit = np.where(
        distance < short,
        max_turn_deg,
        max_turn_deg / 3 + 2 * max_turn_deg / 3 * short / np.maximum(distance, short),
    )
    cost = distance / short + worst / max_turn_deg
    joined: dict[int, int] = {}
    order = np.argsort(cost, kind="stable")
    for k in order[(worst < limit)[order]].tolist():
        one, other = int(a[k]), int(b[k])
        if one not in joined and other not in joined:
            joined[one], joined[other] = other, one
    return _chains(len(pieces.starts), joined)


def _chains(count: int, joined: dict[int, int]) -> list[_Chain]:
    done: set[int] = set()
    chains: list[_Chain] = []
    # Free ends first; what is left after them is closed loops, which are cut anywhere.
    for start in sorted(range(2 * count), key=lambda e: (e in joined, e)):
        entry: int | None = start
        chain: _Chain = []
        while entry is not None and entry // 2 not in done:
            piece, which = divmod(entry, 2)
            done.add(piece)
            chain.append((piece, which == 1))
            entry = joined.get(2 * piece + 1 - which)
        if chain:
            chains.append(chain)
    return chains


def _centerlines(pieces: _Pieces, chains: list[_Chain], reduction: int) -> list[Centerline]:
    """The lines that chains of pieces are, in raw pixels, the longest first."""
    if not chains:
        return []
    cuts = [
        [np.arange(pieces.starts[piece], pieces.stops[piece])[:: -1 if turned else 1] for piece, turned in chain]
        for chain in chains
    ]
    at = np.concatenate([cut for chain in cuts for cut in chain])
    stops = np.cumsum([sum(map(len, chain)) for chain in cuts])
    points, width = (pieces.points[at] + 0.5) * reduction - 0.5, pieces.width[at] * reduction
    along = arc_length(points)
    starts = np.concatenate([[0], stops[:-1]])
    longest = np.argsort(along[starts] - along[stops - 1], kind="stable").tolist()
    return [Centerline(points[starts[k] : stops[k]], width[starts[k] : stops[k]]) for k in longest]
