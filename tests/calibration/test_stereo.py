"""Calibration from the bundled boards against their exact truth, and from drawn corners without noise."""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import BoardView, CharucoBoard, Checkerboard, find_board
from needletrack.calibration.stereo import MIN_VIEWS, StereoCalibration, calibrate_stereo
from needletrack.calibration.worth import expected
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_px
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Float, Image
from needletrack.synthetic.rig import default_rig

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"
# The paper's board in its setting: 250 mm away.
PAPER = Checkerboard(11, 11, 2.0)

BoardRecording = tuple[Checkerboard, StereoRig, list[BoardView]]


def pictures(name: str, camera: int) -> list[Image]:
    files = sorted((RECORDINGS / name / f"cam{camera}" / "data").glob("*.png"))
    return [np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8) for file in files]


def board_recording(name: str) -> BoardRecording:
    truth = json.loads((RECORDINGS / name / "truth.json").read_text())
    squares_x, squares_y = truth["board"]["squares"]
    board = Checkerboard(squares_x, squares_y, truth["board"]["square_mm"])
    left, right = (
        Camera(np.array(camera["K"]), np.array(camera["dist"]), tuple(camera["size"])) for camera in truth["cameras"]
    )
    pose = RigidTransform(np.array(truth["cameras"][1]["R"]), np.array(truth["cameras"][1]["t"]))
    # The detector takes a quarter of a second a picture, and leaves Python's lock alone.
    with ThreadPoolExecutor(max_workers=2) as pool:
        views = list(pool.map(find_board, pictures(name, 0), pictures(name, 1), repeat(board)))
    return board, StereoRig(left, right, pose), views


@pytest.fixture(scope="module")
def large_board() -> BoardRecording:
    """12 × 9 squares of 10 mm, which look the same after a half turn."""
    return board_recording("calib-b")


@pytest.fixture(scope="module")
def paper_board() -> BoardRecording:
    """The paper's board, which looks the same after every quarter turn."""
    return board_recording("calib-a")


def workspace_mm() -> Float:
    """A grid of points (N, 3) where needles are."""
    ranges = np.linspace(-35, 35, 5), np.linspace(-30, 30, 5), np.linspace(210, 300, 4)
    return np.stack(np.meshgrid(*ranges), axis=-1).reshape(-1, 3)


def space_error_mm(rig: StereoRig, true_rig: StereoRig) -> float:
    """Error, rms over the workspace, of what a rig makes of true pixels, after the best rigid alignment."""
    points_mm = workspace_mm()
    left_px, right_px = true_rig.project(points_mm)
    found_mm = triangulate(rig, rig.left.undistort(left_px), rig.right.undistort(right_px))
    found_mm, points_mm = found_mm - found_mm.mean(axis=0), points_mm - points_mm.mean(axis=0)
    _, root_sum_square = Rotation.align_vectors(points_mm, found_mm)
    return float(root_sum_square / np.sqrt(len(points_mm)))


def turned(views: Sequence[BoardView], board: Checkerboard, turns: Sequence[int]) -> list[BoardView]:
    """The same views with the right corners listed from another first corner."""
    return [
        BoardView(view.left_px, None if view.right_px is None else view.right_px[board.turns[turn].order])
        for view, turn in zip(views, turns, strict=True)
    ]


def board_poses(count: int, seed: int = 3) -> list[RigidTransform]:
    """Where a board of 22 mm may be held in front of the left camera."""
    random = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        rotation = Rotation.from_euler("zyx", [random.uniform(-180, 180), *random.uniform(-40, 40, 2)], degrees=True)
        center_mm = np.array([*random.uniform(-40, 40, 2), random.uniform(220, 290)])
        matrix = rotation.as_matrix()
        poses.append(RigidTransform(matrix, center_mm - matrix @ PAPER.points_mm.mean(axis=0)))
    return poses


def drawn(
    rig: StereoRig, board: Checkerboard, poses: Sequence[RigidTransform], noise_px: float = 0.0, seed: int = 1
) -> list[BoardView]:
    random = np.random.default_rng(seed)
    views = []
    for pose in poses:
        left_px, right_px = rig.project(pose.apply(board.points_mm))
        noise = random.normal(0, noise_px, (2, *left_px.shape)) if noise_px else np.zeros((2, *left_px.shape))
        views.append(BoardView(left_px + noise[0], right_px + noise[1]))
    return views


