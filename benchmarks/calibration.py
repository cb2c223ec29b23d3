"""The same boards through needletrack, mrcal and OpenCV's plain call, against exact truth: one table.

    python -m benchmarks.calibration [--mrcal PYTHON] RECORDING ...

RECORDING: pairs of a board with a truth.json. mrcal is a Debian package (apt-get install python3-mrcal): it runs in
the Python that has it, /usr/bin/python3 unless --mrcal says another; without it its rows are left out. Each solver has
both kinds of corners: ours, and OpenCV's, in the order that we found. Times are of solving alone.
"""

import argparse
import json
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import BoardView, Checkerboard, find_board
from needletrack.calibration.stereo import StereoCalibration, calibrate_stereo
from needletrack.calibration.worth import Expected, actual, expected, space_grid_mm
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.records import Float, Image

_PEER = Path(__file__).with_name("mrcal_peer.py")
_RANGES = ((-60.0, 70.0), (-55.0, 55.0), (210.0, 295.0))
_HEAD = (
    "recording",
    "solver",
    "corners",
    "rms, px",
    "error, mm",
    "aligned, mm",
    "own prediction, mm",
    "aligned, mm",
    "seconds",
)


@dataclass(frozen=True)
class Row:
    """One solver on one kind of corners of one recording."""

    recording: str
    solver: str
    corners: str
    rms_px: float
    error: Expected
    predicted: Expected | None
    seconds: float

    def cells(self) -> tuple[str, ...]:
        """The row as text."""
        own = ("–", "–") if self.predicted is None else _two(self.predicted)
        return (
            self.recording,
            self.solver,
            self.corners,
            f"{self.rms_px:.3f}",
            *_two(self.error),
            *own,
            f"{self.seconds:.2f}",
        )


def compared(folder: Path, mrcal_python: str | None) -> Iterator[Row]:
    """All rows of one recording."""
    truth = json.loads((folder / "truth.json").read_text())
    squares_x, squares_y = truth["board"]["squares"]
    board = Checkerboard(squares_x, squares_y, truth["board"]["square_mm"])
    left, right = (
        Camera(np.array(camera["K"]), np.array(camera["dist"]), tuple(camera["size"])) for camera in truth["cameras"]
    )
    pose = RigidTransform(np.array(truth["cameras"][1]["R"]), np.array(truth["cameras"][1]["t"]))
    true_rig = StereoRig(left, right, pose)
    points_mm = space_grid_mm(true_rig, *_RANGES)
    files = [sorted((folder / f"cam{camera}" / "data").glob("*.png")) for camera in (0, 1)]
    pairs = [(_gray(one), _gray(two)) for one, two in zip(*files, strict=True)]
    found = [find_board(one, two, board) for one, two in pairs]
    calibrated = calibrate_stereo(found, board, left.size_px)
    ours = [calibrated.views[place] for place in range(len(calibrated.used))]
    theirs = [_opencv_corners(pairs[index], view, board) for index, view in zip(calibrated.used, ours, strict=True)]
    for corners, views in (("ours", ours), ("OpenCV", theirs)):
        began = time.perf_counter()
        solved = calibrate_stereo(views, board, left.size_px)
        seconds = time.perf_counter() - began
        predicted = expected(solved.rig, solved.bundle.covariance, points_mm)
        error = actual(solved.rig, true_rig, points_mm)
        yield Row(folder.name, "needletrack", corners, solved.rms_px, error, predicted, seconds)
        rig, rms_px, seconds = _opencv(views, board, left.size_px)
        error = actual(rig, true_rig, points_mm)
        yield Row(folder.name, "OpenCV, plain", corners, rms_px, error, None, seconds)
        if mrcal_python is not None:
            yield _mrcal(folder.name, mrcal_python, corners, views, solved, board, true_rig, points_mm)


def _opencv_corners(pair: tuple[Image, Image], view: BoardView, board: Checkerboard) -> BoardView:
    """OpenCV's own corners, in the order of ours."""
    both = []
    for image, ours in zip(pair, (view.left_px, view.right_px), strict=True):
        assert ours is not None
        _, corners = cv2.findChessboardCornersSB(image, board.inner_corners, flags=cv2.CALIB_CB_ACCURACY)
        theirs = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        nearest = np.linalg.norm(ours[:, None] - theirs[None], axis=2).argmin(axis=1)
        both.append(theirs[nearest])
    return BoardView(both[0], both[1])


