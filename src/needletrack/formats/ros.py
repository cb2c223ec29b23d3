"""ROS: a camera_info YAML for each camera, as camera_calibration writes and camera_info_manager reads them.

The pose between the cameras hides in the rectification: R of each camera takes its rays to the common rectified frame,
and P of the right camera holds Tx = -f B. Lengths are in the unit of the board's squares, metres by REP 103.
"""

import reprlib
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, rotation_of, text_of, write_text
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.reading import yaml_document
from needletrack.records import Float
from needletrack.rig import Rig

MODELS = ("plumb_bob", "rational_polynomial")


def read_ros(left: Path, right: Path, name: str, unit_mm: float = 1000.0) -> Rig:
    """The rig of a pair of camera_info files; unit_mm: millimetres in the files' unit of length."""
    files = (left, right)
    documents = [_document(path) for path in files]
    try:
        cameras, turns, projections = zip(*(_camera(document) for document in documents), strict=True)
        if projections[0][0, 3] != 0 or projections[1][1, 3] != 0:
            raise ValueError("projection_matrix: the left camera's has an offset, or the right one's a vertical one")
        focal = projections[1][0, 0]
        if not focal > 0 or projections[1][0, 3] == 0:
            raise ValueError(
                "projection_matrix of the right camera has no baseline: the cameras were calibrated one by one, not as "
                "a stereo pair"
            )
        rotation = turns[1].T @ turns[0]
        shift = turns[1].T @ np.array([projections[1][0, 3] / focal, 0.0, 0.0]) * unit_mm
        return rig_of(cameras[0], cameras[1], RigidTransform(rotation, shift), name, "ros", files)
    except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
        raise CalibrationError(f"{left}, {right}: {_said(error)}") from error


def write_ros(rig: Rig, folder: Path) -> tuple[Path, Path]:
    """Write left.yaml and right.yaml into a folder, in metres; returns their paths."""
    left_turn, right_turn, matrix = rig.rectification
    # The rectified frame's x axis is the baseline: from the right camera's centre the left one lies at -B.
    baseline = float((right_turn @ rig.right_from_left.translation_mm)[0]) / 1000
    written = []
    for side, camera, turn, offset in (
        ("left", rig.left, left_turn, 0.0),
        ("right", rig.right, right_turn, float(matrix[0, 0]) * baseline),
    ):
        projection = np.column_stack([matrix, [offset, 0.0, 0.0]])
        if camera.matrix[0, 1] != 0:
            raise CalibrationError(f"the {side} camera has skew, which ROS does not know")
        lens = camera.distortion if len(camera.distortion) != 4 else np.append(camera.distortion, 0.0)
        document = {
            "image_width": camera.size_px[0],
            "image_height": camera.size_px[1],
            "camera_name": f"{rig.name}/{side}",
            "camera_matrix": _matrix(camera.matrix),
            "distortion_model": MODELS[0] if len(lens) <= 5 else MODELS[1],
            "distortion_coefficients": _matrix(lens[None]),
            "rectification_matrix": _matrix(turn),
            "projection_matrix": _matrix(projection),
        }
        path = folder / f"{side}.yaml"
        write_text(path, yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))
        written.append(path)
    return written[0], written[1]


def _document(path: Path) -> dict[str, Any]:
    try:
        document = yaml_document(text_of(path))
    except ValueError as error:
        raise CalibrationError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(document, dict) or "camera_matrix" not in document:
        raise CalibrationError(f"{path}: not a ROS camera_info file: it has no camera_matrix")
    return document


def _camera(document: dict[str, Any]) -> tuple[Camera, Float, Float]:
    # Some writers call it camera_model.
    model = document.get("distortion_model", document.get("camera_model", "plumb_bob"))
    if model not in MODELS:
        raise ValueError(f"distortion_model {reprlib.repr(model)} is not supported: {' or '.join(MODELS)}")
    size = int(document["image_width"]), int(document["image_height"])
    camera = camera_of(document["camera_matrix"]["data"], document["distortion_coefficients"]["data"], size)
    turn = rotation_of(document["rectification_matrix"]["data"], "rectification_matrix")
    projection = np.asarray(document["projection_matrix"]["data"], dtype=np.float64).reshape(3, 4)
    return camera, turn, projection


def _matrix(values: Float) -> dict[str, object]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": [float(value) for value in values.ravel()]}


def _said(error: Exception) -> str:
    return f"the key {error} is missing" if isinstance(error, KeyError) else str(error)