def noise_floor_mm(
    true_rig: StereoRig, calibration: StereoCalibration, views: list[BoardView], board: Checkerboard
) -> float:
    """The same error where the same views' corners carry only random noise of the residuals' size."""
    poses = []
    for view in views:
        assert view.left_px is not None
        found, rotation, translation = cv2.solvePnP(
            board.points_mm, view.left_px, true_rig.left.matrix, true_rig.left.distortion
        )
        assert found
        matrix = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
        poses.append(RigidTransform(matrix, np.ravel(translation)))
    # The root mean square is of a corner's distance, in two coordinates.
    noise_px = calibration.rms_px / np.sqrt(2)
    errors_mm = [
        space_error_mm(calibrate_stereo(redrawn, board, true_rig.left.size_px).rig, true_rig)
        for redrawn in (drawn(true_rig, board, poses, noise_px, seed) for seed in range(3))
    ]
    return float(np.sqrt(np.mean(np.square(errors_mm))))


@pytest.mark.parametrize("recording", [pytest.param("large_board", marks=pytest.mark.slow), "paper_board"])
def test_real_pictures_give_the_rig_as_well_as_their_noise_allows(
    recording: str, request: pytest.FixtureRequest
) -> None:
    board, true_rig, views = request.getfixturevalue(recording)
    calibration = calibrate_stereo(views, board, true_rig.left.size_px)
    assert calibration.used == tuple(range(len(views)))
    assert calibration.rejected == ()
    assert calibration.rms_px < 0.1
    assert calibration.view_rms_px.shape == (len(views), 2)
    # Neighbouring corners share the detector's and the lens's errors, which average out less than noise.
    assert space_error_mm(calibration.rig, true_rig) < 5 * noise_floor_mm(true_rig, calibration, views, board)


def test_corners_without_noise_give_the_rig_exactly() -> None:
    rig = default_rig()
    views = drawn(rig, PAPER, board_poses(8))
    calibration = calibrate_stereo(views, PAPER, rig.left.size_px)
    assert calibration.rms_px < 1e-4
    assert space_error_mm(calibration.rig, rig) < 1e-3
    np.testing.assert_allclose(
        calibration.rig.right_from_left.translation_mm, rig.right_from_left.translation_mm, atol=0.01
    )


@pytest.mark.parametrize("recording", ["large_board", "paper_board"])
def test_which_corner_comes_first_does_not_matter(recording: str, request: pytest.FixtureRequest) -> None:
    board, true_rig, views = request.getfixturevalue(recording)
    turns = [(3 * i + 1) % len(board.turns) for i in range(len(views))]
    expected = calibrate_stereo(views, board, true_rig.left.size_px)
    found = calibrate_stereo(turned(views, board, turns), board, true_rig.left.size_px)
    assert found.rejected == ()
    assert found.rms_px == pytest.approx(expected.rms_px, abs=1e-4)
    # The solver stops a little elsewhere when it starts elsewhere.
    assert space_error_mm(found.rig, expected.rig) < 1e-3


def test_a_camera_that_stands_on_its_side_is_calibrated_too() -> None:
    upright = default_rig()
    roll = RigidTransform(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))
    rig = StereoRig(upright.left, upright.right, roll @ upright.right_from_left)
    views = turned(drawn(rig, PAPER, board_poses(8), noise_px=0.02), PAPER, [0, 1, 2, 3, 3, 2, 1, 0])
    calibration = calibrate_stereo(views, PAPER, rig.left.size_px)
    assert calibration.rejected == ()
    turn = calibration.rig.right_from_left.rotation.T @ rig.right_from_left.rotation
    assert np.rad2deg(Rotation.from_matrix(turn).magnitude()) < 0.5


def test_views_that_contradict_the_others_are_rejected_with_the_reason() -> None:
    rig = default_rig()
    views = drawn(rig, PAPER, board_poses(14), noise_px=0.02)
    elsewhere = drawn(rig, PAPER, board_poses(14, seed=8))
    assert views[5].right_px is not None
    views[1] = BoardView(views[1].left_px, None)
    views[3] = BoardView(views[3].left_px, elsewhere[3].right_px)
    views[5] = BoardView(views[5].left_px, views[5].right_px + np.array([3.0, 4.0]))
    views[7] = BoardView(views[7].left_px, np.zeros((12, 2)))
    calibration = calibrate_stereo(views, PAPER, rig.left.size_px)
    assert calibration.used == (0, 2, 4, 6, *range(8, 14))
    reasons = {view.index: view.reason for view in calibration.rejected}
    assert "not found in the right picture" in reasons[1]
    assert "fit the other views in no order" in reasons[3]
    assert "moved between the two exposures" in reasons[5]
    assert "the right picture has 12 corners, the board 100" in reasons[7]


