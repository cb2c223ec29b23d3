"""One smooth curve in space, fitted to what both views show across it.

A cubic B-spline whose control points minimise the weighted squared offsets across the projected curve in both images
(Gauss-Newton with robust weights), with a small prior on the change of curvature. A stretch that one view does not see,
or that runs along the epipolar lines, is held by the other view and by its neighbours; the normal matrix knows it and
the stated covariance says so.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length, basis, resample, tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Reason
from needletrack.tracking.axis import AxisObservations
from needletrack.tracking.needle import Positive

# Points triangulated from two skeletons scatter by about this much.
_SKELETON_SIGMA_MM = 0.3


class FitParameters(BaseModel):
    """How stiff the curve is and how outliers are treated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    control_spacing_mm: Positive = Field(7.0, description="Length of needle per control point of the spline, mm.")
    curvature_change_per_mm2: Positive = Field(
        2e-3, description="Typical change of curvature along the needle, 1/mm per mm; the bending prior."
    )
    robust_px: Positive = Field(0.3, description="Offsets beyond this count for less and less (Cauchy), px.")
    correlation_mm: Positive = Field(
        3.0, description="Errors of neighbouring axis points are one error over this length, mm."
    )


@dataclass(frozen=True, slots=True)
class CurveFit:
    """A fitted curve: parameters (N,) in [0, 1], control_mm (M, 3) with covariance_mm2 (3M, 3M), points_mm (N, 3).

    residual_px (2, N): offsets left after the fit in the left and right view, NaN where not seen; rms_px over them,
    weighted as in the fit. The covariance is scaled up where the residuals are larger than the observations' sigmas.
    """

    parameters: Float
    control_mm: Float
    covariance_mm2: Float
    points_mm: Float
    residual_px: Float
    rms_px: float

    def derivative(self, order: int) -> Float:
        """Derivative (N, 3) of the curve by its parameter."""
        return basis(self.parameters, len(self.control_mm), derivative=order) @ self.control_mm

    def point_covariance_mm2(self) -> Float:
        """Covariance (N, 3, 3) of every point."""
        b = basis(self.parameters, len(self.control_mm))
        m = len(self.control_mm)
        half = (b @ self.covariance_mm2.reshape(m, 9 * m)).reshape(-1, 3, m, 3)
        return np.asarray((half.swapaxes(2, 3) @ b[:, None, :, None])[..., 0])


