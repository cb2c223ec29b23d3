"""Kalibr's camchain, written; `needletrack.rig.import_camchain` reads it."""

from pathlib import Path

import numpy as np
import yaml

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import write_text
from needletrack.geometry.camera import Camera
from needletrack.rig import Rig


def write_kalibr(rig: Rig, path: Path) -> None:
    """Write a camchain with pinhole cameras and radtan distortion; cam0 is left, lengths are metres.

    Raises CalibrationError where the lens has more terms than Kalibr's radtan.
    """
    transform = np.eye(4)
    transform[:3, :3] = rig.right_from_left.rotation
    transform[:3, 3] = rig.right_from_left.translation_mm / 1000
    chain: dict[str, dict[str, object]] = {}
    for index, (camera, other) in enumerate(((rig.left, 1), (rig.right, 0))):
        chain[f"cam{index}"] = {
            "cam_overlaps": [other],
            "camera_model": "pinhole",
            "distortion_coeffs": _radtan(camera, path),
            "distortion_model": "radtan",
            "intrinsics": [float(camera.matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "resolution": list(camera.size_px),
            "rostopic": f"/cam{index}/image_raw",
        }
    chain["cam1"]["T_cn_cnm1"] = [[float(value) for value in row] for row in transform]
    write_text(path, yaml.safe_dump(chain, default_flow_style=None, width=110))


def _radtan(camera: Camera, path: Path) -> list[float]:
    if camera.matrix[0, 1] != 0 or np.any(camera.distortion[4:]):
        raise CalibrationError(
            f"{path}: Kalibr's radtan has k1 k2 p1 p2 and no skew, this lens has more: calibrate with --lens 4"
        )
    return [float(value) for value in camera.distortion[:4]]
