"""One door to all formats: which a file has, the rig in it, and a rig written in it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import text_of
from needletrack.formats.kalibr import write_kalibr
from needletrack.formats.matlab import read_matlab, write_matlab
from needletrack.formats.mrcal import read_mrcal, write_mrcal
from needletrack.formats.opencv import read_opencv, write_opencv
from needletrack.formats.ros import read_ros, write_ros
from needletrack.rig import Rig, import_camchain

Format = Literal["kalibr", "ros", "opencv", "matlab", "mrcal"]
_PAIRS: tuple[Format, ...] = ("ros", "mrcal")
# Of each format where a file does not say it: REP 103 and Kalibr speak of metres, OpenCV of the board's unit.
_UNIT_MM: dict[Format, float] = {"ros": 1000.0, "mrcal": 1000.0, "opencv": 1.0}


def format_of(path: Path) -> Format:
    """The format of a calibration file, by its name and its first lines; raises CalibrationError."""
    if path.suffix == ".mat":
        return "matlab"
    if path.suffix == ".cameramodel":
        return "mrcal"
    text = text_of(path)
    if text.startswith("%YAML") or "opencv-matrix" in text or "<opencv_storage>" in text:
        return "opencv"
    if "camera_matrix" in text and "projection_matrix" in text:
        return "ros"
    if "cam0" in text:
        return "kalibr"
    raise CalibrationError(
        f"{path}: its format is not known: Kalibr camchain, ROS camera_info, OpenCV FileStorage, MATLAB .mat or mrcal "
        ".cameramodel"
    )


def import_rig(
    files: Sequence[Path],
    name: str,
    *,
    size_px: tuple[int, int] | None = None,
    unit_mm: float | None = None,
) -> Rig:
    """The rig of another tool's file or files, left before right.

    size_px (width, height): where the file has none. unit_mm: millimetres in its unit of length; None takes what the
    format's owners write. Raises CalibrationError.
    """
    kind = format_of(files[0])
    if kind in _PAIRS and len(files) != 2:
        raise CalibrationError(f"{files[0]}: {kind} has a file for each camera: name the left and the right one")
    unit = unit_mm or _UNIT_MM.get(kind, 1.0)
    # What overflows on the way is no calibration, which the checks say better than NumPy's warnings.
    with np.errstate(all="ignore"):
        if kind == "kalibr":
            return import_camchain(files[0], name)
        if kind == "ros":
            return read_ros(files[0], files[1], name, unit)
        if kind == "mrcal":
            return read_mrcal(files[0], files[1], name, unit)
        if kind == "matlab":
            return read_matlab(files[0], name, size_px)
        return read_opencv(files, name, size_px, unit)


def export_rig(rig: Rig, kind: Format, output: Path) -> tuple[Path, ...]:
    """Write a rig in another tool's format: to a file, or two into a folder (ros, mrcal); returns what was written."""
    if kind in _PAIRS:
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CalibrationError(f"{output}: cannot be made: {error.strerror or error}") from error
        return write_ros(rig, output) if kind == "ros" else write_mrcal(rig, output)
    if kind == "kalibr":
        write_kalibr(rig, output)
    elif kind == "matlab":
        write_matlab(rig, output)
    else:
        write_opencv(rig, output)
    return (output,)
