"""What a calibration is worth: the error in space to expect from it, before and after the best rigid alignment.

Focal length and distance are nearly one parameter where the board is small: the whole scene then moves to and fro, by
far more than it bends. A registration to a robot, or any other best rigid motion, takes that part away; what remains
is the error of shapes and lengths.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import Board, BoardView, Checkerboard
from needletrack.calibration.bundle import adjust, expected_covariance
from needletrack.calibration.stereo import StereoCalibration
from needletrack.geometry.epipolar import epipolar_distance_px
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.geometry.triangulation import triangulate
from needletrack.geometry.uncertainty import RigUncertainty
from needletrack.records import Float

_FOLDS = 5
_LARGER = 3.0
_TILT_DEG = 35.0


@dataclass(frozen=True, slots=True)
class Expected:
    """Root mean square error, mm, over the workspace, that the calibration alone gives points in space.

    before_mm: in the left camera's frame; after_mm: after the best rigid alignment.
    """

    before_mm: float
    after_mm: float


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Views that the solution had not seen, in turn (cross-validation).

    epipolar_px: rms distance of a right corner from its left one's epipolar line; length_mm: rms error of the
    distances between the corners at the ends of each row and column, triangulated; longest_mm: the longest of these.
    """

    epipolar_px: float
    length_mm: float
    longest_mm: float
    views: int


@dataclass(frozen=True, slots=True)
class Improvement:
    """What another board, or more views, would bring."""

    change: str
    expected: Expected


def space_grid_mm(
    rig: StereoRig,
    x_mm: tuple[float, float],
    y_mm: tuple[float, float],
    z_mm: tuple[float, float],
    counts: tuple[int, int, int] = (14, 12, 6),
) -> Float:
    """A grid of points (N, 3) in the left camera's frame that both cameras see; may be empty."""
    axes = [np.linspace(*ends, count) for ends, count in zip((x_mm, y_mm, z_mm), counts, strict=True)]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    local = rig.right_from_left.apply(points)
    points = points[(points[:, 2] > 0) & (local[:, 2] > 0)]
    left_px, right_px = rig.project(points)
    return points[rig.left.contains(left_px) & rig.right.contains(right_px)]


def expected(rig: StereoRig, covariance: Float, points_mm: Float) -> Expected:
    """The error to expect over points (N, 3), given the covariance (P, P) of the rig's parameters."""
    return Expected(
        RigUncertainty(rig, covariance).rms_mm(points_mm),
        RigUncertainty(rig, covariance, points_mm).rms_mm(points_mm),
    )


def actual(rig: StereoRig, true_rig: StereoRig, points_mm: Float) -> Expected:
    """The error of what a rig makes of the true pixels of points (N, 3), where the true rig is known."""
    left_px, right_px = true_rig.project(points_mm)
    found_mm = triangulate(rig, rig.left.undistort(left_px), rig.right.undistort(right_px))
    before = float(np.sqrt(((found_mm - points_mm) ** 2).sum(axis=1).mean()))
    _, root_sum_square = Rotation.align_vectors(points_mm - points_mm.mean(axis=0), found_mm - found_mm.mean(axis=0))
    return Expected(before, float(root_sum_square / np.sqrt(len(points_mm))))


def held_out(calibration: StereoCalibration, board: Board) -> HeldOut:
    """Each fifth of the views judged by a calibration from the other four."""
    views, poses = calibration.views, calibration.bundle.left_from_board
    folds = min(_FOLDS, len(views))
    off_px, off_mm = [], []
    longest = 0.0
    for fold in range(folds):
        inside = [i for i in range(len(views)) if i % folds != fold]
        if len(inside) < 3:
            continue
        rig = adjust(
            [views[i] for i in inside],
            board,
            calibration.rig,
            [poses[i] for i in inside],
            calibration.terms,
            warp=calibration.bundle.warp_mm is not None,
        ).rig
        for view in views[fold::folds]:
            epipolar_px, lengths = judged(rig, view, board)
            off_px.append(epipolar_px)
            off_mm.append(lengths[:, 0] - lengths[:, 1])
            longest = max(longest, float(lengths[:, 1].max(initial=0.0)))
    every_px, every_mm = np.concatenate(off_px), np.concatenate(off_mm)
    return HeldOut(float(np.sqrt((every_px**2).mean())), float(np.sqrt((every_mm**2).mean())), longest, len(off_px))


