"""One camera: the pinhole model with OpenCV's radial-tangential (and rational) distortion."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.records import Float, frozen_array

DISTORTION_LENGTHS = (4, 5, 8, 12, 14)
# The inverse of the distortion has no closed form; 1e-10 px is far below any noise and is reached in about 10 rounds.
_UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


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
        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 1, 3)
        if len(points) == 0:
            return np.zeros((0, 2))
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return self._sheared(np.asarray(pixels, dtype=np.float64).reshape(-1, 2), 1.0)

    def undistort(self, points_px: npt.ArrayLike) -> Float:
        """Undistorted pixels (N, 2), under the same camera matrix, of raw pixels (N, 2)."""
        return self._undistorted(points_px, self.matrix)

    def normalize(self, points_px: npt.ArrayLike) -> Float:
        """Normalised image coordinates (N, 2), x / z and y / z, of raw pixels (N, 2)."""
        return self._undistorted(points_px, np.eye(3))

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

    def _sheared(self, points_px: Float, times: float) -> Float:
        # OpenCV takes fx, fy, cx, cy from the camera matrix and drops its skew in silence.
        skew = self.matrix[0, 1]
        if skew == 0:
            return points_px
        rows = (points_px[:, 1] - self.matrix[1, 2]) / self.matrix[1, 1]
        return np.column_stack([points_px[:, 0] + times * skew * rows, points_px[:, 1]])

    def _undistorted(self, points_px: npt.ArrayLike, new_matrix: Float) -> Float:
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        if len(points) == 0:
            return np.zeros((0, 2))
        unsheared = np.ascontiguousarray(self._sheared(points, -1.0)).reshape(-1, 1, 2)
        found = cv2.undistortPoints(unsheared, self.matrix, self.distortion, None, None, new_matrix, _UNDISTORT_UNTIL)
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)
