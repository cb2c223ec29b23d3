"""A refined curve with its verdict, and the track that is published of it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import orientation_along
from needletrack.kernels import call
from needletrack.records import (
    BasePose,
    Evidence,
    Float,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    TipPose,
)
from needletrack.tracking.fit import CurveFit
from needletrack.tracking.gates import weaknesses
from needletrack.tracking.motion import moved_aside_mm
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import Refined

_SAME_SHAPE_MM = 2.0
# The tip's direction: the stretch over which the bend is told and what is left out before the apex, mm; and the longest
# and the least stretch of a parabola, mm, which follows a needle's turn over so many radians; and of a cubic.
_DIRECTION_RULES = np.array([19.0, 3.0, *(16.0, 6.0, 0.5), *(40.0, 12.0, 0.8)])
_MAX_VELOCITY_INTERVAL_NS = 250_000_000


@dataclass(frozen=True, slots=True)
class Shape:
    """A shape and why it is not ok (empty where it is).

    doubts: those of the reasons that only a search of the whole images can find, or lift. out_of_base (3,): the unit
    direction in which it leaves its base.
    """

    refined: Refined
    curve: NeedleCurve
    out_of_base: Float
    quality: Quality
    reasons: tuple[Reason, ...]
    doubts: tuple[Reason, ...] = ()

    def doubted(self, doubts: Iterable[Reason]) -> "Shape":
        """The same shape with reasons that only a search of the whole images can find, or lift."""
        both = {*self.doubts, *doubts}
        if not both:
            return self
        reasons = tuple(reason for reason in Reason if reason in both or reason in self.reasons)
        return replace(self, reasons=reasons, doubts=tuple(reason for reason in Reason if reason in both))

    def weakened(self, reasons: Iterable[Reason]) -> "Shape":
        """The same shape with further reasons."""
        both = {*self.reasons, *reasons}
        return replace(self, reasons=tuple(reason for reason in Reason if reason in both))


def judged(refined: Refined, rig: StereoRig, parameters: TrackingParameters, previous: NeedleTrack | None) -> Shape:
    """The refined curve as a shape with its verdict; raises NeedleNotFound where it cannot be the needle."""
    fit = refined.fit
    seen = refined.shown
    # One error for all points of all pairs: it does not average out along the needle.
    of_calibration = rig.calibration_covariance_mm2(fit.points_mm)
    if of_calibration is not None:
        refined = replace(refined, calibration_mm2=of_calibration)
    covariance_mm2 = fit.point_covariance_mm2
    if refined.calibration_mm2 is not None:
        covariance_mm2 = covariance_mm2 + refined.calibration_mm2
    sigma_mm, curvature_per_mm, ends, along_epipolar_lines = told_of_curve(
        fit, covariance_mm2, rig, parameters.gates.epipolar_angle_deg
    )
    length_mm = float(arc_length(fit.points_mm)[-1])
    curve = NeedleCurve(fit.points_mm, sigma_mm, seen.sum(axis=0), curvature_per_mm, length_mm)
    off_px = call("off_epipolar_px", *rig.lenses, rig.fundamental, np.ascontiguousarray(refined.tip_px))
    quality = Quality(
        fit.rms_px,
        float(off_px),
        float(seen.all(axis=0).mean()),
    )
    reasons = weaknesses(
        refined,
        curve,
        quality,
        parameters.needle,
        parameters.workspace,
        parameters.gates,
        previous,
        along_epipolar_lines=along_epipolar_lines,
    )
    return Shape(refined, curve, ends[0], quality, reasons)


def told_of_curve(
    fit: CurveFit, covariance_mm2: Float, rig: StereoRig, epipolar_angle_deg: float
) -> tuple[Float, Float, Float, float]:
    """The larger sigma (N,) across a curve, mm, of points of covariance (N, 3, 3); its curvature (N,), 1/mm.

    And unit directions (2, 3) at both its ends, and the share of its points whose picture in the right view runs within
    an angle of the epipolar lines.
    """
    count = len(fit.points_mm)
    sigma_mm, curvature_per_mm, ends = np.empty(count), np.empty(count), np.empty((2, 3))
    share = call(
        "told_of_curve",
        np.ascontiguousarray(fit.control_mm),
        len(fit.control_mm),
        np.ascontiguousarray(fit.parameters),
        np.ascontiguousarray(fit.points_mm),
        count,
        np.ascontiguousarray(covariance_mm2),
        *rig.lenses,
        rig.fundamental,
        float(np.sin(np.radians(epipolar_angle_deg))),
        sigma_mm,
        curvature_per_mm,
        ends,
    )
    return sigma_mm, curvature_per_mm, ends, float(share)


def differ(curve: NeedleCurve, other: NeedleCurve) -> bool:
    """Whether two shapes are different ones, and not two fits of one needle."""
    apart = np.linalg.norm(curve.points_mm[:, None] - other.points_mm[None], axis=2).min(axis=1)
    return float(np.median(apart)) > _SAME_SHAPE_MM


def as_track(
    shape: Shape,
    captured_at_ns: int,
    previous: NeedleTrack | None,
    since_detection: int,
    evidence: Evidence,
    elapsed_ms: dict[str, float],
) -> NeedleTrack:
    """The track to publish: without a tip where the free end was not found, for a curve's end is not yet a tip."""
    fit, points_mm = shape.refined.fit, shape.curve.points_mm
    curve, tip, since_s = shape.curve, None, _since_s(captured_at_ns, previous)
    if since_s is not None and previous is not None and previous.curve is not None:
        curve = replace(curve, velocity_mm_s=moved_aside_mm(points_mm, previous.curve.points_mm) / since_s)
    if Reason.TIP_NOT_SEEN not in shape.reasons:
        out_of_tip = _tip_direction(shape.curve)
        tip = TipPose(
            points_mm[-1],
            out_of_tip,
            orientation_along(out_of_tip),
            shape.refined.tip_covariance_mm2,
            None
            if since_s is None or previous is None or previous.tip is None
            else np.asarray((points_mm[-1] - previous.tip.position_mm) / since_s),
            int(shape.curve.seen[-1]),
        )
    return NeedleTrack(
        captured_at_ns,
        Status.DEGRADED if shape.reasons else Status.OK,
        shape.reasons,
        curve,
        tip,
        BasePose(points_mm[0], shape.out_of_base),
        shape.refined.diameter_mm,
        shape.refined.appearance,
        since_detection,
        shape.quality,
        elapsed_ms,
        replace(evidence, axis_residual_px=fit.residual_px, tip_px=None if tip is None else shape.refined.tip_px),
        shape.doubts,
    )


def _tip_direction(curve: NeedleCurve) -> Float:
    """Unit direction (3,) out of the tip, between that of a parabola and of a longer cubic, the tip's taper left out.

    What shows there is thin and faint: the spline's own end is twice as far off. A parabola errs where the bend
    changes, a cubic more by noise, and both apart from one another.
    """
    direction = np.empty(3)
    call("direction_of_tip", curve.points_mm, len(curve.points_mm), curve.curvature_per_mm, _DIRECTION_RULES, direction)
    return direction


def _since_s(captured_at_ns: int, previous: NeedleTrack | None) -> float | None:
    """How long after the track before, where that tells how the needle moves."""
    if previous is None or previous.status is not Status.OK:
        return None
    elapsed_ns = captured_at_ns - previous.captured_at_ns
    return elapsed_ns * 1e-9 if 0 < elapsed_ns <= _MAX_VELOCITY_INTERVAL_NS else None
