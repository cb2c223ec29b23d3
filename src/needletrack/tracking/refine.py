"""From a rough curve to the needle: observe across it in both views, fit, follow it to its ends, find base and tip.

Works the same from a detection and from the previous track: it needs nothing but a curve that is nearly right.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import uniform_filter1d

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length, cut, resample, spline_basis, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.kernels import call
from needletrack.records import Appearance, Float, NeedleTrack, Reason
from needletrack.tracking.adjust import MOVED, SETTLED, Adjusted, Images, adjust
from needletrack.tracking.beside import Beside, BesideParameters, line_height_gray, look_beside, sides_gray
from needletrack.tracking.ends import (
    TIP_BEFORE_MM,
    TIP_BEYOND_MM,
    EndsParameters,
    Observed,
    Stretch,
    base_end,
    is_crossed,
    needle_stretch,
)
from needletrack.tracking.fit import CurveFit, EndObservation, Ends, FitParameters
from needletrack.tracking.glance import (
    ADVANCE_SIGMA_MM_S,
    BEYOND_END_MM,
    MIN_DEPTH_MM,
    MOST_ADVANCE_MM,
    MOST_LOOKS,
    PARABOLA_MM,
    TIP_REACH_MM,
    TIP_ROUNDS,
    GlanceParameters,
    Steady,
    glance,
)
from needletrack.tracking.grow import Growth, grow
from needletrack.tracking.motion import foreseen_mm, moves_mm
from needletrack.tracking.needle import Needle, Positive, Workspace
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import AxisOffsets, diameter_mm
from needletrack.tracking.tip import (
    BEFORE_MM,
    BEYOND_MM,
    ROW_MM,
    TRIED_MM,
    TipFit,
    TipParameters,
    find_tip,
)

# How far behind a sleeve's edge the needle is looked for once more, for how long a stretch and how strong a line.
GOES_ON_FROM_MM, GOES_ON_TO_MM, GOES_ON_MM, GOES_ON_SHARE = 3.0, 16.0, 4.0, 0.6
# The sides of a sleeve are looked for so far behind its edge. Of 140 sleeves three sides showed by 14 grey levels or
# more, of eight ends of rods and other streaks by 1.4 at most.
_SLEEVE_SIDES_MM = (1.0, 8.0)
# Lens blur and saturation show a needle wider than it is.
WIDTH_ALLOWANCE = 1.4
# No single section has more of a say than these log odds.
_MOST_ODDS = 30.0
# And once more where it was not within this of the end of the curve.
_TIP_MOVED_MM = 0.3
# Where a line is looked for beyond the tip: its blur, and the error of a tip that was found, end before.
_BEYOND_MM, _BEYOND_STEP_MM = (1.5, 6.5), 0.5
# A needle that comes so far aside from pair to pair does not come just as far as the time before.
_ROUGHLY_FIRST_MM = 0.2
# Images without stamps are of a sequence as fast as cameras are.
_USUAL_S = 1 / 30
# Weaknesses of a track that is followed nevertheless: its shape is that of the needle, to its end.
_STEADY_DESPITE = {Reason.TIP_DISAGREES, Reason.HIGH_UNCERTAINTY}


class RefineParameters(BaseModel):
    """How the curve is sampled and followed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spacing_mm: Positive = Field(1.0, description="Spacing of the points of the published centerline, mm.")
    reach_mm: Positive = Field(5.0, description="The curve is followed this far beyond its ends in one round, mm.")
    bend_reach_mm: Positive = Field(
        2.5, description="And once, where it ends, only this far: it may bend more than was foreseen, mm."
    )
    gap_reach_mm: Positive = Field(11.0, description="And once, where it ends, this far, across a gap, mm.")
    settled_mm: Positive = Field(2.0, description="A round that lengthens the curve by less than this is the last, mm.")
    max_rounds: int = Field(15, ge=2, description="Rounds of adjusting, each of which may lengthen the curve.")
    shown_log_odds: Positive = Field(
        3.0, description="Log odds of a needle over none from which on a view shows it at a place."
    )
    shown_share: Positive = Field(0.42, description="The curve goes on where so many places of both views show it ...")
    shown_over_mm: Positive = Field(5.0, description="... over this length, mm.")
    sleeve_reach_mm: Positive = Field(12.0, description="The sleeve is looked for this far beyond the ends, mm.")


