"""A needle that was seen whole in the pair before, looked at where it must be now.

What it looks like and where its base is are known; the curve is known but for how it moved since. So one look across
it, a fit, its tip, and the fit once more to the tip tell all that there is. It is one call into the compiled kernel
`glance.c`, of which every part is also a kernel of its own for a needle that has to be found.
"""

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import address, call, two_tip_views
from needletrack.records import Appearance, Float, Image, Reason
from needletrack.tracking.adjust import Expectation, Looks
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
from needletrack.tracking.beside import BesideParameters
from needletrack.tracking.clipped import WORTH_A_LOOK
from needletrack.tracking.ends import (
    CROSSED_MM,
    EDGE_GAP_MM,
    TIP_BEFORE_MM,
    TIP_BEYOND_MM,
    EndsParameters,
)
from needletrack.tracking.evidence import BLURS, FAR, LIVELY, NEAR, banks, no_needle_bank
from needletrack.tracking.fit import CurveFit, FitParameters
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import EDGE_SPREAD_PX, FLANK_PX, Mask
from needletrack.tracking.silhouette import ROWS_PER_SECTION, diameter_mm, unit_mm
from needletrack.tracking.tip import (
    ACROSS,
    BEFORE_MM,
    BEYOND_MM,
    PICTURE_MM,
    PICTURE_RULES,
    ROW_MM,
    TRIED_AGAIN_MM,
    TipFit,
    TipParameters,
    inside_pictures,
    prior_of_parts,
    reach,
    rules,
    stepped,
    tip_fit,
)

Images = tuple[Image, Image]

# Between two pairs the tip is not expected to come further than this; the curve is kept so far beyond, mm.
MOST_ADVANCE_MM, _BEYOND_MM = 3.0, 3.0
# Where it is not there, it is looked for once more, about so much further on.
_FARTHER_MM, _FARTHEST_ADVANCE_MM = 5.0, 8.0
# Nor is it off from where its motion would take it by more than a few of these, a second.
ADVANCE_SIGMA_MM_S = 18.0
# A needle is looked at again, at most so often, where it was found this far aside of where it was looked for, mm.
MOST_LOOKS, SETTLED_MM = 4, 0.25
# A needle that moves is looked for roughly first, in sections so long, and then nearby: together they take little more
# than a look on the finest grid, which reaches half as far.
_ROUGHLY, _ROUGH_SECTION_MM = Looks((0.7, 0.4), FAR, Expectation.MOVED, with_streak=False), 3.0
_NEARLY = Looks((0.7, 0.4, 0.2), NEAR, Expectation.MOVED)
# Its end is not where it was found if both views would rather have so much of it elsewhere, by these log odds a
# section. Of 203 ends that were right 202 showed no such place; ends a millimetre aside did, by 1.4 to 3.
_END_MM, _ELSEWHERE_GAIN = 12.0, 0.5
# The tip is looked for this far beyond where the needle was followed to, in so many rounds.
TIP_REACH_MM, TIP_ROUNDS = 12.0, 4
# Where it is found so far beyond that end, what lies beyond it is looked at as well.
BEYOND_END_MM = 0.8
# Beyond its end a curve goes on with the bend of so much of it, mm.
PARABOLA_MM = 12.0
MIN_DEPTH_MM = 20.0
# Sections are so much longer than the points of the curve are apart: what is followed changes slowly along itself, and
# most of the work is proportional to their number.
_SECTION_SHARE = 1.0
# Before its tip the needle thins in steps of so many half widths: each has matrices as large as a cache.
_WIDTH_STEP = 3
# The tip shows its angle to the line of sight over so many points.
_TIP_POINTS = 8
# What the kernel says beside what `axis.py` names.
_BEYOND, _TOO_SHORT, _NO_TIP, _TOO_NEAR, _CLIPPED = range(OTHERS, OTHERS + 5)
_LOST = {
    NOT_SEEN: Reason.LOW_COVERAGE,
    NOT_HELD: Reason.HIGH_UNCERTAINTY,
    _BEYOND: Reason.JUMP,
    _TOO_SHORT: Reason.TOO_SHORT,
    _NO_TIP: Reason.TIP_NOT_SEEN,
    _TOO_NEAR: Reason.OUTSIDE_WORKSPACE,
}


