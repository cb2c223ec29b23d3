"""mrcal's .cameramodel, one a camera: a Python dictionary with the lens, the image's size and the pose.

`extrinsics` are rt_fromref: a Rodrigues vector and a shift that take points of the reference frame, the left camera's,
to the camera's; metres.
"""

import ast
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, text_of, write_text
from needletrack.geometry.transform import RigidTransform
from needletrack.rig import Rig

_LENSES = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5, "LENSMODEL_OPENCV8": 8}


def read_mrcal(left: Path, right: Path, name: str, unit_mm: float = 1000.0) -> Rig:
    """The rig of two camera models whose poses share a reference frame; OpenCV lenses and pinholes alone."""
    files = (left, right)
    try:
        cameras, poses = zip(*(_model(path, unit_mm) for path in files), strict=True)
        return rig_of(cameras[0], cameras[1], poses[1] @ poses[0].inverse(), name, "mrcal", files)
    except (RecursionError, MemoryError) as error:  # Python's parser says so
        raise CalibrationError(f"{left}, {right}: not two mrcal camera models: they nest too deep") from error
    except (ValueError, KeyError, TypeError, SyntaxError, OverflowError) as error:
        raise CalibrationError(f"{left}, {right}: not two mrcal camera models: {error}") from error


def write_mrcal(rig: Rig, folder: Path) -> tuple[Path, Path]:
    """Write left.cameramodel and right.cameramodel into a folder; returns their paths."""
    written = []
    poses = (RigidTransform.identity(), rig.right_from_left)
    for side, camera, pose in zip(("left", "right"), (rig.left, rig.right), poses, strict=True):
        if camera.matrix[0, 1] != 0:
            raise CalibrationError(f"the {side} camera has skew, which mrcal does not know")
        matrix = camera.matrix
        intrinsics = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *camera.distortion]
        extrinsics = [*Rotation.from_matrix(pose.rotation).as_rotvec(), *(pose.translation_mm / 1000)]
        path = folder / f"{side}.cameramodel"
        text = (
            f"# {rig.name}, {side} camera; by needletrack\n"
            "{\n"
            f"    'lensmodel':  'LENSMODEL_OPENCV{len(camera.distortion)}',\n\n"
            "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
            f"    'intrinsics': {_listed(intrinsics)},\n\n"
            "    # extrinsics are rt_fromref\n"
            f"    'extrinsics': {_listed(extrinsics)},\n\n"
            f"    'imagersize': [ {camera.size_px[0]}, {camera.size_px[1]}, ],\n"
            "}\n"
        )
        write_text(path, text)
        written.append(path)
    return written[0], written[1]


def _model(path: Path, unit_mm: float) -> tuple[Any, RigidTransform]:
    model = ast.literal_eval(text_of(path))
    if not isinstance(model, dict):
        raise TypeError("no dictionary")
    lens = model["lensmodel"]
    if lens not in _LENSES:
        raise ValueError(f"{path.name}: {reprlib.repr(lens)} is not supported: {', '.join(_LENSES)}")
    fx, fy, cx, cy, *terms = model["intrinsics"]
    if len(terms) != _LENSES[lens]:
        raise ValueError(f"{path.name}: {lens} has {_LENSES[lens]} terms of distortion, not {len(terms)}")
    width, height = model["imagersize"]
    camera = camera_of([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], terms or [0.0] * 4, (int(width), int(height)))
    turn, shift = np.array(model["extrinsics"], dtype=np.float64).reshape(2, 3)
    if not np.isfinite(turn).all():
        raise ValueError(f"{path.name}: extrinsics are not finite")
    return camera, RigidTransform(Rotation.from_rotvec(turn).as_matrix(), shift * unit_mm)


def _listed(values: Sequence[float]) -> str:
    return f"[ {', '.join(repr(float(value)) for value in values)}, ]"
