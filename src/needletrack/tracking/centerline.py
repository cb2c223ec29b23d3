"""From masks of thin structures to ordered lines, followed through crossings and short gaps by their direction."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
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


@dataclass(frozen=True, slots=True)
class _Piece:
    """Reduced pixels (N, 2) in order along one unbranched stretch of skeleton, and the width (N,) seen there."""

    points: Float
    width: Float

    def end(self, which: int) -> tuple[Float, Float]:
        """Position and outward unit direction of the first (0) or the last (1) end."""
        stretch = self.points[:_END_PX][::-1] if which == 0 else self.points[-_END_PX:]
        centered = stretch - stretch.mean(axis=0)
        axis = np.linalg.svd(centered, full_matrices=False)[2][0]
        return stretch[-1], axis if axis @ (stretch[-1] - stretch[0]) >= 0 else -axis


def trace_centerlines(
    ridges: Ridges, max_width_px: float, px_per_mm: float, parameters: CenterlineParameters
) -> list[Centerline]:
    """Ordered lines of at most the given width, raw px, longest first; which end is the base is not known here."""
    reach = _WIDTH_ALLOWANCE * max_width_px / ridges.reduction + 1.0
    skeletons = [points for mask in (ridges.bright, ridges.dark) for points in _skeleton_pieces(mask)]
    pieces = _two_sided(skeletons, ridges, reach, parameters)
    chains = _linked(pieces, parameters.max_gap_mm * px_per_mm / ridges.reduction, parameters.max_turn_deg)
    lines = [_centerline(chain, ridges.reduction) for chain in chains]
    return sorted(lines, key=lambda line: -float(arc_length(line.points_px)[-1]))


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


def _two_sided(pieces: list[Float], ridges: Ridges, max_width: float, parameters: CenterlineParameters) -> list[_Piece]:
    """The stretches of all pieces that differ from both sides: an edge of something wide differs from one only.

    They end at corners too, where a skeleton goes over from the needle to the edge of its sleeve.
    """
    if not pieces:
        return []
    ends = np.cumsum([len(points) for points in pieces])
    runs = _Runs(ends - [len(points) for points in pieces], ends)
    smooth = runs.filtered(lambda x: uniform_filter1d(x, 5, axis=0), np.concatenate(pieces))
    along = unit(smooth[runs.beside(1)] - smooth[runs.beside(-1)])
    distances = np.arange(_WIDTH_STEP, max_width + 2.0, _WIDTH_STEP)
    steps = np.concatenate([-distances[::-1], [0.0], distances])[:, None]
    levels = _sample(ridges.reduced, smooth[:, 0] - steps * along[:, 1], smooth[:, 1] + steps * along[:, 0])
    levels -= levels[len(distances)].copy()
    # (sides, distances, points), from the middle outwards.
    differences = np.stack([levels[len(distances) - 1 :: -1], levels[len(distances) + 1 :]])
    most, least = differences.max(axis=1), differences.min(axis=1)
    side_contrast = np.maximum(most, -least)
    contrast = np.maximum(np.minimum(*most), np.minimum(*-least))
    is_within = np.abs(differences, out=differences) < side_contrast[:, None] / 2
    width = _WIDTH_STEP * is_within.argmin(axis=1).sum(axis=0) + _WIDTH_STEP
    good = runs.filtered(lambda x: uniform_filter1d(x, 5), contrast) > parameters.min_contrast_gray
    good &= runs.filtered(lambda x: median_filter(x, 9), width) <= max_width
    good &= _turn_deg(smooth, runs) < parameters.max_turn_deg
    # A stretch is a run of good points of one piece.
    begins, stops = good.copy(), good.copy()
    begins[1:] &= ~good[:-1]
    stops[:-1] &= ~good[1:]
    begins[runs.starts] = good[runs.starts]
    stops[runs.ends - 1] = good[runs.ends - 1]
    stretches = zip(np.flatnonzero(begins), np.flatnonzero(stops) + 1, strict=True)
    return [_Piece(smooth[a:b], width[a:b]) for a, b in stretches if b - a >= _MIN_PIECE_PX]


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
        if step < 0:
            return np.maximum(at, np.repeat(self.starts, self.lengths))
        return np.minimum(at, np.repeat(self.ends - 1, self.lengths))

    def filtered(self, along: Callable[[Float], Float], values: Float) -> Float:
        """What a filter along the first axis, of a reach of at most _REACH, makes of each piece, its ends repeated."""
        return along(values[self._padded])[self._inner]

    @cached_property
    def _padded(self) -> Int:
        first = self.starts - np.arange(len(self.starts)) * 2 * _REACH
        at = np.arange(self.ends[-1] + 2 * _REACH * len(self.starts)) - _REACH
        longer = self.lengths + 2 * _REACH
        shift = np.repeat(first - self.starts, longer)
        return np.clip(at + shift, np.repeat(self.starts, longer), np.repeat(self.ends - 1, longer))

    @cached_property
    def _inner(self) -> Int:
        return np.arange(self.ends[-1]) + np.repeat((2 * np.arange(len(self.starts)) + 1) * _REACH, self.lengths)


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


def _sample(image: npt.NDArray[np.float32], x: Float, y: Float) -> npt.NDArray[np.float32]:
    return np.asarray(
        cv2.remap(image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def _linked(pieces: list[_Piece], max_gap: float, max_turn_deg: float) -> list[list[_Piece]]:
    """Chains of pieces: every end joins at most one other, the straightest and nearest continuation first."""
    if not pieces:
        return []
    ends = [(i, which) for i in range(len(pieces)) for which in (0, 1)]
    located = [pieces[i].end(which) for i, which in ends]
    position = np.array([p for p, _ in located])
    outward = np.array([d for _, d in located])
    owner = np.array([i for i, _ in ends])
    gap = position[None] - position[:, None]
    distance = np.linalg.norm(gap, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        towards = gap / distance[:, :, None]
    # Across a gap of a pixel or two its direction is noise: only the turn between the pieces counts.
    far = distance > 4.0
    turn = np.degrees(np.arccos(np.clip(-(outward @ outward.T), -1, 1)))
    leave = np.degrees(np.arccos(np.clip(np.where(far, (outward[:, None] * towards).sum(axis=2), 1.0), -1, 1)))
    worst = np.maximum(turn, np.maximum(leave, leave.T))
    short = 12.0
    limit = np.where(
        distance < short,
        max_turn_deg,
        max_turn_deg / 3 + 2 * max_turn_deg / 3 * short / np.maximum(distance, short),
    )
    cost = np.where(
        (owner[:, None] != owner[None]) & (distance < max_gap) & (worst < limit),
        distance / short + worst / max_turn_deg,
        np.inf,
    )
    joined: dict[int, int] = {}
    for flat in np.argsort(cost, axis=None, kind="stable"):
        a, b = divmod(int(flat), len(ends))
        if not np.isfinite(cost[a, b]):
            break
        if a not in joined and b not in joined:
            joined[a], joined[b] = b, a
    return _chains(pieces, joined)


def _chains(pieces: list[_Piece], joined: dict[int, int]) -> list[list[_Piece]]:
    done: set[int] = set()
    chains: list[list[_Piece]] = []
    # Free ends first; what is left after them is closed loops, which are cut anywhere.
    for start in sorted(range(2 * len(pieces)), key=lambda e: (e in joined, e)):
        entry: int | None = start
        chain: list[_Piece] = []
        while entry is not None and entry // 2 not in done:
            piece, which = divmod(entry, 2)
            done.add(piece)
            chain.append(pieces[piece] if which == 0 else _Piece(pieces[piece].points[::-1], pieces[piece].width[::-1]))
            entry = joined.get(2 * piece + 1 - which)
        if chain:
            chains.append(chain)
    return chains


def _centerline(chain: list[_Piece], reduction: int) -> Centerline:
    points = np.concatenate([piece.points for piece in chain])
    width = np.concatenate([piece.width for piece in chain])
    return Centerline((points + 0.5) * reduction - 0.5, width * reduction)
