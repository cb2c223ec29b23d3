"""One look at a needle that was seen whole in the pair before, where it must be now.

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
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import Array, address, call, two_tip_views
from needletrack.records import Appearance, Float, Image, Reason
from needletrack.tracking.adjust import MOVED
from needletrack.tracking.beside import BesideParameters
from needletrack.tracking.clipped import CLIPPED_GRAY, WORTH_A_LOOK
from needletrack.tracking.ends import (
    CROSSED_MM,
    EDGE_GAP_MM,
    TIP_BEFORE_MM,
    TIP_BEYOND_MM,
    EndsParameters,
)
from needletrack.tracking.evidence import (
    BLURS,
    EDGES,
    HALF_WIDTHS,
    LIVELY,
    OFFSETS,
    Grid,
    new_bank,
    no_needle_bank,
    reference,
)
from needletrack.tracking.fit import ROBUST_SIGMAS, ROUNDS, CurveFit, FitParameters, priors
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import EDGE_SPREAD_PX, FLANK_PX, Mask
from needletrack.tracking.silhouette import (
    CLUTTERED,
    DRIFTS,
    LEAST_GAIN,
    LEAST_SIGMA,
    LEAST_UNIT_GRAY,
    LOG_NEVER,
    LOG_OUTLIER,
    MOTION_PRICE,
    OUTLIER,
    ROWS_PER_SECTION,
    UNIT_PER_NOISE,
    USED,
    diameter_mm,
    unit_mm,
)
from needletrack.tracking.streak import LEAST_SHARE, LINE, RULES
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
# The tip is looked for this far beyond where the needle was followed to, in so many rounds.
TIP_REACH_MM, TIP_ROUNDS = 12.0, 4
# Beyond its end a curve goes on with the bend of so much of it, mm.
PARABOLA_MM = 12.0
MIN_DEPTH_MM = 20.0
# Sections are so much longer than the points of the curve are apart: what is followed changes slowly along itself, and
# most of the work is proportional to their number.
_SECTION_SHARE = 1.0
# Before its tip the needle thins in steps of so many half widths: each has matrices as large as a cache.
_WIDTH_STEP = 3
_MOST_CONTROL = 30
# The tip shows its angle to the line of sight over so many points.
_TIP_POINTS = 8
# What the kernel says; 0: found.
_FOUND, _BEYOND, _CLIPPED = 0, 1, 7
_LOST = {
    _BEYOND: Reason.JUMP,
    2: Reason.LOW_COVERAGE,
    3: Reason.HIGH_UNCERTAINTY,
    4: Reason.TOO_SHORT,
    5: Reason.TIP_NOT_SEEN,
    6: Reason.OUTSIDE_WORKSPACE,
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

    since_s: how long ago that was; advance_mm: how far its tip comes in that time.
    """

    points_mm: Float
    appearance: Appearance
    taper_mm: float
    since_s: float
    advance_mm: float


@dataclass(frozen=True, slots=True)
class Glance:
    """The curve base -> tip; where each view shows it (2, N); log odds (2, N) of it; its tip, whether that is free.

    tip_px (2, 2): the tip as the left and the right view alone place it, raw px.
    """

    fit: CurveFit
    shown: Mask
    support: Float
    tip: TipFit
    tip_is_free: bool
    tip_px: Float


def glance(images: Images, rig: StereoRig, steady: Steady, parameters: GlanceParameters) -> Glance | None:
    """The needle where it was moved to since; None where it is so bright that it is white.

    Raises NeedleNotFound where the views do not show it, or its tip has gone further than was looked.
    """
    shaft = replace(steady.appearance, taper_mm=None)
    wanted, kept = _wanted(parameters, shaft)
    now = _Glance.from_buffer_copy(wanted)
    points_mm = np.ascontiguousarray(steady.points_mm)
    now.before_mm, now.before = address(points_mm), len(points_mm)
    now.advance_mm, now.taper_mm, now.since_s = steady.advance_mm, steady.taper_mm, steady.since_s
    now.foreseen_sigma_mm = ADVANCE_SIGMA_MM_S * steady.since_s
    eyes, views = (_Eye * 2)(), two_tip_views()
    poses = (None, rig.right_from_left)
    for eye, view, image, camera, lens, pose in zip(
        eyes, views, images, (rig.left, rig.right), rig.lenses, poses, strict=True
    ):
        contiguous = np.ascontiguousarray(image)
        eye.image, eye.rows, eye.columns, eye.stride = address(contiguous), *contiguous.shape, contiguous.shape[1]
        eye.own, eye.posed = address(camera.lens), address(lens)
        last_mm = points_mm[-_TIP_POINTS:] if pose is None else pose.apply(points_mm[-_TIP_POINTS:])
        along, sight = last_mm[-1] - last_mm[0], last_mm[-1]
        toward = float(along @ sight) ** 2 / float((along @ along) * (sight @ sight))
        sine = stepped(math.sqrt(max(0.0, 1 - toward)))
        pictures = inside_pictures(steady.taper_mm, shaft, unit_mm(parameters.needle), sine, None)
        pictures.lay_out(view, 0)
        kept = (*kept, contiguous, pictures.parts, pictures.own, pictures.extent)
    room = len(points_mm) + round((_FARTHEST_ADVANCE_MM + 2 * _BEYOND_MM) / parameters.spacing_mm) + 16
    found = _Room(room)
    answer = call("glance", now, eyes, views, found.record)
    if answer == _BEYOND:
        # Its tip may have been placed too short before.
        now.advance_mm, now.most_advance_mm, now.foreseen_sigma_mm = _FARTHER_MM, _FARTHEST_ADVANCE_MM, np.inf
        answer = call("glance", now, eyes, views, found.record)
    if answer == _CLIPPED:
        return None
    if answer in _LOST:
        raise NeedleNotFound("glance", _LOST[answer])
    if answer != _FOUND:
        raise MemoryError("there is no memory for the kernel that follows the needle")
    return found.glance(parameters.needle, steady.taper_mm)


