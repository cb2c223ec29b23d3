"""What all formats share: a camera from a matrix and terms, a rig that says which file it is from."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from needletrack import reading
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import DISTORTION_LENGTHS, Camera
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.records import Float
from needletrack.rig import CalibrationInfo, Rig

# Seven decimals and fewer are written; more than this is no rounding.
_NEAR_ROTATION = 2e-3
_LENS_LENGTHS = (4, 5, 8)


def camera_of(matrix: npt.ArrayLike, distortion: npt.ArrayLike, size_px: tuple[int, int]) -> Camera:
    """A camera with as few terms of distortion as hold what is not zero; ValueError for a model of ours that cannot."""
    terms = np.ravel(np.asarray(distortion, dtype=np.float64))
    used = len(np.trim_zeros(terms, "b"))
    length = next((n for n in _LENS_LENGTHS if used <= n), None)
    if length is None or len(terms) > max(DISTORTION_LENGTHS):
        raise ValueError(f"a distortion of {used} terms (thin prism or tilt) is not supported: at most k1 ... k6")
    padded = np.zeros(max(length, len(terms)))
    padded[: len(terms)] = terms
    return Camera(np.asarray(matrix, dtype=np.float64).reshape(3, 3), padded[:length], size_px)


def rotation_of(values: npt.ArrayLike, name: str) -> Float:
    """The rotation (3, 3) that was rounded when it was written; ValueError where it is none."""
    matrix = np.asarray(values, dtype=np.float64).reshape(3, 3)
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not error <= _NEAR_ROTATION or np.linalg.det(matrix) < 0:
        raise ValueError(f"{name} is not a rotation: R R^T is off from the identity by {error:.1e}")
    return orthonormalized(matrix)


def rig_of(
    left: Camera, right: Camera, right_from_left: RigidTransform, name: str, method: str, files: Sequence[Path]
) -> Rig:
    """The rig of an imported calibration."""
    source = f"imported from {' and '.join(file.name for file in files)}"
    return Rig(left, right, right_from_left, name, CalibrationInfo(method=method, source=source))


def text_of(path: Path) -> str:
    """A file's text; raises CalibrationError."""
    try:
        return reading.text_of(path)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read the calibration: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: cannot read the calibration: no text: {error}") from error


def write_text(path: Path, text: str) -> None:
    """Write a file; raises CalibrationError."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror or error}") from error
