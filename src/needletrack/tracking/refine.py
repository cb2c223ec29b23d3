"""From a rough curve to the needle: observe across it in both views, fit, follow it to its ends, find base and tip.

Works the same from a detection and from the previous track: it needs nothing but a curve that is nearly right.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import uniform_filter1d

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length, basis, resample, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float, Image, Reason
from needletrack.tracking.axis import AxisObservations, AxisParameters, observe_axis
from needletrack.tracking.ends import (
    TIP_BEFORE_MM,
    TIP_BEYOND_MM,
    EndsParameters,
    Observed,
    Stretch,
    TipFit,
    base_end,
    find_tip,
    needle_stretch,
)
from needletrack.tracking.fit import CurveFit, EndObservation, FitParameters, fit_curve
from needletrack.tracking.needle import Needle, Positive, Workspace

Images = tuple[Image, Image]

MIN_DEPTH_MM = 20.0
# How far behind a sleeve's edge the needle is looked for once more, for how long a stretch and how strong a line.
GOES_ON_FROM_MM, GOES_ON_TO_MM, GOES_ON_MM, GOES_ON_SHARE = 3.0, 16.0, 4.0, 0.6
# Lens blur and saturation show a needle wider than it is.
WIDTH_ALLOWANCE = 1.4
_SILHOUETTE_PERCENTILE = 65


class RefineParameters(BaseModel):
    """How the curve is sampled and followed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spacing_mm: Positive = Field(0.4, description="Spacing of the points of the published centerline, mm.")
    follow_spacing_mm: Positive = Field(
        0.8, description="Spacing of the cross sections while the needle is followed, mm."
    )
    reach_mm: Positive = Field(8.0, description="The curve is followed this far beyond its ends in one round, mm.")
    hold_mm: Positive = Field(
        1.0,
        description="On the way, a stretch that a view does not see stays about this near to the prediction, mm.",
    )
    settled_mm: Positive = Field(2.0, description="A round that lengthens the curve by less than this is the last, mm.")
    max_rounds: int = Field(
        15, ge=2, description="Rounds of observing and fitting after a detection, each of which may lengthen the curve."
    )
    max_tracking_rounds: int = Field(
        6, ge=2, description="Rounds from the track of the pair before; two suffice where the needle moved little."
    )


@dataclass(frozen=True, slots=True)
class RefineModels:
    """The parameters of the stages that refinement calls."""

    needle: Needle
    workspace: Workspace
    axis: AxisParameters
    fit: FitParameters
    ends: EndsParameters
    refine: RefineParameters


@dataclass(frozen=True, slots=True)
class Refined:
    """The needle's curve, base -> tip where base_is_known, and what it rests on.

    The points of `fit` and of `observed` correspond. tip_px holds the tip as the left and the right view alone place
    it, raw px (2, 2).
    """

    fit: CurveFit
    observed: Observed
    diameter_mm: float
    base_is_known: bool
    tip: TipFit
    tip_px: Float

    @property
    def tip_covariance_mm2(self) -> Float:
        """Covariance (3, 3) of the tip: across the needle that of the curve, along it that of the signal's end."""
        along = unit(self.fit.derivative(1)[-1])
        covariance = self.fit.point_covariance_mm2()[-1] + max(self.tip.sigma_mm) ** 2 * np.outer(along, along)
        return np.asarray((covariance + covariance.T) / 2)


def refine(
    images: Images,
    rig: StereoRig,
    points_mm: Float,
    models: RefineModels,
    *,
    is_track: bool = False,
    previous_base_mm: Float | None = None,
) -> Refined:
    """Follow the needle from a curve (N, 3) in space; raises NeedleNotFound where the views do not show it.

    is_track: the curve is the pair before's, and nearly right; otherwise it is a rough one. previous_base_mm (3,) tells
    base from tip where no sleeve is seen.
    """
    followed = _follow(images, rig, points_mm, models, is_track)
    extended, observed, stretch = followed.extended_mm, followed.observed, followed.stretch
    if stretch.sleeve is not None:
        base: int | None = 0 if stretch.sleeve.index == stretch.start else -1
    else:
        part = extended[stretch.start : stretch.stop]
        base = base_end(part, rig, models.workspace.entry_side, previous_base_mm)
    if base == -1:
        extended, observed = extended[::-1], (observed[0].turned(), observed[1].turned())
        stretch = Stretch(len(extended) - stretch.stop, len(extended) - stretch.start, stretch.sleeve)
    base_is_known = base is not None and not (
        stretch.sleeve is not None and _goes_on(images, rig, extended, observed, stretch, followed.diameter_mm, models)
    )
    arc = arc_length(extended)
    # What was followed coarsely is looked at closely where the tip is.
    spacing = models.refine.spacing_mm
    rough_end_mm = float(arc[stretch.stop - 1])
    near_mm = (max(0.0, rough_end_mm - TIP_BEFORE_MM), min(float(arc[-1]), rough_end_mm + TIP_BEYOND_MM))
    end = _cut(extended, *near_mm, spacing)
    end_observed = _observe(images, rig, end, followed.diameter_mm, models)
    end_arc = np.linspace(*near_mm, len(end))
    tip = find_tip(end_observed, end_arc, rough_end_mm, models.axis.smooth_along_mm, models.ends)
    if tip.at_mm - arc[stretch.start] < models.needle.min_length_mm / 2:
        raise NeedleNotFound("refine", Reason.TOO_SHORT)
    # The final curve ends at the tip itself; its last points are held by the taper's edges and the spline's stiffness.
    visible = _cut(extended, float(arc[stretch.start]), tip.at_mm, spacing)
    observed = _observe(images, rig, visible, followed.diameter_mm, models)
    left_end, right_end = (
        _tip_observation(view, each - tip.at_mm, sigma, spacing)
        for view, each, sigma in zip(observed, tip.each_mm, tip.sigma_mm, strict=True)
    )
    fit = fit_curve(visible, observed, rig, models.fit, ((left_end,), (right_end,)))
    tip_px = np.stack([_tip_px(view, end) for view, end in zip(observed, (left_end, right_end), strict=True)])
    seen_diameter_mm = _diameter_mm(observed, rig, visible)
    return Refined(fit, observed, seen_diameter_mm or followed.diameter_mm, base_is_known, tip, tip_px)


