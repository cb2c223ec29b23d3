"""What an error of the calibration does to points: derivatives against differences, alignment against its meaning."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.triangulation import triangulate
from needletrack.geometry.uncertainty import (
    RigUncertainty,
    parameter_count,
    parameter_names,
    perturbed,
    point_derivatives,
    rigid_motions,
)
from needletrack.records import Float
from needletrack.synthetic.rig import default_rig

POINTS_MM = np.array([[-40.0, 20, 220], [10, -30, 250], [55, 40, 290], [0, 0, 260], [30, -10, 215]])


def rig_with(terms: int) -> StereoRig:
    rig = default_rig()
    lens = np.array([-0.11, 0.075, 2e-4, -1e-4, 0.02, 0.01, -0.02, 0.005])[:terms]
    left = Camera(rig.left.matrix, lens, rig.left.size_px)
    return StereoRig(left, Camera(rig.right.matrix, lens, rig.right.size_px), rig.right_from_left)


def triangulated(rig: StereoRig, pixels: tuple[Float, Float]) -> Float:
    """Where the pictures' squared distances from the pixels are least."""
    start = triangulate(rig, rig.left.undistort(pixels[0]), rig.right.undistort(pixels[1]))

    def off_px(flat: Float) -> Float:
        return np.asarray(np.subtract(rig.project(flat.reshape(-1, 3)), pixels).ravel())

    return np.asarray(least_squares(off_px, start.ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15).x.reshape(-1, 3))


@pytest.mark.parametrize("terms", [4, 5, 8])
def test_derivatives_are_the_limits_of_differences(terms: int) -> None:
    rig = rig_with(terms)
    assert len(parameter_names(rig)) == parameter_count(rig) == 14 + 2 * terms
    pixels = rig.project(POINTS_MM)
    by_parameters, by_pixels = point_derivatives(rig, POINTS_MM)
    for index, name in enumerate(parameter_names(rig)):
        step = np.zeros(parameter_count(rig))
        step[index] = 1e-2 if name.split(".")[1] in ("fx", "fy", "cx", "cy") else 1e-5
        differences = triangulated(perturbed(rig, step), pixels) - triangulated(perturbed(rig, -step), pixels)
        numeric = differences / (2 * step[index])
        scale = np.abs(by_parameters[:, :, index]).max()
        np.testing.assert_allclose(numeric, by_parameters[:, :, index], atol=0.01 * scale, err_msg=name)
    assert by_pixels.shape == (5, 3, 4)


def test_points_along_a_rigid_motion_have_no_error_after_alignment() -> None:
    rig = rig_with(5)
    grid = np.stack(np.meshgrid([-40, 0, 40], [-30, 0, 30], [220, 260, 290]), axis=-1).reshape(-1, 3).astype(float)
    covariance = np.diag(np.full(parameter_count(rig), 1e-6))
    before, after = RigUncertainty(rig, covariance), RigUncertainty(rig, covariance, grid)
    assert after.rms_mm(grid) < before.rms_mm(grid)
    # The aligned derivatives hold no rigid motion any more.
    left_over = after.derivatives(grid).reshape(-1, parameter_count(rig))
    motions = rigid_motions(grid).reshape(-1, 6)
    np.testing.assert_allclose(motions.T @ left_over, 0, atol=1e-6 * np.abs(left_over).max() * len(grid) * 300)


def test_rigid_motions_are_small_turns_and_shifts() -> None:
    turn, shift = np.array([1e-5, -2e-5, 3e-5]), np.array([0.1, -0.2, 0.3])
    moved = Rotation.from_rotvec(turn).apply(POINTS_MM) + shift
    by_motion = rigid_motions(POINTS_MM) @ np.concatenate([turn, shift])
    np.testing.assert_allclose(moved - POINTS_MM, by_motion, atol=1e-6)


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (np.eye(3), "has shape"),
        (-np.eye(24), "negative variance"),
        (np.triu(np.ones((24, 24))), "not symmetric"),
        (np.full((24, 24), np.nan), "not finite"),
    ],
)
def test_what_is_no_covariance_is_refused(matrix: Float, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        RigUncertainty(default_rig(), matrix)
