"""A recording of the calibration board, which brings no rig: it is there to make one."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from needletrack.calibration.board import BoardView, Checkerboard, find_board
from needletrack.calibration.stereo import calibrate_stereo
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.recording.asl import AslRecording, UnusablePair
from needletrack.recording.png import png_size
from needletrack.rig import CalibrationInfo, Rig

_METHOD = "needletrack calibrate"


@dataclass(frozen=True, slots=True)
class BoardCalibration:
    """The rig that a recording of the board gives.

    left_out: a sentence for each pair that could not serve; worst_view_rms_px: of those that did, of the
    worst one in its worse picture.
    """

    rig: Rig
    left_out: tuple[str, ...]
    worst_view_rms_px: float


def calibrate_from_recording(
    folder: Path | str, board: Checkerboard, name: str, calibrated_at: datetime
) -> BoardCalibration:
    """Calibrate both cameras from the pairs of an EuRoC / ASL folder that show the board.

    calibrated_at: with a time zone, for the rig file. Raises RecordingError where the folder is no
    recording, CalibrationError where its pictures do not determine the cameras.
    """
    folder = Path(folder)
    recording = AslRecording(folder, _before_calibration(folder))

    def view(index: int) -> BoardView | UnusablePair:
        try:
            pair = recording.read(index)
        except UnusablePair as unusable:
            return unusable
        return find_board(pair.left.image, pair.right.image, board)

    # The detector leaves Python's lock alone and takes most of the time.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        views = list(pool.map(view, range(len(recording))))
    left_out = [str(view) for view in views if isinstance(view, UnusablePair)]
    readable = [(index, view) for index, view in enumerate(views) if isinstance(view, BoardView)]
    found = calibrate_stereo([view for _, view in readable], board, recording.rig.left.size_px)
    for rejected in found.rejected:
        picture = recording.pairs[readable[rejected.index][0]].left.path.name
        left_out.append(f"{picture}: {rejected.reason}")
    about = f"{folder.resolve().name}, board of {board.squares_x} x {board.squares_y} squares of"
    info = CalibrationInfo(
        method=_METHOD,
        calibrated_at=calibrated_at,
        reprojection_rms_px=found.rms_px,
        views=len(found.used),
        source=f"{about} {board.square_mm:g} mm",
    )
    solved = found.rig
    try:
        rig = Rig(solved.left, solved.right, solved.right_from_left, name, info)
    except ValueError as error:
        raise CalibrationError(
            f"{folder}: no rig: {error}; check the number of squares, their side in mm, and left and right"
        ) from error
    return BoardCalibration(rig, tuple(left_out), float(found.view_rms_px.max()))


def _before_calibration(folder: Path) -> Rig:
    """A rig that knows the images' size and nothing else: pairs are read with it, and nothing is measured."""
    pictures = sorted((folder / "cam0" / "data").glob("*.png"))
    width, height = next((size for picture in pictures if (size := png_size(picture))), (640, 480))
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    camera = Camera(matrix, np.zeros(4), (width, height))
    return Rig(camera, camera, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])), "uncalibrated")