_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class _Eye(ctypes.Structure):
    """One view, as `glance.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("image", _P),
        ("rows", _I),
        ("columns", _I),
        ("stride", _I),
        ("own", _P),
        ("posed", _P),
    ]


class _Glance(ctypes.Structure):
    """What is known and wanted, as `glance.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("before_mm", _P),
        ("before", _I),
        ("advance_mm", _D),
        ("taper_mm", _D),
        ("since_s", _D),
        ("white_gray", _D),
        ("white_share", _D),
        ("spacing_mm", _D),
        ("section_mm", _D),
        ("most_advance_mm", _D),
        ("beyond_mm", _D),
        ("parabola_mm", _D),
        ("least_depth_mm", _D),
        ("least_length_mm", _D),
        ("rows_per_section", _I),
        ("offsets", _P),
        ("places", _I),
        ("unit_mm", _D),
        ("least_gray", _D),
        ("per_noise", _D),
        ("whitener", _P),
        ("half_widths", _P),
        ("half_width", _I),
        ("width_step", _I),
        ("banks", _P),
        ("none_bank", _P),
        ("edges", _I),
        ("shifts", _I),
        ("fine_shifts", _I),
        ("low", _D),
        ("step", _D),
        ("fine_step", _D),
        ("refine", _P),
        ("never", _D),
        ("outlier", _D),
        ("drifts", _P),
        ("drift_count", _I),
        ("motion_price", _D),
        ("floor_log", _D),
        ("least_gain", _D),
        ("least_sigma", _D),
        ("used", _D),
        ("clutter_factor", _D),
        ("spreads", _P),
        ("looks", _I),
        ("lively", _I),
        ("line", _P),
        ("line_length", _I),
        ("streak_rules", _P),
        ("streak_least_share", _D),
        ("control_spacing_mm", _D),
        ("priors", _P),
        ("streak_shares", _P),
        ("streak_mm", _D),
        ("streak_robust", _D),
        ("correlation_mm", _D),
        ("robust_px", _D),
        ("rounds", _I),
        ("systematic_px", _D),
        ("systematic_mm", _D),
        ("tip_reach_mm", _D),
        ("tip_before_mm", _D),
        ("tip_beyond_mm", _D),
        ("row_mm", _D),
        ("across", _P),
        ("width", _I),
        ("picture_mm", _D),
        ("reach", _D),
        ("picture_rules", _P),
        ("tip_rules", _P),
        ("prior", _P),
        ("log_prior", _D),
        ("foreseen_sigma_mm", _D),
        ("tip_rounds", _I),
        ("diameter_mm", _D),
        ("line_search_px", _D),
        ("edge_spread_px", _D),
        ("flank_px", _D),
        ("smooth_mm", _D),
        ("beside_before_mm", _D),
        ("beside_beyond_mm", _D),
        ("step_mm", _D),
        ("gap_mm", _D),
        ("crossed_mm", _D),
        ("step_gray", _D),
    ]


class _Found(ctypes.Structure):
    """What was found, as `glance.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("room", _I),
        ("most_control", _I),
        ("count", _I),
        ("control_count", _I),
        ("parameters", _P),
        ("control_mm", _P),
        ("covariance_mm2", _P),
        ("points_mm", _P),
        ("residual_px", _P),
        ("shown", _P),
        ("support", _P),
        ("rms_px", _D),
        ("streak_misfit", _D),
        ("tip", _D * 8),
        ("tip_px", _D * 4),
        ("is_free", _I),
    ]


