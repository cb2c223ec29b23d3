"""Whether a controller may act on a shape: every weakness has a code, and only a shape without any is ok.

The thresholds follow from what a controller needs, a tip and a shape that are right to a millimetre (docs/status.md).
"""

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.records import Float, NeedleCurve, NeedleTrack, Quality, Reason, Status
from needletrack.tracking.match import inside
from needletrack.tracking.needle import Needle, Positive, Workspace
from needletrack.tracking.refine import Refined
from needletrack.tracking.tip import TipFit

# Saturation widens a bright needle by up to this much, mm.
_SATURATION_MM = 0.35
_BEFORE_TIP_MM = 10.0
# An end stands out clearly where it does by so many times the least contrast.
_CLEARLY = 1.5


class GateParameters(BaseModel):
    """How weak a shape may be and still be ok."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_sigma_mm: Positive = Field(
        0.4,
        description="Largest stated sigma along the shape (95th percentile) and of the tip, mm; 1 mm is 2.5 of it.",
    )
    max_reprojection_rms_px: Positive = Field(
        0.12, description="Largest rms of the axis points about the projected curve, px."
    )
    max_streak_misfit: Positive = Field(
        4.0, description="Largest mean square of what a streak of light leaves its line by, in what is usual."
    )
    min_coverage: float = Field(0.5, ge=0, le=1, description="Smallest share of the length that both cameras see.")
    max_epipolar_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Largest share of the length within epipolar_angle_deg of the epipolar lines.",
    )
    epipolar_angle_deg: Positive = Field(
        12.0, description="A stretch closer than this to the epipolar lines has no depth of its own."
    )
    min_tip_contrast: Positive = Field(
        8.0,
        description="Sigmas by which each view prefers an end there to a needle that goes on, and to none.",
    )
    max_tip_disagreement_mm: Positive = Field(
        0.7, description="Largest distance along the needle between both views' tips, mm."
    )
    max_tip_epipolar_px: Positive = Field(
        3.0, description="Largest distance of one view's tip from the other's epipolar line, px."
    )
    min_tip_seen_share: float = Field(
        0.5, ge=0, le=1, description="Smallest share of the last centimetre before the tip that a camera sees."
    )
    max_step_mm: Positive = Field(15.0, description="Largest motion of the tip since the previous pair, mm.")


# With one of these it is another thing than a needle that is seen, and no shape is given.
_NOT_A_NEEDLE = (Reason.OUTSIDE_WORKSPACE, Reason.TOO_SHORT, Reason.TOO_LONG, Reason.WIDTH_OUT_OF_RANGE)


def weaknesses(
    refined: Refined,
    curve: NeedleCurve,
    quality: Quality,
    needle: Needle,
    workspace: Workspace,
    parameters: GateParameters,
    previous: NeedleTrack | None,
    *,
    along_epipolar_lines: float,
) -> tuple[Reason, ...]:
    """Why a shape is not ok, in the order of `Reason`; empty where it is.

    along_epipolar_lines: share of its length whose picture in the right view runs along them.
    Raises NeedleNotFound for a shape that is no needle of the configured kind and place.
    """
    tip = refined.tip
    found = {
        Reason.OUTSIDE_WORKSPACE: not bool(inside(workspace, curve.points_mm).all()),
        Reason.TOO_SHORT: curve.length_mm < needle.min_length_mm,
        Reason.TOO_LONG: curve.length_mm > needle.max_length_mm,
        Reason.WIDTH_OUT_OF_RANGE: not 0.8 * needle.min_diameter_mm
        <= refined.diameter_mm
        <= needle.max_diameter_mm + _SATURATION_MM,
        Reason.AMBIGUOUS_BASE: not refined.base_is_known,
        Reason.LOW_COVERAGE: (quality.coverage or 0.0) < parameters.min_coverage,
        Reason.ALONG_EPIPOLAR_LINES: along_epipolar_lines > parameters.max_epipolar_share,
        Reason.HIGH_RESIDUAL: refined.fit.rms_px > parameters.max_reprojection_rms_px
        or refined.fit.streak_misfit > parameters.max_streak_misfit,
        Reason.HIGH_UNCERTAINTY: _percentile_95(curve.sigma_mm) > parameters.max_sigma_mm
        or refined.tip_sigma_mm > parameters.max_sigma_mm,
        Reason.TIP_NOT_SEEN: min(tip.contrast) < parameters.min_tip_contrast
        or not refined.tip_is_free
        or _seen_before_tip(curve) < parameters.min_tip_seen_share,
        Reason.TIP_DISAGREES: abs(tip.each_mm[0] - tip.each_mm[1]) > _most_disagreement_mm(tip, parameters)
        or (quality.epipolar_rms_px or 0.0) > parameters.max_tip_epipolar_px,
        Reason.JUMP: previous is not None
        and previous.status is Status.OK
        and previous.tip is not None
        and float(np.linalg.norm(previous.tip.position_mm - curve.points_mm[-1])) > parameters.max_step_mm,
    }
    for reason in _NOT_A_NEEDLE:
        if found[reason]:
            raise NeedleNotFound("gates", reason)
    return tuple(reason for reason in Reason if found.get(reason, False))


def _most_disagreement_mm(tip: TipFit, parameters: GateParameters) -> float:
    """How far apart both views may place an end: what hardly stands out has to agree better."""
    stands_out = min(tip.contrast) / (_CLEARLY * parameters.min_tip_contrast)
    return parameters.max_tip_disagreement_mm * min(1.0, stands_out)


def _seen_before_tip(curve: NeedleCurve) -> float:
    """Share of the points of the last stretch that a camera sees: an end that hangs by nothing is another thing's."""
    spacing_mm = curve.length_mm / (len(curve.points_mm) - 1)
    return float((curve.seen[-max(1, round(_BEFORE_TIP_MM / spacing_mm)) :] > 0).mean())


def _percentile_95(values: Float) -> float:
    """The 95th percentile of values (N,): the least that at least so many of them do not exceed."""
    return float(np.partition(values, -(-19 * len(values) // 20) - 1)[-(-19 * len(values) // 20) - 1])
