"""Whether the cameras still stand as they did: from fresh views of a board, and from tracking itself.

A board of known size tells every motion. Tracking tells less. Along a needle, matched points lie on epipolar lines by
construction; only its tip, which each view finds by itself, may lie off its line. A pitch, a roll away from the middle
and a vertical shift move it across; a yaw and a shift along the baseline move it along, and change depth and length
in silence.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from needletrack.calibration.board import Board, BoardView
from needletrack.calibration.bundle import Refit, refit
from needletrack.calibration.worth import Expected, actual, judged
from needletrack.errors import CalibrationError
from needletrack.geometry.epipolar import cross_matrix, epipolar_distance_px
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, NeedleTrack, Reason, Status

# Chance alone moves the cameras once in so many checks.
_FALSE_ALARM = 1e-4
# How far cameras that were bumped may have moved, standard deviations: degrees and mm.
_BUMP_DEG, _BUMP_MM = 2.0, 5.0
# Corners without a stated noise are found to this, px a coordinate.
_CORNER_SIGMA_PX = 0.05
# A motion that does less than this in space is none, whatever the corners say: neighbouring corners err alike.
_LEAST_EFFECT_MM = 0.05
_MAD_SIGMA = 1.4826
# The standard error of a median is this many times that of a mean.
_MEDIAN_ERROR = 1.2533


class DriftParameters(BaseModel):
    """When tips that lie off their epipolar lines say that a camera has moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    window_pairs: int = Field(60, ge=5, description="So many of the last tips that both views found are looked at.")
    least_pairs: int = Field(10, ge=5, description="Fewer than this say nothing.")
    max_offset_px: float = Field(
        0.3, gt=0, description="Greatest median distance of the right tip from its epipolar line, px."
    )
    clear_sigmas: float = Field(4.0, gt=0, description="It must exceed its own standard error by this factor.")


@dataclass(frozen=True, slots=True)
class DriftState:
    """The last tips' signed distances from their epipolar lines, px, the newest last: a value, as a track is.

    has_moved: whether they lie off their lines, to one side, by more than chance and tips allow. Once they do it takes
    half of what is tolerated to say that they do no more: an alarm that comes and goes with the noise helps nobody.
    """

    offsets_px: tuple[float, ...] = ()
    has_moved: bool = False

    def after(self, track: NeedleTrack, rig: StereoRig, parameters: DriftParameters) -> "DriftState":
        """The state with one more track; one without a tip in both views adds nothing."""
        tip_px = track.evidence.tip_px
        if tip_px is None or track.status is Status.INVALID:
            return self
        left, right = rig.left.undistort(tip_px[[0]]), rig.right.undistort(tip_px[[1]])
        offset = float(epipolar_distance_px(rig.fundamental, left, right)[0])
        offsets = (*self.offsets_px, offset)[-parameters.window_pairs :]
        return DriftState(offsets, _moved(np.array(offsets), parameters, already=self.has_moved))


def _moved(offsets_px: Float, parameters: DriftParameters, *, already: bool) -> bool:
    if len(offsets_px) < parameters.least_pairs:
        return False
    median = float(np.median(offsets_px))
    if already:
        return abs(median) > parameters.max_offset_px / 2
    spread = _MAD_SIGMA * float(np.median(np.abs(offsets_px - median)))
    error = float(_MEDIAN_ERROR * spread / np.sqrt(len(offsets_px)))
    return abs(median) > max(parameters.max_offset_px, parameters.clear_sigmas * error)


def doubted(track: NeedleTrack) -> NeedleTrack:
    """The track, not ok because the cameras have moved; one without a shape stays as it is."""
    if track.status is Status.INVALID:
        return track
    found = {*track.reasons, Reason.CALIBRATION_DRIFT}
    return replace(track, status=Status.DEGRADED, reasons=tuple(reason for reason in Reason if reason in found))


@dataclass(frozen=True, slots=True)
class Motion:
    """How the right camera moved against the left one: turn_deg about its own axes, shift_mm along them, (3,) each.

    x is pitch, y yaw, z roll.
    """

    turn_deg: Float = field(default_factory=lambda: np.zeros(3))
    shift_mm: Float = field(default_factory=lambda: np.zeros(3))

    def applied_to(self, rig: StereoRig) -> StereoRig:
        """The rig after the motion."""
        turn = Rotation.from_rotvec(np.radians(self.turn_deg)).as_matrix()
        pose = rig.right_from_left
        moved = RigidTransform(turn @ pose.rotation, turn @ pose.translation_mm - self.shift_mm)
        return StereoRig(rig.left, rig.right, moved)


@dataclass(frozen=True, slots=True)
class Effect:
    """What a motion does that nobody noticed: error in space over the workspace, and offset from epipolar lines.

    offset_px: median over the workspace, with its sign, and rms.
    """

    error: Expected
    offset_px: float
    offset_rms_px: float