@dataclass(frozen=True, slots=True)
class RefineModels:
    """The parameters of the stages that refinement calls."""

    needle: Needle
    workspace: Workspace
    beside: BesideParameters
    fit: FitParameters
    ends: EndsParameters
    tip: TipParameters
    refine: RefineParameters


@dataclass(frozen=True, eq=False)
class Refined:
    """The needle's curve, base -> tip where base_is_known, and what it rests on.

    tip_px holds the tip as the left and the right view alone place
    it, raw px (2, 2); tip_is_free is false where something crosses there, behind which the needle may go on. log_odds:
    of such a needle over none, both views together; no single section has more than its say. shown (2, N): where each
    view shows the needle, by its silhouette or by the streak of light on it. calibration_mm2 (N, 3, 3): what the
    calibration leaves open at each point, where that is known.
    """

    fit: CurveFit
    shown: Mask
    appearance: Appearance
    diameter_mm: float
    base_is_known: bool
    tip: TipFit
    tip_is_free: bool
    tip_px: Float
    log_odds: float
    calibration_mm2: Float | None = None

    @property
    def tip_covariance_mm2(self) -> Float:
        """Covariance (3, 3) of the tip: across the needle that of the curve, along it that of the end's picture."""
        return self._of_tip[0]

    @property
    def tip_sigma_mm(self) -> float:
        """The tip's largest standard deviation in any direction, mm."""
        return self._of_tip[1]

    @cached_property
    def _of_tip(self) -> tuple[Float, float]:
        at_tip = spline_basis(self.fit.parameters[-1:], len(self.fit.control_mm), derivative=1)
        along = unit(at_tip.curve(self.fit.control_mm)[0])
        (left, right), (left_sigma, right_sigma) = self.tip.each_mm, self.tip.sigma_mm
        along_mm2 = 1 / (left_sigma**-2 + right_sigma**-2) + ((left - right) / 2) ** 2
        covariance_mm2 = np.empty((3, 3))
        of_calibration = None if self.calibration_mm2 is None else np.ascontiguousarray(self.calibration_mm2[-1])
        across = self.fit.point_covariance_mm2[-1]
        sigma_mm = call("covariance_of_tip", across, of_calibration, along, along_mm2, covariance_mm2)
        return covariance_mm2, float(sigma_mm)


@dataclass(frozen=True, slots=True)
class Glanced:
    """What glances at a needle made of it: how many looks they were, how far aside of the last it still lies, mm."""

    refined: Refined
    looks: int
    aside_mm: float


@dataclass(frozen=True, slots=True)
class Traced:
    """A curve (N, 3) that was followed to its ends, base first where that is known, and what the needle looks like.

    moved, steady: what it was followed from, where that was the track of the pair before.
    """

    points_mm: Float
    appearance: Appearance
    base_is_known: bool
    moved: Adjusted | None
    steady: Steady | None


def refine(
    images: Images,
    rig: StereoRig,
    points_mm: Float,
    models: RefineModels,
    *,
    previous: NeedleTrack | None = None,
    since_s: float = 0.0,
) -> Refined:
    """Follow the needle from a curve (N, 3) in space; raises NeedleNotFound where the views do not show it.

    previous: the track of the pair before, whose curve this is, which is then nearly right and tells base from tip
    where no sleeve is seen; without it the curve is a rough one. since_s: how long ago it was taken; 0: nobody knows.
    """
    return settled(images, rig, trace(images, rig, points_mm, models, previous=previous, since_s=since_s), models)


