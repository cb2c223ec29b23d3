"""Finding the board: on drawn pictures whose corners are known, and on turned ones."""

import cv2
import numpy as np
import pytest

from needletrack.calibration.board import BoardView, Checkerboard, find_board, find_corners
from needletrack.errors import CalibrationError
from needletrack.records import Float, Image

PAPER = Checkerboard(11, 11, 2.0)
ODD_EVEN = Checkerboard(7, 6, 5.0)


def drawn(board: Checkerboard, homography: Float, size_px: tuple[int, int] = (480, 400)) -> Image:
    """The board in a picture (rows, columns), sampled four times each way; homography: px from board mm."""
    fine = 4
    to_fine = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1]])
    board_from_fine = np.linalg.inv(to_fine @ homography)
    columns, rows = np.meshgrid(np.arange(size_px[0] * fine), np.arange(size_px[1] * fine))
    x, y, w = np.tensordot(board_from_fine, np.stack([columns, rows, np.ones_like(rows)]), axes=1)
    square_x, square_y = (
        np.floor(x / w / board.square_mm).astype(int) + 1,
        np.floor(y / w / board.square_mm).astype(int) + 1,
    )
    on_board = (square_x >= 0) & (square_x < board.squares_x) & (square_y >= 0) & (square_y < board.squares_y)
    black = on_board & ((square_x + square_y) % 2 == 0)
    shades = np.where(black, 40.0, 210.0).astype(np.float32)
    picture = cv2.resize(shades, size_px, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(7).normal(0, 2, picture.shape)
    return np.asarray(np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7) + noise, 0, 255), dtype=np.uint8)


def tilted(board: Checkerboard, turn_deg: float) -> Float:
    """A homography that shows the board tilted, about 25 px a square."""
    scale, turn = 25 / board.square_mm, np.deg2rad(turn_deg)
    center = board.points_mm.mean(axis=0)
    rotate = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    perspective = np.array([[1, 0.05, 0], [-0.03, 1, 0], [1e-4, -2e-4, 1]])
    place = np.array([[1, 0, 235.3], [0, 1, 197.8], [0, 0, 1]])
    to_center = np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1]])
    return np.asarray(place @ perspective @ rotate @ to_center)


def projected(board: Checkerboard, homography: Float) -> Float:
    corners = np.column_stack([board.points_mm[:, :2], np.ones(len(board.points_mm))]) @ homography.T
    return np.asarray(corners[:, :2] / corners[:, 2:])


@pytest.mark.parametrize("turn_deg", [0, 100, 190])
def test_corners_lie_where_they_were_drawn_in_one_of_the_board_s_orders(turn_deg: float) -> None:
    homography = tilted(ODD_EVEN, turn_deg)
    corners_px = find_corners(drawn(ODD_EVEN, homography), ODD_EVEN)
    assert corners_px is not None
    true_px = projected(ODD_EVEN, homography)
    errors_px = [np.linalg.norm(corners_px[turn.order] - true_px, axis=1) for turn in ODD_EVEN.turns]
    best_px = min(errors_px, key=lambda error_px: float(error_px.max()))
    # Two grey levels of noise on edges of 170, spread over about 2 px by the blur, averaged over the edges
    # that meet in a corner: some hundredths of a pixel.
    assert best_px.max() < 0.1


def test_an_image_without_the_whole_board_has_no_corners() -> None:
    picture = drawn(ODD_EVEN, tilted(ODD_EVEN, 0)).copy()
    picture[:, :200] = 128
    assert find_corners(picture, ODD_EVEN) is None
    assert find_board(picture, picture, ODD_EVEN).left_px is None


@pytest.mark.parametrize(("board", "count"), [(PAPER, 4), (ODD_EVEN, 2)])
def test_every_turn_lays_corners_onto_corners(board: Checkerboard, count: int) -> None:
    assert len(board.turns) == count
    for turn in board.turns:
        np.testing.assert_allclose(turn.turned.apply(board.points_mm), board.points_mm[turn.order], atol=1e-9)
    np.testing.assert_array_equal(board.turns[0].order, np.arange(len(board.points_mm)))
    assert len({tuple(turn.order) for turn in board.turns}) == count


def test_corners_are_spaced_by_the_square() -> None:
    columns, rows = ODD_EVEN.inner_corners
    grid = ODD_EVEN.points_mm.reshape(rows, columns, 3)
    np.testing.assert_allclose(np.diff(grid, axis=1), np.broadcast_to([5, 0, 0], (rows, columns - 1, 3)))
    np.testing.assert_allclose(np.diff(grid, axis=0), np.broadcast_to([0, 5, 0], (rows - 1, columns, 3)))


@pytest.mark.parametrize(("columns", "rows", "square_mm"), [(3, 9, 2.0), (9, 3, 2.0), (11, 11, 0.0), (11, 11, np.nan)])
def test_a_board_that_cannot_be_detected_is_refused(columns: int, rows: int, square_mm: float) -> None:
    with pytest.raises(CalibrationError, match="at least 4 squares"):
        Checkerboard(columns, rows, square_mm)


def test_a_view_s_corners_are_points_in_a_plane() -> None:
    with pytest.raises(ValueError, match="right_px has shape"):
        BoardView(None, np.zeros((10, 3)))