def effect(rig: StereoRig, motion: Motion, points_mm: Float) -> Effect:
    """The effect of a motion over points (N, 3) mm, computed; points that leave an image count as well."""
    moved = motion.applied_to(rig)
    left_px, right_px = moved.project(points_mm)
    left, right = rig.left.undistort(left_px), rig.right.undistort(right_px)
    offsets = epipolar_distance_px(rig.fundamental, left, right)
    return Effect(actual(rig, moved, points_mm), float(np.median(offsets)), float(np.sqrt((offsets**2).mean())))


@dataclass(frozen=True, slots=True)
class BoardCheck:
    """What fresh views of a board say about a calibration.

    epipolar_px: rms distance of right corners from the epipolar lines, and its mean; length_error: mean relative error
    of the board's lengths; motion: of the right camera, with its standard deviations; effect: what it does in space.
    moved: whether chance, and the calibration's own uncertainty, leave that open.
    """

    views: int
    epipolar_rms_px: float
    epipolar_mean_px: float
    length_error: float
    motion: Motion
    motion_sigma: Motion
    effect: Effect
    surprise: float
    moved: bool


def check_views(
    rig: StereoRig,
    covariance: Float | None,
    corner_sigma_px: float | None,
    views: Sequence[BoardView],
    board: Board,
    points_mm: Float,
) -> BoardCheck:
    """Judge a rig, with the covariance (P, P) of its calibration, by fresh views of a board.

    The board's poses and the right camera's are solved for, once with that camera where it was, once free: twice the
    difference of the log likelihoods is chi squared with six degrees of freedom where nothing moved. points_mm (N, 3):
    where the effect is told. Raises CalibrationError where no view shows the board to both cameras.
    """
    ordered = [found for view in views if (found := _in_order(rig, view, board)) is not None]
    if not ordered:
        raise CalibrationError("no pair shows the board to both cameras: hold it where both see it whole")
    # The noise of these pictures may be another than that of the calibration's.
    sigma_px = corner_sigma_px or _CORNER_SIGMA_PX
    free = refit(rig, covariance, ordered, board, sigma_px, bump=(_BUMP_DEG, _BUMP_MM))
    sigma_px = max(sigma_px, free.sigma_px)
    free = refit(rig, covariance, ordered, board, sigma_px, bump=(_BUMP_DEG, _BUMP_MM))
    held = refit(rig, covariance, ordered, board, sigma_px)
    surprise = max(0.0, held.cost - free.cost)
    motion, sigma = _motion(rig, free)
    caused = effect(rig, motion, points_mm)
    distances, lengths = _distances(rig, ordered, board)
    moved = surprise > chdtri(6, _FALSE_ALARM) and caused.error.before_mm > _LEAST_EFFECT_MM
    return BoardCheck(
        len(ordered),
        float(np.sqrt((distances**2).mean())),
        float(distances.mean()),
        lengths,
        motion,
        sigma,
        caused,
        surprise,
        bool(moved),
    )


def _motion(rig: StereoRig, free: Refit) -> tuple[Motion, Motion]:
    """How the right camera moved, and the standard deviations."""
    turn, shift = free.bump[:3], free.bump[3:]
    before_mm = rig.right_from_left.translation_mm
    moved_mm = Rotation.from_rotvec(turn).as_matrix() @ before_mm - (before_mm + shift)
    by_bump = np.column_stack([-cross_matrix(before_mm), -np.eye(3)])
    sigma_mm = np.sqrt(np.diag(by_bump @ free.bump_covariance @ by_bump.T))
    sigma_deg = np.degrees(np.sqrt(np.diag(free.bump_covariance)[:3]))
    return Motion(np.degrees(turn), moved_mm), Motion(sigma_deg, sigma_mm)


def _in_order(rig: StereoRig, view: BoardView, board: Board) -> BoardView | None:
    """The view with the right corners in the order that suits the rig best."""
    if view.left_px is None or view.right_px is None:
        return None
    left = rig.left.undistort(np.nan_to_num(view.left_px))
    best, least = None, np.inf
    for turn in board.turns:
        right_px = view.right_px[turn.order]
        known = np.isfinite(view.left_px + right_px).all(axis=1)
        if known.sum() < 6:
            return None
        right = rig.right.undistort(right_px[known])
        off = float(np.abs(epipolar_distance_px(rig.fundamental, left[known], right)).mean())
        if off < least:
            best, least = BoardView(view.left_px, right_px), off
    return best


def _distances(rig: StereoRig, views: Sequence[BoardView], board: Board) -> tuple[Float, float]:
    parts = [judged(rig, view, board) for view in views]
    lengths = np.concatenate([each for _, each in parts])
    relative = float((lengths[:, 0] / lengths[:, 1] - 1).mean()) if len(lengths) else float("nan")
    return np.concatenate([each for each, _ in parts]), relative
