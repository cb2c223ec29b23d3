import numpy as np
import pytest

from needletrack.synthetic.rig import default_rig


@pytest.mark.parametrize("size_px", [(640, 512), (1280, 1024), (2560, 2048)])
def test_the_rig_is_like_a_laboratory_one(size_px: tuple[int, int]) -> None:
    rig = default_rig(size_px)
    assert rig.left.size_px == rig.right.size_px == size_px
    assert 60 <= rig.baseline_mm <= 75
    assert 1.05 < rig.left.focal_px / size_px[0] < 1.15
    right_axis = rig.right_from_left.inverse().rotation[:, 2]
    # The right camera looks to the left, where the left one looks too.
    assert 8 < np.degrees(np.arctan2(-right_axis[0], right_axis[2])) < 10


def test_a_larger_sensor_sees_the_same() -> None:
    points_mm = np.array([[15.0, 0.0, 250.0], [-60.0, 70.0, 220.0], [90.0, -60.0, 300.0]])
    small, large = default_rig((1280, 1024)), default_rig((2560, 2048))
    for narrow, wide in zip(small.project(points_mm), large.project(points_mm), strict=True):
        # Pixel (0, 0) is a pixel's centre: what scales is the distance from the image's corner.
        np.testing.assert_allclose(wide + 0.5, 2 * (narrow + 0.5), atol=1e-6)


def test_both_cameras_see_the_workspace() -> None:
    rig = default_rig()
    u, v, z = np.meshgrid([-30.0, 60.0], [-55.0, 55.0], [210.0, 310.0])
    for camera, pixels in zip(
        (rig.left, rig.right), rig.project(np.column_stack([u.ravel(), v.ravel(), z.ravel()])), strict=True
    ):
        assert camera.contains(pixels).all()
