import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Float
from needletrack.synthetic.rig import default_rig

SeenPoints = st.SearchStrategy[tuple[StereoRig, Float]]


def undistorted(rig: StereoRig, points_mm: Float) -> tuple[Float, Float]:
    left_px, right_px = rig.project(points_mm)
    return rig.left.undistort(left_px), rig.right.undistort(right_px)


@settings(max_examples=40)
@given(data=st.data())
def test_projected_points_are_found_again(seen_points: SeenPoints, data: st.DataObject) -> None:
    rig, points_mm = data.draw(seen_points)
    found_mm = triangulate(rig, *undistorted(rig, points_mm))
    # Undistortion is exact to about 1e-9 px; 20 mm of baseline at 500 mm make of it less than 1e-6 mm.
    np.testing.assert_allclose(found_mm, points_mm, atol=1e-5)


@settings(max_examples=40)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_rays_that_miss_each_other_give_the_point_half_way(
    seen_points: SeenPoints, data: st.DataObject, seed: int
) -> None:
    rig, points_mm = data.draw(seen_points)
    left_px, right_px = undistorted(rig, points_mm)
    right_px = right_px + np.random.default_rng(seed).normal(0, 0.5, right_px.shape)
    found_mm = triangulate(rig, left_px, right_px)
    # Its two feet on the rays are equally far, and the way to each is across that ray.
    pose = rig.right_from_left
    gaps = []
    for camera, pixels, rotation, center_mm in (
        (rig.left, left_px, np.eye(3), np.zeros(3)),
        (rig.right, right_px, pose.rotation, pose.inverse().translation_mm),
    ):
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.matrix).T @ rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        away = found_mm - center_mm
        gaps.append(away - (away * rays).sum(axis=1, keepdims=True) * rays)
    np.testing.assert_allclose(gaps[0], -gaps[1], atol=1e-5)


def test_parallel_rays_have_no_point() -> None:
    camera = Camera(np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]), np.zeros(4), (1000, 800))
    rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])))
    found_mm = triangulate(rig, [[500.0, 400.0], [600.0, 400.0]], [[500.0, 400.0], [400.0, 400.0]])
    assert np.isnan(found_mm[0]).all()
    np.testing.assert_allclose(found_mm[1], [30.0, 0.0, 300.0])


def test_no_points_give_no_points() -> None:
    none = np.zeros((0, 2))
    assert triangulate(default_rig(), none, none).shape == (0, 3)


def test_noise_of_a_parallel_rig_grows_with_the_square_of_the_depth() -> None:
    camera = Camera(np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]), np.zeros(4), (1000, 800))
    rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])))
    rng = np.random.default_rng(11)
    samples, sigma_px = 4000, 0.05
    for depth_mm in (150.0, 300.0):
        left_px, right_px = rig.project(np.tile([30.0, 0.0, depth_mm], (samples, 1)))
        left_noise, right_noise = rng.normal(0, sigma_px, (2, samples, 2))
        found_mm = triangulate(rig, left_px + left_noise, right_px + right_noise)
        # Depth = f b / disparity, whose noise is sqrt(2) sigma.
        predicted_mm = depth_mm**2 / (1000.0 * 60.0) * np.sqrt(2) * sigma_px
        assert found_mm[:, 2].std() == pytest.approx(predicted_mm, rel=4 / np.sqrt(2 * samples))


@pytest.mark.parametrize("point_mm", [(15.0, 0.0, 250.0), (-40.0, 50.0, 210.0), (70.0, -50.0, 300.0)])
def test_noise_propagates_as_the_projections_predict(point_mm: tuple[float, float, float]) -> None:
    rig = default_rig()
    rng = np.random.default_rng(5)
    samples, sigma_px, step_mm = 4000, 0.1, 1e-3

    # First order: the four pixel coordinates' covariance, taken back through the projections' Jacobian.
    steps = step_mm * np.concatenate([np.eye(3), -np.eye(3)])
    pixels = np.hstack(undistorted(rig, np.array(point_mm) + steps))
    jacobian = ((pixels[:3] - pixels[3:]) / (2 * step_mm)).T
    predicted = sigma_px**2 * np.linalg.inv(jacobian.T @ jacobian)

    left_px, right_px = undistorted(rig, np.tile(point_mm, (samples, 1)))
    left_noise, right_noise = rng.normal(0, sigma_px, (2, samples, 2))
    found_mm = triangulate(rig, left_px + left_noise, right_px + right_noise)
    # A variance of n samples is known to sqrt(2 / n); half-way points are hardly worse than the best.
    variances = np.linalg.eigvals(np.linalg.solve(predicted, np.cov(found_mm.T))).real
    np.testing.assert_allclose(variances, 1.0, atol=0.02 + 4 * np.sqrt(2 / samples))
    bias = found_mm.mean(axis=0) - point_mm
    assert bias @ np.linalg.solve(predicted / samples, bias) < 25
