"""The curve adjusted to both silhouettes: observe, fit one spline in space, expect, observe again."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from typing import Any, ClassVar

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import address, call
from needletrack.records import Appearance, Float, Image, Reason
from needletrack.tracking.axis import (
    FOUND,
    MOST_CONTROL,
    NOT_HELD,
    NOT_SEEN,
    OTHERS,
    Axis,
    D,
    I,
    Kept,
    P,
    Spline,
    axis_of,
    spline_of,
    two_eyes,
)
from needletrack.tracking.clipped import WHITE, WORTH_A_LOOK, Flanks, clipped_axis
from needletrack.tracking.evidence import FINE, HALF_WIDTHS, LIVELY, NEAR, WIDE, Grid, banks, no_needle_addresses
from needletrack.tracking.fit import CurveFit, CurveFitting, Ends, FitParameters, StreakObservation, Streaks
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import (
    DECIDING,
    AxisOffsets,
    as_look,
    diameter_mm,
    looks_of,
    make_wanted,
    no_bank_wanted,
)
from needletrack.tracking.silhouette import Looks as KernelLooks

Images = tuple[Image, Image]

# What the kernel says beside what `axis.py` names: banks have to be made first, those that it marked.
BANK_WANTED = OTHERS


class Expectation(IntEnum):
    """Where the axis is expected at first, as the kernels number it."""

    STAYED = 0
    PATH = 1
    MOVED = 2


@dataclass(frozen=True, slots=True)
class Looks:
    """How a curve is adjusted: how far the axis may be from where each look expects it, units across, on which grid.

    expectation: where the first look expects it: where the curve is, on the likeliest path, or moved as a whole.
    with_covariance: or the fit's covariance and residuals are NaN. looks_within: the needle's look is told from how it
    looks within so many units of where it is; None: anywhere on the grid.
    """

    spreads: tuple[float, ...]
    grid: Grid
    expectation: Expectation
    with_streak: bool = True
    with_covariance: bool = True
    looks_within: float | None = None


# At a rough curve; at one that was adjusted and then lengthened; at that of the pair before; at one that is settled.
ROUGH = Looks((0.7, 0.5, 0.4), WIDE, Expectation.PATH, with_streak=False)
GROWING = Looks((0.7, 0.4), WIDE, Expectation.PATH, with_streak=False, with_covariance=False, looks_within=1.75)
MOVED, SETTLED = Looks((0.7, 0.4, 0.2), FINE, Expectation.MOVED), Looks((0.4, 0.2), NEAR, Expectation.STAYED)


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The fitted curve, what both views showed of its points, and what the needle looks like.

    support (2, N): log Bayes factor, in each view, of a needle at the point over none there; shines (2, N): whether a
    streak of light shows it. flanks: what is left of a needle that is clipped, or None.
    """

    fit: CurveFit
    observed: tuple[AxisOffsets, AxisOffsets]
    appearance: Appearance
    support: Float
    shines: Mask
    flanks: Flanks | None = None


