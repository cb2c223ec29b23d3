"""A plausible pair of cameras for the synthetic world."""

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform

FOCAL_PER_WIDTH = 1.1
TOE_IN_DEG = 9.0
RIGHT_CENTER_MM = (68.0, 0.6, -0.4)


def default_rig(size_px: tuple[int, int] = (1280, 1024)) -> StereoRig:
    """Two slightly unlike cameras 68 mm apart, turned to each other by 9 degrees; size_px (width, height).

    Everything in pixels scales with the width: the same lens before another sensor.
    """
    width, height = size_px
    focal_px = FOCAL_PER_WIDTH * width

    def camera(focal: float, center: tuple[float, float], distortion: tuple[float, ...]) -> Camera:
        u = (width - 1) / 2 + center[0] * width
        v = (height - 1) / 2 + center[1] * width
        matrix = np.array([[focal, 0.0, u], [0.0, focal * 1.0005, v], [0.0, 0.0, 1.0]])
        return Camera(matrix, np.array(distortion), size_px)

    rotation = Rotation.from_euler("yxz", [TOE_IN_DEG, 0.3, -0.2], degrees=True).as_matrix()
    return StereoRig(
        left=camera(focal_px, (0.008, -0.003), (-0.11, 0.075, 2e-4, -1e-4, 0.0)),
        right=camera(1.004 * focal_px, (-0.006, 0.002), (-0.10, 0.085, -1e-4, 3e-4, 0.0)),
        right_from_left=RigidTransform(rotation, -rotation @ np.array(RIGHT_CENTER_MM)),
    )