class _Room:
    """Room for what is found of a curve of at most `room` points."""

    def __init__(self, room: int) -> None:
        self._parameters, self._points_mm, self._residual_px = np.empty(room), np.empty((room, 3)), np.empty((2, room))
        self._control_mm = np.empty((_MOST_CONTROL, 3))
        self._covariance_mm2 = np.empty(9 * _MOST_CONTROL**2)
        self._shown, self._support = np.empty((2, room), np.bool_), np.empty((2, room))
        self.record = _Found(
            room=room,
            most_control=_MOST_CONTROL,
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
        return Glance(fit, self._shown[:, :count], self._support[:, :count], tip, bool(record.is_free), tip_px)


@lru_cache(maxsize=64)
def _bank(half_width: int, blur: int, inside: int, grid: Grid) -> Array:
    """A bank by the indices of its half width, blur and inside."""
    return new_bank(float(HALF_WIDTHS[half_width]), BLURS[blur], inside, grid)


@lru_cache(maxsize=16)
def _wanted(parameters: GlanceParameters, appearance: Appearance) -> tuple[_Glance, tuple[Array, ...]]:
    """What does not change from pair to pair; and the arrays that it points to."""
    needle, fit, looks = parameters.needle, parameters.fit, MOVED
    grid, blur = looks.grid, BLURS[appearance.blur]
    banks = np.zeros(len(HALF_WIDTHS), np.uintp)
    kept: list[Array] = [banks]
    for width in {*range(0, appearance.half_width, _WIDTH_STEP), appearance.half_width}:
        each = _bank(width, appearance.blur, appearance.inside, grid)
        banks[width] = address(each)
        kept.append(each)
    prior, log_prior = prior_of_parts()

    def at(array: Array) -> int:
        kept.append(array)
        return address(array)

    return _Glance(
        white_gray=CLIPPED_GRAY,
        white_share=WORTH_A_LOOK,
        spacing_mm=parameters.spacing_mm,
        section_mm=_SECTION_SHARE * parameters.spacing_mm,
        most_advance_mm=MOST_ADVANCE_MM,
        beyond_mm=_BEYOND_MM,
        parabola_mm=PARABOLA_MM,
        least_depth_mm=MIN_DEPTH_MM,
        least_length_mm=needle.min_length_mm / 2,
        rows_per_section=round(_SECTION_SHARE * ROWS_PER_SECTION),
        offsets=at(OFFSETS),
        places=len(OFFSETS),
        unit_mm=unit_mm(needle),
        least_gray=LEAST_UNIT_GRAY,
        per_noise=UNIT_PER_NOISE,
        whitener=at(reference()),
        half_widths=at(HALF_WIDTHS),
        half_width=appearance.half_width,
        width_step=_WIDTH_STEP,
        banks=address(banks),
        none_bank=at(no_needle_bank(blur)),
        edges=EDGES,
        shifts=len(grid.shifts),
        fine_shifts=len(grid.fine_shifts),
        low=grid.shifts[0],
        step=grid.shifts[1] - grid.shifts[0],
        fine_step=grid.fine_shifts[1] - grid.fine_shifts[0],
        refine=at(grid.refine),
        never=LOG_NEVER,
        outlier=OUTLIER,
        drifts=at(DRIFTS),
        drift_count=len(DRIFTS),
        motion_price=MOTION_PRICE,
        floor_log=LOG_OUTLIER,
        least_gain=LEAST_GAIN,
        least_sigma=LEAST_SIGMA,
        used=USED,
        clutter_factor=CLUTTERED,
        spreads=at(np.array(looks.spreads)),
        looks=len(looks.spreads),
        lively=appearance.inside == LIVELY,
        line=at(LINE),
        line_length=len(LINE),
        streak_rules=at(RULES),
        streak_least_share=LEAST_SHARE,
        control_spacing_mm=fit.control_spacing_mm,
        priors=at(priors(fit)),
        streak_shares=at(np.array([fit.streak_share, fit.streak_change_share, fit.streak_bend_share])),
        streak_mm=fit.streak_mm,
        streak_robust=ROBUST_SIGMAS,
        correlation_mm=fit.correlation_mm,
        robust_px=fit.robust_px,
        rounds=ROUNDS,
        systematic_px=fit.systematic_px[appearance.inside],
        systematic_mm=fit.systematic_mm,
        tip_reach_mm=TIP_REACH_MM,
        tip_before_mm=BEFORE_MM,
        tip_beyond_mm=BEYOND_MM,
        row_mm=ROW_MM,
        across=at(ACROSS),
        width=len(ACROSS),
        picture_mm=PICTURE_MM,
        reach=reach(appearance),
        picture_rules=at(PICTURE_RULES),
        tip_rules=at(rules(TRIED_AGAIN_MM, (0.0, np.inf), 0.0, parameters.tip)),
        prior=at(prior),
        log_prior=log_prior,
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
    ), tuple(kept)
