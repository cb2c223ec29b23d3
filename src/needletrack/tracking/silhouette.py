"""What each view says about the needle's axis across a curve that is nearly right, its inside left out of account.

The image is straightened along the projected curve and averaged over short sections of the needle; for each the
evidence (`evidence.py`) tells how likely the axis is at each offset, given the width that diameter and depth imply.
Diameter, blur of the lens and liveliness of the inside are the same all along the needle and are found first.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from needletrack.geometry.camera import Camera
from needletrack.kernels import address, call
from needletrack.records import Appearance, Float, Image, Int
from needletrack.tracking.evidence import (
    BLURS,
    DULL,
    HALF_WIDTHS,
    LIVELY,
    OFFSETS,
    UNITS_PER_MAX_DIAMETER,
    WIDE,
    Float32,
    Grid,
    banks,
    log_evidence_by_background,
    log_evidence_of_no_needle,
    no_needle_addresses,
    over_none,
    products,
)
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import Mask

# A section is the mean of so many rows across the needle, about a pixel apart.
ROWS_PER_SECTION = 5
# The unit in which a section is measured: its noise, and what the model leaves out, which is at least so many greys.
LEAST_UNIT_GRAY = 1.0
UNIT_PER_NOISE = 0.7
# Log Bayes factor of a needle over none from which on a section has a say.
USED = 2.0
# A section may be of something else altogether, at this log density.
LOG_OUTLIER = -12.0
OUTLIER = float(np.exp(LOG_OUTLIER))
LOG_NEVER = -1e4
# Log odds against the axis turning aside from a nearly right curve, per unit.
TURN_PRICE = 6.0
# Differences between the motions of the two ends that are tried, units; log odds against a motion, per unit squared.
DRIFTS = np.linspace(-4.0, 4.0, 17)
MOTION_PRICE = 1.0
# What is not noise, such as the interpolation between pixels: an axis point is no better than this, units.
LEAST_SIGMA = 0.03
# What lies about the needle before clutter misleads neighbouring sections alike: together they are worth fewer of them.
CLUTTERED = 2.0
# A section that narrows the expectation by less than this share tells nothing.
LEAST_GAIN = 0.3
# So many sections of each view decide on the appearance; a section has at most so much of a say.
DECIDING = 16
# An inside is lively where this share of sections says so, by this much each, and the others do not deny it: where
# nothing shines, a dull one is likelier by two or more.
_LIVELY_SHARE, _LIVELY_SAY, _DULL_SAY = 0.05, 4.0, -1.5
_MOST_SAY = 40.0
# Blurs of lenses in and nearly in focus, px; diameters are looked for a little beyond those in use: saturation widens.
_BLURS_PX = (0.45, 1.1)
_BLURS = np.array(BLURS)
_DIAMETER_MARGIN = (0.9, 1.3)


@dataclass(frozen=True, slots=True)
class Sections:
    """Cross sections of one view, one about each point of a curve.

    center_px, normal (N, 2), raw px; values (N, len(OFFSETS)) grey levels in units of their noise; px_per_unit (N,)
    length of a unit across (`evidence.py`); inside (N,) whether the point is in the image.
    """

    center_px: Float
    normal: Float
    values: Float
    px_per_unit: Float
    inside: Mask


@dataclass(frozen=True, slots=True)
class AxisOffsets:
    """Where one view places the axis across a curve of N points.

    center_px, normal (N, 2): where each cross section was taken and its direction, raw px; offset_px (N,) of the axis
    along the normal, with sigma_px (N,), infinite where the needle is not seen.
    """

    center_px: Float
    normal: Float
    offset_px: Float
    sigma_px: Float

    @property
    def seen(self) -> Mask:
        """Where the view shows the needle, (N,) bool."""
        return np.isfinite(self.sigma_px)


def unit_mm(needle: Needle) -> float:
    """Length across the needle of one unit of `evidence.py`, mm."""
    return needle.max_diameter_mm / UNITS_PER_MAX_DIAMETER


def diameter_mm(appearance: Appearance, needle: Needle) -> float:
    """The needle's diameter, as wide as it looks, mm."""
    return float(2 * HALF_WIDTHS[appearance.half_width] * unit_mm(needle))


