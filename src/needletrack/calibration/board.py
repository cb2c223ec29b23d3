"""The boards: their corners in space, and in the pictures of both cameras."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.calibration.corners import fit_corners
from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Image, Int, frozen_array

# The detector's sector masks need three corners in a row.
MIN_SQUARES = 4


# Of a board with markers: fewer corners than this hold no pose.
_LEAST_CORNERS = 12
# Two crossing edges leave less of the picture than this share of their step: 0.02 to 0.15 where a corner is, 0.6 where
# the board's border was taken for one.
_NO_CORNER, _MOST_NO_CORNERS = 0.45, 2
_DEFAULT_DICTIONARY = "DICT_5X5_1000"


class Board(Protocol):
    """What calibration knows of a board, whichever it is."""

    @property
    def squares_x(self) -> int:
        """Squares in a row."""

    @property
    def squares_y(self) -> int:
        """Squares in a column."""

    @property
    def square_mm(self) -> float:
        """Side of a square, mm."""

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners in a row and in a column."""

    @property
    def points_mm(self) -> Float:
        """The inner corners (N, 3) in the board's frame, row by row."""

    @property
    def turns(self) -> tuple["Turn", ...]:
        """The turns of the board in its plane that pictures do not tell apart, the identity first."""

    def find(self, image: Image) -> "Detection":
        """The board in an image (rows, columns)."""


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

    def find(self, image: Image) -> "Detection":
        """All inner corners, or why there are none: a checkerboard is found whole or not at all.

        Rows and columns are such that the board's z axis points away from the camera. Localized Radon transform
        (Duda & Frese 2018, BMVC; cv2.findChessboardCornersSB), then `fit_corners`.
        """
        rough_px = _detected(image, self.inner_corners)
        if rough_px is None:
            return Detection(None, None, _what_is_there(image, self))
        columns, rows = self.inner_corners
        grid = rough_px.reshape(rows, columns, 2)
        along, down = (np.asarray(np.gradient(grid, axis=axis)).reshape(-1, 2) for axis in (1, 0))
        return _fitted(image, rough_px, along, down)