def adjust(
    images: Images,
    rig: StereoRig,
    points_mm: Float,
    needle: Needle,
    parameters: FitParameters,
    appearance: Appearance | None = None,
    *,
    looks: Looks = ROUGH,
    looks_the_same: bool = False,
    before_tip: tuple[Float, float] | None = None,
    ends: Ends = ((), ()),
    flanks: Flanks | None = None,
    bent_for_s: float | None = None,
) -> Adjusted:
    """The curve in space nearest to a nearly right one (N, 3), evenly spaced, that both views' silhouettes agree on.

    appearance: what the needle looked like before, or None; looks_the_same: it still does. before_tip: distance (N,)
    of the points from the apex and the length of its taper, mm, where the needle is thinner. flanks: of a needle that
    is clipped, as they were nearly. bent_for_s: the curve is that of so long ago. Raises NeedleNotFound where
    nothing holds a curve.
    """
    now = _Adjust.from_buffer_copy(adjusting(needle, parameters, looks))
    mine = Kept()
    count = len(points_mm)
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    now.points_mm, now.n, now.bent_for_s = mine.at(points), count, bent_for_s or 0.0
    now.near[:] = as_look(appearance).tolist()
    now.looks_the_same = appearance is not None and looks_the_same
    if before_tip is not None:
        now.before_tip_mm, now.taper_mm = mine.at(np.ascontiguousarray(before_tip[0])), before_tip[1]
    for view, seen in enumerate(ends):
        for end in seen:
            now.end_index[view], now.end_shift_px[view], now.end_sigma_px[view] = end.index, end.shift_px, end.sigma_px
    found = _Room(count)
    eyes = two_eyes(images, rig, mine)
    while (answer := call("adjust", now, eyes, found.record)) == BANK_WANTED and make_missing(
        needle, parameters, looks
    ):
        pass
    if answer in (NOT_SEEN, NOT_HELD):
        raise NeedleNotFound("fit", Reason.LOW_COVERAGE if answer == NOT_SEEN else Reason.HIGH_UNCERTAINTY)
    if answer != FOUND:
        raise MemoryError("there is no memory for the kernel that adjusts a curve")
    del mine
    adjusted = found.adjusted()
    if looks is not SETTLED or max(found.record.white_shares) < WORTH_A_LOOK:
        return adjusted
    seen_mm = diameter_mm(adjusted.appearance, needle)
    is_shaft = _is_shaft(points_mm, before_tip, needle)
    clipped = clipped_axis(
        images, rig, adjusted.fit.points_mm, adjusted.observed, list(found.expected_px), seen_mm, is_shaft, flanks
    )
    if clipped is None:
        return adjusted
    shown, observed = clipped
    fitting = CurveFitting(
        points_mm, rig, parameters, observed, streaks=found.streaks(), bent_for_s=bent_for_s, begun=adjusted.fit
    )
    fit = fitting.fit(observed, ends, parameters.systematic_px[adjusted.appearance.inside])
    return replace(adjusted, fit=fit, observed=observed, flanks=shown)


