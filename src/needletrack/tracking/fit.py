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
# Robust weights settle in so many rounds.
_ROUNDS = 2


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


class Sections(Protocol):
    """Where the cross sections of a curve of N points lie in one view, as `silhouette.Sections` does."""

    @property
    def center_px(self) -> Float:
        """Where each was taken, raw px (N, 2)."""

    @property
    def normal(self) -> Float:
        """Its direction, (N, 2)."""


class AcrossObservations(Sections, Protocol):
    """What one view shows across a curve of N points, as `AxisOffsets` does."""

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
    """What one view shows of a streak of light along the needle, across the same sections; and the needle's radius_px.

    offset_px, sigma_px (N,): infinite sigmas where it is not seen.
    """

    offset_px: Float
    sigma_px: Float
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
    return CurveFitting(points_mm, rig, parameters, observed).fit(observed, ends, systematic_px)


class CurveFitting:
    """Fits about one predicted curve (N, 3) and the sections across it, one after another: see `fit_curve`.

    streaks: of light, which run beside the axis. bent_for_s: the curve is where the needle was so long ago, and it
    bends now much as it did then; None: it is not.
    """

    def __init__(
        self,
        points_mm: Float,
        rig: StereoRig,
        parameters: FitParameters,
        sections: tuple[Sections, Sections],
        *,
        streaks: Streaks = (None, None),
        bent_for_s: float | None = None,
    ) -> None:
        self._parameters = parameters
        self._length = arc_length(points_mm)
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
        self._views = [
            _View(camera, pose, each)
            for camera, pose, each in zip(
                (rig.left, rig.right), (_IDENTITY, rig.right_from_left), sections, strict=True
            )
        ]
        self._lines = [
            None if streak is None else _Line(view, streak, points_mm, self._length, self._basis, parameters)
            for view, streak in zip(self._views, streaks, strict=True)
        ]

    def points_mm(self) -> Float:
        """The curve (N, 3) so far; raises NeedleNotFound where it is none."""
        points = self._basis @ self._control
        if not np.isfinite(points).all():
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
        return np.asarray(points)

    def approach(self, observed: tuple[AcrossObservations, AcrossObservations], ends: Ends = ((), ())) -> "_Approach":
        """One step of Gauss-Newton from where the curve is, its weights settled in rounds.

        Raises NeedleNotFound where one of the views shows nothing.
        """
        if not (observed[0].seen.any() and observed[1].seen.any()):
            raise NeedleNotFound("fit", Reason.LOW_COVERAGE)
        points, moved = self.points_mm(), (self._control - self._start).ravel()
        # What is measured counts from the start: where no view holds the curve it stays where it was predicted.
        seen = [
            view.measured(points, each, end, self._basis, self._share, moved)
            for view, each, end in zip(self._views, observed, ends, strict=True)
        ]
        lines = [line.normal(points, self._basis, moved) for line in self._lines if line is not None]
        fixed = self._held + sum(normal for normal, _ in lines)
        pull = sum(pull for _, pull in lines) - self._smooth @ self._start.ravel()
        normal, weighted, step = fixed, [each.rows for each in seen], moved
        for _ in range(_ROUNDS):
            off = [each.residual - each.rows @ step for each in seen]
            robust = [
                each.weight / (1 + (left / np.maximum(self._parameters.robust_px, each.sigma_px)) ** 2)
                for each, left in zip(seen, off, strict=True)
            ]
            weighted = [each.rows * each_weight[:, None] for each, each_weight in zip(seen, robust, strict=True)]
            normal = fixed + sum(w.T @ each.rows for w, each in zip(weighted, seen, strict=True))
            step = _solved(normal, pull + sum(w.T @ each.residual for w, each in zip(weighted, seen, strict=True)))
        self._control = self._start + step.reshape(self._start.shape)
        pulls = [
            (w[each.is_across].T, self._length[each.index[each.is_across]])
            for w, each in zip(weighted, seen, strict=True)
        ]
        return _Approach(seen, normal, pulls)

    def fit(
        self,
        observed: tuple[AcrossObservations, AcrossObservations],
        ends: Ends = ((), ()),
        systematic_px: float = 0.0,
    ) -> CurveFit:
        """The curve that the observations agree on, with what is left over and its covariance."""
        self.approach(observed, ends)
        found = self.approach(observed, ends)
        points = self.points_mm()
        moved = (self._control - self._start).ravel()
        residuals = np.full((2, len(points)), np.nan)
        normalized = []
        for row, each in zip(residuals, found.seen, strict=True):
            left_over = each.residual - each.rows @ moved
            row[each.index[each.is_across]] = left_over[each.is_across]
            normalized.append(left_over / each.sigma_px)
        misfit = np.concatenate(normalized) ** 2
        precision = np.concatenate([each.sigma_px**-2.0 for each in found.seen])
        rms = float(np.sqrt(misfit.sum() / precision.sum()))
        excess = max(1.0, float(misfit.mean()))
        spread = _solved(found.normal, np.eye(len(found.normal)))
        covariance = excess * spread
        streak_misfits = [0.0 if line is None else line.misfit(points) for line in self._lines]
        for (pull, at), contradiction in zip(found.pulls, streak_misfits, strict=True) if systematic_px > 0 else ():
            alike = np.exp(-np.abs(at[:, None] - at) / self._parameters.systematic_mm)
            # Where streak and silhouette contradict each other either may be wrong by as much.
            alike *= max(1.0, contradiction) * systematic_px**2
            gain = spread @ pull
            covariance = covariance + gain @ alike @ gain.T
        control = np.asarray(self._control, dtype=np.float64)
        return CurveFit(self._u, control, np.asarray(covariance), points, residuals, rms, max(streak_misfits))