def trace(
    images: Images,
    rig: StereoRig,
    points_mm: Float,
    models: RefineModels,
    *,
    previous: NeedleTrack | None = None,
    since_s: float = 0.0,
) -> Traced:
    """The first half of `refine`: the curve to both its ends, and which of them is the base."""
    steady = None if previous is None or set(previous.reasons) - _STEADY_DESPITE else _steady(previous, since_s, models)
    spacing = models.refine.spacing_mm
    moved = None if steady is None else _moved(images, rig, steady, models)
    if moved is None:
        appearance = None if previous is None else previous.appearance
        # A needle that is followed has been looked for behind bends and gaps before.
        growth = _growth(models.refine, models.ends, is_followed=previous is not None)
        followed_mm, appearance = grow(
            images, rig, _even(points_mm, spacing), models.needle, models.fit, growth, appearance
        )
    else:
        followed_mm, appearance = moved.fit.points_mm, moved.appearance
    margin = round(models.refine.sleeve_reach_mm / spacing)
    extended = _extended(followed_mm, models.refine.sleeve_reach_mm, spacing)
    seen_diameter_mm = diameter_mm(appearance, models.needle)
    observed = _look_beside(images, rig, extended, seen_diameter_mm, models)
    stretch = needle_stretch(observed, margin, len(extended) - margin, spacing, models.ends)
    if stretch.sleeve is not None:
        base: int | None = 0 if stretch.sleeve.index == stretch.start else -1
    else:
        part = extended[stretch.start : stretch.stop]
        previous_base_mm = None
        if previous is not None and previous.base is not None and Reason.AMBIGUOUS_BASE not in previous.reasons:
            previous_base_mm = previous.base.position_mm
        base = base_end(part, rig, models.workspace.entry_side, previous_base_mm)
    if base == -1:
        extended, observed = extended[::-1], (observed[0].turned(), observed[1].turned())
        stretch = Stretch(len(extended) - stretch.stop, len(extended) - stretch.start, stretch.sleeve)
    base_is_known = base is not None and (
        stretch.sleeve is None
        or (
            _has_sides(images, rig, extended[stretch.start : stretch.stop], seen_diameter_mm, models)
            and not _goes_on(images, rig, extended, observed, stretch, seen_diameter_mm, models)
        )
    )
    return Traced(extended[stretch.start : stretch.stop], appearance, base_is_known, moved, steady)


def settled(images: Images, rig: StereoRig, traced: Traced, models: RefineModels) -> Refined:
    """The second half of `refine`: the curve as well as both views show it, to its tip."""
    if traced.moved is not None:
        ended = _ended(images, rig, traced.points_mm, traced.moved, models, traced.steady)
    else:
        adjusted = adjust(
            images,
            rig,
            _even(traced.points_mm, models.refine.spacing_mm),
            models.needle,
            models.fit,
            traced.appearance,
            looks=SETTLED,
        )
        ended = _ended(images, rig, adjusted.fit.points_mm, adjusted, models)
        if abs(ended.tip.at_mm - float(arc_length(adjusted.fit.points_mm)[-1])) > _TIP_MOVED_MM:
            # Beyond its tip the curve was a guess, and so was what lay about it.
            ended = _ended(images, rig, ended.final.fit.points_mm, ended.final, models)
    return _with_tip(images, rig, ended, models, base_is_known=traced.base_is_known)


@dataclass(frozen=True, slots=True)
class _Ended:
    """A tip, the curve (N, 3) on which it was looked for, and the curve that ends there, as both views show it."""

    tip: TipFit
    along_mm: Float
    final: Adjusted
    ends: Ends


def glanced(
    images: Images,
    rig: StereoRig,
    models: RefineModels,
    *,
    previous: NeedleTrack,
    since_s: float,
    first_mm: Float | None = None,
    is_astray: bool = False,
    most_looks: int = MOST_LOOKS,
) -> Glanced | None:
    """The needle where it has moved since the pair before, looked at there: a hundredth of what `refine` takes.

    What it looks like and where its base is are known. None where a glance does not do: its tip was never seen, or it
    is so bright that it is white. first_mm: the curve (N, 3) to the tip at which a first glance put it already, and
    is_astray: whether it is not there; most_looks: how often it is looked at.
    Raises NeedleNotFound where the views do not show it.
    """
    steady = _steady(previous, since_s, models)
    if steady is None:
        return None
    if first_mm is not None:
        advance_mm = float(np.clip(steady.advance_mm, -MOST_ADVANCE_MM, MOST_ADVANCE_MM))
        length_mm = float(arc_length(steady.points_mm)[-1]) + advance_mm
        steady = replace(steady, points_mm=first_mm, advance_mm=0.0, length_mm=length_mm, is_moving=is_astray)
    seen = glance(
        images,
        rig,
        steady,
        GlanceParameters(models.needle, models.fit, models.ends, models.tip, models.beside, models.refine.spacing_mm),
        most_looks,
    )
    if seen is None:
        return None
    refined = Refined(
        seen.fit,
        seen.shown,
        steady.appearance,
        diameter_mm(steady.appearance, models.needle),
        Reason.AMBIGUOUS_BASE not in previous.reasons,
        seen.tip,
        seen.tip_is_free,
        seen.tip_px,
        float(np.clip(seen.support, -_MOST_ODDS, _MOST_ODDS).sum()),
    )
    return Glanced(refined, seen.looks, seen.aside_mm)


