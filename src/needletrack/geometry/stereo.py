"""The two cameras of a rig and what follows from them."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.geometry import epipolar
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float

MIN_BASELINE_MM = 1e-3


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Left and right camera and the pose between them; the left camera's frame is the world frame.

    Raises ValueError where both cameras stand in one place.
    """

    left: Camera
    right: Camera
    right_from_left: RigidTransform

    def __post_init__(self) -> None:
        if self.baseline_mm < MIN_BASELINE_MM:
            raise ValueError(f"the baseline is {self.baseline_mm:g} mm: two cameras in one place see no depth")

    @property
    def baseline_mm(self) -> float:
        """Distance of the two camera centres, mm."""
        return float(np.linalg.norm(self.right_from_left.translation_mm))

    @cached_property
    def fundamental(self) -> Float:
        """F (3, 3) with right^T F left = 0 for undistorted pixels, of unit Frobenius norm."""
        pose = self.right_from_left
        return epipolar.fundamental_matrix(self.left.matrix, self.right.matrix, pose.rotation, pose.translation_mm)

    @cached_property
    def lenses(self) -> tuple[Float, Float]:
        """Both cameras as the kernels take them, in the left camera's frame."""
        return self.left.lens, self.right.lens_at(self.right_from_left)

    @cached_property
    def epipoles(self) -> tuple[Float, Float]:
        """Left and right epipole, homogeneous undistorted pixels (3,)."""
        pose = self.right_from_left
        return epipolar.epipoles(self.left.matrix, self.right.matrix, pose.rotation, pose.translation_mm)

    def project(self, points_mm: npt.ArrayLike) -> tuple[Float, Float]:
        """Raw pixels (N, 2) of points (N, 3) in the left camera's frame, in the left and in the right view."""
        return self.left.project(points_mm), self.right.project(self.right_from_left.apply(points_mm))

    def calibration_covariance_mm2(self, points_mm: npt.ArrayLike) -> Float | None:
        """Covariance (N, 3, 3) of triangulated points (N, 3) mm that the calibration gives them; None where unknown."""
        return None

    @cached_property
    def rectification(self) -> tuple[Float, Float, Float]:
        """Rotations (3, 3) that turn left and right rays so that epipolar lines are rows, and the common camera matrix.

        Returned as (left_rotation, right_rotation, camera_matrix): a rectified pixel is matrix @ rotation @ ray
        (Bouguet's algorithm, cv2.stereoRectify without a shift of the principal point).
        """
        pose = self.right_from_left
        left_rotation, right_rotation, projection, *_ = cv2.stereoRectify(
            self.left.matrix,
            np.zeros(5),
            self.right.matrix,
            np.zeros(5),
            self.left.size_px,
            pose.rotation,
            pose.translation_mm.reshape(3, 1),
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=-1,
        )
        return (
            np.asarray(left_rotation, dtype=np.float64),
            np.asarray(right_rotation, dtype=np.float64),
            np.asarray(projection[:, :3], dtype=np.float64),
        )