def _opencv(
    views: Sequence[BoardView], board: Checkerboard, size_px: tuple[int, int]
) -> tuple[StereoRig, float, float]:
    """cv2.calibrateCamera for each camera and cv2.stereoCalibrate for both, everything else as it comes."""
    points = [board.points_mm.astype(np.float32) for _ in views]
    left = [np.asarray(view.left_px, dtype=np.float32) for view in views]
    right = [np.asarray(view.right_px, dtype=np.float32) for view in views]
    began = time.perf_counter()
    _, k1, d1, *_ = cv2.calibrateCamera(points, left, size_px, np.eye(3), np.zeros(5))
    _, k2, d2, *_ = cv2.calibrateCamera(points, right, size_px, np.eye(3), np.zeros(5))
    rms, k1, d1, k2, d2, rotation, translation, *_ = cv2.stereoCalibrate(
        points, left, right, k1, d1, k2, d2, size_px, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    seconds = time.perf_counter() - began
    cameras = [
        Camera(np.asarray(k, dtype=np.float64), np.ravel(d)[:5].astype(np.float64), size_px)
        for k, d in ((k1, d1), (k2, d2))
    ]
    pose = RigidTransform(orthonormalized(rotation), np.ravel(translation))
    return StereoRig(cameras[0], cameras[1], pose), float(rms), seconds


def _mrcal(
    name: str,
    python: str,
    corners: str,
    views: Sequence[BoardView],
    solved: StereoCalibration,
    board: Checkerboard,
    true_rig: StereoRig,
    points_mm: Float,
) -> Row:
    columns, rows = board.inner_corners
    stacked = np.array([[view.left_px, view.right_px] for view in views]).reshape(len(views), 2, rows, columns, 2)
    rig = solved.rig
    given = {
        "corners_px": stacked.tolist(),
        "terms": solved.terms,
        "intrinsics": [
            [*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), *camera.distortion.tolist()]
            for camera in (rig.left, rig.right)
        ],
        "right_from_left_rt": _rt(rig.right_from_left),
        "left_from_board_rt": [_rt(pose) for pose in solved.bundle.left_from_board],
        "size_px": list(rig.left.size_px),
        "square_m": board.square_mm / 1000,
        # Each point costs mrcal a factorization; every tenth one tells the same.
        "points_m": (points_mm[::10] / 1000).tolist(),
    }
    done = subprocess.run([python, str(_PEER)], input=json.dumps(given), capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    cameras = [
        Camera(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(lens), rig.left.size_px)
        for fx, fy, cx, cy, *lens in answer["intrinsics"]
    ]
    turn, shift = np.array(answer["right_from_left_rt"][:3]), np.array(answer["right_from_left_rt"][3:])
    pose = RigidTransform(Rotation.from_rotvec(turn).as_matrix(), 1000 * shift)
    error = actual(StereoRig(cameras[0], cameras[1], pose), true_rig, points_mm)
    # mrcal states the root mean square of all coordinates; ours is of a corner's distance.
    rms_px = float(np.sqrt(2) * answer["rms_px"])
    before_mm, after_mm = answer["rms_mm"]
    return Row(name, "mrcal", corners, rms_px, error, Expected(before_mm, after_mm), answer["seconds"])


def _rt(pose: RigidTransform) -> list[float]:
    turn = Rotation.from_matrix(pose.rotation).as_rotvec()
    return [*turn.tolist(), *(pose.translation_mm / 1000).tolist()]


def _two(error: Expected) -> tuple[str, str]:
    return f"{error.before_mm:.3f}", f"{error.after_mm:.4f}"


def _gray(file: Path) -> Image:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _has_mrcal(python: str) -> bool:
    try:
        return subprocess.run([python, "-c", "import mrcal"], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--mrcal", default="/usr/bin/python3", help="a Python that has mrcal")
    given = parser.parse_args()
    python = given.mrcal if _has_mrcal(given.mrcal) else None
    if python is None:
        print(f"{given.mrcal} has no mrcal: its rows are left out (apt-get install python3-mrcal)\n")
    print(f"| {' | '.join(_HEAD)} |")
    print("|---" * len(_HEAD) + "|")
    for folder in given.recordings:
        for row in compared(folder, python):
            print(f"| {' | '.join(row.cells())} |", flush=True)


if __name__ == "__main__":
    main()
