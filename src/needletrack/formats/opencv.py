"""OpenCV FileStorage (YAML, XML, JSON): one file, or intrinsics and extrinsics apart as its own sample writes them.

It is written by OpenCV and read by parsers of its three languages: cv2.FileStorage (5.0.0) corrupts memory and ends the
process on a damaged file.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, rotation_of, text_of, write_text
from needletrack.geometry.transform import RigidTransform
from needletrack.reading import json_document, yaml_document
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
        try:
            storage = _storage(text_of(path))
            for key, names in NAMES.items():
                for each in names:
                    if (matrix := _matrix(storage.get(each), each)) is not None:
                        found.setdefault(key, matrix)
            for key, names in (("width", _WIDTH), ("height", _HEIGHT)):
                for each in names:
                    if isinstance(value := storage.get(each), int):
                        found.setdefault(key, np.array(value))
        except ValueError as error:
            raise CalibrationError(f"{path}: not an OpenCV FileStorage: {error}") from error
    said = ", ".join(map(str, files))
    if missing := [NAMES[key][0] for key in NAMES if key not in found]:
        raise CalibrationError(f"{said}: {', '.join(missing)} missing (names as of OpenCV's stereo_calib sample)")
    if size_px is None and not {"width", "height"} <= found.keys():
        raise CalibrationError(f"{said}: the images' size is not in it: give it, e.g. --size 1280x1024")
    size = size_px or (int(found["width"]), int(found["height"]))
    try:
        turn = found["rotation"]
        rotation = Rotation.from_rotvec(turn.ravel()).as_matrix() if turn.size == 3 else turn
        return rig_of(
            camera_of(found["left_matrix"], found["left_lens"], size),
            camera_of(found["right_matrix"], found["right_lens"], size),
            RigidTransform(rotation_of(rotation, "R"), found["translation"].ravel() * unit_mm),
            name,
            "opencv",
            files,
        )
    except (ValueError, OverflowError) as error:
        raise CalibrationError(f"{said}: {error}") from error


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's one tag."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(_mapping(node), deep=True)
)


def _mapping(node: yaml.Node) -> yaml.MappingNode:
    if not isinstance(node, yaml.MappingNode):
        raise ValueError("an opencv-matrix without rows, cols and data")
    return node


def _storage(text: str) -> dict[str, Any]:
    """The top of a FileStorage: names and what stands under them; ValueError where it is none."""
    if text.lstrip().startswith("<"):
        return _xml_storage(text)
    if text.lstrip().startswith("{"):
        document = json_document(text)
    else:
        # `%YAML:1.0` is OpenCV's own; YAML's directive has a blank.
        document = yaml_document(text.partition("\n")[2] if text.startswith("%YAML") else text, _Loader)
    if not isinstance(document, dict):
        raise ValueError("it holds no names")
    return document


def _xml_storage(text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise ValueError("a document type or an entity, which OpenCV does not write")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, RecursionError) as error:
        raise ValueError(str(error)) from error
    storage: dict[str, Any] = {}
    for child in root:
        plain = (child.text or "").strip()
        if len(child) == 0:
            storage[child.tag] = int(plain) if plain.isascii() and plain.isdecimal() and len(plain) < 10 else plain
        else:
            parts = {part.tag: (part.text or "").strip() for part in child}
            storage[child.tag] = {**parts, "data": parts.get("data", "").split()}
    return storage


def _matrix(entry: object, name: str) -> Float | None:
    """The matrix (rows, cols) in an entry; None where it is something else; ValueError where it contradicts itself."""
    if not isinstance(entry, dict) or not {"rows", "cols", "data"} <= entry.keys():
        return None
    data = entry["data"]
    if not isinstance(data, list):
        raise ValueError(f"{name}: its data are no list of numbers")
    try:
        rows, columns = int(entry["rows"]), int(entry["cols"])
        values = np.array([float(value) for value in data])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: {error}") from error
    if min(rows, columns) < 1 or len(values) != rows * columns:
        raise ValueError(f"{name}: {rows} x {columns} is not the size of {len(values)} numbers")
    return values.reshape(rows, columns)


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
