"""Whether the cameras still stand as they did, from fresh views of a board, which tells every motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from needletrack.calibration.board import Board, BoardView
from needletrack.calibration.bundle import Refit, refit
from needletrack.calibration.worth import Expected, actual, judged
from needletrack.errors import CalibrationError
from needletrack.geometry.epipolar import cross_matrix, epipolar_distance_px
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, turned_by
from needletrack.records import Float

# Chance alone moves the cameras once in so many checks.
_FALSE_ALARM = 1e-4
# How far cameras that were bumped may have moved, standard deviations: degrees and mm.
_BUMP_DEG, _BUMP_MM = 2.0, 5.0
# Corners without a stated noise are found to this, px a coordinate.
_CORNER_SIGMA_PX = 0.05
# A motion that does less than this in space is none, whatever the corners say: neighbouring corners err alike.
_LEAST_EFFECT_MM = 0.05


@dataclass(frozen=True, slots=True)
class Motion:
    """How the right camera moved against the left one: turn_deg about its own axes, shift_mm along them, (3,) each.

    x is pitch, y yaw, z roll.
    """

    turn_deg: Float = field(default_factory=lambda: np.zeros(3))
    shift_mm: Float = field(default_factory=lambda: np.zeros(3))

    def applied_to(self, rig: StereoRig) -> StereoRig:
        """The rig after the motion."""
        turn = turned_by(np.radians(self.turn_deg))
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
    moved_mm = turned_by(turn) @ before_mm - (before_mm + shift)
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
