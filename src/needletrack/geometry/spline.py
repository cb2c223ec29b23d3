"""Smooth curves in space and in the image: arc length, resampling, tangents, curvature, B-spline bases."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from needletrack.kernels import call
from needletrack.records import Float, Int

DEGREE = 3


def arc_length(points: npt.ArrayLike) -> Float:
    """Length (N,) along a polyline (N, D) from its first point."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=np.float64), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: npt.ArrayLike, count: int) -> Float:
    """`count` points (count, D), evenly spaced along the polyline (N, D)."""
    array = np.asarray(points, dtype=np.float64)
    length = arc_length(array)
    at = np.linspace(0.0, length[-1], count)
    return np.column_stack([np.interp(at, length, column) for column in array.T])


def unit(vectors: npt.ArrayLike) -> Float:
    """Vectors (..., D) scaled to length one; a vector of length zero stays zero."""
    array = np.asarray(vectors, dtype=np.float64)
    return np.asarray(array / np.maximum(np.linalg.norm(array, axis=-1, keepdims=True), 1e-300))


def distance_from_curve(points: npt.ArrayLike, curve: npt.ArrayLike) -> Float:
    """Distance (N,) of each point (N, D) from a polyline (M, D)."""
    at, line = np.asarray(points, dtype=np.float64), np.asarray(curve, dtype=np.float64)
    start, step = line[:-1], np.diff(line, axis=0)
    along = ((at[:, None] - start) * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-12)
    nearest = start + np.clip(along, 0, 1)[..., None] * step
    return np.asarray(np.linalg.norm(at[:, None] - nearest, axis=-1).min(axis=1))


def tangents(points: npt.ArrayLike) -> Float:
    """Unit tangents (N, D) of a polyline (N, D), by central differences."""
    return unit(np.gradient(np.asarray(points, dtype=np.float64), axis=0))


@dataclass(frozen=True, eq=False)
class SplineBasis:
    """The four basis functions that are not 0 at each of N parameters: the first of them (N,), their values (N, 4).

    Of a clamped uniform cubic B-spline on [0, 1] of `control_points` (de Boor 1978), or of its derivative.
    """

    first: Int
    mixing: Float
    control_points: int

    def dense(self) -> Float:
        """Values (N, control_points) of every basis function."""
        every = np.zeros((len(self.first), self.control_points))
        np.put_along_axis(every, self.first[:, None] + np.arange(DEGREE + 1), self.mixing, axis=1)
        return every

    def curve(self, control: Float) -> Float:
        """Points (N, 3) for control points (M, 3)."""
        points = np.empty((len(self.first), 3))
        call("curve", np.ascontiguousarray(control), self.first, self.mixing, len(points), points)
        return points


def spline_basis(at: npt.ArrayLike, control_points: int, derivative: int = 0) -> SplineBasis:
    """The basis functions, or their derivative of that order, at parameters (N,), which are clipped to [0, 1].

    Raises ValueError below four control points, or for a derivative beyond the third.
    """
    if control_points < DEGREE + 1:
        raise ValueError(f"a cubic spline needs at least {DEGREE + 1} control points, not {control_points}")
    if not 0 <= derivative <= DEGREE:
        raise ValueError(f"a cubic spline has no derivative of order {derivative}")
    parameters = np.ascontiguousarray(at, dtype=np.float64)
    first, mixing = np.empty(len(parameters), np.int64), np.empty((len(parameters), DEGREE + 1))
    call("basis", parameters, len(parameters), control_points, derivative, first, mixing)
    return SplineBasis(first, mixing, control_points)


def basis(at: npt.ArrayLike, control_points: int, derivative: int = 0) -> Float:
    """Values (N, control_points) of each basis function, or of its derivative, at parameters (N,) in [0, 1].

    A curve is `basis(u, len(c)) @ c` for control points c (M, D): linear in c, so that fits are linear too.
    """
    return spline_basis(at, control_points, derivative).dense()


def curvature(first: npt.ArrayLike, second: npt.ArrayLike) -> Float:
    """Curvature (N,) from first and second derivatives (N, 3) with respect to any parameter: |r' x r''| / |r'|^3."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return np.asarray(np.linalg.norm(np.cross(a, b), axis=1) / np.linalg.norm(a, axis=1) ** 3)