def test_too_few_views_are_refused_with_the_remedy() -> None:
    rig = default_rig()
    views = drawn(rig, PAPER, board_poses(MIN_VIEWS))
    views[0] = BoardView(None, None)
    with pytest.raises(CalibrationError, match=r"3 usable views .* show the whole board .* view 0: .* not found"):
        calibrate_stereo(views, PAPER, rig.left.size_px)


def test_a_view_that_repeats_another_is_left_out() -> None:
    rig = default_rig()
    poses = board_poses(8)
    views = drawn(rig, PAPER, [*poses, poses[3]], noise_px=0.02)
    calibration = calibrate_stereo(views, PAPER, rig.left.size_px)
    assert calibration.used == tuple(range(8))
    assert [view.index for view in calibration.rejected] == [8]
    assert "repeats view 3" in calibration.rejected[0].reason


def test_views_that_are_all_alike_are_refused_with_the_poses_to_add() -> None:
    rig = default_rig()
    center = board_poses(1)[0]
    # The same tilt at places 3 mm apart: neither the focal length nor the turn that was made can be told.
    alike = [
        RigidTransform(center.rotation, center.translation_mm + np.array([3.0 * i, 2.0 * i, 0.0])) for i in range(6)
    ]
    views = drawn(rig, PAPER, alike, noise_px=0.02)
    with pytest.raises(CalibrationError, match=r"too much alike.*what is missing: tilt the board"):
        calibrate_stereo(views, PAPER, rig.left.size_px)


def test_a_blurred_view_is_left_out() -> None:
    rig = default_rig()
    views = [replace(view, blur_px=(0.5, 0.6)) for view in drawn(rig, PAPER, board_poses(8), noise_px=0.02)]
    views[2] = replace(views[2], blur_px=(0.5, 2.4))
    calibration = calibrate_stereo(views, PAPER, rig.left.size_px)
    assert [view.index for view in calibration.rejected] == [2]
    assert "the right picture is blurred: its edges have a sigma of 2.4 px" in calibration.rejected[0].reason


@pytest.mark.slow
def test_motion_between_the_exposures_is_told_from_false_corners() -> None:
    rig = default_rig()
    poses = board_poses(12)
    views = drawn(rig, PAPER, poses, noise_px=0.02)
    shaken = RigidTransform(np.eye(3), np.array([0.2, 0.4, 0.0])) @ poses[4]
    views[4] = BoardView(views[4].left_px, drawn(rig, PAPER, [shaken], noise_px=0.02)[0].right_px)
    assert views[6].left_px is not None
    bent = views[6].left_px + 3 * np.sin(np.arange(len(PAPER.points_mm)))[:, None]
    views[6] = BoardView(bent, views[6].right_px)
    reasons = {view.index: view.reason for view in calibrate_stereo(views, PAPER, rig.left.size_px).rejected}
    assert "moved between the two exposures" in reasons[4]
    assert "not even one picture alone fits" in reasons[6]


def test_a_board_that_shows_in_part_needs_no_order_where_markers_tell_it() -> None:
    rig = default_rig()
    board = CharucoBoard(11, 11, 2.0, 1.5)
    random = np.random.default_rng(5)
    views = []
    for view in drawn(rig, PAPER, board_poses(10), noise_px=0.02):
        assert view.left_px is not None
        assert view.right_px is not None
        hidden = random.random((2, 100, 1)) < 0.3
        views.append(BoardView(np.where(hidden[0], np.nan, view.left_px), np.where(hidden[1], np.nan, view.right_px)))
    calibration = calibrate_stereo(views, board, rig.left.size_px)
    assert calibration.rejected == ()
    points_mm = workspace_mm()
    covariance = calibration.bundle.covariance
    assert space_error_mm(calibration.rig, rig) < 3 * expected(calibration.rig, covariance, points_mm).after_mm