def _with_tip(images: Images, rig: StereoRig, ended: _Ended, models: RefineModels, *, base_is_known: bool) -> Refined:
    tip, final = ended.tip, ended.final
    seen_diameter_mm = diameter_mm(final.appearance, models.needle)
    tip_px = np.stack([_tip_px(view, end[0]) for view, end in zip(final.observed, ended.ends, strict=True)])
    start_mm = max(0.0, tip.at_mm - TIP_BEFORE_MM)
    beyond = _cut(ended.along_mm, start_mm, tip.at_mm + TIP_BEYOND_MM, models.refine.spacing_mm)
    beside = _look_beside(images, rig, beyond, seen_diameter_mm, models)
    is_free = not is_crossed(beside, min(tip.at_mm, TIP_BEFORE_MM), arc_length(beyond), models.ends)
    return Refined(
        final.fit,
        np.stack([view.seen for view in final.observed]) | final.shines,
        replace(final.appearance, taper_mm=tip.taper_mm),
        seen_diameter_mm if final.flanks is None else final.flanks.diameter_mm,
        base_is_known,
        tip,
        is_free,
        tip_px,
        float(np.clip(final.support, -_MOST_ODDS, _MOST_ODDS).sum()),
    )


def _ended(
    images: Images,
    rig: StereoRig,
    curve_mm: Float,
    adjusted: Adjusted,
    models: RefineModels,
    steady: Steady | None = None,
) -> _Ended:
    """The curve brought to an end at the tip itself; raises NeedleNotFound where hardly anything is left of it."""
    tip, along_mm = _tip(images, rig, curve_mm, adjusted, models, steady)
    if tip.at_mm < models.needle.min_length_mm / 2:
        raise NeedleNotFound("refine", Reason.TOO_SHORT)
    visible = _cut(along_mm, 0.0, tip.at_mm, models.refine.spacing_mm)
    left, right = (
        (_end_observation(visible, len(visible) - 1, camera, pose, each - tip.at_mm, sigma),)
        for camera, pose, each, sigma in zip(*_views(rig), tip.each_mm, tip.sigma_mm, strict=True)
    )
    final = adjust(
        images,
        rig,
        visible,
        models.needle,
        models.fit,
        adjusted.appearance,
        looks=SETTLED,
        looks_the_same=True,
        before_tip=(np.linspace(tip.at_mm, 0.0, len(visible)), tip.taper_mm),
        ends=(left, right),
        flanks=adjusted.flanks,
        bent_for_s=None if steady is None else steady.since_s,
    )
    return _Ended(tip, along_mm, final, (left, right))


def _tip(
    images: Images, rig: StereoRig, curve: Float, adjusted: Adjusted, models: RefineModels, steady: Steady | None
) -> tuple[TipFit, Float]:
    """The tip, and the curve (N, 3) on which it lies, from the base to well beyond it."""
    needle, tried_mm = models.needle, TRIED_MM
    spacing = models.refine.spacing_mm
    along = np.concatenate([curve, _beyond(curve, round(TIP_REACH_MM / spacing), spacing)])
    arc = arc_length(along)
    end_mm, remaining = float(arc[len(curve) - 1]), TIP_ROUNDS
    is_foreseen = steady is not None and not steady.is_same_pair
    foreseen_mm = (end_mm, ADVANCE_SIGMA_MM_S * steady.since_s if steady is not None and is_foreseen else np.inf)
    while True:
        rows_mm = np.arange(max(0.0, end_mm - BEFORE_MM), min(end_mm + BEYOND_MM, arc[-1]), ROW_MM)
        rows = np.column_stack([np.interp(rows_mm, arc, column) for column in along.T])
        views = tuple(
            (image, camera, pose.apply(rows)) for image, camera, pose in zip(images, *_views(rig), strict=True)
        )
        tip = find_tip(
            (views[0], views[1]),
            rows_mm,
            end_mm,
            adjusted.appearance,
            needle,
            models.tip,
            adjusted.flanks,
            tried_mm,
            foreseen_mm,
        )
        # At the border of what was tried, or well beyond where the curve was followed to, it may lie further on.
        remaining -= 1
        is_inside = tried_mm[0] + 0.2 < tip.at_mm - end_mm < BEYOND_END_MM
        if is_inside or remaining == 0 or not BEFORE_MM < tip.at_mm < arc[-1] - BEYOND_MM:
            return tip, along
        end_mm = tip.at_mm