@dataclass(frozen=True, slots=True)
class _Measured:
    """What one view measures at K points: index (K,), whether across the curve or along it, sigma_px and weight (K,).

    residual (K,) px, rows (K, 3M): offsets of the start of the curve, and their derivatives by its control points.
    """

    index: npt.NDArray[np.int64]
    is_across: npt.NDArray[np.bool_]
    sigma_px: Float
    weight: Float
    residual: Float
    rows: Float


@dataclass(frozen=True, slots=True)
class _Approach:
    """What both views measure, the normal matrix (3M, 3M), and what pulls (3M, K) each view at which lengths (K,)."""

    seen: list[_Measured]
    normal: Float
    pulls: list[tuple[Float, Float]]


class _View:
    """One view's sections in undistorted pixels, ready for linearising."""

    def __init__(self, camera: Camera, pose: RigidTransform, sections: Sections) -> None:
        self._camera, self._pose, self._sections = camera, pose, sections
        self._here_px, self._ahead = self._undistorted(sections.center_px, sections.normal)

    def _undistorted(self, center_px: Float, direction: Float) -> tuple[Float, Float]:
        """Undistorted places (K, 2), and what a raw pixel along the directions (K, 2) is there (K, 2)."""
        # Over the few pixels of an offset the distortion is linear to 1e-4 px.
        here, there = self._camera.undistort(np.concatenate([center_px, center_px + direction])).reshape(2, -1, 2)
        return here, there - here

    def measured(
        self,
        points_mm: Float,
        observed: AcrossObservations,
        ends: tuple[EndObservation, ...],
        b: Float,
        share: float,
        moved: Float,
    ) -> _Measured:
        """What is observed of a curve that is now at points (N, 3), by the control points of which it moved (3M,)."""
        across = np.flatnonzero(observed.seen)
        residual, jacobian = self.linearized(points_mm, across, observed.offset_px)
        index, sigma = across, observed.sigma_px[across]
        if ends:
            at = np.array([end.index for end in ends], dtype=np.int64)
            normal = self._sections.normal[at]
            # At an end the curve is measured along itself, which is the normal turned by a quarter.
            here, ahead = self._undistorted(
                self._sections.center_px[at], np.column_stack([normal[:, 1], -normal[:, 0]])
            )
            shift = np.array([end.shift_px for end in ends])
            end_residual, end_jacobian = self._by_points(points_mm[at], here + shift[:, None] * ahead, ahead)
            index = np.concatenate([across, at])
            sigma = np.concatenate([sigma, [end.sigma_px for end in ends]])
            residual = np.concatenate([residual, end_residual])
            jacobian = np.concatenate([jacobian, end_jacobian])
        is_across = np.arange(len(index)) < len(across)
        rows = _rows(b[index], jacobian)
        weight = np.where(is_across, share, 1.0) / sigma**2
        return _Measured(index, is_across, sigma, weight, residual + rows @ moved, rows)

    def linearized(self, points_mm: Float, index: npt.NDArray[np.int64], offset_px: Float) -> tuple[Float, Float]:
        """Offsets (K,) px that a curve (N, 3) misses at sections index (K,), and derivatives (K, 3) by its points."""
        ahead = self._ahead[index]
        return self._by_points(points_mm[index], self._here_px[index] + offset_px[index, None] * ahead, ahead)

    def _by_points(self, points_mm: Float, target_px: Float, ahead: Float) -> tuple[Float, Float]:
        normal = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        local = self._pose.apply(points_mm)
        depth = local[:, 2:]
        ray = local[:, :2] / depth
        matrix = self._camera.matrix
        residual = ((target_px - ray @ matrix[:2, :2].T - matrix[:2, 2]) * normal).sum(axis=1)
        by_ray = normal * (matrix[[0, 1], [0, 1]] / depth)
        by_local = np.concatenate([by_ray, -(by_ray * ray).sum(axis=1, keepdims=True)], axis=1)
        return np.asarray(residual), np.asarray(by_local @ self._pose.rotation)


