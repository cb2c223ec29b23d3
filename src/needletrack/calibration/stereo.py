"""Both cameras and the pose between them, from views of a checkerboard.

Each camera by itself (Zhang 2000, DOI 10.1109/34.888718), then the order of corners in the right pictures,
then all parameters together (cv2.stereoCalibrate). Order: the board looks the same after a half turn, a
square one after a quarter turn, and no single picture tells which corner is the first. But the pose between
the cameras is one for all views: of the turns that each view allows, those are right that agree on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.calibration.board import BoardView, Checkerboard
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.records import Float

MIN_VIEWS = 4
# A turn of the board moves its corners by many squares; half as clear is not clear.
_CLEARLY_BETTER = 3.0
# Corners are found to a tenth of a pixel or better: views this far off are not merely noisy.
_OUTLIER_RATIO, _OUTLIER_PX = 4.0, 0.5
_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
_REMEDY = "show the whole board to both cameras at ten or more places, distances and tilts"


@dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that was left out: its place in the sequence of views, and why."""

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """The rig, and how well it explains the corners.

    rms_px: over all corners in both pictures; used: which views; view_rms_px (len(used), 2): of each, left
    and right.
    """

    rig: StereoRig
    rms_px: float
    used: tuple[int, ...]
    view_rms_px: Float
    rejected: tuple[RejectedView, ...]


def calibrate_stereo(views: Sequence[BoardView], board: Checkerboard, size_px: tuple[int, int]) -> StereoCalibration:
    """Both cameras, for images of size_px (width, height), each with the distortion k1 k2 p1 p2 k3.

    A view is rejected, with the reason, where a picture lacks the board, the order of corners stays
    ambiguous, or the corners contradict the other views. Raises CalibrationError where fewer than MIN_VIEWS
    remain, or where the views are too much alike.
    """
    rejected = [RejectedView(i, reason) for i, view in enumerate(views) if (reason := _missing(view, board))]
    pairs = [
        _Pair(index, view.left_px, view.right_px)
        for index, view in enumerate(views)
        if view.left_px is not None and view.right_px is not None and not _missing(view, board)
    ]
    _require_enough(pairs, rejected)
    try:
        pairs, out_of_order = _in_one_order(pairs, board, size_px)
        rejected += out_of_order
        _require_enough(pairs, rejected)
        solution = _solve(pairs, board, size_px)
        # One at a time: a bad view spoils its neighbours.
        while reason := _worst_is_an_outlier(solution.view_rms_px):
            worst = pairs.pop(int(solution.view_rms_px.max(axis=1).argmax()))
            rejected.append(RejectedView(worst.index, reason))
            _require_enough(pairs, rejected)
            solution = _solve(pairs, board, size_px)
    except (cv2.error, ValueError) as error:
        raise CalibrationError(f"{len(pairs)} views do not determine the cameras: {_REMEDY} ({error})") from error
    return StereoCalibration(
        solution.rig,
        solution.rms_px,
        tuple(pair.index for pair in pairs),
        solution.view_rms_px,
        tuple(sorted(rejected, key=lambda view: view.index)),
    )


@dataclass(frozen=True, slots=True)
class _Pair:
    """A view whose corners (N, 2) both pictures show."""

    index: int
    left_px: Float
    right_px: Float


@dataclass(frozen=True, slots=True)
class _Solution:
    rig: StereoRig
    rms_px: float
    view_rms_px: Float


def _missing(view: BoardView, board: Checkerboard) -> str:
    found = {"left": view.left_px, "right": view.right_px}
    for side, corners_px in found.items():
        if corners_px is not None and len(corners_px) != len(board.points_mm):
            return f"the {side} picture has {len(corners_px)} corners, the board {len(board.points_mm)}"
    without = [side for side, corners_px in found.items() if corners_px is None]
    return f"the board was not found in the {' and the '.join(without)} picture" if without else ""


def _require_enough(pairs: Sequence[_Pair], rejected: Sequence[RejectedView]) -> None:
    if len(pairs) < MIN_VIEWS:
        reasons = "".join(f"; view {view.index}: {view.reason}" for view in rejected)
        raise CalibrationError(f"{len(pairs)} usable views of the board are fewer than {MIN_VIEWS}: {_REMEDY}{reasons}")


def _worst_is_an_outlier(view_rms_px: Float) -> str:
    """Why the worst of the views (N, 2) has to go; empty where it may stay."""
    by_view_px = view_rms_px.max(axis=1)
    worst_px, limit_px = by_view_px.max(), max(_OUTLIER_RATIO * np.median(by_view_px), _OUTLIER_PX)
    if worst_px <= limit_px:
        return ""
    return (
        f"its corners are {worst_px:.2f} px rms off, and {limit_px:.2f} px are the limit here: "
        "the board or a camera may have moved between the two exposures"
    )


# The order of corners