def _goes_on(
    images: Images,
    rig: StereoRig,
    extended_mm: Float,
    observed: Observed,
    stretch: Stretch,
    diameter_mm: float,
    models: RefineModels,
) -> bool:
    """Whether both views show the needle again behind what was taken for the sleeve: a dark rod may hide 6 mm of it.

    The base is at the start of the stretch. A sleeve is longer than what is looked at, and its highlights are fainter.
    """
    spacing = models.refine.follow_spacing_mm
    outwards = extended_mm[stretch.start : stretch.stop][::-1]
    skipped, count = (round(mm / spacing) for mm in (GOES_ON_FROM_MM, GOES_ON_TO_MM))
    behind = _observe(images, rig, _beyond(outwards, count, spacing)[skipped:], diameter_mm, models)
    shares = [
        view.signals_gray_px[1] / max(float(np.median(seen.signals_gray_px[1, stretch.start : stretch.stop])), 1e-6)
        for view, seen in zip(behind, observed, strict=True)
    ]
    shown = np.min(shares, axis=0) > GOES_ON_SHARE
    return bool(uniform_filter1d(shown.astype(np.float64), round(GOES_ON_MM / spacing), mode="constant").max() > 0.999)


def _tip_observation(view: AxisObservations, ahead_mm: float, sigma_mm: float, spacing_mm: float) -> EndObservation:
    px_per_mm = float(np.linalg.norm(view.center_px[-1] - view.center_px[-2])) / spacing_mm
    return EndObservation(len(view.center_px) - 1, ahead_mm * px_per_mm, max(0.5, sigma_mm * px_per_mm))


def _tip_px(view: AxisObservations, end: EndObservation) -> Float:
    normal = view.normal[-1]
    along = np.array([normal[1], -normal[0]])
    return np.asarray(view.center_px[-1] + view.offset_px[-1] * normal + end.shift_px * along)


@dataclass(frozen=True, slots=True)
class _Followed:
    """A curve that runs on past both ends of the needle, what the views show across it, and the needle's part of it."""

    extended_mm: Float
    observed: Observed
    stretch: Stretch
    diameter_mm: float


def _follow(images: Images, rig: StereoRig, points_mm: Float, models: RefineModels, is_track: bool) -> _Followed:
    """Observe, and fit and lengthen, until the needle's part grows no more.

    A detected curve needs two fits to settle. The track of the pair before needs one, and is done with as soon as it
    has its length again: where the needle has moved sideways, its far end comes into reach round by round.
    """
    max_rounds = models.refine.max_tracking_rounds if is_track else models.refine.max_rounds
    min_rounds = 2 if is_track else 3
    needed_mm = float(arc_length(points_mm)[-1]) if is_track else np.inf
    spacing = models.refine.follow_spacing_mm
    points, longest_mm = points_mm, 0.0
    diameter_mm: float | None = None
    for remaining in reversed(range(max_rounds)):
        extended, observed = _observe_extended(images, rig, points, diameter_mm, models)
        stretch = needle_stretch(observed, spacing, models.ends)
        start, stop = stretch.start, stretch.stop
        part = (observed[0].part(start, stop), observed[1].part(start, stop))
        diameter_mm = _diameter_mm(part, rig, extended[start:stop])
        length_mm = (stop - start) * spacing
        if diameter_mm is None or length_mm < models.needle.min_length_mm / 2:
            raise NeedleNotFound("refine", Reason.LOW_COVERAGE)
        if length_mm > 2 * models.needle.max_length_mm:
            raise NeedleNotFound("refine", Reason.TOO_LONG)
        grows = length_mm > longest_mm + models.refine.settled_mm
        is_whole = length_mm > needed_mm - models.refine.settled_mm
        if remaining == 0 or (max_rounds - remaining >= min_rounds and (is_whole or not grows)):
            return _Followed(extended, observed, stretch, diameter_mm)
        longest_mm = max(longest_mm, length_mm)
        fit = fit_curve(extended[start:stop], part, rig, models.fit, hold_mm=models.refine.hold_mm)
        points = _sampled(fit, spacing)
        if arc_length(points)[-1] < models.needle.min_length_mm / 2:
            raise NeedleNotFound("refine", Reason.TOO_SHORT)
    raise ValueError("max_rounds must be one or more")


