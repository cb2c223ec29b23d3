"""Rigid transforms, named `a_from_b` so that neighbours cancel."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.records import Float, frozen_array

# Kalibr prints 12 digits and people round further; 1e-6 is 0.25 micrometres at 250 mm.
ORTHONORMAL_TOLERANCE = 1e-6

_Axis = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """`a_from_b`: rotation (3, 3) and translation_mm (3,) take points of frame b into frame a.

    Raises ValueError where the rotation is not a proper one, or a number is not finite.
    """

    rotation: Float
    translation_mm: Float

    def __post_init__(self) -> None:
        rotation = frozen_array(self.rotation, (3, 3), "rotation")
        translation_mm = frozen_array(self.translation_mm, (3,), "translation_mm")
        if not (np.isfinite(rotation).all() and np.isfinite(translation_mm).all()):
            raise ValueError("rotation and translation must be finite")
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not error < ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError(
                f"not a rotation: R R^T is off from the identity by {error:.2g}, det {np.linalg.det(rotation):.3f}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_mm", translation_mm)

    @classmethod
    def identity(cls) -> "RigidTransform":
        """The transform of a frame onto itself."""
        return cls(np.eye(3), np.zeros(3))

    def apply(self, points_mm: npt.ArrayLike) -> Float:
        """Points (..., 3) of frame b, expressed in frame a."""
        return np.asarray(points_mm, dtype=np.float64) @ self.rotation.T + self.translation_mm

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """`a_from_c = a_from_b @ b_from_c`."""
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation_mm))

    def inverse(self) -> "RigidTransform":
        """`b_from_a`."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation_mm)


def orthonormalized(rotation: npt.ArrayLike) -> Float:
    """The proper rotation (3, 3) nearest to a matrix, in the Frobenius norm (through its SVD)."""
    u, _, vt = np.linalg.svd(np.asarray(rotation, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def turned_by(vector_rad: npt.ArrayLike) -> Float:
    """The rotation (3, 3) about a vector (3,) by its length, rad (Rodrigues).

    SciPy's Rotation does the same, and more, for half a second of import that a daemon would wait for.
    """
    return np.asarray(cv2.Rodrigues(np.asarray(vector_rad, dtype=np.float64))[0], dtype=np.float64)


def turned_orientation(rotation: npt.ArrayLike, orientation_xyzw: npt.ArrayLike) -> Float:
    """Quaternion xyzw (4,) of an orientation (4,) after a rotation (3, 3) of the frame that it is told in."""
    (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = np.asarray(rotation, dtype=np.float64).tolist()
    ax, ay, az, aw = _quaternion((x0, x1, x2), (y0, y1, y2), (z0, z1, z2))
    bx, by, bz, bw = np.asarray(orientation_xyzw, dtype=np.float64).tolist()
    product = np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )
    return np.asarray(product / np.linalg.norm(product))


def orientation_along(direction: npt.ArrayLike) -> Float:
    """Quaternion xyzw (4,) of the frame with +z along `direction` and +x in the plane of +z and the camera's x.

    The roll of a round needle about its axis is not observable; this is the convention that sets it.
    Where the needle points along the camera's x axis, the camera's y takes its place.
    """
    z0, z1, z2 = (float(each) for each in np.asarray(direction, dtype=np.float64))
    length = math.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    z0, z1, z2 = z0 / length, z1 / length, z2 / length
    # x is the reference axis less its part along z; plain numbers are ten times as fast here as arrays of three.
    along, x = (z0, (1 - z0 * z0, -z0 * z1, -z0 * z2)) if abs(z0) < 0.99 else (z1, (-z1 * z0, 1 - z1 * z1, -z1 * z2))
    across = math.sqrt(1 - along * along)
    x0, x1, x2 = (each / across for each in x)
    y = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    return np.array(_quaternion((x0, x1, x2), y, (z0, z1, z2)))


def _quaternion(x: _Axis, y: _Axis, z: _Axis) -> tuple[float, ...]:
    """Quaternion xyzw of the frame with these axes, each of length one."""
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = x, y, z
    # Shepperd (1978): the largest of the four squares is the one to divide by.
    squares = (1 + x0 - y1 - z2, 1 - x0 + y1 - z2, 1 - x0 - y1 + z2, 1 + x0 + y1 + z2)
    rows = (
        (squares[0], y0 + x1, z0 + x2, y2 - z1),
        (y0 + x1, squares[1], z1 + y2, z0 - x2),
        (z0 + x2, z1 + y2, squares[2], x1 - y0),
        (y2 - z1, z0 - x2, x1 - y0, squares[3]),
    )
    largest = max(range(4), key=squares.__getitem__)
    scale = 0.5 / math.sqrt(squares[largest])
    return tuple(each * scale for each in rows[largest])
