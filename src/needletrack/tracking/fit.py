"""One smooth curve in space, fitted to what both views show across it.

A cubic B-spline whose control points minimise the weighted squared offsets across the projected curve in both images
(Gauss-Newton with robust weights), with a small prior on the change of curvature. A stretch that one view does not see,
or that runs along the epipolar lines, is held by the other view and by its neighbours; the normal matrix knows it and
the stated covariance says so.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dposv

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length, basis, resample, tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Reason
from needletrack.tracking.needle import Positive

# Points triangulated from two skeletons scatter by about this much.
_SKELETON_SIGMA_MM = 0.3
_IDENTITY = RigidTransform.identity()
# Sigmas by which a streak's places may be off its line before they count for less.
_ROBUST_SIGMAS = 2.0


class FitParameters(BaseModel):
    """How stiff the curve is and how outliers are treated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    control_spacing_mm: Positive = Field(7.0, description="Length of needle per control point of the spline, mm.")
    curvature_change_per_mm2: Positive = Field(
        2e-3, description="Typical change of curvature along the needle, 1/mm per mm; the bending prior."
    )
    curvature_motion_per_mm_s: Positive = Field(
        0.03, description="Typical change of curvature of a needle that is followed, 1/mm a second ..."
    )
    correlation_of_motion_mm: Positive = Field(10.0, description="... alike over this length, mm.")
    robust_px: Positive = Field(0.3, description="Offsets beyond this count for less and less (Cauchy), px.")
    correlation_mm: Positive = Field(
        1.0, description="Noise of neighbouring axis points is one error over this length, mm."
    )
    systematic_px: tuple[Positive, Positive] = Field(
        (0.02, 0.08),
        description="What pulls the axis aside all along a stretch, px: of a dull inside, and of a lively one.",
    )
    systematic_mm: Positive = Field(15.0, description="Length of such a stretch, mm.")
    streak_share: Positive = Field(
        0.3, description="Typical distance of a streak of light from the axis, as a share of the radius."
    )
    streak_change_share: Positive = Field(
        0.12, description="How much that distance changes along the needle, of the radius."
    )
    streak_bend_share: Positive = Field(
        0.4, description="And how much where the needle turns by a radian, of the radius."
    )
    streak_mm: Positive = Field(30.0, description="Length of needle over which that distance changes, mm.")


@dataclass(frozen=True, slots=True)
class CurveFit:
    """A fitted curve: parameters (N,) in [0, 1], control_mm (M, 3) with covariance_mm2 (3M, 3M), points_mm (N, 3).

    residual_px (2, N): offsets left after the fit in the left and right view, NaN where not seen; rms_px over them,
    weighted as in the fit. streak_misfit: how much more than expected a streak of light leaves its line, mean square of
    the worse view. The covariance is scaled up where the residuals are larger than the observations' sigmas.
    """

    parameters: Float
    control_mm: Float
    covariance_mm2: Float
    points_mm: Float
    residual_px: Float
    rms_px: float
    streak_misfit: float = 0.0

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


class AcrossObservations(Protocol):
    """What one view shows across a curve of N points, as `AxisOffsets` does."""

    @property
    def center_px(self) -> Float:
        """Where each cross section was taken, raw px (N, 2)."""

    @property
    def normal(self) -> Float:
        """Its direction, (N, 2)."""

    @property
    def offset_px(self) -> Float:
        """The axis along it, (N,)."""

    @property
    def sigma_px(self) -> Float:
        """Its standard deviation (N,), infinite where the needle is not seen."""

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Where the needle is seen, (N,)."""


Ends = tuple[tuple[EndObservation, ...], tuple[EndObservation, ...]]


@dataclass(frozen=True, slots=True)
class StreakObservation:
    """What one view shows of a streak of light along the needle: `across` the curve, and the needle's radius_px."""

    across: AcrossObservations
    radius_px: float


Streaks = tuple[StreakObservation | None, StreakObservation | None]


