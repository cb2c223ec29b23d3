"""MATLAB: what stereoParametersToOpenCV returns, in a .mat file, and what stereoParametersFromOpenCV takes.

Those functions move the principal point by one pixel between MATLAB's origin (1, 1) and OpenCV's (0, 0): the numbers in
the file are OpenCV's. Lengths are millimetres. A stereoParameters object itself cannot be read outside of MATLAB.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, rotation_of
from needletrack.geometry.transform import RigidTransform
from needletrack.rig import Rig

KEYS = (
    "intrinsicMatrix1",
    "distortionCoefficients1",
    "intrinsicMatrix2",
    "distortionCoefficients2",
    "rotationOfCamera2",
    "translationOfCamera2",
)


def read_matlab(path: Path, name: str, size_px: tuple[int, int] | None) -> Rig:
    """The rig of a .mat file; size_px (width, height) where it has no imageSize (rows, columns, as in MATLAB)."""
    try:
        found: dict[str, Any] = loadmat(path)
    except (OSError, ValueError, NotImplementedError) as error:
        raise CalibrationError(f"{path}: cannot be read: {error}; save it with -v7 or older") from error
    if missing := [key for key in KEYS if key not in found]:
        raise CalibrationError(
            f"{path}: {', '.join(missing)} missing: save what stereoParametersToOpenCV(stereoParams) returns"
        )
    if size_px is None:
        if "imageSize" not in found:
            raise CalibrationError(f"{path}: the images' size is not in it: give it, e.g. --size 1280x1024")
        rows, columns = np.ravel(found["imageSize"])[:2]
        size_px = int(columns), int(rows)
    values = [np.asarray(found[key], dtype=np.float64) for key in KEYS]
    try:
        left, right = (camera_of(values[i], values[i + 1], size_px) for i in (0, 2))
        pose = RigidTransform(rotation_of(values[4], KEYS[4]), values[5].ravel())
        return rig_of(left, right, pose, name, "matlab", [path])
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from error


def write_matlab(rig: Rig, path: Path) -> None:
    """Write a .mat file for stereoParametersFromOpenCV; raises CalibrationError for a rational lens, unknown there."""
    lenses = []
    for camera in (rig.left, rig.right):
        if np.any(camera.distortion[5:]):
            raise CalibrationError(f"{path}: MATLAB knows k1 k2 p1 p2 k3, this lens has more: calibrate with --lens 5")
        lens = np.zeros(5)
        kept = camera.distortion[:5]
        lens[: len(kept)] = kept
        lenses.append(lens[None])
    width, height = rig.left.size_px
    pose = rig.right_from_left
    values = (
        rig.left.matrix,
        lenses[0],
        rig.right.matrix,
        lenses[1],
        pose.rotation,
        pose.translation_mm.reshape(3, 1),
    )
    content = {**dict(zip(KEYS, values, strict=True)), "imageSize": np.array([[height, width]], dtype=np.float64)}
    try:
        savemat(path, content, appendmat=False)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror or error}") from error
