"""OpenCV FileStorage (YAML, XML, JSON): one file, or intrinsics and extrinsics apart as its own sample writes them."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, rotation_of, text_of, write_text
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float
from needletrack.rig import Rig

# Left and right camera matrix, left and right distortion, rotation, translation: of OpenCV's stereo_calib sample, of
# its function's parameters, of MATLAB's stereoParametersToOpenCV, and what people make of these.
NAMES = {
    "left_matrix": ("M1", "K1", "cameraMatrix1", "CM1", "intrinsicMatrix1", "K_l", "left_camera_matrix"),
    "right_matrix": ("M2", "K2", "cameraMatrix2", "CM2", "intrinsicMatrix2", "K_r", "right_camera_matrix"),
    "left_lens": ("D1", "distCoeffs1", "distortionCoefficients1", "D_l", "left_distortion"),
    "right_lens": ("D2", "distCoeffs2", "distortionCoefficients2", "D_r", "right_distortion"),
    "rotation": ("R", "rotationOfCamera2"),
    "translation": ("T", "translationOfCamera2"),
}
_WIDTH, _HEIGHT = ("image_width", "imageWidth", "width"), ("image_height", "imageHeight", "height")


def read_opencv(files: Sequence[Path], name: str, size_px: tuple[int, int] | None, unit_mm: float = 1.0) -> Rig:
    """The rig of one or two FileStorage files; size_px (width, height) where they do not say it.

    unit_mm: millimetres in the unit of T, which is that of the board's squares.
    """
    found: dict[str, Float] = {}
    for path in files:
        # FileStorage aborts on what is no file of its own kind; it wants to be asked kindly.
        text = text_of(path)
        try:
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError) as error:
            raise CalibrationError(f"{path}: not an OpenCV FileStorage: {error}") from error
        for key, names in NAMES.items():
            for each in names:
                node = storage.getNode(each)
                if not node.empty() and node.isMap():
                    found.setdefault(key, np.asarray(node.mat(), dtype=np.float64))
        for key, names in (("width", _WIDTH), ("height", _HEIGHT)):
            for each in names:
                if (node := storage.getNode(each)).isInt():
                    found.setdefault(key, np.array(node.real()))
        storage.release()
    said = ", ".join(map(str, files))
    if missing := [NAMES[key][0] for key in NAMES if key not in found]:
        raise CalibrationError(f"{said}: {', '.join(missing)} missing (names as of OpenCV's stereo_calib sample)")
    if size_px is None and not {"width", "height"} <= found.keys():
        raise CalibrationError(f"{said}: the images' size is not in it: give it, e.g. --size 1280x1024")
    size = size_px or (int(found["width"]), int(found["height"]))
    try:
        turn = found["rotation"]
        rotation = cv2.Rodrigues(turn)[0] if turn.size == 3 else turn
        return rig_of(
            camera_of(found["left_matrix"], found["left_lens"], size),
            camera_of(found["right_matrix"], found["right_lens"], size),
            RigidTransform(rotation_of(rotation, "R"), found["translation"].ravel() * unit_mm),
            name,
            "opencv",
            files,
        )
    except ValueError as error:
        raise CalibrationError(f"{said}: {error}") from error


def write_opencv(rig: Rig, path: Path) -> None:
    """Write one file with the names of OpenCV's stereo_calib sample, T in mm, and the images' size."""
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", rig.left.size_px[0])
    storage.write("image_height", rig.left.size_px[1])
    pose = rig.right_from_left
    for key, value in (
        ("M1", rig.left.matrix),
        ("D1", rig.left.distortion[None]),
        ("M2", rig.right.matrix),
        ("D2", rig.right.distortion[None]),
        ("R", pose.rotation),
        ("T", pose.translation_mm.reshape(3, 1)),
    ):
        storage.write(key, np.ascontiguousarray(value))
    write_text(path, storage.releaseAndGetString())