def _views(rig: StereoRig) -> tuple[tuple[Camera, Camera], tuple[RigidTransform, RigidTransform]]:
    return (rig.left, rig.right), (RigidTransform.identity(), rig.right_from_left)


def _has_sides(images: Images, rig: StereoRig, points_mm: Float, diameter_mm: float, models: RefineModels) -> bool:
    """Whether what was taken for a sleeve, before the first point of a curve (N, 3), has sides.

    Where a rod ends, or the sleeve itself, the flanks of the streak of light on it change as those of a needle do where
    it leaves its sleeve; but nothing goes on there. One side of four may be hidden.
    """
    spacing = models.refine.spacing_mm
    skipped, count = (round(mm / spacing) for mm in _SLEEVE_SIDES_MM)
    within = _beyond(points_mm[::-1], count, spacing)[skipped:]
    sides = np.concatenate(
        [
            sides_gray(image, camera, pose.apply(within), diameter_mm)
            for image, camera, pose in zip(images, *_views(rig), strict=True)
        ]
    )
    return bool(np.sort(sides)[1] > models.ends.sleeve_step_gray / 2)


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
    spacing = models.refine.spacing_mm
    outwards = extended_mm[stretch.start : stretch.stop][::-1]
    skipped, count = (round(mm / spacing) for mm in (GOES_ON_FROM_MM, GOES_ON_TO_MM))
    behind = _look_beside(images, rig, _beyond(outwards, count, spacing)[skipped:], diameter_mm, models)
    shares = [
        view.line_gray_px / max(float(np.median(seen.line_gray_px[stretch.start : stretch.stop])), 1e-6)
        for view, seen in zip(behind, observed, strict=True)
    ]
    shown = np.min(shares, axis=0) > GOES_ON_SHARE
    return bool(uniform_filter1d(shown.astype(np.float64), round(GOES_ON_MM / spacing), mode="constant").max() > 0.999)


def is_line_beyond(
    images: Images, rig: StereoRig, points_mm: Float, diameter_mm: float, parameters: BesideParameters
) -> bool:
    """Whether both views show a line as wide as the needle go on beyond the end of its curve (N, 3).

    However faint: a needle whose contrast fades, behind which something crosses, seems to end there and does not.
    """
    even = _cut(points_mm, 0.0, float(arc_length(points_mm)[-1]), _BEYOND_STEP_MM)
    first, last = (round(mm / _BEYOND_STEP_MM) for mm in _BEYOND_MM)
    beyond = _beyond(even, last, _BEYOND_STEP_MM)[first:]
    heights_gray = [
        abs(line_height_gray(image, camera, pose.apply(beyond), diameter_mm))
        for image, camera, pose in zip(images, *_views(rig), strict=True)
    ]
    return min(heights_gray) > parameters.faint_line_gray


def _end_observation(
    points_mm: Float, index: int, camera: Camera, pose: RigidTransform, ahead_mm: float, sigma_mm: float
) -> EndObservation:
    about = points_mm[[max(0, index - 1), min(index + 1, len(points_mm) - 1)]]
    px = camera.project(pose.apply(about))
    px_per_mm = float(np.linalg.norm(px[1] - px[0]) / np.linalg.norm(about[1] - about[0]))
    return EndObservation(index, ahead_mm * px_per_mm, max(0.5, sigma_mm * px_per_mm))


def _tip_px(view: AxisOffsets, end: EndObservation) -> Float:
    normal = view.normal[-1]
    along = np.array([normal[1], -normal[0]])
    return np.asarray(view.center_px[-1] + view.offset_px[-1] * normal + end.shift_px * along)


