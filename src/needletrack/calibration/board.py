"""The checkerboard: its corners in space, and in the pictures of both cameras."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Image, Int, frozen_array

# The detector's sector masks need three corners in a row.
MIN_SQUARES = 4


@dataclass(frozen=True)
class Checkerboard:
    """A board of squares_x × squares_y squares of square_mm; the 2017 paper's is 11 × 11 of 2 mm.

    Its frame lies in the board: origin in the first inner corner, x along the rows, z into the board as a
    camera sees it. Raises CalibrationError where no such board can be found in a picture.
    """

    squares_x: int
    squares_y: int
    square_mm: float

    def __post_init__(self) -> None:
        if min(self.squares_x, self.squares_y) < MIN_SQUARES or not self.square_mm > 0:
            raise CalibrationError(
                f"a board of {self.squares_x} x {self.squares_y} squares of {self.square_mm:g} mm cannot be "
                f"detected: use at least {MIN_SQUARES} squares each way and give their side in millimetres"
            )

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners in a row and in a column."""
        return self.squares_x - 1, self.squares_y - 1

    @cached_property
    def points_mm(self) -> Float:
        """The inner corners (N, 3) in the board's frame, row by row."""
        columns, rows = self.inner_corners
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.square_mm
        return frozen_array(grid, (columns * rows, 3), "points_mm")

    @cached_property
    def turns(self) -> tuple["Turn", ...]:
        """The turns of the board in its plane that lay its corners onto its corners, the identity first.

        Two, or four where it is square: pictures of an odd × odd board do not tell which has been made.
        """
        center_mm = self.points_mm.mean(axis=0)
        quarter_turns = (0, 1, 2, 3) if self.squares_x == self.squares_y else (0, 2)
        turns = []
        for quarters in quarter_turns:
            rotation = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()
            turned = RigidTransform(rotation, center_mm - rotation @ center_mm)
            column, row, _ = np.rint(turned.apply(self.points_mm) / self.square_mm).astype(np.int64).T
            turns.append(Turn(turned, row * self.inner_corners[0] + column))
        return tuple(turns)


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn of the board onto itself: turned.apply(points_mm) is points_mm[order], order (N,)."""

    turned: RigidTransform
    order: Int


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board's inner corners (N, 2) in a stereo pair, raw px, row by row; None where they were not found.

    Which of the board's corners comes first is arbitrary, and may differ between the two pictures.
    """

    left_px: Float | None
    right_px: Float | None

    def __post_init__(self) -> None:
        for name in ("left_px", "right_px"):
            corners_px = getattr(self, name)
            if corners_px is not None:
                object.__setattr__(self, name, frozen_array(corners_px, (None, 2), name))


def find_board(left: Image, right: Image, board: Checkerboard) -> BoardView:
    """The board in both images (rows, columns) of a pair."""
    return BoardView(find_corners(left, board), find_corners(right, board))


def find_corners(image: Image, board: Checkerboard) -> Float | None:
    """The board's inner corners (N, 2) in an image (rows, columns), raw px, row by row; None if any hides.

    Localized Radon transform (Duda & Frese 2018, BMVC; cv2.findChessboardCornersSB). Rows and columns are
    such that the board's z axis points away from the camera. Searched on the whole image first, and then,
    enlarged, around what was found: enlarging the whole image costs three times as long.
    """
    rough_px = _detect(image, board, 0)
    if rough_px is None:
        return None
    columns, rows = board.inner_corners
    grid = rough_px.reshape(rows, columns, 2)
    margin_px = 2 * max(np.linalg.norm(np.diff(grid, axis=axis), axis=2).max() for axis in (0, 1))
    lowest = np.maximum(np.floor(rough_px.min(axis=0) - margin_px), 0).astype(int)
    highest = np.ceil(rough_px.max(axis=0) + margin_px).astype(int)
    around = np.ascontiguousarray(image[lowest[1] : highest[1] + 1, lowest[0] : highest[0] + 1])
    fine_px = _detect(around, board, cv2.CALIB_CB_ACCURACY)
    return None if fine_px is None else fine_px + lowest


def _detect(image: Image, board: Checkerboard, flags: int) -> Float | None:
    found, corners = cv2.findChessboardCornersSB(image, board.inner_corners, flags=flags)
    if not found:
        return None
    columns, rows = board.inner_corners
    grid = np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
    along_row, along_column = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    mirrored = along_row[0] * along_column[1] < along_row[1] * along_column[0]
    return (grid[::-1] if mirrored else grid).reshape(-1, 2)