def test_the_lens_model_is_the_one_that_the_views_call_for() -> None:
    plain = default_rig()
    fish = Camera(plain.left.matrix, np.array([-0.35, 0.3, 2e-4, -1e-4, -0.5, 0.1, -0.2, 0.4]), plain.left.size_px)
    board = Checkerboard(12, 9, 18.0)
    poses = [
        RigidTransform(pose.rotation, pose.translation_mm - pose.rotation @ board.points_mm.mean(axis=0))
        for pose in board_poses(14)
    ]
    rational = StereoRig(fish, fish, plain.right_from_left)
    for rig, terms in ((plain, 4), (rational, 8)):
        views = drawn(rig, board, poses, noise_px=0.01)
        calibration = calibrate_stereo(views, board, rig.left.size_px)
        assert calibration.terms == terms, calibration.lens_bic


def test_epipolar_geometry_of_the_calibrated_rig_holds_for_the_corners(large_board: BoardRecording) -> None:
    board, true_rig, views = large_board
    calibration = calibrate_stereo(views, board, true_rig.left.size_px)
    rig = calibration.rig
    distances_px = [
        epipolar_distance_px(rig.fundamental, rig.left.undistort(view.left_px), rig.right.undistort(right_px))
        for view in views
        if view.left_px is not None and (right_px := in_left_order(view, board, true_rig)) is not None
    ]
    # Across the line lies one of the two coordinates of the right corner's error, and one of the left's.
    assert np.sqrt(np.mean(np.square(distances_px))) < 1.5 * calibration.rms_px
    left_epipole, right_epipole = rig.epipoles
    right_center_mm = rig.right_from_left.inverse().apply(np.zeros(3))
    left_center_mm = rig.right_from_left.apply(np.zeros(3))
    np.testing.assert_allclose(left_epipole / left_epipole[2], pinhole(rig.left, right_center_mm), rtol=1e-9)
    np.testing.assert_allclose(right_epipole / right_epipole[2], pinhole(rig.right, left_center_mm), rtol=1e-9)
    assert np.linalg.norm(rig.fundamental @ left_epipole) < 1e-9 * np.linalg.norm(left_epipole)
    assert np.linalg.norm(rig.fundamental.T @ right_epipole) < 1e-9 * np.linalg.norm(right_epipole)


def pinhole(camera: Camera, point_mm: Float) -> Float:
    projected = camera.matrix @ point_mm
    return np.asarray(projected / projected[2])


def in_left_order(view: BoardView, board: Checkerboard, true_rig: StereoRig) -> Float | None:
    """The right corners in the order in which they lie nearest to the left ones' true epipolar lines."""
    if view.left_px is None or view.right_px is None:
        return None
    left_px, right_px = true_rig.left.undistort(view.left_px), true_rig.right.undistort(view.right_px)

    def distance_px(corners_px: Float) -> float:
        return float(np.abs(epipolar_distance_px(true_rig.fundamental, left_px, corners_px)).max())

    order = min((turn.order for turn in board.turns), key=lambda order: distance_px(right_px[order]))
    return view.right_px[order]


def test_a_bent_board_is_found_to_be_bent() -> None:
    rig = default_rig()
    board = Checkerboard(12, 9, 8.0)
    middle = board.points_mm.mean(axis=0)
    half = np.ptp(board.points_mm, axis=0)[:2] / 2
    bulge = 1 - ((board.points_mm[:, :2] - middle[:2]) / half) ** 2
    bent_mm = board.points_mm + np.array([0.0, 0.0, 1.0]) * (bulge @ np.array([0.3, -0.1]))[:, None]
    random = np.random.default_rng(2)
    views = []
    for pose in board_poses(12, seed=5):
        at = RigidTransform(pose.rotation, pose.apply(PAPER.points_mm.mean(axis=0)) - pose.rotation @ middle)
        pixels = rig.project(at.apply(bent_mm))
        left_px, right_px = (px + random.normal(0, 0.02, px.shape) for px in pixels)
        views.append(BoardView(left_px, right_px))
    flat = calibrate_stereo(views, board, rig.left.size_px, lens=4)
    bent = calibrate_stereo(views, board, rig.left.size_px, lens=4, warp=True)
    assert bent.bundle.warp_mm is not None
    np.testing.assert_allclose(bent.bundle.warp_mm, [0.3, -0.1], atol=0.02)
    assert bent.rms_px < 0.035
    assert flat.rms_px > 2 * bent.rms_px
    assert space_error_mm(bent.rig, rig) < space_error_mm(flat.rig, rig) / 3
