"""The curve adjusted to both silhouettes: observe, fit one spline in space, expect, observe again."""

from dataclasses import dataclass, replace

import numpy as np

from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Appearance, Float, Image, Int
from needletrack.tracking.clipped import WHITE, WORTH_A_LOOK, Flanks, clipped_axis, clipped_share
from needletrack.tracking.evidence import FINE, HALF_WIDTHS, LIVELY, NEAR, WIDE, Grid
from needletrack.tracking.fit import CurveFit, CurveFitting, Ends, FitParameters, StreakObservation
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import (
    AxisOffsets,
    Sections,
    axis_evidence,
    cut_sections,
    diameter_mm,
    estimate_appearance,
)
from needletrack.tracking.streak import Streak, find_streak

Images = tuple[Image, Image]


@dataclass(frozen=True, slots=True)
class Looks:
    """How a curve is adjusted: how far the axis may be from where each look expects it, units across, on which grid."""

    spreads: tuple[float, ...]
    grid: Grid
    with_streak: bool = True


# At a rough curve; at one that was adjusted and then lengthened; at that of the pair before; at one that is settled.
ROUGH, GROWING = Looks((0.7, 0.5, 0.4), WIDE, with_streak=False), Looks((0.7, 0.4), WIDE, with_streak=False)
MOVED, SETTLED = Looks((0.7, 0.4, 0.2), FINE), Looks((0.4, 0.2), NEAR)


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

    def part(self, start: int, stop: int) -> "Adjusted":
        """The points start <= i < stop alone."""
        fit = self.fit
        cut = slice(start, stop)
        left, right = self.observed
        return Adjusted(
            CurveFit(
                fit.parameters[cut],
                fit.control_mm,
                fit.covariance_mm2,
                fit.points_mm[cut],
                fit.residual_px[:, cut],
                fit.rms_px,
                fit.streak_misfit,
            ),
            (left.part(cut), right.part(cut)),
            self.appearance,
            self.support[:, cut],
            self.shines[:, cut],
            self.flanks,
        )


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
    cameras = ((rig.left, points_mm), (rig.right, rig.right_from_left.apply(points_mm)))
    sections = [
        cut_sections(image, camera, local, needle) for image, (camera, local) in zip(images, cameras, strict=True)
    ]
    if appearance is None or not looks_the_same:
        is_white = bool(clipped_share(images, rig, points_mm).min() > WHITE)
        appearance = estimate_appearance((sections[0], sections[1]), needle, appearance, looks.grid, is_white=is_white)
    half_widths = _half_widths(len(points_mm), appearance, before_tip)
    evidence = [axis_evidence(each, appearance, half_widths, looks.grid) for each in sections]
    if looks is SETTLED:
        expected: list[Float] = [np.zeros(len(points_mm))] * 2
    else:
        expected = [each.likeliest_motion_px() if looks is MOVED else each.likeliest_path_px() for each in evidence]
    streaks: list[Streak | None] = [None, None]
    if looks.with_streak and appearance.inside == LIVELY:
        streaks = [
            find_streak(each.values, _units(half_widths), at / each.px_per_unit)
            for each, at in zip(sections, expected, strict=True)
        ]
    shines = np.stack([np.zeros(len(points_mm), np.bool_) if each is None else each.seen for each in streaks])
    evidence = [replace(each, shines=led) for each, led in zip(evidence, shines, strict=True)]
    left_line, right_line = (
        None if streak is None else _line(streak, each, appearance)
        for each, streak in zip(sections, streaks, strict=True)
    )

    fitting = CurveFitting(
        points_mm,
        rig,
        parameters,
        (sections[0], sections[1]),
        streaks=(left_line, right_line),
        bent_for_s=bent_for_s,
    )

    def across(curve_mm: Float) -> list[Float]:
        return [
            ((px - each.center_px) * each.normal).sum(axis=1)
            for px, each in zip(rig.project(curve_mm), sections, strict=True)
        ]

    def look(at: list[Float], spread: float) -> tuple[tuple[AxisOffsets, AxisOffsets], Float]:
        left, right = (each.offsets(px, spread) for each, px in zip(evidence, at, strict=True))
        return (left[0], right[0]), np.stack([left[1], right[1]])

    systematic_px = parameters.systematic_px[appearance.inside]
    for spread in looks.spreads[:-1]:
        fitting.approach(look(expected, spread)[0], ends)
        expected = across(fitting.points_mm())
    observed, _ = look(expected, looks.spreads[-1])
    fit = fitting.fit(observed, ends, systematic_px)
    expected = across(fit.points_mm)
    _, support = look(expected, looks.spreads[-1])
    if looks is not SETTLED:
        return Adjusted(fit, observed, appearance, support, shines)
    is_shaft = _is_shaft(points_mm, before_tip, needle)
    if clipped_share(images, rig, fit.points_mm).max() < WORTH_A_LOOK:
        return Adjusted(fit, observed, appearance, support, shines)
    seen_mm = diameter_mm(appearance, needle)
    found = clipped_axis(images, rig, fit.points_mm, observed, expected, seen_mm, is_shaft, flanks)
    if found is None:
        return Adjusted(fit, observed, appearance, support, shines)
    shown, observed = found
    return Adjusted(fitting.fit(observed, ends, systematic_px), observed, appearance, support, shines, shown)


def _units(half_widths: Int) -> Float:
    return np.where(half_widths < 0, 0.0, HALF_WIDTHS[half_widths])


def _line(streak: Streak, sections: Sections, appearance: Appearance) -> StreakObservation:
    scale = sections.px_per_unit
    radius_px = float(HALF_WIDTHS[appearance.half_width] * np.median(scale))
    return StreakObservation(np.where(streak.seen, streak.offset, 0.0) * scale, streak.sigma * scale, radius_px)


def _is_shaft(points_mm: Float, before_tip: tuple[Float, float] | None, needle: Needle) -> Mask:
    """Where (N,) the needle has its full thickness; an end that has not been looked at may be a cone."""
    if before_tip is not None:
        # A round end begins its radius before the apex.
        return np.asarray(before_tip[0] > max(before_tip[1], needle.max_diameter_mm / 2))
    arc_mm = arc_length(points_mm)
    return np.asarray(arc_mm < arc_mm[-1] - max(needle.tip_tapers_mm))


def _half_widths(count: int, appearance: Appearance, before_tip: tuple[Float, float] | None) -> Int:
    """Index (N,) into HALF_WIDTHS at each point; -1 where the tip is thinner than all of them."""
    if before_tip is None:
        return np.full(count, appearance.half_width)
    share = np.clip(before_tip[0] / max(before_tip[1], 1e-6), 0.0, 1.0)
    widths = HALF_WIDTHS[appearance.half_width] * share
    return np.where(
        widths < HALF_WIDTHS[0], -1, np.abs(np.log(np.maximum(widths, 1e-6)[:, None] / HALF_WIDTHS)).argmin(axis=1)
    )