@dataclass(frozen=True)
class CharucoBoard:
    """A checkerboard whose white squares hold markers of marker_mm; a part of it is enough, and no turn is ambiguous.

    dictionary: OpenCV's name of the markers' dictionary. is_legacy: the first marker's place as before OpenCV 4.6.
    Raises CalibrationError where no such board can be found in a picture.
    """

    squares_x: int
    squares_y: int
    square_mm: float
    marker_mm: float
    dictionary: str = _DEFAULT_DICTIONARY
    is_legacy: bool = False

    def __post_init__(self) -> None:
        Checkerboard(self.squares_x, self.squares_y, self.square_mm)
        if not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"markers of {self.marker_mm:g} mm do not fit into squares of {self.square_mm:g} mm: give the side of "
                "a marker's black border"
            )
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        if self.dictionary not in known:
            raise CalibrationError(f"{self.dictionary!r} is no dictionary of markers: one of {', '.join(known)}")
        room = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        if self.squares_x * self.squares_y // 2 > room:
            raise CalibrationError(f"{self.dictionary} has {room} markers, too few for the board")

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners in a row and in a column."""
        return self.squares_x - 1, self.squares_y - 1

    @cached_property
    def points_mm(self) -> Float:
        """The inner corners (N, 3) in the board's frame, row by row."""
        return Checkerboard(self.squares_x, self.squares_y, self.square_mm).points_mm

    @property
    def turns(self) -> tuple["Turn", ...]:
        """The identity alone: markers tell every turn."""
        return (Turn(RigidTransform.identity(), np.arange(len(self.points_mm))),)

    @cached_property
    def drawn(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's own board."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.squares_x, self.squares_y), self.square_mm, self.marker_mm, dictionary)
        board.setLegacyPattern(self.is_legacy)
        return board

    def find(self, image: Image) -> "Detection":
        """The inner corners that show, or why they are too few (cv2.aruco.CharucoDetector, then `fit_corners`)."""
        # A detector for each call: one is not to be used by two threads.
        corners, ids, _, markers = cv2.aruco.CharucoDetector(self.drawn).detectBoard(image)
        # Its types say that it always finds some.
        found, seen = (0 if each is None else len(each) for each in (ids, markers))  # type: ignore[redundant-expr]
        if found < _LEAST_CORNERS:
            return Detection(
                None,
                None,
                f"{found} of its corners and {seen} of its markers were found, fewer than {_LEAST_CORNERS} corners",
            )
        index = np.ravel(ids)
        rough_px = np.full((len(self.points_mm), 2), np.nan)
        rough_px[index] = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        plane = self.points_mm[:, :2]
        homography, _ = cv2.findHomography(plane[index], rough_px[index], cv2.RANSAC, 3.0)
        if homography is None:
            return Detection(None, None, "its corners lie in no plane")
        there = [
            cv2.perspectiveTransform((plane[index] + step)[:, None], homography)[:, 0]
            for step in ([0.0, 0.0], [self.square_mm, 0.0], [0.0, self.square_mm])
        ]
        clear = (1 - self.marker_mm / self.square_mm) / 2
        fitted = _fitted(image, rough_px[index], there[1] - there[0], there[2] - there[0], clear)
        if fitted.corners_px is None:
            return fitted
        rough_px[index] = fitted.corners_px
        return Detection(rough_px, fitted.blur_px)


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn of the board onto itself: turned.apply(points_mm) is points_mm[order], order (N,)."""

    turned: RigidTransform
    order: Int


@dataclass(frozen=True, slots=True)
class Detection:
    """A board's inner corners_px (N, 2) in one image, raw px, row by row, NaN where one does not show.

    blur_px: median sigma of the edges at its corners. None where it was not found, and fault says what was seen.
    """

    corners_px: Float | None
    blur_px: float | None
    fault: str = ""


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board's inner corners (N, 2) in a stereo pair, raw px, row by row; None where they were not found.

    NaN stands for a corner that does not show. Which of the corners of a board without markers comes first is
    arbitrary, and may differ between the two pictures. blur_px, faults: left and right, as of `Detection`.
    """

    left_px: Float | None
    right_px: Float | None
    blur_px: tuple[float | None, float | None] = (None, None)
    faults: tuple[str, str] = ("", "")

    def __post_init__(self) -> None:
        for name in ("left_px", "right_px"):
            corners_px = getattr(self, name)
            if corners_px is not None:
                object.__setattr__(self, name, frozen_array(corners_px, (None, 2), name))


def find_board(left: Image, right: Image, board: Board) -> BoardView:
    """The board in both images (rows, columns) of a pair."""
    found = board.find(left), board.find(right)
    return BoardView(
        found[0].corners_px,
        found[1].corners_px,
        (found[0].blur_px, found[1].blur_px),
        (found[0].fault, found[1].fault),
    )


def find_corners(image: Image, board: Board) -> Float | None:
    """The board's inner corners (N, 2) in an image (rows, columns), raw px, row by row; None if it was not found."""
    return board.find(image).corners_px


def _fitted(image: Image, rough_px: Float, along: Float, down: Float, clear: float | None = None) -> Detection:
    fitted = fit_corners(image, rough_px, along, down, clear)
    # From where they were found once more: what lies within reach of a corner depends on where it is thought to be.
    again = fit_corners(
        image, np.where(np.isfinite(fitted.corners_px), fitted.corners_px, rough_px), along, down, clear
    )
    fitted_px = np.where(again.misfit[:, None] > _NO_CORNER, np.nan, again.corners_px)
    none = int((again.misfit > _NO_CORNER).sum())
    if clear is None and none > _MOST_NO_CORNERS:
        # A whole row that is none: the detector took the border for one, and every corner has a wrong number.
        return Detection(None, None, f"{none} of its corners are none: it is hidden in part, or in the dark")
    lost = np.asarray(~np.isfinite(fitted_px).all(axis=1))
    if lost.mean() > 0.2:
        return Detection(None, None, f"{int(lost.sum())} of its {len(lost)} corners are too faint or too small")
    return Detection(fitted_px, float(np.median(again.blur_px[~lost])))


def _detected(image: Image, inner_corners: tuple[int, int]) -> Float | None:
    # Photographs with a bright background are found with their grey levels evened out, dim ones as they are.
    for flags in (cv2.CALIB_CB_NORMALIZE_IMAGE, 0):
        found, corners = cv2.findChessboardCornersSB(image, inner_corners, flags=flags)
        if found:
            break
    else:
        return None
    columns, rows = inner_corners
    grid = np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
    along_row, along_column = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    mirrored = along_row[0] * along_column[1] < along_row[1] * along_column[0]
    return (grid[::-1] if mirrored else grid).reshape(-1, 2)


def _what_is_there(image: Image, board: Checkerboard) -> str:
    """What a picture shows in place of the whole board; empty where it shows no squares at all."""
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), cv2.CALIB_CB_LARGER)
    if not found or meta is None:
        return ""
    rows, columns = np.asarray(meta).shape[:2]
    wanted = " x ".join(map(str, board.inner_corners))
    return f"{columns} x {rows} inner corners show, the board has {wanted}: it is hidden in part, or another board"
