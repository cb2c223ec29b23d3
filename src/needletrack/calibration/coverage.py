"""What the views of a board so far cover, and which views would help most: guidance while it is held up.

Three things make a calibration: corners all over both images fix the lens, boards tilted both ways fix the focal
length (Zhang 2000: boards that are parallel to the image leave it free), near and far boards tell it from distance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from needletrack.calibration.board import Board, BoardView
from needletrack.geometry.camera import Camera
from needletrack.records import Float, Int

CELLS = 3
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")
WANTED_VIEWS = 12
# A board is tilted from here on; what is farther or nearer than another by this factor is at another distance.
TILT_DEG = 15.0
_DISTANCE_RATIO = 1.2
TILTS = ("left side nearer", "right side nearer", "top nearer", "bottom nearer")
# Of a lens nobody has calibrated yet: guidance needs no better one.
_FOCAL_PER_WIDTH = 1.2


@dataclass(frozen=True, slots=True)
class Coverage:
    """views: that show the board in both pictures; corners (2, 3, 3): camera, row, column: corners in each ninth.

    tilts: how many views have each of TILTS; tilt_deg (V, 2): how much nearer the right side and the bottom are;
    distance_ratio: of the farthest to the nearest board.
    """

    views: int
    corners: Int
    tilts: tuple[int, int, int, int]
    tilt_deg: Float
    distance_ratio: float

    @property
    def missing(self) -> tuple[str, ...]:
        """What to show next, the most useful first; empty where nothing is missing."""
        wanted = []
        for name, count in zip(TILTS, self.tilts, strict=True):
            if not count:
                wanted.append(f"tilt the board by 30 degrees, its {name}")
        for side, ninths in zip(("left", "right"), self.corners, strict=True):
            empty = [_ninth(row, column) for row in range(CELLS) for column in range(CELLS) if not ninths[row, column]]
            if empty:
                wanted.append(f"show it in the {' and the '.join(empty)} of the {side} camera's image")
        if self.distance_ratio < _DISTANCE_RATIO:
            wanted.append("hold it once at the near and once at the far end of the workspace")
        if self.views < WANTED_VIEWS:
            wanted.append(f"take {WANTED_VIEWS - self.views} more views, each from another place")
        return tuple(wanted)

    @property
    def share(self) -> float:
        """How much of what is wanted is there, 0 to 1."""
        parts = [
            min(1.0, self.views / WANTED_VIEWS),
            float((self.corners > 0).mean()),
            float(np.mean([count > 0 for count in self.tilts])),
            float(np.clip((self.distance_ratio - 1) / (_DISTANCE_RATIO - 1), 0, 1)),
        ]
        return float(np.mean(parts))


def coverage(
    views: Sequence[BoardView], board: Board, size_px: tuple[int, int], left: Camera | None = None
) -> Coverage:
    """What views, with images of size_px (width, height), cover; left: the left camera, once it is known."""
    both = [view for view in views if view.left_px is not None and view.right_px is not None]
    counts = np.zeros((2, CELLS, CELLS), dtype=np.int64)
    camera = left or _any_camera(size_px)
    tilt_deg, distance = [], []
    for view in both:
        for side, corners_px in enumerate((view.left_px, view.right_px)):
            assert corners_px is not None
            known = corners_px[np.isfinite(corners_px).all(axis=1)]
            cell = np.clip(known / size_px * CELLS, 0, CELLS - 1).astype(np.int64)
            np.add.at(counts[side], (cell[:, 1], cell[:, 0]), 1)
        assert view.left_px is not None
        normal, depth_mm = _facing(view.left_px, board, camera)
        tilt_deg.append(np.degrees(np.arctan2(normal[:2], normal[2])))
        distance.append(depth_mm)
    tilts = np.array(tilt_deg).reshape(-1, 2)
    return Coverage(
        len(both),
        counts,
        (
            int((tilts[:, 0] < -TILT_DEG).sum()),
            int((tilts[:, 0] > TILT_DEG).sum()),
            int((tilts[:, 1] < -TILT_DEG).sum()),
            int((tilts[:, 1] > TILT_DEG).sum()),
        ),
        tilts,
        float(max(distance) / min(distance)) if distance else 1.0,
    )


def adds_something(view: BoardView, views: Sequence[BoardView], least_px: float) -> bool:
    """Whether a view, found in both pictures, shows the board elsewhere than each one so far, by least_px rms."""
    return all(displacement_px(view, other) > least_px for other in views)


def displacement_px(view: BoardView, other: BoardView) -> float:
    """How far apart, px rms, two views show the board; by its outline, which no order of corners changes."""
    apart = []
    for one, two in ((view.left_px, other.left_px), (view.right_px, other.right_px)):
        if one is None or two is None:
            return float("inf")
        apart.append(_outline_distance_px(one, two))
    return float(np.sqrt(np.mean(np.square(apart))))


def _outline_distance_px(one: Float, two: Float) -> float:
    """RMS distance of each corner of one from the nearest of the other, which for small motions is the motion."""
    first, second = one[np.isfinite(one).all(axis=1)], two[np.isfinite(two).all(axis=1)]
    if len(first) == 0 or len(second) == 0:
        return float("inf")
    # A board that moved by whole squares lies upon itself but for its border: the extremes tell.
    extremes = np.abs(np.stack([first.min(axis=0) - second.min(axis=0), first.max(axis=0) - second.max(axis=0)]))
    nearest = np.linalg.norm(first[:, None] - second[None], axis=2).min(axis=1)
    return float(max(np.sqrt((nearest**2).mean()), extremes.max()))


def _ninth(row: int, column: int) -> str:
    names = [_ROWS[row], _COLUMNS[column]]
    return "middle" if row == column == 1 else " ".join(name for name in names if name != "middle")


def _facing(corners_px: Float, board: Board, camera: Camera) -> tuple[Float, float]:
    """The board's normal (3,), into the board, and its depth, mm, in the camera's frame."""
    known = np.isfinite(corners_px).all(axis=1)
    points = board.points_mm[known]
    rays = camera.normalize(corners_px[known])
    homography, _ = cv2.findHomography(points[:, :2], rays)
    columns = homography / np.linalg.norm(homography[:, :2], axis=0).mean()
    columns = columns if columns[2, 2] > 0 else -columns
    normal = np.cross(columns[:, 0], columns[:, 1])
    normal /= np.linalg.norm(normal)
    return (normal if normal[2] > 0 else -normal), float(columns[2, 2])


def _any_camera(size_px: tuple[int, int]) -> Camera:
    width, height = size_px
    focal = _FOCAL_PER_WIDTH * width
    return Camera(
        np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]), np.zeros(4), size_px
    )
