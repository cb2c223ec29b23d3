import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from needletrack.geometry import spline
from needletrack.records import Float

COUNTS = st.integers(4, 30)
INNER = np.linspace(0.01, 0.99, 57)


def circle(radius: float, points: int, share: float = 0.8) -> Float:
    angle = np.linspace(0, 2 * np.pi * share, points)
    return radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(points)])


@given(control_points=COUNTS, at=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_the_basis_is_a_partition_of_unity(control_points: int, at: list[float]) -> None:
    values = spline.basis(at, control_points)
    assert values.shape == (len(at), control_points)
    assert (values >= 0).all()
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-12)
    # The bases' derivatives grow with the number of spans, their sum stays zero.
    for derivative in (1, 2):
        np.testing.assert_allclose(
            spline.basis(at, control_points, derivative).sum(axis=1), 0.0, atol=1e-9 * control_points**2
        )


@given(control_points=COUNTS)
def test_a_curve_starts_and_ends_at_its_end_points(control_points: int) -> None:
    ends = spline.basis([0.0, 1.0], control_points)
    np.testing.assert_allclose(ends, np.eye(control_points)[[0, -1]], atol=1e-12)
    # It leaves its first control point towards the second.
    first = spline.basis([0.0], control_points, 1)[0]
    assert first[1] == pytest.approx(-first[0])
    np.testing.assert_allclose(first[2:], 0.0, atol=1e-12)


@given(control_points=COUNTS, derivative=st.sampled_from([1, 2]))
def test_derivatives_are_those_of_finite_differences(control_points: int, derivative: int) -> None:
    step = 1e-6
    before, after = (spline.basis(INNER + d, control_points, derivative - 1) for d in (-step, step))
    exact = spline.basis(INNER, control_points, derivative)
    # Off by step^2 f''' / 6, by rounding eps / step, and by step f'' where a knot lies between.
    scale = float(control_points) ** (derivative + 1)
    np.testing.assert_allclose((after - before) / (2 * step), exact, atol=1e-4 * scale)


@given(control_points=COUNTS)
def test_straight_lines_are_reproduced(control_points: int) -> None:
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, control_points - 2), np.ones(3)])
    greville = np.array([knots[i + 1 : i + 4].mean() for i in range(control_points)])
    np.testing.assert_allclose(spline.basis(INNER, control_points) @ greville, INNER, atol=1e-12)
    np.testing.assert_allclose(spline.basis(INNER, control_points, 1) @ greville, 1.0, atol=1e-9)


def test_beyond_the_ends_lies_the_end() -> None:
    np.testing.assert_array_equal(spline.basis([-0.5, 1.5], 6), spline.basis([0.0, 1.0], 6))


def test_fewer_than_four_control_points_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 4"):
        spline.basis([0.5], 3)


@given(
    radius=st.floats(1.0, 1e3),
    speed=st.lists(st.floats(0.1, 10.0), min_size=1, max_size=10),
    pitch=st.floats(0.0, 5.0),
)
def test_curvature_of_a_helix_at_any_speed(radius: float, speed: list[float], pitch: float) -> None:
    # r(u) = (R cos wu, R sin wu, p R w u) has curvature 1 / (R (1 + p^2)), whatever its speed w.
    w = np.array(speed)
    angle = np.linspace(0, 5, len(w))
    rise = np.full_like(w, pitch)
    first = radius * w[:, None] * np.column_stack([-np.sin(angle), np.cos(angle), rise])
    second = -radius * w[:, None] ** 2 * np.column_stack([np.cos(angle), np.sin(angle), 0 * rise])
    np.testing.assert_allclose(spline.curvature(first, second), 1 / (radius * (1 + pitch**2)), rtol=1e-9)


@given(radius=st.floats(10.0, 1e3))
def test_curvature_of_a_fitted_circle(radius: float) -> None:
    points, at = circle(radius, 400, share=0.5), np.linspace(0, 1, 400)
    control = np.linalg.lstsq(spline.basis(at, 12), points, rcond=None)[0]
    first, second = (spline.basis(INNER, 12, order) @ control for order in (1, 2))
    # A cubic over a ninth of half a turn: its second derivative is off by (pi / 9)^2 / 12 = 1 %.
    np.testing.assert_allclose(spline.curvature(first, second), 1 / radius, rtol=0.02)


def test_a_straight_line_has_no_curvature() -> None:
    first = np.tile([1.0, 2.0, 3.0], (4, 1))
    np.testing.assert_array_equal(spline.curvature(first, np.zeros((4, 3))), 0.0)
    np.testing.assert_allclose(spline.curvature(first, 2 * first), 0.0, atol=1e-12)


