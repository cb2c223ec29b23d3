import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needletrack.geometry.camera import Camera
from needletrack.records import Float

MATRIX = np.array([[1400.0, 0.0, 640.0], [0.0, 1402.0, 510.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.11, 0.08, 3e-4, -2e-4, 0.01])
CAMERA = Camera(MATRIX, DISTORTION, (1280, 1024))


def pixels_in(camera: Camera, data: st.DataObject) -> Float:
    shares = data.draw(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=10))
    return np.asarray(np.array(shares) * (np.array(camera.size_px) - 1))


@settings(max_examples=40)
@given(data=st.data())
def test_distorting_what_was_undistorted_gives_it_back(cameras: st.SearchStrategy[Camera], data: st.DataObject) -> None:
    camera = data.draw(cameras)
    pixels = pixels_in(camera, data)
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-7)


@settings(max_examples=40)
@given(data=st.data())
def test_a_projected_point_lies_on_its_own_ray(cameras: st.SearchStrategy[Camera], data: st.DataObject) -> None:
    camera = data.draw(cameras)
    rays = camera.normalize(pixels_in(camera, data))
    depth_mm = data.draw(st.floats(1.0, 1e4))
    projected = camera.project(depth_mm * np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(camera.normalize(projected), rays, atol=1e-9)


@settings(max_examples=40)
@given(data=st.data())
def test_undistorted_pixels_are_those_of_the_same_camera_without_distortion(
    cameras: st.SearchStrategy[Camera], data: st.DataObject
) -> None:
    camera = data.draw(cameras)
    pixels = pixels_in(camera, data)
    pinhole = Camera(camera.matrix, np.zeros(4), camera.size_px)
    rays = np.column_stack([camera.normalize(pixels), np.ones(len(pixels))])
    np.testing.assert_allclose(camera.undistort(pixels), pinhole.project(rays), atol=1e-8)


def test_projection_is_the_formula() -> None:
    x, y = 60.0 / 250.0, -40.0 / 250.0
    k1, k2, p1, p2, k3 = DISTORTION
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    distorted = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    ]
    expected = [[1400.0 * distorted[0] + 640.0, 1402.0 * distorted[1] + 510.0]]
    np.testing.assert_allclose(CAMERA.project([[60.0, -40.0, 250.0]]), expected, atol=1e-9)


def test_skew_shears_the_picture_by_rows() -> None:
    skewed = Camera(changed(0, 1, 7.0), DISTORTION, (1280, 1024))
    point_mm = [[60.0, -40.0, 250.0]]
    ((u, v),) = CAMERA.project(point_mm)
    np.testing.assert_allclose(skewed.project(point_mm), [[u + 7.0 * (v - 510.0) / 1402.0, v]])


def test_the_axis_goes_through_the_principal_point() -> None:
    np.testing.assert_allclose(CAMERA.project([[0.0, 0.0, 300.0]]), [[640.0, 510.0]])
    np.testing.assert_allclose(CAMERA.normalize([[640.0, 510.0]]), [[0.0, 0.0]], atol=1e-12)
    assert CAMERA.focal_px == 1401.0


def test_no_points_are_no_pixels() -> None:
    assert CAMERA.project(np.zeros((0, 3))).shape == (0, 2)
    none = np.zeros((0, 2))
    for of_none in (CAMERA.undistort, CAMERA.normalize, CAMERA.distort):
        assert of_none(none).shape == (0, 2)


def test_the_image_contains_its_pixels_centers() -> None:
    corners = [[0.0, 0.0], [1279.0, 1023.0], [-0.1, 5.0], [1279.1, 5.0], [5.0, 1023.1]]
    np.testing.assert_array_equal(CAMERA.contains(corners), [True, True, False, False, False])
    np.testing.assert_array_equal(CAMERA.contains(corners, margin_px=1.0), [False] * 5)
    np.testing.assert_array_equal(CAMERA.contains(corners, margin_px=-0.2), [True] * 5)


def test_a_camera_does_not_change_with_the_arrays_it_was_made_of() -> None:
    matrix = MATRIX.copy()
    camera = Camera(matrix, DISTORTION, (1280, 1024))
    matrix[0, 0] = 1.0
    assert camera.matrix[0, 0] == 1400.0
    with pytest.raises(ValueError, match="read-only"):
        camera.matrix[0, 0] = 1.0


def changed(row: int, column: int, value: float) -> Float:
    matrix = MATRIX.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "distortion", "size_px", "complaint"),
    [
        (np.eye(4), DISTORTION, (1280, 1024), "camera matrix has shape"),
        (MATRIX, DISTORTION[None], (1280, 1024), "distortion has shape"),
        (MATRIX, np.zeros(3), (1280, 1024), "distortion has 3 terms"),
        (MATRIX, np.zeros(6), (1280, 1024), "distortion has 6 terms"),
        (MATRIX, np.full(5, np.nan), (1280, 1024), "finite"),
        (changed(0, 2, np.inf), DISTORTION, (1280, 1024), "finite"),
        (changed(0, 0, -1400.0), DISTORTION, (1280, 1024), "focal"),
        (changed(1, 1, 0.0), DISTORTION, (1280, 1024), "focal"),
        (MATRIX.T, DISTORTION, (1280, 1024), "camera matrix"),
        (2 * MATRIX, DISTORTION, (1280, 1024), "camera matrix"),
        (MATRIX, DISTORTION, (1280, 0), "size"),
    ],
)
def test_what_cannot_be_a_camera_is_refused(
    matrix: Float, distortion: Float, size_px: tuple[int, int], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        Camera(matrix, distortion, size_px)