def initial_curve(points_mm: Float, confidence: Float, spacing_mm: float, parameters: FitParameters) -> Float:
    """A smooth curve (N, 3) of the given spacing through triangulated points (M, 3) of the given confidence (M,)."""
    length = arc_length(points_mm)
    # Noise makes a zigzag of triangulated points longer than the needle; a coarse resampling measures it.
    coarse_mm = float(arc_length(resample(points_mm, max(4, len(points_mm) // 6)))[-1])
    count = _control_count(coarse_mm, parameters)
    u = length / length[-1]
    b = basis(u, count)
    weight = np.asarray(confidence, dtype=np.float64) ** 2
    third = _third_derivative(count) / coarse_mm**3
    stiffness = (_SKELETON_SIGMA_MM / parameters.curvature_change_per_mm2) ** 2 * third.T @ third
    control: npt.NDArray[np.floating] = points_mm[[0]].repeat(count, axis=0)
    for _ in range(5):
        normal = b.T @ (weight[:, None] * b) + stiffness + 1e-9 * np.eye(count)
        control = np.linalg.solve(normal, b.T @ (weight[:, None] * points_mm))
        error = np.linalg.norm(b @ control - points_mm, axis=1)
        scale = max(0.3, 1.5 * float(np.median(error)))
        weight = np.asarray(confidence, dtype=np.float64) ** 2 / (1 + (error / scale) ** 2)
    dense = basis(np.linspace(0, 1, 400), count) @ control
    return resample(dense, max(8, round(float(arc_length(dense)[-1]) / spacing_mm) + 1))


@dataclass(frozen=True, slots=True)
class EndObservation:
    """Where one view shows an end of the needle: shift_px ahead, along the curve, of the predicted end `index`."""

    index: int
    shift_px: float
    sigma_px: float


Ends = tuple[tuple[EndObservation, ...], tuple[EndObservation, ...]]


def fit_curve(
    points_mm: Float,
    observed: tuple[AxisObservations, AxisObservations],
    rig: StereoRig,
    parameters: FitParameters,
    ends: Ends = ((), ()),
    hold_mm: float | None = None,
) -> CurveFit:
    """The curve that both views' axis observations across a predicted curve (N, 3), evenly spaced, agree on.

    `ends` are the ends that the left and the right view show; they fix the depth of a needle along the epipolar lines.
    hold_mm keeps the curve within about that distance of the prediction where nothing is seen: for the way to the
    answer, not for the answer, whose covariance it would flatter. Raises NeedleNotFound where nothing holds a curve.
    """
    if not (observed[0].seen.any() and observed[1].seen.any()):
        raise NeedleNotFound("fit", Reason.LOW_COVERAGE)
    length = arc_length(points_mm)
    u = length / length[-1]
    count = _control_count(float(length[-1]), parameters)
    b = basis(u, count)
    control = np.linalg.lstsq(b, points_mm, rcond=None)[0]
    prior = _prior_matrix(points_mm, b, float(length[-1]), count, parameters, hold_mm)
    views = [
        _View(camera, pose, seen, end)
        for camera, pose, seen, end in zip(
            (rig.left, rig.right),
            (RigidTransform.identity(), rig.right_from_left),
            observed,
            ends,
            strict=True,
        )
    ]
    share = min(1.0, float(length[-1]) / (len(points_mm) - 1) / parameters.correlation_mm)
    smooth = _smoothness_matrix(count, float(length[-1]), parameters)
    normal = prior + smooth
    # On the way the next round corrects what two steps leave.
    for _ in range(4 if hold_mm is None else 2):
        normal = prior + smooth
        gradient = -(smooth @ control.ravel())
        points = b @ control
        for view in views:
            residual, jacobian = view.linearized(points)
            weight = np.where(view.is_across, share, 1.0) / view.sigma_px**2
            weight /= 1 + (residual / np.maximum(parameters.robust_px, view.sigma_px)) ** 2
            # One row per point and view: d(offset)/d(control) = basis (x) d(offset)/d(point).
            rows = (b[view.index][:, :, None] * jacobian[:, None, :]).reshape(len(residual), 3 * count)
            normal += rows.T @ (weight[:, None] * rows)
            gradient += rows.T @ (weight * residual)
        try:
            factor = cho_factor(normal)
        except (LinAlgError, ValueError) as error:
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY) from error
        step = cho_solve(factor, gradient).reshape(control.shape)
        control = control + step
        if np.abs(step).max() < 1e-3:
            break
    points = b @ control
    if not np.isfinite(points).all():
        raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
    residuals = np.full((2, len(points)), np.nan)
    normalized = []
    for row, view in zip(residuals, views, strict=True):
        left_over = view.linearized(points)[0]
        row[view.index[view.is_across]] = left_over[view.is_across]
        normalized.append(left_over / view.sigma_px)
    misfit = np.concatenate(normalized) ** 2
    precision = np.concatenate([view.sigma_px**-2.0 for view in views])
    rms = float(np.sqrt(misfit.sum() / precision.sum()))
    excess = max(1.0, float(misfit.mean()))
    covariance = np.asarray(excess * cho_solve(cho_factor(normal), np.eye(len(normal))), dtype=np.float64)
    return CurveFit(u, np.asarray(control, dtype=np.float64), covariance, points, residuals, rms)


class _View:
    """One view's observations in undistorted pixels, ready for linearising."""

    def __init__(
        self, camera: Camera, pose: RigidTransform, seen: AxisObservations, ends: tuple[EndObservation, ...]
    ) -> None:
        across = np.flatnonzero(seen.seen)
        at_ends = np.array([end.index for end in ends], dtype=np.int64)
        self.index = np.concatenate([across, at_ends])
        self.is_across = np.arange(len(self.index)) < len(across)
        self.sigma_px = np.concatenate([seen.sigma_px[across], [end.sigma_px for end in ends]])
        normal = seen.normal[self.index]
        # At an end the curve is measured along itself, which is the normal turned by a quarter.
        normal[len(across) :] = np.column_stack([normal[len(across) :, 1], -normal[len(across) :, 0]])
        offset = np.concatenate([seen.offset_px[across], [end.shift_px for end in ends]])
        center = seen.center_px[self.index]
        self.target_px = camera.undistort(center + offset[:, None] * normal)
        ahead = camera.undistort(center + normal) - camera.undistort(center)
        self.normal = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        self._camera, self._pose = camera, pose

    def linearized(self, points_mm: Float) -> tuple[Float, Float]:
        """Offsets (K,) still missing across the curve, px, and their derivatives (K, 3) by the points in space."""
        local = self._pose.apply(points_mm[self.index])
        fx, fy = self._camera.matrix[0, 0], self._camera.matrix[1, 1]
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        projected = np.column_stack([x, y, np.ones_like(x)]) @ self._camera.matrix[:2].T
        nx, ny = self.normal[:, 0] * fx / local[:, 2], self.normal[:, 1] * fy / local[:, 2]
        by_local = np.column_stack([nx, ny, -nx * x - ny * y])
        residual = ((self.target_px - projected) * self.normal).sum(axis=1)
        return np.asarray(residual), np.asarray(by_local @ self._pose.rotation)


def _control_count(length_mm: float, parameters: FitParameters) -> int:
    return int(np.clip(round(length_mm / parameters.control_spacing_mm) + 3, 5, 30))


def _third_derivative(count: int) -> Float:
    middles = (np.arange(count - 3) + 0.5) / (count - 3)
    return basis(middles, count, derivative=3)


def _smoothness_matrix(count: int, length_mm: float, parameters: FitParameters) -> Float:
    """Prior on the third derivative by arc length, which for a needle is the change of its curvature."""
    third = _third_derivative(count) / length_mm**3
    weight = 1 / parameters.curvature_change_per_mm2**2
    return np.asarray(np.kron(weight * third.T @ third, np.eye(3)), dtype=np.float64)


def _prior_matrix(
    points_mm: Float, b: Float, length_mm: float, count: int, parameters: FitParameters, hold_mm: float | None
) -> Float:
    """Holds the points along the curve, where no view sees a motion, and everything to a metre: never singular."""
    along = tangents(points_mm)
    rows = (b[:, :, None] * along[:, None, :]).reshape(len(b), 3 * count)
    per_point = length_mm / len(b) / parameters.correlation_mm
    held = np.zeros((3 * count, 3 * count)) if hold_mm is None else np.kron(b.T @ b, np.eye(3)) / hold_mm**2
    return np.asarray(per_point * (rows.T @ rows / 0.3**2 + held) + np.eye(3 * count) / 1000.0**2)
