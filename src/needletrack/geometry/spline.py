"""Smooth curves in space and in the image: arc length, resampling, tangents, curvature, B-spline bases."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from needletrack.kernels import call
from needletrack.records import Float, Int

DEGREE = 3


def arc_length(points: npt.ArrayLike) -> Float:
    """Length (N,) along a polyline (N, D) from its first point."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    arc = np.empty(len(array))
    call("arc_lengths", array, *array.shape, arc)
    return arc


def resample(points: npt.ArrayLike, count: int) -> Float:
    """`count` points (count, D), evenly spaced along the polyline (N, D)."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    return _cut(array, arc := arc_length(array), 0.0, float(arc[-1]), count)


def cut(points: npt.ArrayLike, start: float, stop: float, count: int) -> Float:
    """`count` points (count, D), evenly spaced from one arc length to another, of a polyline (N, D)."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    return _cut(array, arc_length(array), start, stop, count)


def _cut(points: Float, arc: Float, start: float, stop: float, count: int) -> Float:
    out = np.empty((count, points.shape[1]))
    call("cut_evenly", points, arc, *points.shape, start, stop, count, out)
    return out


def parabola(at: npt.ArrayLike, values: npt.ArrayLike) -> Float:
    """Terms (3, D), constant first, of the parabolas nearest to values (N, D) at places (N,), by least squares.

    Raises ValueError where the places hold no parabola.
    """
    places, array = (np.ascontiguousarray(each, dtype=np.float64) for each in (at, values))
    terms = np.empty((3, array.shape[1]))
    if call("parabola", places, array, *array.shape, terms):
        raise ValueError(f"{len(places)} places hold no parabola: it takes three that differ")
    return terms


def unit(vectors: npt.ArrayLike) -> Float:
    """Vectors (..., D) scaled to length one; a vector of length zero stays zero."""
    array = np.asarray(vectors, dtype=np.float64)
    return np.asarray(array / np.maximum(np.linalg.norm(array, axis=-1, keepdims=True), 1e-300))


def distance_from_curve(points: npt.ArrayLike, curve: npt.ArrayLike) -> Float:
    """Distance (N,) of each point (N, D) from a polyline (M, D)."""
    at, line = (np.ascontiguousarray(each, dtype=np.float64) for each in (points, curve))
    distance = np.empty(len(at))
    call("distances_from", at, len(at), line, *line.shape, distance)
    return distance


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


def cubic_interpolation(values: int, finer: int) -> Float:
    """Weights (F, values) of evenly spaced values in a cubic spline through them, read `finer` times to each step.

    Two pieces at either end are one cubic ("not a knot", de Boor 1978): SciPy's CubicSpline, without the 0.2 s that
    its optimizers take to load. Raises ValueError below four values.
    """
    if values < 4:
        raise ValueError(f"a cubic spline goes through at least 4 values, not {values}")
    # Second derivatives, times the square of a step: their change is even within either two pieces at the ends.
    differences, held = np.zeros((values, values)), np.zeros((values, values))
    inner = np.arange(1, values - 1)
    for off, weight, share in ((-1, 6, 1), (0, -12, 4), (1, 6, 1)):
        differences[inner, inner + off], held[inner, inner + off] = weight, share
    held[0, :3] = held[-1, -3:] = 1, -2, 1
    bent = np.linalg.solve(held, differences)
    at = np.arange(finer * (values - 1) + 1)
    piece = np.minimum(at // finer, values - 2)
    after = (at / finer - piece)[:, None]
    before, each = 1 - after, np.eye(values)
    straight = before * each[piece] + after * each[piece + 1]
    return np.asarray(straight + ((before**3 - before) * bent[piece] + (after**3 - after) * bent[piece + 1]) / 6)