def improvements(calibration: StereoCalibration, board: Board, points_mm: Float) -> tuple[Improvement, ...]:
    """What would make it better over points (N, 3), computed for boards that were not shown: the best first."""
    rig, bundle = calibration.rig, calibration.bundle
    bent = bundle.warp_mm is not None
    poses = list(bundle.left_from_board)
    sigma_px = bundle.sigma_px
    found = []
    larger = Checkerboard(board.squares_x, board.squares_y, _LARGER * board.square_mm)
    size = " x ".join(f"{count * larger.square_mm:.0f}" for count in (board.squares_x, board.squares_y))
    about_middle = [_enlarged(pose, board) for pose in poses]
    found.append(
        Improvement(
            f"a board {_LARGER:g} times as large ({size} mm), held at the same places",
            expected(rig, expected_covariance(rig, larger, about_middle, sigma_px, warp=bent), points_mm),
        )
    )
    tilted = _tilted(rig, board, points_mm)
    found.append(
        Improvement(
            f"{len(tilted)} more views, tilted by {_TILT_DEG:g} degrees each way, near and far",
            expected(rig, expected_covariance(rig, board, [*poses, *tilted], sigma_px, warp=bent), points_mm),
        )
    )
    return tuple(sorted(found, key=lambda each: each.expected.before_mm))


def judged(rig: StereoRig, view: BoardView, board: Board) -> tuple[Float, Float]:
    """Distances (N,) px from epipolar lines, and lengths (M, 2) mm, triangulated and true."""
    assert view.left_px is not None
    assert view.right_px is not None
    columns, rows = board.inner_corners
    known = np.asarray(np.isfinite(view.left_px + view.right_px).all(axis=1))
    points = np.full((len(known), 3), np.nan)
    left, right = rig.left.undistort(view.left_px[known]), rig.right.undistort(view.right_px[known])
    points[known] = triangulate(rig, left, right)
    found, true = points.reshape(rows, columns, 3), board.points_mm.reshape(rows, columns, 3)
    lengths = [
        np.column_stack([np.linalg.norm(grid[1] - grid[0], axis=-1) for grid in ends])
        for ends in (
            ((found[:, 0], found[:, -1]), (true[:, 0], true[:, -1])),
            ((found[0], found[-1]), (true[0], true[-1])),
        )
    ]
    every = np.concatenate(lengths)
    return epipolar_distance_px(rig.fundamental, left, right), every[np.isfinite(every).all(axis=1)]


def _enlarged(pose: RigidTransform, board: Board) -> RigidTransform:
    """Where a larger board lies whose middle is where this one's is."""
    middle = board.points_mm.mean(axis=0)
    return replace(pose, translation_mm=pose.translation_mm + pose.rotation @ middle * (1 - _LARGER))


def _tilted(rig: StereoRig, board: Board, points_mm: Float) -> list[RigidTransform]:
    """Boards in the middle of the workspace and at its ends, tilted to each side."""
    near, far = np.percentile(points_mm[:, 2], [5, 95]).tolist()
    middle = points_mm.mean(axis=0)
    poses = []
    for depth in (near, far):
        for axis in ("x", "y"):
            for sign in (-1, 1):
                turn = Rotation.from_euler(axis, sign * _TILT_DEG, degrees=True).as_matrix()
                center = np.array([middle[0], middle[1], depth])
                poses.append(RigidTransform(turn, center - turn @ board.points_mm.mean(axis=0)))
    return poses
