import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needletrack.geometry import epipolar
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float
from needletrack.synthetic.rig import default_rig

Rigs = st.SearchStrategy[StereoRig]
SeenPoints = st.SearchStrategy[tuple[StereoRig, Float]]

SEEDS = st.integers(0, 2**32 - 1)


def undistorted(rig: StereoRig, points_mm: Float) -> tuple[Float, Float]:
    left_px, right_px = rig.project(points_mm)
    return rig.left.undistort(left_px), rig.right.undistort(right_px)


def anywhere(rig: StereoRig, seed: int, count: int) -> Float:
    """Undistorted pixels (count, 2), matched with nothing."""
    return np.random.default_rng(seed).uniform(-0.1, 1.1, (count, 2)) * rig.left.size_px


@given(vector=st.tuples(*[st.floats(-10, 10)] * 3), other=st.tuples(*[st.floats(-10, 10)] * 3))
def test_the_cross_matrix_is_the_cross_product(vector: tuple[float, ...], other: tuple[float, ...]) -> None:
    np.testing.assert_allclose(epipolar.cross_matrix(vector) @ other, np.cross(vector, other), atol=1e-12)


@settings(max_examples=40)
@given(data=st.data())
def test_projections_of_a_point_obey_the_fundamental_matrix(seen_points: SeenPoints, data: st.DataObject) -> None:
    rig, points_mm = data.draw(seen_points)
    left_px, right_px = undistorted(rig, points_mm)
    np.testing.assert_allclose(epipolar.epipolar_distance_px(rig.fundamental, left_px, right_px), 0.0, atol=1e-6)
    np.testing.assert_allclose(epipolar.epipolar_distance_px(rig.fundamental.T, right_px, left_px), 0.0, atol=1e-6)
    np.testing.assert_allclose(epipolar.sampson_distance_px(rig.fundamental, left_px, right_px), 0.0, atol=1e-6)


@settings(max_examples=40)
@given(data=st.data())
def test_the_fundamental_matrix_is_that_of_the_projection_matrices(rigs: Rigs, data: st.DataObject) -> None:
    # Hartley & Zisserman eq. 9.1: F = [e']x P' P+, for P = K [I 0], P' = K' [R t].
    rig = data.draw(rigs)
    pose = rig.right_from_left
    left = rig.left.matrix @ np.eye(3, 4)
    right = rig.right.matrix @ np.column_stack([pose.rotation, pose.translation_mm])
    expected = epipolar.cross_matrix(right @ [0.0, 0.0, 0.0, 1.0]) @ right @ np.linalg.pinv(left)
    expected /= np.linalg.norm(expected)
    expected *= np.sign((expected * rig.fundamental).sum())
    np.testing.assert_allclose(rig.fundamental, expected, atol=1e-9)
    assert np.linalg.norm(rig.fundamental) == pytest.approx(1.0)


@settings(max_examples=40)
@given(data=st.data(), seed=SEEDS)
def test_both_epipoles_lie_on_all_epipolar_lines(rigs: Rigs, data: st.DataObject, seed: int) -> None:
    rig = data.draw(rigs)
    left_epipole, right_epipole = rig.epipoles
    points_px = anywhere(rig, seed, 20)
    for fundamental, epipole, other in (
        (rig.fundamental, right_epipole, left_epipole),
        (rig.fundamental.T, left_epipole, right_epipole),
    ):
        np.testing.assert_allclose(fundamental.T @ epipole, 0.0, atol=1e-12 * float(np.abs(epipole).max()))
        np.testing.assert_allclose(fundamental @ other, 0.0, atol=1e-12 * float(np.abs(other).max()))
        lines = epipolar.epipolar_lines(fundamental, points_px)
        np.testing.assert_allclose(np.hypot(lines[:, 0], lines[:, 1]), 1.0)
        # Epipoles lie far outside the image: the distance is exact to a rounding of their own.
        np.testing.assert_allclose(lines @ epipole, 0.0, atol=1e-9 * float(np.abs(epipole).max()))


@settings(max_examples=40)
@given(data=st.data())
def test_an_epipole_is_the_picture_of_the_other_camera(rigs: Rigs, data: st.DataObject) -> None:
    rig = data.draw(rigs)
    left_epipole, right_epipole = rig.epipoles
    for matrix, center_mm, epipole in (
        (rig.left.matrix, rig.right_from_left.inverse().translation_mm, left_epipole),
        (rig.right.matrix, rig.right_from_left.translation_mm, right_epipole),
    ):
        np.testing.assert_allclose(np.cross(matrix @ center_mm, epipole), 0.0, atol=1e-6 * float(epipole @ epipole))


@settings(max_examples=40)
@given(data=st.data(), seed=SEEDS)
def test_the_distance_map_is_the_distance_of_each_pair(rigs: Rigs, data: st.DataObject, seed: int) -> None:
    rig = data.draw(rigs)
    left_px, right_px = anywhere(rig, seed, 7), anywhere(rig, seed + 1, 5)
    distances = epipolar.epipolar_distance_map_px(rig.fundamental, left_px, right_px)
    assert distances.shape == (7, 5)
    i, j = (index.ravel() for index in np.indices((7, 5)))
    pairwise = epipolar.epipolar_distance_px(rig.fundamental, left_px[i], right_px[j])
    np.testing.assert_allclose(distances.ravel(), pairwise, atol=1e-9)


@settings(max_examples=40)
@given(data=st.data(), seed=SEEDS)
def test_the_distance_is_that_of_the_nearest_point_of_the_line(rigs: Rigs, data: st.DataObject, seed: int) -> None:
    rig = data.draw(rigs)
    left_px, right_px = anywhere(rig, seed, 6), anywhere(rig, seed + 1, 6)
    a, b, c = epipolar.epipolar_lines(rig.fundamental, left_px).T
    distances = epipolar.epipolar_distance_px(rig.fundamental, left_px, right_px)
    feet = right_px - distances[:, None] * np.column_stack([a, b])
    np.testing.assert_allclose(a * feet[:, 0] + b * feet[:, 1] + c, 0.0, atol=1e-9 * (1 + np.abs(c).max()))
    np.testing.assert_allclose(np.linalg.norm(right_px - feet, axis=1), np.abs(distances), atol=1e-9)


def test_sampson_is_the_exact_distance_to_first_order() -> None:
    rig = default_rig()
    rng = np.random.default_rng(7)
    points_mm = rng.uniform((-40, -60, 210), (70, 60, 310), (200, 3))
    left_px, right_px = undistorted(rig, points_mm)
    left_noise, right_noise = rng.normal(size=(2, 200, 2))
    for noise_px in (0.3, 3.0):
        left, right = left_px + noise_px * left_noise, right_px + noise_px * right_noise
        sampson_px = epipolar.sampson_distance_px(rig.fundamental, left, right)
        # The nearest pair that obeys the epipolar constraint (Hartley & Sturm 1997).
        nearest = cv2.correctMatches(rig.fundamental, left[None], right[None])
        exact_px = np.sqrt(
            sum(((px[0] - noisy) ** 2).sum(axis=1) for px, noisy in zip(nearest, (left, right), strict=True))
        )
        # What the first order leaves out is smaller by noise / distance of the epipoles, thousands of px.
        np.testing.assert_allclose(sampson_px, exact_px, rtol=1e-3 * noise_px, atol=1e-5)