def cut_sections(image: Image, camera: Camera, local_mm: Float, needle: Needle) -> Sections:
    """The sections across a curve (N, 3) in this camera's frame, evenly spaced, one about each point."""
    local = np.ascontiguousarray(local_mm)
    count, columns = len(local), len(OFFSETS)
    center, normal = np.empty((count, 2)), np.empty((count, 2))
    values, scale, inside = np.empty((count, columns)), np.empty(count), np.empty(count, np.bool_)
    call(
        "cut_sections",
        *rows_of(image),
        camera.lens,
        local,
        count,
        ROWS_PER_SECTION,
        OFFSETS,
        columns,
        unit_mm(needle),
        LEAST_UNIT_GRAY,
        UNIT_PER_NOISE,
        np.empty(ROWS_PER_SECTION * count * (7 + columns)),
        center,
        normal,
        values,
        scale,
        inside,
    )
    return Sections(center, normal, values, scale, inside)


def straightened(image: Image, camera: Camera, local_mm: Float, offsets: Float, needle: Needle) -> Float:
    """Grey levels (N, len(offsets)) across a curve (N, 3) in this camera's frame; offsets in units (`evidence.py`)."""
    local = np.ascontiguousarray(local_mm)
    gray = np.empty((len(local), len(offsets)), np.float32)
    pixels, normal = np.empty((2, len(local), 2))
    call(
        "straighten",
        *rows_of(image),
        camera.lens,
        local,
        len(local),
        offsets,
        len(offsets),
        unit_mm(needle),
        pixels,
        normal,
        gray,
    )
    return gray.astype(np.float64)


def rows_of(image: Image) -> tuple[Image, int, int, int]:
    """An image as the kernels take it: its bytes, rows, columns, and bytes from row to row."""
    contiguous = np.ascontiguousarray(image)
    return contiguous, *contiguous.shape, contiguous.shape[1]


def _looks(needle: Needle, px_per_unit: float) -> tuple[list[int], list[int]]:
    """The half widths and the blurs, as indices, that a needle may have where it is seen so large."""
    low, high = (
        margin * d / 2 / unit_mm(needle)
        for margin, d in zip(_DIAMETER_MARGIN, (needle.min_diameter_mm, needle.max_diameter_mm), strict=True)
    )
    widths = [i for i, w in enumerate(HALF_WIDTHS) if low <= w <= high]
    blurs = [i for i, b in enumerate(BLURS) if _BLURS_PX[0] <= b * px_per_unit <= _BLURS_PX[1]] or [len(BLURS) - 1]
    return widths, blurs


def make_banks(needle: Needle, px_per_unit: float) -> None:
    """Make what every look of a needle is tried with: a fifth of a second, which no pair should wait for."""
    widths, blurs = _looks(needle, px_per_unit)
    no_needle_addresses()
    for blur in blurs:
        for width in widths:
            for inside in (DULL, LIVELY):
                banks(WIDE).bank(inside, blur, width)


