"""Cameras that were bumped: what a board tells, what tips tell, and what neither claims."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import BoardView, Checkerboard, find_board
from needletrack.calibration.drift import Motion, check_views, effect
from needletrack.calibration.stereo import calibrate_stereo
from needletrack.calibration.worth import space_grid_mm
from needletrack.errors import CalibrationError
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float
from needletrack.synthetic.rig import default_rig

BOARD = Checkerboard(11, 11, 2.0)
NOISE_PX = 0.03
AXES = np.eye(3)
RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"


def workspace_mm(rig: StereoRig) -> Float:
    return space_grid_mm(rig, (-60, 70), (-55, 55), (210, 295))


def views_of(rig: StereoRig, count: int, seed: int, noise_px: float = NOISE_PX) -> list[BoardView]:
    random = np.random.default_rng(seed)
    views = []
    for _ in range(count):
        turn = Rotation.from_euler("zyx", [random.uniform(-90, 90), *random.uniform(-30, 30, 2)], degrees=True)
        matrix = turn.as_matrix()
        center = np.array([*random.uniform(-20, 40, 2), random.uniform(220, 280)])
        pose = RigidTransform(matrix, center - matrix @ BOARD.points_mm.mean(axis=0))
        pixels = rig.project(pose.apply(BOARD.points_mm))
        noise = random.normal(0, noise_px, (2, *pixels[0].shape))
        # Which corner comes first is arbitrary.
        order = BOARD.turns[int(random.integers(4))].order
        views.append(BoardView(pixels[0] + noise[0], (pixels[1] + noise[1])[order]))
    return views


@pytest.fixture(scope="module")
def calibrated() -> tuple[StereoRig, StereoRig, Float, float]:
    """The true rig, and a calibration of it with its covariance and corner noise."""
    rig = default_rig()
    found = calibrate_stereo(views_of(rig, 12, 1), BOARD, rig.left.size_px)
    return rig, found.rig, found.bundle.covariance, found.bundle.sigma_px


@pytest.mark.parametrize("seed", range(5))
def test_a_rig_that_stands_still_is_ok(calibrated: tuple[StereoRig, StereoRig, Float, float], seed: int) -> None:
    true_rig, rig, covariance, sigma_px = calibrated
    found = check_views(rig, covariance, sigma_px, views_of(true_rig, 1, 100 + seed), BOARD, workspace_mm(rig))
    assert not found.moved
    # Four standard deviations: one in fifteen thousand by chance.
    assert (np.abs(found.motion.turn_deg) < 4 * found.motion_sigma.turn_deg).all()
    assert (np.abs(found.motion.shift_mm) < 4 * found.motion_sigma.shift_mm).all()


@pytest.mark.parametrize(
    "motion",
    [
        Motion(turn_deg=0.1 * AXES[0]),
        Motion(turn_deg=0.1 * AXES[1]),
        Motion(turn_deg=0.1 * AXES[2]),
        Motion(shift_mm=0.1 * AXES[0]),
        Motion(shift_mm=0.2 * AXES[1]),
    ],
    ids=["pitch", "yaw", "roll", "along the baseline", "across it"],
)
def test_one_fresh_pair_tells_a_bump(calibrated: tuple[StereoRig, StereoRig, Float, float], motion: Motion) -> None:
    true_rig, rig, covariance, sigma_px = calibrated
    moved = motion.applied_to(true_rig)
    found = check_views(rig, covariance, sigma_px, views_of(moved, 1, 7), BOARD, workspace_mm(rig))
    assert found.moved
    assert (np.abs(found.motion.turn_deg - motion.turn_deg) < 4 * found.motion_sigma.turn_deg).all()
    assert (np.abs(found.motion.shift_mm - motion.shift_mm) < 4 * found.motion_sigma.shift_mm).all()


def test_a_few_pairs_tell_it_to_a_hundredth_of_a_degree(
    calibrated: tuple[StereoRig, StereoRig, Float, float],
) -> None:
    true_rig, rig, covariance, sigma_px = calibrated
    motion = Motion(np.array([0.03, -0.05, 0.02]), np.array([0.1, 0.0, -0.1]))
    views = views_of(motion.applied_to(true_rig), 6, 9)
    found = check_views(rig, covariance, sigma_px, views, BOARD, workspace_mm(rig))
    assert found.moved
    assert found.motion_sigma.turn_deg.max() < 0.02
    assert (np.abs(found.motion.turn_deg - motion.turn_deg) < 4 * found.motion_sigma.turn_deg).all()


def test_a_rig_without_a_stated_uncertainty_is_checked_too() -> None:
    rig = default_rig()
    still = check_views(rig, None, None, views_of(rig, 2, 3), BOARD, workspace_mm(rig))
    assert not still.moved
    moved = Motion(turn_deg=0.05 * AXES[1]).applied_to(rig)
    assert check_views(rig, None, None, views_of(moved, 2, 3), BOARD, workspace_mm(rig)).moved


@pytest.mark.slow
def test_real_pictures_of_a_rig_that_stood_still_and_of_one_that_did_not() -> None:
    folder = RECORDINGS / "calib-a"
    files = [sorted((folder / f"cam{camera}" / "data").glob("*.png")) for camera in (0, 1)]
    views = [
        find_board(
            np.asarray(cv2.imread(str(left), 0), dtype=np.uint8),
            np.asarray(cv2.imread(str(right), 0), dtype=np.uint8),
            BOARD,
        )
        for left, right in zip(*files, strict=True)
    ]
    size = tuple(json.loads((folder / "truth.json").read_text())["cameras"][0]["size"])
    found = calibrate_stereo(views[:4], BOARD, (size[0], size[1]))
    rig, covariance = found.rig, found.bundle.covariance
    fresh = views[4:]
    assert not check_views(rig, covariance, found.bundle.sigma_px, fresh, BOARD, workspace_mm(rig)).moved
    back = Motion(turn_deg=-0.1 * AXES[1]).applied_to(rig)
    assert check_views(back, covariance, found.bundle.sigma_px, fresh, BOARD, workspace_mm(rig)).moved


def test_without_the_board_there_is_nothing_to_check() -> None:
    rig = default_rig()
    with pytest.raises(CalibrationError, match="no pair shows the board"):
        check_views(rig, None, None, [BoardView(None, None)], BOARD, workspace_mm(rig))


def test_what_motions_do_is_as_the_docs_say() -> None:
    rig = default_rig()
    points_mm = workspace_mm(rig)
    pitch, yaw, roll = (effect(rig, Motion(turn_deg=0.1 * axis), points_mm) for axis in AXES)
    focal = rig.right.focal_px
    # A pitch moves everything across the epipolar lines, by f tan(0.1 degrees).
    assert abs(pitch.offset_px) == pytest.approx(focal * np.tan(np.radians(0.1)), rel=0.1)
    # A yaw hardly shows there, and costs most in space.
    assert yaw.offset_rms_px < 0.15
    assert yaw.error.before_mm > 5 * max(pitch.error.before_mm, roll.error.before_mm)
    assert abs(roll.offset_px) < roll.offset_rms_px
