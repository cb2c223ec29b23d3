import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float

SeenPoints = st.SearchStrategy[tuple[StereoRig, Float]]

CAMERA = Camera(np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]), np.zeros(4), (1000, 800))


def test_cameras_in_one_place_are_refused() -> None:
    with pytest.raises(ValueError, match="baseline is 0 mm"):
        StereoRig(CAMERA, CAMERA, RigidTransform.identity())


def test_the_baseline_is_the_distance_of_the_cameras() -> None:
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert StereoRig(CAMERA, CAMERA, RigidTransform(turned, np.array([3.0, 4.0, 12.0]))).baseline_mm == pytest.approx(
        13.0
    )


def test_a_parallel_rig_projects_with_disparity_focal_times_baseline_over_depth() -> None:
    # The right camera stands 60 mm to the right of the left one.
    rig = StereoRig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])))
    left_px, right_px = rig.project([[10.0, 20.0, 240.0]])
    np.testing.assert_allclose(left_px - right_px, [[1000 * 60 / 240, 0.0]])
    np.testing.assert_allclose(left_px, [[500 + 1000 * 10 / 240, 400 + 1000 * 20 / 240]])


@settings(max_examples=40)
@given(data=st.data())
def test_rectification_turns_epipolar_lines_into_rows(seen_points: SeenPoints, data: st.DataObject) -> None:
    rig, points_mm = data.draw(seen_points)
    left_rotation, right_rotation, matrix = rig.rectification
    rectified = []
    for camera, rotation, pixels in zip(
        (rig.left, rig.right), (left_rotation, right_rotation), rig.project(points_mm), strict=True
    ):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        rays = np.column_stack([camera.normalize(pixels), np.ones(len(pixels))])
        turned = rays @ rotation.T @ matrix.T
        assert (turned[:, 2] > 0).all()
        rectified.append(turned[:, :2] / turned[:, 2:])
    left_px, right_px = rectified
    np.testing.assert_allclose(left_px[:, 1], right_px[:, 1], atol=1e-6)
    # The right camera stands to the right: what both see lies further left in its picture.
    assert (left_px[:, 0] > right_px[:, 0]).all()
    # The disparity gives the depth along the rectified axis.
    depth_mm = (points_mm @ left_rotation.T)[:, 2]
    np.testing.assert_allclose(matrix[0, 0] * rig.baseline_mm / (left_px[:, 0] - right_px[:, 0]), depth_mm, rtol=1e-6)