def fit_curve(
    points_mm: Float,
    observed: tuple[AcrossObservations, AcrossObservations],
    rig: StereoRig,
    parameters: FitParameters,
    ends: Ends = ((), ()),
    systematic_px: float = 0.0,
) -> CurveFit:
    """The curve that both views' axis observations across a predicted curve (N, 3), evenly spaced, agree on.

    `ends` are the ends that the left and the right view show; they fix the depth of a needle along the epipolar lines.
    systematic_px: what a view's axis may be off by all along a stretch, which the covariance then says (Huber's
    sandwich); 0 leaves that, and its cost, out.
    Raises NeedleNotFound where nothing holds a curve.
    """
    return CurveFitting(points_mm, rig, parameters).fit(observed, ends, systematic_px)


class CurveFitting:
    """Fits about one predicted curve (N, 3), one after another: see `fit_curve`.

    bent_for_s: the curve is where the needle was so long ago, and it bends now much as it did then; None: it is not.
    """

    def __init__(
        self, points_mm: Float, rig: StereoRig, parameters: FitParameters, *, bent_for_s: float | None = None
    ) -> None:
        self._rig, self._parameters = rig, parameters
        self._points, self._length = points_mm, arc_length(points_mm)
        whole = float(self._length[-1])
        self._u = self._length / whole
        count = _control_count(whole, parameters)
        self._basis = basis(self._u, count)
        self._start: Float = np.asarray(np.linalg.lstsq(self._basis, points_mm, rcond=None)[0], dtype=np.float64)
        self._control = self._start
        self._smooth = _smoothness_matrix(count, whole, parameters)
        self._bend = np.zeros_like(self._smooth)
        if bent_for_s is not None:
            self._bend = _bend_matrix(self._u, count, whole, bent_for_s, parameters)
        self._held = _prior_matrix(points_mm, self._basis, whole, count, parameters) + self._smooth + self._bend
        self._share = min(1.0, whole / (len(points_mm) - 1) / parameters.correlation_mm)

    def points_mm(self) -> Float:
        """The curve (N, 3) so far; raises NeedleNotFound where it is none."""
        points = self._basis @ self._control
        if not np.isfinite(points).all():
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
        return np.asarray(points)

    def approach(
        self,
        observed: tuple[AcrossObservations, AcrossObservations],
        ends: Ends = ((), ()),
        streaks: Streaks = (None, None),
        rounds: int = 2,
    ) -> "_Approach":
        """Gauss-Newton rounds towards what both views show; raises NeedleNotFound where one of them shows nothing."""
        if not (observed[0].seen.any() and observed[1].seen.any()):
            raise NeedleNotFound("fit", Reason.LOW_COVERAGE)
        views = [
            _View(camera, pose, seen, end)
            for camera, pose, seen, end in zip(
                (self._rig.left, self._rig.right), (_IDENTITY, self._rig.right_from_left), observed, ends, strict=True
            )
        ]
        weights = [np.where(view.is_across, self._share, 1.0) / view.sigma_px**2 for view in views]
        mixings = [self._basis[view.index] for view in views]
        lines = [
            None
            if streak is None
            else _Line(
                _View(camera, pose, streak.across, ()), streak.radius_px, self._points, self._length, self._parameters
            )
            for camera, pose, streak in zip(
                (self._rig.left, self._rig.right), (_IDENTITY, self._rig.right_from_left), streaks, strict=True
            )
        ]
        # Where no view holds the curve it stays where it was predicted.
        self._control = self._start
        normal = self._held
        pulls: list[tuple[Float, Float]] = []
        for _ in range(rounds):
            normal = self._held.copy()
            gradient = -(self._smooth @ self._control.ravel()) - self._bend @ (self._control - self._start).ravel()
            points = self._basis @ self._control
            pulls = []
            for view, weight, mixing in zip(views, weights, mixings, strict=True):
                residual, jacobian = view.linearized(points)
                robust = weight / (1 + (residual / np.maximum(self._parameters.robust_px, view.sigma_px)) ** 2)
                # One row per point and view: d(offset)/d(control) = basis (x) d(offset)/d(point).
                rows = (mixing[:, :, None] * jacobian[:, None, :]).reshape(len(residual), -1)
                weighted = (robust[:, None] * rows).T
                normal += weighted @ rows
                gradient += weighted @ residual
                pulls.append((weighted[:, view.is_across], self._length[view.index[view.is_across]]))
            for line in lines:
                if line is None:
                    continue
                rows, residual = line.whitened(points, self._basis)
                normal += rows.T @ rows
                gradient += rows.T @ residual
            step = _solved(normal, gradient).reshape(self._control.shape)
            self._control = self._control + step
            if np.abs(step).max() < 1e-3:
                break
        return _Approach(views, lines, normal, pulls)

    def fit(
        self,
        observed: tuple[AcrossObservations, AcrossObservations],
        ends: Ends = ((), ()),
        systematic_px: float = 0.0,
        streaks: Streaks = (None, None),
    ) -> CurveFit:
        """The curve that the observations agree on, with what is left over and its covariance."""
        found = self.approach(observed, ends, streaks, rounds=3)
        points = self.points_mm()
        residuals = np.full((2, len(points)), np.nan)
        normalized = []
        for row, view in zip(residuals, found.views, strict=True):
            left_over = view.linearized(points)[0]
            row[view.index[view.is_across]] = left_over[view.is_across]
            normalized.append(left_over / view.sigma_px)
        misfit = np.concatenate(normalized) ** 2
        precision = np.concatenate([view.sigma_px**-2.0 for view in found.views])
        rms = float(np.sqrt(misfit.sum() / precision.sum()))
        excess = max(1.0, float(misfit.mean()))
        spread = _solved(found.normal, np.eye(len(found.normal)))
        covariance = excess * spread
        streak_misfits = [0.0 if line is None else line.misfit(points) for line in found.lines]
        for (pull, at), contradiction in zip(found.pulls, streak_misfits, strict=True) if systematic_px > 0 else ():
            alike = np.exp(-np.abs(at[:, None] - at) / self._parameters.systematic_mm)
            # Where streak and silhouette contradict each other either may be wrong by as much.
            alike *= max(1.0, contradiction) * systematic_px**2
            gain = spread @ pull
            covariance = covariance + gain @ alike @ gain.T
        control = np.asarray(self._control, dtype=np.float64)
        return CurveFit(self._u, control, np.asarray(covariance), points, residuals, rms, max(streak_misfits))


