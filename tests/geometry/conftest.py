"""What the properties are tested on: cameras, poses and rigs such as stand in laboratories, and beyond."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from needletrack.geometry.camera import DISTORTION_LENGTHS, Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float

# Greatest absolute value of each term, in OpenCV's order: k1 k2 p1 p2 k3, k4 k5 k6, s1 s2 s3 s4, tilts (rad).
# Within these the distortion has an inverse all over the image.
GREATEST_DISTORTION = (0.2, 0.05, 2e-3, 2e-3, 0.01, 0.02, 0.01, 0.005, 1e-3, 1e-3, 1e-3, 1e-3, 0.02, 0.02)


def _vectors(count: int, greatest: float) -> st.SearchStrategy[Float]:
    values = st.floats(-greatest, greatest, allow_subnormal=False)
    return st.tuples(*[values] * count).map(np.array)


def _rotations(greatest_rad: float) -> st.SearchStrategy[Float]:
    return _vectors(3, greatest_rad).map(lambda vector: Rotation.from_rotvec(vector).as_matrix())


@st.composite
def _cameras(draw: st.DrawFn, size_px: tuple[int, int] | None = None) -> Camera:
    width, height = size_px or (draw(st.integers(320, 2560)), draw(st.integers(240, 2048)))
    focal = draw(st.floats(0.9, 3.0)) * max(width, height)
    shift = draw(_vectors(2, 0.05))
    matrix = [
        [focal, draw(st.sampled_from([0.0, 0.0, 3.0])), (width - 1) / 2 + shift[0] * width],
        [0, focal * draw(st.floats(0.98, 1.02)), (height - 1) / 2 + shift[1] * height],
        [0, 0, 1],
    ]
    terms = draw(st.sampled_from(DISTORTION_LENGTHS))
    distortion = np.array([draw(st.floats(-most, most)) for most in GREATEST_DISTORTION[:terms]])
    return Camera(np.array(matrix), distortion, (width, height))


@st.composite
def _rigs(draw: st.DrawFn) -> StereoRig:
    size_px = draw(st.integers(320, 2560)), draw(st.integers(240, 2048))
    baseline_mm = draw(st.floats(20.0, 150.0))
    center_mm = baseline_mm * np.array([1.0, draw(st.floats(-0.2, 0.2)), draw(st.floats(-0.2, 0.2))])
    # Turned towards what the left camera sees at 250 mm, and a little any other way.
    toe_in = Rotation.from_euler("y", np.arctan2(baseline_mm / 2, 250.0)).as_matrix()
    rotation = draw(_rotations(0.1)) @ toe_in
    return StereoRig(draw(_cameras(size_px)), draw(_cameras(size_px)), RigidTransform(rotation, -rotation @ center_mm))


@pytest.fixture(scope="session")
def vectors() -> st.SearchStrategy[Float]:
    return _vectors(3, 500.0)


@pytest.fixture(scope="session")
def transforms() -> st.SearchStrategy[RigidTransform]:
    return st.builds(RigidTransform, _rotations(np.pi), _vectors(3, 500.0))


@pytest.fixture(scope="session")
def cameras() -> st.SearchStrategy[Camera]:
    return _cameras()


@pytest.fixture(scope="session")
def rigs() -> st.SearchStrategy[StereoRig]:
    return _rigs()


@st.composite
def _seen_points(draw: st.DrawFn) -> tuple[StereoRig, Float]:
    rig = draw(_rigs())
    shares = draw(st.lists(st.tuples(*[st.floats(0.0, 1.0)] * 3), min_size=1, max_size=8))
    x, y, depth = np.array(shares).T
    pixels = np.column_stack([x, y]) * (np.array(rig.left.size_px) - 1)
    depth_mm = (150.0 + 350.0 * depth)[:, None]
    points_mm = np.column_stack([rig.left.normalize(pixels), np.ones(len(pixels))]) * depth_mm
    # Outside of the image a distortion may have no inverse.
    in_front = rig.right_from_left.apply(points_mm)[:, 2] > 50
    return rig, points_mm[rig.right.contains(rig.project(points_mm)[1]) & in_front]


@pytest.fixture(scope="session")
def seen_points() -> st.SearchStrategy[tuple[StereoRig, Float]]:
    """Rigs, and points (N, 3) mm that both of its cameras see."""
    return _seen_points().filter(lambda seen: len(seen[1]) > 0)
