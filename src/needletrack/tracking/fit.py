"""One smooth curve in space, fitted to what both views show across it.

A cubic B-spline whose control points minimise the weighted squared offsets across the projected curve in both images
(Gauss-Newton with robust weights), with a small prior on the change of curvature. A stretch that one view does not see,
or that runs along the epipolar lines, is held by the other view and by its neighbours; the normal matrix knows it and
the stated covariance says so.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length, basis, resample, spline_basis, tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import Sight, address, call, two_sights
from needletrack.records import Float, Int, Reason
from needletrack.tracking.needle import Positive

# Points triangulated from two skeletons scatter by about this much.
_SKELETON_SIGMA_MM = 0.3
# Points this far off a rough curve count half.
_LEAST_ROUGHNESS_MM = 0.3
# Sigmas by which a streak's places may be off its line before they count for less.
ROBUST_SIGMAS = 2.0
# Points of the curve may slide along it by so much.
_ALONG_SIGMA_MM = 0.3
# Robust weights settle in so many rounds.
ROUNDS = 2


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


@dataclass(frozen=True, eq=False)
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
        return spline_basis(self.parameters, len(self.control_mm), derivative=order).curve(self.control_mm)

    @cached_property
    def point_covariance_mm2(self) -> Float:
        """Covariance (N, 3, 3) of every point."""
        b = spline_basis(self.parameters, len(self.control_mm))
        covariance = np.empty((len(self.parameters), 3, 3))
        call(
            "point_covariance",
            np.ascontiguousarray(self.covariance_mm2),
            b.control_points,
            b.first,
            b.mixing,
            len(covariance),
            covariance,
        )
        return covariance


def initial_curve(points_mm: Float, confidence: Float, spacing_mm: float, parameters: FitParameters) -> Float:
    """A smooth curve (N, 3) of the given spacing through triangulated points (M, 3) of the given confidence (M,)."""
    length = arc_length(points_mm)
    # Noise makes a zigzag of triangulated points longer than the needle; a coarse resampling measures it.
    coarse_mm = float(arc_length(resample(points_mm, max(4, len(points_mm) // 6)))[-1])
    count = _control_count(coarse_mm, parameters)
    near = spline_basis(length / length[-1], count)
    stiffness = (_SKELETON_SIGMA_MM / parameters.curvature_change_per_mm2 / coarse_mm**3) ** 2 * _stiffness(count)
    stiffness[:, 0] += 1e-9
    control = np.empty((count, 3))
    call(
        "rough_curve",
        np.ascontiguousarray(points_mm, dtype=np.float64),
        np.ascontiguousarray(confidence, dtype=np.float64),
        len(points_mm),
        count,
        near.first,
        near.mixing,
        stiffness,
        5,
        _LEAST_ROUGHNESS_MM,
        np.empty(4 * count + 2 * len(points_mm)),
        control,
    )
    dense = _dense_basis(count) @ control
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
    bends now much as it did then; None: it is not. begun: a fit about the same curve to go on from.
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
        begun: CurveFit | None = None,
    ) -> None:
        self._parameters = parameters
        self._points_mm = np.ascontiguousarray(points_mm)
        self._length = arc_length(points_mm)
        whole = float(self._length[-1])
        count = _control_count(whole, parameters)
        self.basis = spline_basis(self._length / whole, count)
        n, size = len(points_mm), 3 * count
        self._start, self._held, self._smooth = np.empty((count, 3)), np.empty((size, size)), np.empty((size, size))
        failed = call(
            "start_of_fit",
            self._points_mm,
            self._length,
            n,
            count,
            self.basis.first,
            self.basis.mixing,
            priors(parameters),
            0.0 if bent_for_s is None else bent_for_s,
            self._start,
            self._held,
            self._smooth,
            np.empty(4 * n + 4 * max(n, count) + count * (count + 3)),
        )
        if failed:
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
        self._control = (self._start if begun is None else begun.control_mm).copy()
        self._share = min(1.0, whole / (len(points_mm) - 1) / parameters.correlation_mm)
        self._sights = two_sights()
        self._views = [
            _View(sight, camera, lens, each, size=3 * count)
            for sight, camera, lens, each in zip(self._sights, (rig.left, rig.right), rig.lenses, sections, strict=True)
        ]
        self._expected = [
            None if streak is None else self._streak_line(view, streak)
            for view, streak in zip(self._views, streaks, strict=True)
        ]
        self._normal = np.empty((3 * count, 3 * count))

    @property
    def parameters(self) -> Float:
        """Parameters (N,) of the points."""
        return np.asarray(self._length / self._length[-1])

    def points_mm(self) -> Float:
        """The curve (N, 3) so far."""
        return self.basis.curve(self._control)

    def approach(self, observed: tuple[AcrossObservations, AcrossObservations], ends: Ends = ((), ())) -> None:
        """One step of Gauss-Newton from where the curve is, its weights settled in rounds.

        Raises NeedleNotFound where one of the views shows nothing, or nothing holds a curve.
        """
        for view, each, end in zip(self._views, observed, ends, strict=True):
            view.look_at(each, end)
        n, m = len(self._points_mm), self.basis.control_points
        failed = call(
            "approach",
            self._sights,
            n,
            m,
            self.basis.first,
            self.basis.mixing,
            self._start,
            self._control,
            self._held,
            self._smooth,
            self._share,
            self._parameters.robust_px,
            ROUNDS,
            self._normal,
            np.empty(3 * n + 3 * m * (6 * m + 4)),
        )
        # What is measured counts from the start: where no view holds the curve it stays where it was predicted.
        if failed:
            raise NeedleNotFound("fit", Reason.LOW_COVERAGE if failed == 1 else Reason.HIGH_UNCERTAINTY)

    def fit(
        self,
        observed: tuple[AcrossObservations, AcrossObservations],
        ends: Ends = ((), ()),
        systematic_px: float = 0.0,
    ) -> CurveFit:
        """The curve that the observations agree on, with what is left over and its covariance."""
        self.approach(observed, ends)
        self.approach(observed, ends)
        points = self.points_mm()
        streak_misfits = [
            0.0
            if expected is None
            else float(call("streak_misfit", view.sight, points, expected, np.empty(len(expected))))
            for view, expected in zip(self._views, self._expected, strict=True)
        ]
        # Where streak and silhouette contradict each other either may be wrong by as much.
        systematic = np.array([max(1.0, contradiction) * systematic_px**2 for contradiction in streak_misfits])
        n, m = len(points), self.basis.control_points
        residuals, rms, covariance = np.empty((2, n)), np.empty(1), np.empty((3 * m, 3 * m))
        failed = call(
            "fit_covariance",
            self._sights,
            n,
            m,
            self.basis.first,
            self._start,
            self._control,
            self._normal,
            self._length,
            systematic,
            self._parameters.systematic_mm,
            residuals,
            rms,
            covariance,
            np.empty(4 * 9 * m * m),
        )
        if failed:
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
        return CurveFit(
            self.parameters, self._control.copy(), covariance, points, residuals, float(rms[0]), max(streak_misfits)
        )

    def _streak_line(self, view: "_View", streak: StreakObservation) -> Float:
        """Adds a streak to what a view measures; returns what is expected of it, a Cholesky factor (K, K).

        The streak runs beside the axis, at a distance that nobody knows but that changes slowly: a Gaussian process
        along the needle, integrated out. What is left are offsets with correlated noise.
        """
        parameters = self._parameters
        index = np.flatnonzero(np.isfinite(streak.sigma_px))
        at, along = self._length[index], tangents(self._points_mm)[index]
        # Neighbouring sections blur into one another as those of the silhouette do.
        variance = streak.sigma_px[index] ** 2 * max(
            1.0, parameters.correlation_mm * len(at) / max(np.ptp(self._length), 1e-9)
        )
        view.run_beside(index, streak.offset_px[index])
        expected = np.empty((len(index), len(index)))
        m = self.basis.control_points
        failed = call(
            "streak_line",
            view.sight,
            self._points_mm,
            self.basis.first,
            self.basis.mixing,
            m,
            at,
            along,
            variance,
            streak.radius_px,
            np.array([parameters.streak_share, parameters.streak_change_share, parameters.streak_bend_share]),
            parameters.streak_mm,
            ROBUST_SIGMAS,
            expected,
            np.empty((len(index) + 3 * m + 16) * len(index)),
        )
        if failed:
            raise NeedleNotFound("fit", Reason.HIGH_UNCERTAINTY)
        return expected


class _View:
    """What one view measures, in undistorted pixels, as the kernels take it."""

    def __init__(self, sight: Sight, camera: Camera, lens: Float, sections: Sections, size: int) -> None:
        self._camera, self._sections, self._size = camera, sections, size
        self._arrays: dict[str, Float | Int] = {}
        here, ahead = self._undistorted(sections.center_px, sections.normal)
        room = len(here) + 2
        self.sight = sight
        sight.camera = self._kept("lens", lens)
        sight.here_px, sight.ahead = self._kept("here", here), self._kept("ahead", ahead)
        sight.index = self._kept("index", np.empty(room, np.int64))
        sight.residual, sight.rows = self._kept("residual", np.empty(room)), self._kept("rows", np.empty((room, 12)))
        sight.weight, sight.sigma = self._kept("weight", np.empty(room)), self._kept("sigma", np.empty(room))

    def look_at(self, observed: AcrossObservations, ends: tuple[EndObservation, ...]) -> None:
        """Measure these offsets, and these ends, from now on."""
        sight = self.sight
        sight.offset_px = self._kept("offset", np.ascontiguousarray(observed.offset_px))
        sight.sigma_px = self._kept("sigma_px", np.ascontiguousarray(observed.sigma_px))
        sight.ends = len(ends)
        if ends:
            at = np.array([end.index for end in ends], dtype=np.int64)
            normal = self._sections.normal[at]
            # At an end the curve is measured along itself, which is the normal turned by a quarter.
            here, ahead = self._undistorted(
                self._sections.center_px[at], np.column_stack([normal[:, 1], -normal[:, 0]])
            )
            shift = np.array([end.shift_px for end in ends])
            sight.end_index = self._kept("end_index", at)
            sight.end_here_px = self._kept("end_here", here + shift[:, None] * ahead)
            sight.end_ahead = self._kept("end_ahead", ahead)
            sight.end_sigma_px = self._kept("end_sigma", np.array([end.sigma_px for end in ends]))

    def run_beside(self, index: Int, offset_px: Float) -> None:
        """Measure a streak at sections index (K,), offset_px (K,) along them, as well."""
        sight = self.sight
        sight.lines = len(index)
        sight.line_index = self._kept("line_index", index)
        sight.line_offset_px = self._kept("line_offset", offset_px)
        sight.line_weighted = self._kept("line_weighted", np.empty((len(index), self._size)))
        sight.line_normal = self._kept("line_normal", np.empty((self._size, self._size)))

    def _kept(self, name: str, array: Float | Int) -> int:
        # The kernels see addresses; the arrays must live as long.
        self._arrays[name] = array
        return address(array)

    def _undistorted(self, center_px: Float, direction: Float) -> tuple[Float, Float]:
        """Undistorted places (K, 2), and what a raw pixel along the directions (K, 2) is there (K, 2)."""
        # Over the few pixels of an offset the distortion is linear to 1e-4 px.
        here, there = self._camera.undistort(np.concatenate([center_px, center_px + direction])).reshape(2, -1, 2)
        return here, there - here


def _control_count(length_mm: float, parameters: FitParameters) -> int:
    return int(np.clip(round(length_mm / parameters.control_spacing_mm) + 3, 5, 30))


@lru_cache(maxsize=64)
def _third_derivative(count: int) -> Float:
    middles = (np.arange(count - 3) + 0.5) / (count - 3)
    return basis(middles, count, derivative=3)


@lru_cache(maxsize=64)
def _stiffness(count: int) -> Float:
    """The cost of a change of curvature by control points, its diagonal and the three beside it (count, 4)."""
    third = _third_derivative(count)
    dense = third.T @ third
    return np.stack([np.pad(np.diagonal(dense, k), (0, k)) for k in range(4)], axis=1)


@lru_cache(maxsize=64)
def _dense_basis(count: int) -> Float:
    return basis(np.linspace(0, 1, 400), count)


def priors(parameters: FitParameters) -> Float:
    """What is known of a needle before it is looked at, as the kernel `start_of_fit` takes it.

    The third derivative by arc length is the change of its curvature, the second's change is that of its curvature
    itself. The points are held along the curve, where no view sees a motion.
    """
    return np.array(
        [
            parameters.curvature_change_per_mm2,
            parameters.curvature_motion_per_mm_s,
            parameters.correlation_of_motion_mm,
            parameters.correlation_mm,
            _ALONG_SIGMA_MM,
        ]
    )