@given(radius=st.floats(1.0, 100.0), points=st.integers(100, 400))
def test_the_length_of_a_circle(radius: float, points: int) -> None:
    length = spline.arc_length(circle(radius, points, share=1.0))
    assert length[0] == 0.0
    assert (np.diff(length) > 0).all()
    # A polygon's sides are shorter than their arcs by step^2 / 24.
    assert length[-1] == pytest.approx(2 * np.pi * radius, rel=(2 * np.pi / (points - 1)) ** 2 / 20)


polylines = st.lists(
    st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-100, 100)), min_size=2, max_size=30
).map(np.array)


@given(points=polylines, count=st.integers(2, 200))
def test_resampled_points_lie_on_the_line_evenly(points: Float, count: int) -> None:
    resampled = spline.resample(points, count)
    assert resampled.shape == (count, 3)
    np.testing.assert_allclose(resampled[[0, -1]], points[[0, -1]], atol=1e-9)
    steps = np.linalg.norm(np.diff(resampled, axis=0), axis=1)
    # Along the line all steps are equal; a chord across a corner is shorter, never longer.
    assert (steps <= spline.arc_length(points)[-1] / (count - 1) + 1e-9).all()
    distances = _distance_to_line(resampled, points)
    assert distances.max() < 1e-9 * (1 + np.abs(points).max())


def _distance_to_line(points: Float, line: Float) -> Float:
    start, run = line[:-1], np.diff(line, axis=0)
    squared = np.maximum((run**2).sum(axis=1), 1e-300)
    share = np.clip(((points[:, None] - start) * run).sum(axis=2) / squared, 0, 1)
    feet = start + share[..., None] * run
    return np.asarray(np.linalg.norm(points[:, None] - feet, axis=2).min(axis=1))


def test_resampling_a_smooth_line_spaces_it_evenly() -> None:
    angle = np.linspace(0, 1, 500) ** 3 * 2
    uneven = 50 * np.column_stack([np.cos(angle), np.sin(angle)])
    steps = np.linalg.norm(np.diff(spline.resample(uneven, 100), axis=0), axis=1)
    # Chords of a polygon inscribed in an arc: off by the polygon's own corners.
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-4)


def test_tangents_of_a_circle_are_across_its_radius() -> None:
    points = circle(30.0, 200)
    tangents = spline.tangents(points)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0)
    np.testing.assert_allclose((tangents * points).sum(axis=1)[1:-1], 0.0, atol=1e-9)
    assert (np.cross(points, tangents)[:, 2] > 0).all()


@given(points=polylines)
def test_unit_vectors_keep_their_direction(points: Float) -> None:
    vectors = points + np.array([300.0, 0.0, 0.0])
    units = spline.unit(vectors)
    np.testing.assert_allclose(np.linalg.norm(units, axis=1), 1.0)
    np.testing.assert_allclose(units * np.linalg.norm(vectors, axis=1, keepdims=True), vectors, atol=1e-9)


@given(
    st.lists(st.floats(-30.0, 30.0), min_size=3, max_size=3),
    st.floats(-50.0, 0.0),
    st.floats(1.0, 40.0),
    st.integers(3, 40),
)
def test_a_parabola_is_found_again(terms: list[float], start: float, length: float, count: int) -> None:
    at = np.linspace(start, start + length, count)
    values = np.vander(at, 3, increasing=True) @ np.array([terms, terms[::-1]]).T
    found = spline.parabola(at, values)
    assert found.shape == (3, 2)
    scale = 1 + np.abs(values).max()
    np.testing.assert_allclose(np.vander(at, 3, increasing=True) @ found, values, atol=1e-6 * scale)


def test_a_parabola_is_the_nearest_one() -> None:
    at = np.linspace(-19.0, -3.0, 17)
    values = np.random.default_rng(5).normal(size=(17, 3))
    expected = np.linalg.lstsq(np.vander(at, 3, increasing=True), values, rcond=None)[0]
    np.testing.assert_allclose(spline.parabola(at, values), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("at", [[0.0, 1.0], [-17.3, -3.1], [0.1, 0.1, 0.7, 0.7]])
def test_two_places_hold_no_parabola(at: list[float]) -> None:
    with pytest.raises(ValueError, match="places hold no parabola"):
        spline.parabola(at, np.zeros((len(at), 3)))


@pytest.mark.parametrize("values", [4, 5, 25, 57])
@pytest.mark.parametrize("finer", [1, 4])
def test_interpolation_is_that_of_scipy(values: int, finer: int) -> None:
    at = np.arange(finer * (values - 1) + 1) / finer
    expected = CubicSpline(np.arange(values), np.eye(values))(at)
    np.testing.assert_allclose(spline.cubic_interpolation(values, finer), expected, atol=1e-14)


def test_three_values_hold_no_cubic() -> None:
    with pytest.raises(ValueError, match="at least 4 values"):
        spline.cubic_interpolation(3, 4)
