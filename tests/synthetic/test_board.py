"""Drawn boards: their corners are found where they were put, in both views, with and without markers."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import BoardView, CharucoBoard, Checkerboard, find_board
from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float
from needletrack.synthetic.board import Texture, checkerboard_texture, draw_board
from needletrack.synthetic.rig import default_rig

RIG = default_rig((640, 512))
PLAIN = Checkerboard(9, 7, 6.0)
MARKED = CharucoBoard(9, 7, 8.0, 5.6, "DICT_4X4_50")


def pose(board: Checkerboard | CharucoBoard, tilt_deg: float = 20.0, x: float = 33.0) -> RigidTransform:
    turn = Rotation.from_euler("zxy", [8, tilt_deg, -15], degrees=True).as_matrix()
    return RigidTransform(turn, np.array([x, 2.0, 250.0]) - turn @ board.points_mm.mean(axis=0))


def marked_texture() -> Texture:
    side = 80
    gray = MARKED.drawn.generateImage((9 * side, 7 * side), marginSize=0)
    border = np.pad(np.asarray(gray), side, constant_values=255)
    # The board's first inner corner is one square in; OpenCV draws it without a margin here.
    return Texture(np.asarray(border, dtype=np.uint8), side / 8.0, np.full(2, 2.0 * side - 0.5))


def errors_px(view: BoardView, board: Checkerboard | CharucoBoard, at: RigidTransform) -> Float:
    true_px = RIG.project(at.apply(board.points_mm))
    errors = []
    for found, true in zip((view.left_px, view.right_px), true_px, strict=True):
        assert found is not None
        orders = [np.linalg.norm(found[turn.order] - true, axis=1) for turn in board.turns]
        errors.append(min(orders, key=lambda error: float(np.nanmean(error))))
    return np.concatenate(errors)


def test_corners_of_a_plain_board_to_hundredths_of_a_pixel() -> None:
    at = pose(PLAIN)
    view = find_board(*draw_board(RIG, checkerboard_texture((9, 7), 6.0), at), PLAIN)
    # 1.5 grey levels of noise on steps of 200, spread over a pixel.
    assert errors_px(view, PLAIN, at).max() < 0.06
    assert view.blur_px[0] == pytest.approx(0.6, abs=0.15)


def test_a_blurred_picture_says_how_much() -> None:
    at = pose(PLAIN)
    view = find_board(*draw_board(RIG, checkerboard_texture((9, 7), 6.0), at, blur_px=2.0), PLAIN)
    assert view.blur_px[1] == pytest.approx(2.0, abs=0.2)


def test_an_overexposed_board_is_neither_blurred_nor_somewhere_else() -> None:
    at = pose(PLAIN)
    view = find_board(*draw_board(RIG, checkerboard_texture((9, 7), 6.0), at, exposure=1.9), PLAIN)
    assert errors_px(view, PLAIN, at).max() < 0.06
    # White is half as bright again as what 255 shows: taken as it is, its edges would look three times as wide.
    assert view.blur_px[0] == pytest.approx(0.6, abs=0.15)


def test_markers_tell_every_turn_and_a_part_is_enough() -> None:
    at = pose(MARKED, x=48.0)
    images = draw_board(RIG, marked_texture(), at)
    view = find_board(images[0], images[1], MARKED)
    assert len(MARKED.turns) == 1
    errors = errors_px(view, MARKED, at)
    assert np.isfinite(errors).mean() > 0.8
    assert np.nanmax(errors) < 0.12
    hidden = images[0].copy()
    hidden[:, :250] = 128
    part = find_board(hidden, images[1], MARKED).left_px
    assert part is not None
    seen = np.asarray(np.isfinite(part).all(axis=1))
    assert 12 <= seen.sum() < len(seen)
    true_px = RIG.project(at.apply(MARKED.points_mm))[0]
    assert np.linalg.norm(part[seen] - true_px[seen], axis=1).max() < 0.12


def test_a_picture_of_another_board_says_what_it_shows() -> None:
    view = find_board(*draw_board(RIG, checkerboard_texture((9, 7), 6.0), pose(PLAIN)), Checkerboard(10, 8, 6.0))
    assert view.left_px is None
    assert "the board has 9 x 7" in view.faults[0]


def test_a_picture_without_markers_says_how_few_there_are() -> None:
    empty = np.full((512, 640), 128, dtype=np.uint8)
    assert "0 of its corners and 0 of its markers" in MARKED.find(empty).fault


@pytest.mark.parametrize(
    ("marker_mm", "dictionary", "match"),
    [(9.0, "DICT_4X4_50", "do not fit"), (5.0, "DICT_3X3", "no dictionary"), (5.0, "DICT_ARUCO_MIP_36h12", "")],
)
def test_boards_of_markers_that_cannot_be_are_refused(marker_mm: float, dictionary: str, match: str) -> None:
    if not match:
        assert CharucoBoard(9, 7, 8.0, marker_mm, dictionary).squares_x == 9
        return
    with pytest.raises(CalibrationError, match=match):
        CharucoBoard(9, 7, 8.0, marker_mm, dictionary)


def test_the_drawn_board_is_gray_where_there_is_none() -> None:
    left, _ = draw_board(RIG, checkerboard_texture((9, 7), 6.0), pose(PLAIN), noise_gray=0.0)
    assert left[0, 0] == 128
    assert cv2.minMaxLoc(left)[1] > 220


def test_a_border_that_was_taken_for_a_row_of_corners_is_no_board() -> None:
    # The board's right end is out of the image; the detector finds as many corners as were wanted all the same, eight
    # of them where the white border begins, and every other one by a column too far.
    rig, board = default_rig(), Checkerboard(12, 9, 7.0)
    turn = Rotation.from_euler("zyx", [8.5, 16.1, 3.1], degrees=True).as_matrix()
    at = RigidTransform(turn, np.array([65.5, 22.1, 225.2]) - turn @ board.points_mm.mean(axis=0))
    left, _ = draw_board(rig, checkerboard_texture((12, 9), 7.0), at)
    found, _ = cv2.findChessboardCornersSB(left, board.inner_corners, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    assert found
    detection = board.find(left)
    assert detection.corners_px is None
    assert "8 of its corners are none" in detection.fault
