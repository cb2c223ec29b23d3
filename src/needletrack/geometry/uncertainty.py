"""What an error of the calibration does to points in space.

The parameters of a rig, in this order: fx fy cx cy and the distortion's terms of the left camera, the same of the
right one, then a small turn (rad, about the right camera's axes) and shift (mm) that follow right_from_left.
A point is triangulated where its pictures' squared distances from the pixels are least; its derivative by the
parameters, the pixels held, follows from the implicit function theorem (Hartley & Zisserman, section 5.2.4).
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, turned_by
from needletrack.records import Float, frozen_array


@dataclass(frozen=True, eq=False)
class Linearized:
    """Pictures (N, 2) of points in a camera's frame, and their derivatives.

    by_point (N, 2, 3): by the point, 1/mm; by_camera (N, 2, 4 + terms): by fx fy cx cy and the distortion.
    """

    pixels: Float
    by_point: Float
    by_camera: Float


def linearized(camera: Camera, points_mm: Float) -> Linearized:
    """The projection of points (N, 3) mm in the camera's frame with its derivatives; the skew counts as known."""
    if len(points_mm) == 0:
        terms = 4 + len(camera.distortion)
        return Linearized(np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, terms)))
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 1, 3)
    pixels, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    rows = np.asarray(jacobian, dtype=np.float64).reshape(len(points), 2, -1)
    return Linearized(
        np.asarray(pixels, dtype=np.float64).reshape(-1, 2),
        rows[:, :, 3:6],
        rows[:, :, 6 : 10 + len(camera.distortion)],
    )


def parameter_names(rig: StereoRig) -> tuple[str, ...]:
    """A name for each parameter: left.fx ... right.k1 ... turn.x ... shift.z."""
    lens = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
    names = []
    for side, camera in (("left", rig.left), ("right", rig.right)):
        names += [f"{side}.{name}" for name in ("fx", "fy", "cx", "cy", *lens[: len(camera.distortion)])]
    return (*names, *(f"{kind}.{axis}" for kind in ("turn", "shift") for axis in "xyz"))


def parameter_count(rig: StereoRig) -> int:
    """How many parameters a rig has."""
    return 14 + len(rig.left.distortion) + len(rig.right.distortion)


def perturbed(rig: StereoRig, change: npt.ArrayLike) -> StereoRig:
    """The rig whose parameters differ by `change` (P,)."""
    delta = np.asarray(change, dtype=np.float64)
    at = 4 + len(rig.left.distortion)
    turn, shift = delta[-6:-3], delta[-3:]
    moved = RigidTransform(turned_by(turn), shift)
    pose = rig.right_from_left
    rotation = moved.rotation @ pose.rotation
    return StereoRig(
        _perturbed_camera(rig.left, delta[:at]),
        _perturbed_camera(rig.right, delta[at:-6]),
        RigidTransform(rotation, pose.translation_mm + shift),
    )


def _perturbed_camera(camera: Camera, delta: Float) -> Camera:
    matrix = camera.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += delta[:4]
    return Camera(matrix, camera.distortion + delta[4:], camera.size_px)


def point_derivatives(rig: StereoRig, points_mm: Float) -> tuple[Float, Float]:
    """Derivatives of triangulated points (N, 3): by the parameters (N, 3, P), and by the pixels (N, 3, 4).

    The pixels are left u, v and right u, v.
    """
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    rotation = rig.right_from_left.rotation
    turned = points @ rotation.T
    left, right = linearized(rig.left, points), linearized(rig.right, turned + rig.right_from_left.translation_mm)
    by_point = np.concatenate([left.by_point, right.by_point @ rotation], axis=1)
    count, n_left, n_right = len(points), left.by_camera.shape[2], right.by_camera.shape[2]
    by_parameters = np.zeros((count, 4, n_left + n_right + 6))
    by_parameters[:, :2, :n_left] = left.by_camera
    by_parameters[:, 2:, n_left:-6] = right.by_camera
    by_parameters[:, 2:, -6:-3] = -right.by_point @ cross_matrices(turned)
    by_parameters[:, 2:, -3:] = right.by_point
    transposed = by_point.swapaxes(1, 2)
    by_pixels = np.linalg.solve(transposed @ by_point, transposed)
    return -by_pixels @ by_parameters, by_pixels


def cross_matrices(vectors: Float) -> Float:
    """The matrices [v]x (N, 3, 3) of vectors (N, 3)."""
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def rigid_motions(points_mm: Float) -> Float:
    """How points (N, 3) move (N, 3, 6) under a small turn about the origin (rad) and a shift (mm) of all of them."""
    return np.concatenate([-cross_matrices(points_mm), np.broadcast_to(np.eye(3), (len(points_mm), 3, 3))], axis=2)


@dataclass(frozen=True, eq=False)
class RigUncertainty:
    """How uncertain a rig's calibration is: covariance (P, P) of its parameters.

    reference_mm (M, 3): points in the left camera's frame, through which the rig is registered to another frame; the
    rigid motion that fits them best takes a part of the error with it. None: the left camera's own frame.
    Raises ValueError for a covariance of another size, or one that is none.
    """

    rig: StereoRig
    covariance: Float
    reference_mm: Float | None = None

    def __post_init__(self) -> None:
        count = parameter_count(self.rig)
        covariance = frozen_array(self.covariance, (count, count), "calibration covariance")
        if not np.isfinite(covariance).all() or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12):
            raise ValueError("the calibration's covariance is not symmetric, or not finite")
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        if np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] < -1e-6:
            raise ValueError("the calibration's covariance has a negative variance")
        object.__setattr__(self, "covariance", covariance)

    @cached_property
    def _motion(self) -> Float | None:
        """The rigid motion (6, P) that the reference points take part in, by the parameters."""
        if self.reference_mm is None:
            return None
        there, _ = point_derivatives(self.rig, self.reference_mm)
        motions = rigid_motions(self.reference_mm).reshape(-1, 6)
        return np.asarray(np.linalg.lstsq(motions, there.reshape(-1, there.shape[2]), rcond=None)[0])

    def derivatives(self, points_mm: Float) -> Float:
        """Derivatives (N, 3, P) of triangulated points (N, 3) mm, left camera's frame, by the parameters."""
        by_parameters, _ = point_derivatives(self.rig, points_mm)
        if self._motion is None:
            return by_parameters
        return np.asarray(by_parameters - rigid_motions(np.asarray(points_mm)) @ self._motion)

    def covariance_mm2(self, points_mm: Float) -> Float:
        """Covariance (N, 3, 3) of triangulated points (N, 3) mm that the calibration alone gives them."""
        by_parameters = self.derivatives(points_mm)
        return np.asarray(by_parameters @ self.covariance @ by_parameters.swapaxes(1, 2))

    def rms_mm(self, points_mm: Float) -> float:
        """Expected root mean square error over points (N, 3)."""
        return float(np.sqrt(np.trace(self.covariance_mm2(points_mm), axis1=1, axis2=2).mean()))
