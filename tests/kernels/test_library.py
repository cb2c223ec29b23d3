"""The compiled kernels: both libraries agree, with each other and with the libraries whose work they do."""

import ctypes
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from needletrack.errors import InstallationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import basis
from needletrack.kernels.library import BASELINE, WITH_AVX2, address, best_library, call, load
from needletrack.records import Float

MATRIX = np.array([[1500.0, 0.0, 640.0], [0.0, 1490.0, 500.0], [0.0, 0.0, 1.0]])
# What a lens does at most: OpenCV's order, the last two terms tilt the sensor by a few degrees.
MOST = np.array([0.15, 0.1, 0.005, 0.005, 0.05, 0.05, 0.05, 0.05, 0.005, 0.005, 0.005, 0.005, 0.08, 0.08])


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    terms = draw(st.sampled_from([4, 5, 8, 12, 14]))
    shares = draw(st.lists(st.floats(-1, 1), min_size=terms, max_size=terms))
    return Camera(MATRIX, np.array(shares) * MOST[:terms], (1280, 1024))


def points_mm(seed: int) -> Float:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-90, 90, (40, 2)), random.uniform(200, 310, 40)])


@given(camera=cameras(), seed=st.integers(0, 100))
def test_projection_is_opencvs(camera: Camera, seed: int) -> None:
    points = points_mm(seed)
    theirs, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    # Of pixels in the thousands; sums are taken in another order.
    np.testing.assert_allclose(camera.project(points), theirs.reshape(-1, 2), atol=1e-9)


@given(camera=cameras(), seed=st.integers(0, 100))
def test_undistortion_is_the_inverse(camera: Camera, seed: int) -> None:
    points = points_mm(seed)
    rays = camera.normalize(camera.project(points))
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], atol=1e-10)


@given(control_points=st.integers(4, 30), derivative=st.integers(0, 3), seed=st.integers(0, 100))
def test_basis_functions_are_scipys(control_points: int, derivative: int, seed: int) -> None:
    u = np.random.default_rng(seed).uniform(0, 1, 20)
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, control_points - 2), np.ones(3)])
    theirs = BSpline(knots, np.eye(control_points), 3)(u, nu=derivative)
    np.testing.assert_allclose(
        basis(u, control_points, derivative), theirs, atol=1e-12 * control_points**derivative * 30
    )


def test_both_libraries_say_the_same() -> None:
    if best_library() != WITH_AVX2:
        pytest.skip("this processor has no AVX2: there is one library for it")
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (200, 220), dtype=np.uint8)
    lens = Camera(MATRIX, np.zeros(5), (1280, 1024)).lens
    local_mm = np.column_stack([np.linspace(-90, -70, 50), np.linspace(-70, -60, 50), np.full(50, 250.0)])
    offsets = np.arange(-5.0, 5.5, 0.5)
    found = []
    for path in (BASELINE, WITH_AVX2):
        gray, px, normal = np.empty((50, 21), np.float32), np.empty((50, 2)), np.empty((50, 2))
        pointers = [ctypes.c_void_p(address(each)) for each in (image, lens, local_mm, offsets, px, normal, gray)]
        size = [ctypes.c_int64(each) for each in (200, 220, 220, 50, 21)]
        load(path).straighten(
            pointers[0], *size[:3], pointers[1], pointers[2], size[3], pointers[3], size[4], ctypes.c_double(0.2),
            *pointers[4:],
        )  # fmt: skip
        found.append(gray)
    # Fused or not, a sum of sixteen grey levels is right to a few units in the last place.
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)


def test_an_array_that_is_not_contiguous_is_refused() -> None:
    with pytest.raises(ValueError, match="contiguous"):
        call("project", np.zeros(40), np.zeros((4, 6))[:, ::2], 4, np.zeros((4, 2)))


def test_a_library_that_is_missing_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InstallationError, match=r"none\.so: .* install needletrack again, with a C compiler"):
        load(tmp_path / "none.so")