def _steady(previous: NeedleTrack, since_s: float, models: RefineModels) -> Steady | None:
    """What the track before tells, where it tells enough."""
    if previous.curve is None or previous.appearance is None:
        return None
    taper_mm, tip = previous.appearance.taper_mm, previous.tip
    if taper_mm is None or taper_mm not in models.needle.tip_tapers_mm:
        return None
    return Steady(
        foreseen_mm(previous.curve, since_s),
        previous.appearance,
        taper_mm,
        since_s if since_s > 0 else _USUAL_S,
        0.0 if tip is None or tip.velocity_mm_s is None else float(tip.velocity_mm_s @ tip.direction) * since_s,
        is_moving=moves_mm(previous.curve, since_s) > _ROUGHLY_FIRST_MM,
        is_same_pair=since_s <= 0,
    )


def _moved(images: Images, rig: StereoRig, steady: Steady, models: RefineModels) -> Adjusted:
    """The curve of a needle that was seen whole in the pair before, where it is now."""
    spacing = models.refine.spacing_mm
    points = np.concatenate([steady.points_mm, _beyond(steady.points_mm, round(MOST_ADVANCE_MM / spacing), spacing)])
    length_mm = float(arc_length(steady.points_mm)[-1])
    points = _cut(
        points, 0.0, length_mm + float(np.clip(steady.advance_mm, -MOST_ADVANCE_MM, MOST_ADVANCE_MM)), spacing
    )
    return adjust(
        images,
        rig,
        points,
        models.needle,
        models.fit,
        steady.appearance,
        looks=MOVED,
        bent_for_s=steady.since_s,
    )


@lru_cache(maxsize=4)
def _growth(refine: RefineParameters, ends: EndsParameters, *, is_followed: bool) -> Growth:
    reaches_mm = (refine.reach_mm,) if is_followed else (refine.reach_mm, refine.bend_reach_mm, refine.gap_reach_mm)
    return Growth(
        refine.spacing_mm,
        reaches_mm,
        PARABOLA_MM,
        refine.settled_mm,
        refine.max_rounds,
        refine.shown_log_odds,
        refine.shown_share,
        refine.shown_over_mm,
        ends.max_gap_mm,
    )


def _look_beside(
    images: Images, rig: StereoRig, points_mm: Float, diameter_mm: float, models: RefineModels
) -> tuple[Beside, Beside]:
    right_mm = rig.right_from_left.apply(points_mm)
    if min(points_mm[:, 2].min(), right_mm[:, 2].min()) < MIN_DEPTH_MM:
        raise NeedleNotFound("refine", Reason.OUTSIDE_WORKSPACE)
    return (
        look_beside(images[0], rig.left, points_mm, diameter_mm, models.beside),
        look_beside(images[1], rig.right, right_mm, diameter_mm, models.beside),
    )


def _even(points_mm: Float, spacing_mm: float) -> Float:
    return resample(points_mm, max(8, round(float(arc_length(points_mm)[-1]) / spacing_mm) + 1))


def _extended(points_mm: Float, reach_mm: float, spacing_mm: float) -> Float:
    """The curve, evenly spaced, and beyond both ends as a parabola whose bend is that of the last stretch."""
    even = _even(points_mm, spacing_mm)
    n = round(reach_mm / spacing_mm)
    return np.concatenate([_beyond(even[::-1], n, spacing_mm)[::-1], even, _beyond(even, n, spacing_mm)])


def _beyond(points_mm: Float, count: int, spacing_mm: float) -> Float:
    stretch = points_mm[-min(len(points_mm), round(PARABOLA_MM / spacing_mm)) :]
    s = arc_length(stretch) - arc_length(stretch)[-1]
    design = np.column_stack([s, s**2])
    slope, bend = np.linalg.lstsq(design, stretch - stretch[-1], rcond=None)[0]
    ahead = np.arange(1, count + 1) * spacing_mm
    direction = unit(slope)
    return np.asarray(stretch[-1] + ahead[:, None] * direction + (ahead**2)[:, None] * bend)


def _cut(points_mm: Float, start_mm: float, stop_mm: float, spacing_mm: float) -> Float:
    return cut(points_mm, start_mm, stop_mm, max(8, round((stop_mm - start_mm) / spacing_mm) + 1))