@dataclass(frozen=True, slots=True)
class GlanceParameters:
    """The parameters of the stages that a glance is made of."""

    needle: Needle
    fit: FitParameters
    ends: EndsParameters
    tip: TipParameters
    beside: BesideParameters
    spacing_mm: float


@dataclass(frozen=True, slots=True)
class Steady:
    """A needle that was seen whole in the pair before: its curve (N, 3), what it looked like, how its tip is shaped.

    since_s: how long ago that was; advance_mm: how far its tip comes in that time. length_mm: where the tip is expected
    from the base, which the end of a curve that was looked at already is not; None: advance_mm beyond its end.
    is_moving: it may be well aside of there.
    is_same_pair: it was seen in the very images that are looked at, which then are not to be told twice.
    """

    points_mm: Float
    appearance: Appearance
    taper_mm: float
    since_s: float
    advance_mm: float
    length_mm: float | None = None
    is_moving: bool = False
    is_same_pair: bool = False


@dataclass(frozen=True, slots=True)
class Glance:
    """The curve base -> tip; where each view shows it (2, N); log odds (2, N) of it; its tip, whether that is free.

    tip_px (2, 2): the tip as the left and the right view alone place it, raw px. looks: how often it was looked at,
    each time where it had been found; aside_mm: how far, at most, it lies aside of where it was looked for last, or how
    far its end is seen elsewhere.
    """

    fit: CurveFit
    shown: Mask
    support: Float
    tip: TipFit
    tip_is_free: bool
    tip_px: Float
    looks: int
    aside_mm: float


def glance(
    images: Images, rig: StereoRig, steady: Steady, parameters: GlanceParameters, most_looks: int = MOST_LOOKS
) -> Glance | None:
    """The needle where it was moved to since; None where it is so bright that it is white.

    It is looked at again, most_looks times at most, from where it was found, until it is found there: it is seen well
    only where it is looked for.

    Raises NeedleNotFound where the views do not show it, or its tip has gone further than was looked.
    """
    shaft = replace(steady.appearance, taper_mm=None)
    kept, views = Kept(), two_tip_views()
    now = _Glance.from_buffer_copy(_wanted(parameters, shaft)[0])
    points_mm = np.ascontiguousarray(steady.points_mm)
    now.before_mm, now.before = kept.at(points_mm), len(points_mm)
    now.advance_mm, now.taper_mm, now.since_s = steady.advance_mm, steady.taper_mm, steady.since_s
    now.most_looks, now.roughly_first = most_looks, steady.is_moving
    now.foreseen_sigma_mm = ADVANCE_SIGMA_MM_S * steady.since_s
    if steady.length_mm is not None:
        now.foreseen_off_mm = steady.length_mm - (float(arc_length(points_mm)[-1]) + steady.advance_mm)
    eyes = two_eyes(images, rig, kept)
    pictures = []
    for view, pose in zip(views, (None, rig.right_from_left), strict=True):
        last_mm = points_mm[-_TIP_POINTS:] if pose is None else pose.apply(points_mm[-_TIP_POINTS:])
        along, sight = last_mm[-1] - last_mm[0], last_mm[-1]
        toward = float(along @ sight) ** 2 / float((along @ along) * (sight @ sight))
        sine = stepped(math.sqrt(max(0.0, 1 - toward)))
        pictures.append(inside_pictures(steady.taper_mm, shaft, unit_mm(parameters.needle), sine, None))
        pictures[-1].lay_out(view, 0)
    room = len(points_mm) + round((_FARTHEST_ADVANCE_MM + 2 * _BEYOND_MM) / parameters.spacing_mm) + 16
    found = _Room(room)
    answer = call("glance", now, eyes, views, found.record)
    if answer == _BEYOND:
        # Its tip may have been placed too short before.
        now.advance_mm, now.most_advance_mm, now.foreseen_sigma_mm = _FARTHER_MM, _FARTHEST_ADVANCE_MM, np.inf
        now.foreseen_off_mm = 0.0
        answer = call("glance", now, eyes, views, found.record)
    if answer == _CLIPPED:
        return None
    if answer in _LOST:
        raise NeedleNotFound("glance", _LOST[answer])
    if answer != FOUND:
        raise MemoryError("there is no memory for the kernel that follows the needle")
    del kept, pictures
    return found.glance(parameters.needle, steady.taper_mm)