def _in_one_order(
    pairs: Sequence[_Pair], board: Checkerboard, size_px: tuple[int, int]
) -> tuple[list[_Pair], list[RejectedView]]:
    """The pairs with the right corners in the order of the left ones, and those whose order stays ambiguous.

    Every turn of every view says where the right camera stands; the best such answer is the one under which
    the views, each with the turn that suits it best, leave the least error.
    """
    left_from_board = _solve_camera([pair.left_px for pair in pairs], board, size_px).camera_from_board
    right = _solve_camera([pair.right_px for pair in pairs], board, size_px)
    errors_px = []
    for from_left, from_right in zip(left_from_board, right.camera_from_board, strict=True):
        for turn in board.turns:
            right_from_left = from_right @ turn.turned @ from_left.inverse()
            errors_px.append(_turn_errors_px(pairs, board, left_from_board, right.camera, right_from_left))
    by_answer = np.array(errors_px)  # (answers, views, turns)
    chosen = by_answer.argmin(axis=2)
    remaining_px = np.median(by_answer.min(axis=2), axis=1)
    best = int(remaining_px.argmin())
    different = remaining_px[(chosen != chosen[best]).mean(axis=1) > 0.5]
    if len(different) and different.min() < _CLEARLY_BETTER * remaining_px[best]:
        raise CalibrationError(
            f"the board looks the same after a turn, and the views are too much alike to tell which was made: {_REMEDY}"
        )
    ordered, out_of_order = [], []
    for pair, view_errors_px, turn_index in zip(pairs, by_answer[best], chosen[best], strict=True):
        least_px, second_px = np.sort(view_errors_px)[:2]
        if second_px < _CLEARLY_BETTER * least_px:
            reason = (
                "its corners fit the other views in no order, or in several: "
                f"{least_px:.1f} px off in the best, {second_px:.1f} in the next"
            )
            out_of_order.append(RejectedView(pair.index, reason))
        else:
            ordered.append(_Pair(pair.index, pair.left_px, pair.right_px[board.turns[turn_index].order]))
    return ordered, out_of_order


def _turn_errors_px(
    pairs: Sequence[_Pair],
    board: Checkerboard,
    left_from_board: Sequence[RigidTransform],
    right: Camera,
    right_from_left: RigidTransform,
) -> Float:
    """Error (views, turns), px rms, of the right corners in each order under one right_from_left."""
    errors_px = np.empty((len(pairs), len(board.turns)))
    for i, (pair, from_board) in enumerate(zip(pairs, left_from_board, strict=True)):
        projected_px = right.project((right_from_left @ from_board).apply(board.points_mm))
        for j, turn in enumerate(board.turns):
            off_px = np.linalg.norm(pair.right_px[turn.order] - projected_px, axis=1)
            errors_px[i, j] = np.sqrt((off_px**2).mean())
    return errors_px


# OpenCV's solvers


@dataclass(frozen=True, slots=True)
class _CameraSolution:
    camera: Camera
    camera_from_board: tuple[RigidTransform, ...]


def _solve_camera(corners_px: Sequence[Float], board: Checkerboard, size_px: tuple[int, int]) -> _CameraSolution:
    board_points, image_points = _for_opencv([board.points_mm] * len(corners_px)), _for_opencv(corners_px)
    _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
        board_points, image_points, size_px, np.eye(3), np.zeros(5), criteria=_UNTIL
    )
    poses = tuple(
        RigidTransform(orthonormalized(cv2.Rodrigues(rotation)[0]), np.ravel(translation))
        for rotation, translation in zip(rotations, translations, strict=True)
    )
    return _CameraSolution(_camera(matrix, distortion, size_px), poses)


def _solve(pairs: Sequence[_Pair], board: Checkerboard, size_px: tuple[int, int]) -> _Solution:
    left = _solve_camera([pair.left_px for pair in pairs], board, size_px).camera
    right = _solve_camera([pair.right_px for pair in pairs], board, size_px).camera
    (
        rms_px,
        left_matrix,
        left_distortion,
        right_matrix,
        right_distortion,
        rotation,
        translation,
        *_,
        view_rms_px,
    ) = cv2.stereoCalibrateExtended(
        _for_opencv([board.points_mm] * len(pairs)),
        _for_opencv([pair.left_px for pair in pairs]),
        _for_opencv([pair.right_px for pair in pairs]),
        left.matrix.copy(),
        left.distortion.copy(),
        right.matrix.copy(),
        right.distortion.copy(),
        size_px,
        np.eye(3),
        np.zeros(3),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=_UNTIL,
    )
    rig = StereoRig(
        _camera(left_matrix, left_distortion, size_px),
        _camera(right_matrix, right_distortion, size_px),
        RigidTransform(orthonormalized(rotation), np.ravel(translation)),
    )
    return _Solution(rig, float(rms_px), np.asarray(view_rms_px, dtype=np.float64))


def _camera(matrix: npt.ArrayLike, distortion: npt.ArrayLike, size_px: tuple[int, int]) -> Camera:
    return Camera(np.asarray(matrix, dtype=np.float64), np.ravel(distortion)[:5], size_px)


def _for_opencv(points: Sequence[Float]) -> list[npt.NDArray[np.float32]]:
    return [np.ascontiguousarray(each, dtype=np.float32) for each in points]