class Looks(ctypes.Structure):
    """What a needle may look like, as `adjust.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("banks", ctypes.c_void_p),
        ("wanted", ctypes.c_void_p),
        ("blurs", ctypes.c_int64),
        ("widths", ctypes.c_int64),
        ("first_width", ctypes.c_int64),
        ("last_width", ctypes.c_int64),
        ("samples", ctypes.c_int64),
        ("places", ctypes.c_int64),
        ("reached", ctypes.c_int64),
        ("blur_units", ctypes.c_void_p),
        ("blur_low_px", ctypes.c_double),
        ("blur_high_px", ctypes.c_double),
        ("most_say", ctypes.c_double),
        ("lively_share", ctypes.c_double),
        ("lively_say", ctypes.c_double),
        ("dull_say", ctypes.c_double),
    ]


def looks_of(needle: Needle, reach: float, wanted: Mask) -> Looks:
    """What a needle may look like whose axis is at most so far away, units.

    The coarse grid tells looks apart as well as a fine one does, and one set of banks is less to make. wanted (insides,
    BLURS, HALF_WIDTHS): where the kernel marks the banks that it missed; the caller keeps it.
    """
    widths, _ = _looks(needle, 1.0)
    return Looks(
        banks=address(banks(WIDE).addresses),
        wanted=address(wanted),
        blurs=len(BLURS),
        widths=len(HALF_WIDTHS),
        first_width=widths[0],
        last_width=widths[-1] + 1,
        samples=len(OFFSETS),
        places=WIDE.reach + 1,
        reached=int((np.abs(WIDE.shifts) <= reach).sum()) // 2,
        blur_units=address(_BLURS),
        blur_low_px=_BLURS_PX[0],
        blur_high_px=_BLURS_PX[1],
        most_say=_MOST_SAY,
        lively_share=_LIVELY_SHARE,
        lively_say=_LIVELY_SAY,
        dull_say=_DULL_SAY,
    )


def no_bank_wanted() -> Mask:
    """Where a kernel marks the banks of a grid that it missed, (insides, BLURS, HALF_WIDTHS)."""
    return np.zeros(banks(WIDE).addresses.shape, np.bool_)


def make_wanted(grid: Grid, wanted: Mask) -> bool:
    """Make the banks of a grid that a kernel missed; whether there are any."""
    missed = np.argwhere(wanted).tolist()
    for inside, blur, width in missed:
        banks(grid).bank(inside, blur, width)
    wanted[:] = False
    return bool(missed)


def estimate_appearance(
    views: tuple[Sections, Sections], needle: Needle, near: Appearance | None, grid: Grid, *, is_white: bool = False
) -> Appearance:
    """Diameter, blur and inside under which the sections of both views are likeliest; `near`: what they were before.

    The axis may be as far away as the grid reaches. A white needle that saturates is dull, though its profile is cut
    off. `adjust` does the same to the sections that it cuts.
    """
    decisive = [np.arange(DECIDING) * (len(v.values) - 1) // (DECIDING - 1) for v in views]
    picked = [view.values[np.unique(at)] for view, at in zip(views, decisive, strict=True)]
    shown = products(np.concatenate(picked))
    px_per_unit = float(np.median(np.concatenate([view.px_per_unit for view in views])))
    wanted = no_bank_wanted()
    looks = looks_of(needle, float(grid.shifts[-1]), wanted)
    found = as_look(near)
    while call("appearance_of", looks, shown, len(shown), px_per_unit, 1 if is_white else 2, found):
        if not make_wanted(WIDE, wanted):
            raise MemoryError("there is no memory for the kernel that tells what a needle looks like")
    return Appearance(*found.tolist())


def as_look(appearance: Appearance | None) -> Int:
    """Half width, blur and inside (3,), as the kernels take them."""
    if appearance is None:
        return np.full(3, -1)
    return np.array([appearance.half_width, appearance.blur, appearance.inside])


@dataclass(frozen=True, eq=False)
class AxisEvidence:
    """One view's sections with the log evidence (N, S) of the axis in each, over that of no needle there.

    cluttered (N,): where it is seen before a background that is not even. shines (N,): where a streak of light shows
    its way as well.
    """

    sections: Sections
    log_evidence: Float
    cluttered: Mask
    grid: Grid
    shines: Mask

    def offsets(self, expected_px: Float, spread: float) -> tuple[AxisOffsets, Float]:
        """The axis where it is expected at expected_px (N,), give or take spread units.

        And the log Bayes factor (N,) of a needle there over none.

        Moments of evidence times expectation, with the expectation taken out again (expectation propagation, Minka
        2001): of several places that the evidence allows, the one that is expected counts. sigma is infinite where the
        section adds nothing.
        """
        count, grid, sections = len(self.log_evidence), self.grid, self.sections
        most, relative, likelihood = self._prepared
        offset, sigma, support = np.empty((3, count))
        call(
            "sites",
            most,
            relative,
            likelihood,
            count,
            float(grid.shifts[0]),
            float(grid.shifts[1] - grid.shifts[0]),
            len(grid.shifts),
            float(grid.fine_shifts[1] - grid.fine_shifts[0]),
            len(grid.fine_shifts),
            np.ascontiguousarray(expected_px),
            spread,
            sections.px_per_unit,
            sections.inside,
            self.cluttered & self.shines,
            LEAST_GAIN,
            LEAST_SIGMA,
            USED,
            CLUTTERED,
            offset,
            sigma,
            support,
        )
        return AxisOffsets(sections.center_px, sections.normal, offset, sigma), support

    def likeliest_path_px(self) -> Float:
        """Offsets (N,) px of the likeliest axis from end to end, which may turn aside, at a price (Viterbi 1967)."""
        shifts = self.grid.shifts
        path = likeliest_path(self._floored, TURN_PRICE * float(shifts[1] - shifts[0]))
        return np.asarray(shifts[path] * self.sections.px_per_unit)

    def likeliest_motion_px(self) -> Float:
        """Offsets (N,) px of the likeliest axis that moved as a whole: alike everywhere, or ever more to one end."""
        log, shifts = self._floored, self.grid.shifts
        moved = np.empty(len(log))
        step = float(shifts[1] - shifts[0])
        call(
            "best_motion",
            log,
            len(log),
            len(shifts),
            DRIFTS,
            len(DRIFTS),
            step,
            MOTION_PRICE,
            LOG_OUTLIER,
            moved,
        )
        return np.asarray(moved * self.sections.px_per_unit)

    @property
    def _floored(self) -> Float:
        """The log evidence (N, S) over its most; a section may be of something else altogether."""
        most, _, _ = self._prepared
        return np.maximum(self.log_evidence - most[:, None], LOG_OUTLIER)

    @cached_property
    def _prepared(self) -> tuple[Float, Float32, Float32]:
        """The most log evidence (N,) of each section; the evidence (N, S) over that; and at finer shifts (N, F)."""
        grid, (count, places) = self.grid, self.log_evidence.shape
        most = np.empty(count)
        relative = np.empty((count, places), np.float32)
        likelihood = np.empty((count, len(grid.fine_shifts)), np.float32)
        call(
            "prepared",
            self.log_evidence,
            count,
            places,
            grid.refine,
            len(grid.fine_shifts),
            LOG_NEVER,
            OUTLIER,
            most,
            relative,
            likelihood,
        )
        return most, relative, likelihood


def likeliest_path(worth: Float, turn_price: float) -> Int:
    """Columns (N,) of the path through (N, places) worth most; each place aside has its price (Viterbi 1967)."""
    total = np.array(worth, order="C")
    path = np.empty(len(total), np.int64)
    call("best_path", total, *total.shape, turn_price, path)
    return path


def axis_evidence(sections: Sections, appearance: Appearance, half_widths: Int, grid: Grid) -> AxisEvidence:
    """The evidence of sections whose half widths (N,), as indices into HALF_WIDTHS, differ; -1: too thin to say."""
    log = np.full((len(sections.values), len(grid.shifts)), -np.inf)
    cluttered = np.zeros(len(log), dtype=np.bool_)
    shown = products(sections.values)
    none = log_evidence_of_no_needle(shown, appearance.blur)
    for width in np.unique(half_widths[half_widths >= 0]):
        rows = half_widths == width
        each = Appearance(int(width), appearance.blur, appearance.inside)
        log[rows], cluttered[rows] = over_none(log_evidence_by_background(shown[rows], each, grid), none[rows])
    return AxisEvidence(sections, log, cluttered, grid, np.zeros(len(log), dtype=np.bool_))
