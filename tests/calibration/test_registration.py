"""Where the rig stands in a robot's frame: from points, from poses of a flange, and what cannot be told."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from needletrack.calibration.registration import register_points, register_poses
from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float

POINTS_MM = np.array(
    [[-40.0, -30, 220], [45, -25, 230], [-35, 35, 240], [40, 30, 225], [0, 0, 290], [20, -10, 260], [-20, 15, 285]]
)


def robot_from_rig(seed: int) -> RigidTransform:
    random = np.random.default_rng(seed)
    return RigidTransform(Rotation.random(random_state=seed).as_matrix(), random.uniform(-800, 800, 3))


@given(st.integers(0, 10_000))
def test_exact_points_give_the_exact_motion(seed: int) -> None:
    true = robot_from_rig(seed)
    found = register_points(POINTS_MM, true.apply(POINTS_MM))
    np.testing.assert_allclose(found.robot_from_rig.rotation, true.rotation, atol=1e-9)
    np.testing.assert_allclose(found.robot_from_rig.translation_mm, true.translation_mm, atol=1e-6)
    assert found.rms_mm < 1e-9
    assert found.leave_one_out_rms_mm < 1e-9


def test_the_stated_covariance_is_that_of_many_repeats() -> None:
    true, random = robot_from_rig(3), np.random.default_rng(4)
    middle = true.apply(POINTS_MM.mean(axis=0))
    errors, stated = [], []
    for _ in range(400):
        found = register_points(POINTS_MM, true.apply(POINTS_MM) + random.normal(0, 0.2, POINTS_MM.shape))
        turn = Rotation.from_matrix(found.robot_from_rig.rotation @ true.rotation.T).as_rotvec()
        shift = found.robot_from_rig.apply(POINTS_MM.mean(axis=0)) - middle
        errors.append(np.concatenate([turn, shift]))
        stated.append(np.diag(found.covariance))
    np.testing.assert_allclose(np.std(errors, axis=0), np.sqrt(np.mean(stated, axis=0)), rtol=0.15)


def test_a_point_that_was_mistaken_shows_when_it_is_left_out() -> None:
    true = robot_from_rig(5)
    robot_mm = true.apply(POINTS_MM)
    robot_mm[2] += [0.0, 3.0, 0.0]
    found = register_points(POINTS_MM, robot_mm)
    assert found.leave_one_out_mm.argmax() == 2
    assert found.leave_one_out_mm[2] > 2.9
    assert found.leave_one_out_mm[2] > 1.2 * found.residual_mm[2]


def flanges(true: RigidTransform, tool_mm: Float, noise_mm: float = 0.0) -> tuple[Float, Float]:
    random = np.random.default_rng(8)
    turns = Rotation.from_rotvec(random.uniform(-0.6, 0.6, (len(POINTS_MM), 3))).as_matrix()
    places = true.apply(POINTS_MM) - turns @ tool_mm + random.normal(0, noise_mm, POINTS_MM.shape)
    return turns, places


def test_the_tool_s_tip_is_found_with_the_rig() -> None:
    true, tool_mm = robot_from_rig(6), np.array([3.0, -5.0, 120.0])
    exact = register_poses(POINTS_MM, *flanges(true, tool_mm))
    np.testing.assert_allclose(exact.robot_from_rig.translation_mm, true.translation_mm, atol=1e-4)
    assert exact.tool_mm is not None
    np.testing.assert_allclose(exact.tool_mm, tool_mm, atol=1e-5)
    noisy = register_poses(POINTS_MM, *flanges(true, tool_mm, 0.1))
    middle = POINTS_MM.mean(axis=0)
    off = noisy.robot_from_rig.apply(middle) - true.apply(middle)
    assert (np.abs(off) < 5 * noisy.shift_sigma_mm).all()
    assert noisy.leave_one_out_rms_mm > noisy.rms_mm > 0.02


def test_what_leaves_something_open_is_refused() -> None:
    with pytest.raises(CalibrationError, match="3 points are fewer than 4"):
        register_points(POINTS_MM[:3], POINTS_MM[:3])
    line = np.linspace([0.0, 0, 220], [40, 10, 280], 8)
    with pytest.raises(CalibrationError, match="on a line"):
        register_points(line, line)
    turns, places = flanges(robot_from_rig(1), np.array([0.0, 0, 100]))
    with pytest.raises(CalibrationError, match="leaves the tool's tip open"):
        register_poses(POINTS_MM, np.broadcast_to(np.eye(3), turns.shape), places)
