"""From masks of thin structures to ordered lines, followed through crossings and short gaps by their direction."""

import ctypes
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.spline import arc_length
from needletrack.kernels import call
from needletrack.records import Centerline, Float, Int
from needletrack.tracking.needle import Positive
from needletrack.tracking.segment import Gray, Mask, Ridges

# Shorter pieces have no direction that could be continued; reduced px.
_MIN_PIECE_PX = 6
_END_PX = 10
# A corner is a turn within so many pixels to either side.
_CORNER_PX = 6
_WIDTH_STEP = 0.5
# Gaps from four pixels on; places are means of five whole pixels, so that distances of just 4 are common.
_FAR_PX = 3.997
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
    (bright, bright_ends), (dark, dark_ends) = (_skeleton_pieces(mask) for mask in (ridges.bright, ridges.dark))
    pixels, ends = np.concatenate([bright, dark]), np.concatenate([bright_ends, dark_ends + len(bright)])
    pieces = _two_sided(pixels, ends, ridges.reduced, reach, parameters)
    chains = _linked(pieces, parameters.max_gap_mm * px_per_mm / ridges.reduction, parameters.max_turn_deg)
    return _centerlines(pieces, chains, ridges.reduction)


def _skeleton_pieces(mask: Mask) -> tuple[Float, Int]:
    """The unbranched stretches of a mask's skeleton: reduced pixels (N, 2), in order along each up to its end (P,)."""
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
    return points[: ends[count - 1] if count else 0], ends[:count]


class _TwoSided(ctypes.Structure):
    """What a stretch must be, as the kernel takes it."""

    _fields_: ClassVar = [
        ("step", ctypes.c_double),
        ("max_width", ctypes.c_double),
        ("min_contrast", ctypes.c_double),
        ("max_turn_rad", ctypes.c_double),
        ("steps", ctypes.c_int64),
        ("corner", ctypes.c_int64),
        ("shortest", ctypes.c_int64),
    ]


def _two_sided(pixels: Float, ends: Int, image: Gray, max_width: float, parameters: CenterlineParameters) -> _Pieces:
    """The stretches of pieces that differ from both sides: an edge of something wide differs from one only.

    They end at corners too, where a skeleton goes over from the needle to the edge of its sleeve.
    """
    steps = math.ceil((max_width + 2.0) / _WIDTH_STEP) - 1
    wanted = _TwoSided(
        _WIDTH_STEP,
        max_width,
        parameters.min_contrast_gray,
        math.radians(parameters.max_turn_deg),
        steps,
        _CORNER_PX,
        _MIN_PIECE_PX,
    )
    points, width = np.empty_like(pixels), np.empty(len(pixels))
    starts, stops = np.empty(len(pixels), np.int64), np.empty(len(pixels), np.int64)
    count = call(
        "two_sided",
        image,
        *image.shape,
        np.ascontiguousarray(pixels),
        ends,
        len(ends),
        wanted,
        np.empty(steps, np.float32),
        np.empty(len(pixels)),
        points,
        width,
        starts,
        stops,
    )
    return _Pieces(points, width, starts[:count], stops[:count])


_Chain = list[tuple[int, bool]]


def _linked(pieces: _Pieces, max_gap: float, max_turn_deg: float) -> list[_Chain]:
    """Chains of pieces, and whether each is taken from its last end.

    Every end joins at most one other, the straightest and nearest continuation first.
    """
    position, outward = pieces.ends()
    x, y = position.T
    a, b = np.nonzero((x - x[:, None]) ** 2 + (y - y[:, None]) ** 2 < max_gap**2)
    of_two = a // 2 < b // 2
    a, b = a[of_two], b[of_two]
    towards = position[b] - position[a]
    distance = np.linalg.norm(towards, axis=1)
    towards /= np.maximum(distance, 1e-9)[:, None]
    # Across a gap of a pixel or two its direction is noise: only the turn between the pieces counts.
    far = distance > _FAR_PX
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
