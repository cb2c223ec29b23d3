"""One camera: the pinhole model with OpenCV's radial-tangential (and rational) distortion."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from needletrack.geometry.transform import RigidTransform
from needletrack.kernels import call, packed_lens
from needletrack.records import Float, frozen_array

DISTORTION_LENGTHS = (4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera matrix K (3, 3), distortion (n,) in OpenCV's order k1 k2 p1 p2 [k3 ...], size_px (width, height).

    Pixel (0, 0) is the centre of the top-left pixel. Raises ValueError where a shape or value cannot be a camera's.
    """

    matrix: Float
    distortion: Float
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        matrix = frozen_array(self.matrix, (3, 3), "camera matrix")
        distortion = frozen_array(self.distortion, (None,), "distortion")
        if len(distortion) not in DISTORTION_LENGTHS:
            raise ValueError(f"distortion has {len(distortion)} terms, not one of {DISTORTION_LENGTHS}")
        if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
            raise ValueError("camera matrix and distortion must be finite")
        if not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise ValueError("camera matrix is not [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise ValueError("camera matrix has a focal length that is not positive")
        if min(self.size_px) <= 0:
            raise ValueError(f"image size {self.size_px} is not positive")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)

    @property
    def focal_px(self) -> float:
        """Mean of the two focal lengths, px."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2

    def project(self, points_mm: npt.ArrayLike) -> Float:
        """Raw pixels (N, 2) of points (N, 3) in this camera's frame; points behind the camera are not defined."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
        pixels = np.empty((len(points), 2))
        call("project", self.lens, points, len(points), pixels)
        return pixels

    def undistort(self, points_px: npt.ArrayLike) -> Float:
        """Undistorted pixels (N, 2), under the same camera matrix, of raw pixels (N, 2)."""
        rays = self.normalize(points_px)
        skewed = rays @ self.matrix[:2, :2].T
        return np.asarray(skewed + self.matrix[:2, 2])

    def normalize(self, points_px: npt.ArrayLike) -> Float:
        """Normalised image coordinates (N, 2), x / z and y / z, of raw pixels (N, 2)."""
        points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 2)
        rays = np.empty_like(points)
        call("normalize", self.lens, points, len(points), rays)
        return rays

    def distort(self, undistorted_px: npt.ArrayLike) -> Float:
        """Raw pixels (N, 2) of undistorted pixels (N, 2)."""
        undistorted = np.asarray(undistorted_px, dtype=np.float64)
        y = (undistorted[:, 1] - self.matrix[1, 2]) / self.matrix[1, 1]
        x = (undistorted[:, 0] - self.matrix[0, 2] - self.matrix[0, 1] * y) / self.matrix[0, 0]
        return self.project(np.column_stack([x, y, np.ones_like(x)]))

    def contains(self, points_px: npt.ArrayLike, margin_px: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which raw pixels (N, 2) lie inside the image, by at least the margin; (N,) bool."""
        points = np.asarray(points_px, dtype=np.float64)
        upper = np.array(self.size_px) - 1.0 - margin_px
        return np.asarray(((points >= margin_px) & (points <= upper)).all(axis=-1), dtype=np.bool_)

    @cached_property
    def lens(self) -> Float:
        """The camera as the kernels take it, at the origin of its own frame."""
        return packed_lens(self.matrix, self.distortion, self._tilt)

    def lens_at(self, camera_from_world: RigidTransform) -> Float:
        """The camera as the kernels take it, at its pose."""
        pose = camera_from_world
        return packed_lens(self.matrix, self.distortion, self._tilt, pose.rotation, pose.translation_mm)

    @property
    def _tilt(self) -> Float:
        """How a tilted sensor (terms tau_x, tau_y) pictures the plane of the lens (OpenCV's tilted model)."""
        if len(self.distortion) < max(DISTORTION_LENGTHS):
            return np.eye(3)
        (sin_x, sin_y), (cos_x, cos_y) = np.sin(self.distortion[12:]), np.cos(self.distortion[12:])
        about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
        turned = about_y @ about_x
        onto_plane = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]])
        return np.asarray(onto_plane @ turned)
