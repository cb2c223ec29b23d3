import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from needletrack.geometry.spline import unit
from needletrack.geometry.transform import (
    RigidTransform,
    orientation_along,
    orthonormalized,
    turned_by,
    turned_orientation,
)
from needletrack.records import Float

Transforms = st.SearchStrategy[RigidTransform]
Vectors = st.SearchStrategy[Float]


def assert_same(one: RigidTransform, other: RigidTransform) -> None:
    np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
    np.testing.assert_allclose(one.translation_mm, other.translation_mm, atol=1e-9)


@given(data=st.data())
def test_products_are_associative_and_apply_in_turn(
    transforms: Transforms, vectors: Vectors, data: st.DataObject
) -> None:
    a_from_b, b_from_c, c_from_d = (data.draw(transforms) for _ in range(3))
    point = data.draw(vectors)
    assert_same((a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d))
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(point), a_from_b.apply(b_from_c.apply(point)), atol=1e-9)


@given(data=st.data())
def test_the_inverse_undoes(transforms: Transforms, vectors: Vectors, data: st.DataObject) -> None:
    a_from_b, point = data.draw(transforms), data.draw(vectors)
    assert_same(a_from_b @ a_from_b.inverse(), RigidTransform.identity())
    assert_same(a_from_b.inverse() @ a_from_b, RigidTransform.identity())
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(point)), point, atol=1e-9)


@given(data=st.data())
def test_distances_do_not_change(transforms: Transforms, vectors: Vectors, data: st.DataObject) -> None:
    a_from_b, points = data.draw(transforms), np.array([data.draw(vectors) for _ in range(2)])
    moved = a_from_b.apply(points)
    np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0)), np.linalg.norm(np.diff(points, axis=0)))


def test_points_of_any_shape_are_moved_one_by_one() -> None:
    quarter = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([10.0, 0.0, 0.0]))
    np.testing.assert_allclose(quarter.apply([1.0, 2.0, 3.0]), [8.0, 1.0, 3.0])
    grid = np.arange(24.0).reshape(2, 4, 3)
    moved = quarter.apply(grid)
    assert moved.shape == grid.shape
    np.testing.assert_allclose(moved[1, 2], quarter.apply(grid[1, 2]))


def test_a_transform_does_not_change_with_the_arrays_it_was_made_of() -> None:
    translation_mm = np.zeros(3)
    transform = RigidTransform(np.eye(3), translation_mm)
    translation_mm[0] = 5.0
    assert transform.translation_mm[0] == 0.0


@pytest.mark.parametrize(
    ("rotation", "translation_mm", "complaint"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "not a rotation"),
        (1.001 * np.eye(3), np.zeros(3), "not a rotation"),
        (np.zeros((3, 3)), np.zeros(3), "not a rotation"),
        (np.full((3, 3), np.nan), np.zeros(3), "finite"),
        (np.eye(3), np.array([0.0, np.nan, 0.0]), "finite"),
        (np.eye(4), np.zeros(3), "rotation has shape"),
        (np.eye(3), np.zeros((3, 1)), "translation_mm has shape"),
        (np.eye(3), np.zeros(2), "translation_mm has shape"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(rotation: Float, translation_mm: Float, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        RigidTransform(rotation, translation_mm)


@given(data=st.data())
def test_the_nearest_rotation_of_a_rotation_is_itself(transforms: Transforms, data: st.DataObject) -> None:
    rotation = data.draw(transforms).rotation
    np.testing.assert_allclose(orthonormalized(rotation), rotation, atol=1e-12)


@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_no_rotation_lies_nearer_than_the_nearest(transforms: Transforms, data: st.DataObject, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rounded = data.draw(transforms).rotation + rng.uniform(-1e-2, 1e-2, (3, 3))
    nearest = orthonormalized(rounded)
    RigidTransform(nearest, np.zeros(3))
    for turn in Rotation.from_rotvec(rng.uniform(-1e-2, 1e-2, (20, 3))).as_matrix():
        assert np.linalg.norm(turn @ nearest - rounded) >= np.linalg.norm(nearest - rounded)


def test_a_reflection_is_turned_into_a_rotation() -> None:
    assert np.linalg.det(orthonormalized(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


@given(data=st.data())
def test_z_of_an_orientation_runs_along_the_direction(vectors: Vectors, data: st.DataObject) -> None:
    direction = data.draw(vectors)
    assume(np.linalg.norm(direction) > 1e-3)
    x, y, z = Rotation.from_quat(orientation_along(direction)).as_matrix().T
    np.testing.assert_allclose(z, unit(direction), atol=1e-9)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-9)
    # The stated convention: +x in the plane of +z and the camera's x, or its y for needles along x.
    reference = np.eye(3)[0] if abs(z[0]) < 0.99 else np.eye(3)[1]
    assert abs(np.cross(reference, z) @ x) < 1e-9
    assert x @ reference > 0


@pytest.mark.parametrize("direction", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1e-9, 0)])
def test_orientations_along_the_axes(direction: tuple[float, float, float]) -> None:
    frame = Rotation.from_quat(orientation_along(direction)).as_matrix()
    np.testing.assert_allclose(frame[:, 2], direction, atol=1e-8)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 3.0, np.pi])
def test_a_turn_is_that_of_scipy(angle: float) -> None:
    for axis in (np.eye(3)[1], unit(np.array([0.3, -0.5, 0.8]))):
        expected = Rotation.from_rotvec(angle * axis).as_matrix()
        np.testing.assert_allclose(turned_by(angle * axis), expected, atol=2e-15)


def test_an_orientation_turns_as_scipy_turns_it() -> None:
    random = np.random.default_rng(1)
    for turn, before in zip(Rotation.random(200, rng=random), Rotation.random(200, rng=random), strict=True):
        after = turned_orientation(turn.as_matrix(), before.as_quat())
        assert np.linalg.norm(after) == pytest.approx(1.0, abs=1e-15)
        # A quaternion and its negative are the same orientation.
        np.testing.assert_allclose(Rotation.from_quat(after).as_matrix(), (turn * before).as_matrix(), atol=2e-15)