class _Line:
    """One view's streak: it runs beside the axis, at a distance that nobody knows but that changes slowly.

    The distance is a Gaussian process along the needle, integrated out: what is left are offsets with correlated noise.
    """

    def __init__(
        self,
        view: _View,
        streak: StreakObservation,
        points_mm: Float,
        length_mm: Float,
        b: Float,
        parameters: FitParameters,
    ) -> None:
        self._view, self._offset_px = view, streak.offset_px
        self._index = np.flatnonzero(np.isfinite(streak.sigma_px))
        at, along = length_mm[self._index], tangents(points_mm)[self._index]
        slowly = parameters.streak_change_share**2 * _matern(np.abs(at[:, None] - at) / parameters.streak_mm)
        alike = along @ along.T
        bending = parameters.streak_bend_share**2 * _matern(np.sqrt(np.maximum(2 - 2 * alike, 0.0)))
        distance = streak.radius_px**2 * (parameters.streak_share**2 + slowly + bending)
        # Neighbouring sections blur into one another as those of the silhouette do.
        variance = streak.sigma_px[self._index] ** 2 * max(
            1.0, parameters.correlation_mm * len(at) / max(np.ptp(length_mm), 1e-9)
        )
        self._expected = distance + np.diag(variance)
        residual, jacobian = view.linearized(points_mm, self._index, self._offset_px)
        # What jumps off the line is not of it.
        own = variance * np.linalg.solve(self._expected, residual)
        jumping = variance * (1 + own**2 / (_ROBUST_SIGMAS**2 * variance))
        rows = _rows(b[self._index], jacobian)
        self._weighted = np.linalg.solve(distance + np.diag(jumping), rows).T
        self._normal = self._weighted @ rows

    def misfit(self, points_mm: Float) -> float:
        """Mean squared offset left over about points (N, 3), in what was expected of a streak there."""
        residual, _ = self._view.linearized(points_mm, self._index, self._offset_px)
        return float(residual @ np.linalg.solve(self._expected, residual) / len(residual))

    def normal(self, points_mm: Float, b: Float, moved: Float) -> tuple[Float, Float]:
        """Normal matrix (3M, 3M), and the pull (3M,) on the start of a curve that is now at points (N, 3)."""
        residual, _ = self._view.linearized(points_mm, self._index, self._offset_px)
        return self._normal, self._weighted @ residual + self._normal @ moved


def _rows(mixing: Float, jacobian: Float) -> Float:
    """Derivatives (K, 3M) by control points from those by points (K, 3), of which mixing (K, M) says the shares."""
    return np.asarray((mixing[:, :, None] * jacobian[:, None, :]).reshape(len(mixing), -1))


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