@dataclass(frozen=True, slots=True)
class _Approach:
    """Both views, their streaks, the normal matrix (3M, 3M), and what pulls (3M, K) each view at which lengths (K,)."""

    views: list["_View"]
    lines: list["_Line | None"]
    normal: Float
    pulls: list[tuple[Float, Float]]


class _View:
    """One view's observations in undistorted pixels, ready for linearising."""

    def __init__(
        self, camera: Camera, pose: RigidTransform, seen: AcrossObservations, ends: tuple[EndObservation, ...]
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
        undistorted = camera.undistort(np.concatenate([center + offset[:, None] * normal, center + normal, center]))
        self.target_px, there, here = undistorted.reshape(3, -1, 2)
        ahead = there - here
        self.normal = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        self._camera, self._pose = camera, pose

    def linearized(self, points_mm: Float) -> tuple[Float, Float]:
        """Offsets (K,) still missing across the curve, px, and their derivatives (K, 3) by the points in space."""
        local = self._pose.apply(points_mm[self.index])
        depth = local[:, 2:]
        ray = local[:, :2] / depth
        matrix = self._camera.matrix
        residual = ((self.target_px - ray @ matrix[:2, :2].T - matrix[:2, 2]) * self.normal).sum(axis=1)
        by_ray = self.normal * (matrix[[0, 1], [0, 1]] / depth)
        by_local = np.concatenate([by_ray, -(by_ray * ray).sum(axis=1, keepdims=True)], axis=1)
        return np.asarray(residual), np.asarray(by_local @ self._pose.rotation)


class _Line:
    """One view's streak: it runs beside the axis, at a distance that nobody knows but that changes slowly.

    The distance is a Gaussian process along the needle, integrated out: what is left are offsets with correlated noise.
    """

    def __init__(
        self, view: _View, radius_px: float, points_mm: Float, length_mm: Float, parameters: FitParameters
    ) -> None:
        self._view = view
        at, along = length_mm[view.index], tangents(points_mm)[view.index]
        slowly = parameters.streak_change_share**2 * _matern(np.abs(at[:, None] - at) / parameters.streak_mm)
        turning = np.linalg.norm(along[:, None] - along, axis=2)
        bending = parameters.streak_bend_share**2 * _matern(turning)
        self._distance = radius_px**2 * (parameters.streak_share**2 + slowly + bending)
        self._factor: Float | None = None
        # Neighbouring sections blur into one another as those of the silhouette do.
        self._variance = view.sigma_px**2 * max(1.0, parameters.correlation_mm * len(at) / max(np.ptp(length_mm), 1e-9))

    def misfit(self, points_mm: Float) -> float:
        """Mean squared offset left over about points (N, 3), in what was expected of a streak there."""
        residual, _ = self._view.linearized(points_mm)
        expected = self._distance + np.diag(self._variance)
        return float(residual @ np.linalg.solve(expected, residual) / len(residual))

    def whitened(self, points_mm: Float, b: Float) -> tuple[Float, Float]:
        """Rows (K, 3M) and residuals (K,) of unit noise, linearised about points (N, 3); b (N, M) is their basis."""
        residual, jacobian = self._view.linearized(points_mm)
        if self._factor is None:
            # What jumps off the line is not of it.
            own = self._variance * np.linalg.solve(self._distance + np.diag(self._variance), residual)
            variance = self._variance * (1 + own**2 / (_ROBUST_SIGMAS**2 * self._variance))
            self._factor = np.asarray(np.linalg.cholesky(self._distance + np.diag(variance)), dtype=np.float64)
        mixing = b[self._view.index]
        rows = (mixing[:, :, None] * jacobian[:, None, :]).reshape(len(residual), -1)
        white = solve_triangular(self._factor, np.column_stack([rows, residual]), lower=True, check_finite=False)
        return white[:, :-1], white[:, -1]


def _matern(apart: Float) -> Float:
    """Matern's covariance of order 3/2 at unit length (Rasmussen & Williams 2006, eq. 4.17)."""
    scaled = np.sqrt(3) * apart
    return np.asarray((1 + scaled) * np.exp(-scaled))


def _solved(normal: Float, right: Float) -> Float:
    """normal^-1 right; raises NeedleNotFound where the matrix is not positive definite."""
    _, solution, info = dposv(normal, right)
    if info != 0:
        raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
    return np.asarray(solution, dtype=np.float64)


def _control_count(length_mm: float, parameters: FitParameters) -> int:
    return int(np.clip(round(length_mm / parameters.control_spacing_mm) + 3, 5, 30))


@lru_cache(maxsize=64)
def _third_derivative(count: int) -> Float:
    middles = (np.arange(count - 3) + 0.5) / (count - 3)
    return basis(middles, count, derivative=3)


def _smoothness_matrix(count: int, length_mm: float, parameters: FitParameters) -> Float:
    """Prior on the third derivative by arc length, which for a needle is the change of its curvature."""
    return _third_derivative_squared(count) / (parameters.curvature_change_per_mm2 * length_mm**3) ** 2


@lru_cache(maxsize=64)
def _third_derivative_squared(count: int) -> Float:
    third = _third_derivative(count)
    return np.asarray(np.kron(third.T @ third, np.eye(3)), dtype=np.float64)


def _bend_matrix(u: Float, count: int, length_mm: float, after_s: float, parameters: FitParameters) -> Float:
    """Prior on the change of the second derivative by arc length, which for a needle is that of its curvature."""
    second = basis(u, count, derivative=2) / length_mm**2
    change_per_mm = parameters.curvature_motion_per_mm_s * after_s
    weight = length_mm / len(u) / parameters.correlation_of_motion_mm / change_per_mm**2
    return np.asarray(np.kron(weight * second.T @ second, np.eye(3)), dtype=np.float64)


def _prior_matrix(points_mm: Float, b: Float, length_mm: float, count: int, parameters: FitParameters) -> Float:
    """Holds the points along the curve, where no view sees a motion, and everything to a metre: never singular."""
    along = tangents(points_mm)
    rows = (b[:, :, None] * along[:, None, :]).reshape(len(b), 3 * count)
    per_point = length_mm / len(b) / parameters.correlation_mm
    return np.asarray(per_point * rows.T @ rows / 0.3**2 + np.eye(3 * count) / 1000.0**2)