class _Glance(ctypes.Structure):
    """What is known and wanted, as `glance.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("axis", Axis),
        ("spline", Spline),
        ("before_mm", P),
        ("before", I),
        ("advance_mm", D),
        ("taper_mm", D),
        ("since_s", D),
        ("roughly_first", I),
        ("rough", Axis),
        ("rough_section_mm", D),
        ("end_mm", D),
        ("elsewhere_gain", D),
        ("white_share", D),
        ("most_looks", I),
        ("settled_mm", D),
        ("spacing_mm", D),
        ("section_mm", D),
        ("most_advance_mm", D),
        ("beyond_mm", D),
        ("parabola_mm", D),
        ("least_depth_mm", D),
        ("least_length_mm", D),
        ("width_step", I),
        ("tip_reach_mm", D),
        ("tip_before_mm", D),
        ("tip_beyond_mm", D),
        ("row_mm", D),
        ("across", P),
        ("width", I),
        ("picture_mm", D),
        ("reach", D),
        ("picture_rules", P),
        ("tip_rules", P),
        ("prior", P),
        ("log_prior", D),
        ("beyond_end_mm", D),
        ("foreseen_off_mm", D),
        ("foreseen_sigma_mm", D),
        ("tip_rounds", I),
        ("diameter_mm", D),
        ("line_search_px", D),
        ("edge_spread_px", D),
        ("flank_px", D),
        ("smooth_mm", D),
        ("beside_before_mm", D),
        ("beside_beyond_mm", D),
        ("step_mm", D),
        ("gap_mm", D),
        ("crossed_mm", D),
        ("step_gray", D),
    ]


class _Found(ctypes.Structure):
    """What was found, as `glance.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("room", I),
        ("most_control", I),
        ("count", I),
        ("control_count", I),
        ("parameters", P),
        ("control_mm", P),
        ("covariance_mm2", P),
        ("points_mm", P),
        ("residual_px", P),
        ("shown", P),
        ("support", P),
        ("rms_px", D),
        ("streak_misfit", D),
        ("tip", D * 8),
        ("tip_px", D * 4),
        ("is_free", I),
        ("looks", I),
        ("aside_mm", D),
        ("elsewhere_mm", D),
    ]


class _Room:
    """Room for what is found of a curve of at most `room` points."""

    def __init__(self, room: int) -> None:
        self._parameters, self._points_mm, self._residual_px = np.empty(room), np.empty((room, 3)), np.empty((2, room))
        self._control_mm = np.empty((MOST_CONTROL, 3))
        self._covariance_mm2 = np.empty(9 * MOST_CONTROL**2)
        self._shown, self._support = np.empty((2, room), np.bool_), np.empty((2, room))
        self.record = _Found(
            room=room,
            most_control=MOST_CONTROL,
            parameters=address(self._parameters),
            control_mm=address(self._control_mm),
            covariance_mm2=address(self._covariance_mm2),
            points_mm=address(self._points_mm),
            residual_px=address(self._residual_px),
            shown=address(self._shown),
            support=address(self._support),
        )

    def glance(self, needle: Needle, taper_mm: float) -> Glance:
        """The room's content."""
        record = self.record
        count, size = int(record.count), 3 * int(record.control_count)
        fit = CurveFit(
            self._parameters[:count],
            self._control_mm[: record.control_count],
            self._covariance_mm2[: size * size].reshape(size, size),
            self._points_mm[:count],
            self._residual_px[:, :count],
            float(record.rms_px),
            float(record.streak_misfit),
        )
        tip = tip_fit(np.array(record.tip), (taper_mm,))
        tip_px = np.array(record.tip_px).reshape(2, 2)
        return Glance(
            fit,
            self._shown[:, :count],
            self._support[:, :count],
            tip,
            bool(record.is_free),
            tip_px,
            int(record.looks),
            max(float(record.aside_mm), float(record.elsewhere_mm)),
        )


def _axis(needle: Needle, looks: Looks, appearance: Appearance, kept: Kept) -> Axis:
    """The axis of a needle of this appearance, looked for like this."""
    axis = axis_of(needle, looks.grid, looks.spreads, kept)
    for width in {*range(0, appearance.half_width, _WIDTH_STEP), appearance.half_width}:
        banks(looks.grid).bank(appearance.inside, appearance.blur, width)
    axis.half_width, axis.lively = appearance.half_width, looks.with_streak and appearance.inside == LIVELY
    axis.banks = kept.at(banks(looks.grid).addresses[appearance.inside, appearance.blur])
    axis.none_bank = kept.at(no_needle_bank(BLURS[appearance.blur]))
    return axis


@lru_cache(maxsize=16)
def _wanted(parameters: GlanceParameters, appearance: Appearance) -> tuple[_Glance, Kept]:
    """What does not change from pair to pair; and the arrays that it points to."""
    needle, kept = parameters.needle, Kept()
    axis, rough = (_axis(needle, looks, appearance, kept) for looks in (_NEARLY, _ROUGHLY))
    axis.rows_per_section = round(_SECTION_SHARE * ROWS_PER_SECTION)
    spline = spline_of(parameters.fit, kept)
    spline.systematic_px = parameters.fit.systematic_px[appearance.inside]
    prior, log_prior = prior_of_parts()
    return _Glance(
        axis=axis,
        spline=spline,
        rough=rough,
        rough_section_mm=_ROUGH_SECTION_MM,
        end_mm=_END_MM,
        elsewhere_gain=_ELSEWHERE_GAIN,
        white_share=WORTH_A_LOOK,
        settled_mm=SETTLED_MM,
        spacing_mm=parameters.spacing_mm,
        section_mm=_SECTION_SHARE * parameters.spacing_mm,
        most_advance_mm=MOST_ADVANCE_MM,
        beyond_mm=_BEYOND_MM,
        parabola_mm=PARABOLA_MM,
        least_depth_mm=MIN_DEPTH_MM,
        least_length_mm=needle.min_length_mm / 2,
        width_step=_WIDTH_STEP,
        tip_reach_mm=TIP_REACH_MM,
        tip_before_mm=BEFORE_MM,
        tip_beyond_mm=BEYOND_MM,
        row_mm=ROW_MM,
        across=kept.at(ACROSS),
        width=len(ACROSS),
        picture_mm=PICTURE_MM,
        reach=reach(appearance),
        picture_rules=kept.at(PICTURE_RULES),
        tip_rules=kept.at(rules(TRIED_AGAIN_MM, (0.0, np.inf), 0.0, parameters.tip)),
        prior=kept.at(prior),
        log_prior=log_prior,
        beyond_end_mm=BEYOND_END_MM,
        tip_rounds=TIP_ROUNDS,
        diameter_mm=diameter_mm(appearance, needle),
        line_search_px=parameters.beside.search_px,
        edge_spread_px=EDGE_SPREAD_PX,
        flank_px=FLANK_PX,
        smooth_mm=parameters.beside.smooth_along_mm,
        beside_before_mm=TIP_BEFORE_MM,
        beside_beyond_mm=TIP_BEYOND_MM,
        step_mm=parameters.ends.sleeve_step_mm,
        gap_mm=EDGE_GAP_MM,
        crossed_mm=CROSSED_MM,
        step_gray=parameters.ends.sleeve_step_gray,
    ), kept