class _Adjust(ctypes.Structure):
    """What is known and wanted, as `adjust.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("axis", Axis),
        ("spline", Spline),
        ("looks", KernelLooks),
        ("banks", P),
        ("none_banks", P),
        ("wanted", P),
        ("systematic_px", P),
        ("deciding", I),
        ("lively_inside", I),
        ("white_share", D),
        ("expectation", I),
        ("with_streak", I),
        ("with_covariance", I),
        ("points_mm", P),
        ("n", I),
        ("near", I * 3),
        ("looks_the_same", I),
        ("before_tip_mm", P),
        ("taper_mm", D),
        ("bent_for_s", D),
        ("end_index", I * 2),
        ("end_shift_px", D * 2),
        ("end_sigma_px", D * 2),
    ]


class _Adjusted(ctypes.Structure):
    """What was found, as `adjust.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("control_mm", P),
        ("covariance_mm2", P),
        ("parameters", P),
        ("points_mm", P),
        ("residual_px", P),
        ("center_px", P),
        ("normal", P),
        ("offset_px", P),
        ("sigma_px", P),
        ("support", P),
        ("expected_px", P),
        ("streak_px", P),
        ("streak_sigma_px", P),
        ("px_per_unit", P),
        ("shines", P),
        ("control_count", I),
        ("look", I * 3),
        ("rms_px", D),
        ("streak_misfit", D),
        ("white_shares", D * 2),
    ]


class _Room:
    """Room for what is found of a curve of `count` points."""

    def __init__(self, count: int) -> None:
        self._control_mm, self._covariance_mm2 = np.empty((MOST_CONTROL, 3)), np.full(9 * MOST_CONTROL**2, np.nan)
        self._parameters, self._points_mm = np.empty(count), np.empty((count, 3))
        self._center_px, self._normal = np.empty((2, 2, count, 2))
        self._residual_px = np.full((2, count), np.nan)
        self._offset_px, self._sigma_px, self._support = np.empty((3, 2, count))
        self.expected_px, self._streak_px, self._streak_sigma_px, self._px_per_unit = np.empty((4, 2, count))
        self._shines = np.empty((2, count), np.bool_)
        self.record = _Adjusted(
            control_mm=address(self._control_mm),
            covariance_mm2=address(self._covariance_mm2),
            parameters=address(self._parameters),
            points_mm=address(self._points_mm),
            residual_px=address(self._residual_px),
            center_px=address(self._center_px),
            normal=address(self._normal),
            offset_px=address(self._offset_px),
            sigma_px=address(self._sigma_px),
            support=address(self._support),
            expected_px=address(self.expected_px),
            streak_px=address(self._streak_px),
            streak_sigma_px=address(self._streak_sigma_px),
            px_per_unit=address(self._px_per_unit),
            shines=address(self._shines),
        )

    @property
    def _appearance(self) -> Appearance:
        return Appearance(*self.record.look)

    def adjusted(self) -> Adjusted:
        """The room's content."""
        record = self.record
        size = 3 * int(record.control_count)
        fit = CurveFit(
            self._parameters,
            self._control_mm[: record.control_count],
            self._covariance_mm2[: size * size].reshape(size, size),
            self._points_mm,
            self._residual_px,
            float(record.rms_px),
            float(record.streak_misfit),
        )
        left, right = (
            AxisOffsets(*each)
            for each in zip(self._center_px, self._normal, self._offset_px, self._sigma_px, strict=True)
        )
        return Adjusted(fit, (left, right), self._appearance, self._support, self._shines)

    def streaks(self) -> Streaks:
        """The streaks of light that were found."""
        left, right = (
            StreakObservation(offset, sigma, float(HALF_WIDTHS[self._appearance.half_width] * np.median(scale)))
            if seen.any()
            else None
            for offset, sigma, scale, seen in zip(
                self._streak_px, self._streak_sigma_px, self._px_per_unit, self._shines, strict=True
            )
        )
        return left, right


def adjusting(needle: Needle, parameters: FitParameters, looks: Looks) -> ctypes.Structure:
    """What the kernels that adjust a curve know beforehand, which stays where it is."""
    return _template(needle, parameters, looks)[0]


def make_missing(needle: Needle, parameters: FitParameters, *looks: Looks) -> bool:
    """Make the banks that the kernels missed when they adjusted a curve by these looks; whether there were any."""
    made = [
        make_wanted(grid, wanted)
        for each in looks
        for grid, wanted in zip((WIDE, each.grid), _template(needle, parameters, each)[2], strict=True)
    ]
    return any(made)


@cache
def _template(needle: Needle, parameters: FitParameters, looks: Looks) -> tuple[_Adjust, Kept, tuple[Mask, Mask]]:
    """What does not change from curve to curve; the arrays that it points to; where it marks banks that are missed."""
    kept, wanted = Kept(), (no_bank_wanted(), no_bank_wanted())
    return (
        _Adjust(
            axis=axis_of(needle, looks.grid, looks.spreads, kept),
            spline=spline_of(parameters, kept),
            looks=looks_of(needle, looks.looks_within or float(looks.grid.shifts[-1]), wanted[0]),
            banks=kept.at(banks(looks.grid).addresses),
            none_banks=kept.at(no_needle_addresses()),
            wanted=kept.at(wanted[1]),
            systematic_px=kept.at(np.array(parameters.systematic_px)),
            deciding=DECIDING,
            lively_inside=LIVELY,
            white_share=WHITE,
            expectation=looks.expectation,
            with_streak=looks.with_streak,
            with_covariance=looks.with_covariance,
            end_index=(-1, -1),
        ),
        kept,
        wanted,
    )


def _is_shaft(points_mm: Float, before_tip: tuple[Float, float] | None, needle: Needle) -> Mask:
    """Where (N,) the needle has its full thickness; an end that has not been looked at may be a cone."""
    if before_tip is not None:
        # A round end begins its radius before the apex.
        return np.asarray(before_tip[0] > max(before_tip[1], needle.max_diameter_mm / 2))
    arc_mm = arc_length(points_mm)
    return np.asarray(arc_mm < arc_mm[-1] - max(needle.tip_tapers_mm))