def _observe_extended(
    images: Images, rig: StereoRig, points_mm: Float, diameter_mm: float | None, models: RefineModels
) -> tuple[Float, Observed]:
    extended = _extended(points_mm, models.refine.reach_mm, models.refine.follow_spacing_mm)
    return extended, _observe(images, rig, extended, diameter_mm, models)


def _observe(
    images: Images, rig: StereoRig, points_mm: Float, diameter_mm: float | None, models: RefineModels
) -> Observed:
    return (
        _observe_one(images[0], rig.left, points_mm, diameter_mm, models),
        _observe_one(images[1], rig.right, rig.right_from_left.apply(points_mm), diameter_mm, models),
    )


def _observe_one(
    image: Image, camera: Camera, local_mm: Float, diameter_mm: float | None, models: RefineModels
) -> AxisObservations:
    if local_mm[:, 2].min() < MIN_DEPTH_MM:
        raise NeedleNotFound("refine", Reason.OUTSIDE_WORKSPACE)
    px_per_mm = camera.focal_px / local_mm[:, 2]
    max_width_px = float(models.needle.max_diameter_mm * px_per_mm.max()) * WIDTH_ALLOWANCE
    # A diameter out of range is told by the gates; expecting it here would follow ever wider things.
    expected = (
        None if diameter_mm is None else min(diameter_mm, models.needle.max_diameter_mm * WIDTH_ALLOWANCE) * px_per_mm
    )
    return observe_axis(image, camera, local_mm, max_width_px, expected, models.axis)


def _diameter_mm(observed: Observed, rig: StereoRig, points_mm: Float) -> float | None:
    depth = (points_mm[:, 2], rig.right_from_left.apply(points_mm)[:, 2])
    focal = (rig.left.focal_px, rig.right.focal_px)
    widths = np.concatenate([view.width_px * z / f for view, z, f in zip(observed, depth, focal, strict=True)])
    # Streaks show less than the needle's width, clutter more: an upper quartile is the silhouette's.
    return float(np.nanpercentile(widths, _SILHOUETTE_PERCENTILE)) if np.isfinite(widths).any() else None


def _sampled(fit: CurveFit, spacing_mm: float) -> Float:
    dense = basis(np.linspace(0, 1, 4 * len(fit.points_mm)), len(fit.control_mm)) @ fit.control_mm
    return resample(dense, max(8, round(float(arc_length(dense)[-1]) / spacing_mm) + 1))


def _extended(points_mm: Float, reach_mm: float, spacing_mm: float) -> Float:
    """The curve, evenly spaced, and beyond both ends as a parabola whose bend is that of the last stretch."""
    count = max(8, round(float(arc_length(points_mm)[-1]) / spacing_mm) + 1)
    even = resample(points_mm, count)
    n = round(reach_mm / spacing_mm)
    return np.concatenate([_beyond(even[::-1], n, spacing_mm)[::-1], even, _beyond(even, n, spacing_mm)])


def _beyond(points_mm: Float, count: int, spacing_mm: float) -> Float:
    stretch = points_mm[-min(len(points_mm), round(12.0 / spacing_mm)) :]
    s = arc_length(stretch) - arc_length(stretch)[-1]
    design = np.column_stack([s, s**2])
    slope, bend = np.linalg.lstsq(design, stretch - stretch[-1], rcond=None)[0]
    ahead = np.arange(1, count + 1) * spacing_mm
    direction = unit(slope)
    # An extrapolated bend is a guess: half of it is right for an arc and harmless for a straight end.
    return np.asarray(stretch[-1] + ahead[:, None] * direction + 0.5 * (ahead**2)[:, None] * bend)


def _cut(points_mm: Float, start_mm: float, stop_mm: float, spacing_mm: float) -> Float:
    arc = arc_length(points_mm)
    at = np.linspace(start_mm, stop_mm, max(8, round((stop_mm - start_mm) / spacing_mm) + 1))
    return np.column_stack([np.interp(at, arc, column) for column in points_mm.T])
