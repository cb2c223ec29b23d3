from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needletrack.geometry import spline
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.rig import default_rig

STRAIGHT = NeedleMotion(base_mm=(0.0, -30.0, 250.0), direction=(0.2, 1.0, 0.1), length_mm=Wave(60.0))


def test_a_wave_repeats_after_its_period() -> None:
    wave = Wave(3.0, 2.0, period_s=4.0, phase_rad=0.7)
    assert wave(1.3) == pytest.approx(wave(5.3))
    assert {round(wave(t), 3) for t in np.linspace(0, 4, 4001)} >= {1.0, 5.0}


def test_without_bend_it_is_straight() -> None:
    shape = STRAIGHT.at(0.0)
    direction = np.array([0.2, 1.0, 0.1]) / np.linalg.norm([0.2, 1.0, 0.1])
    np.testing.assert_allclose(shape.points_mm[0], [0.0, -30.0, 250.0])
    np.testing.assert_allclose(shape.points_mm[-1], shape.points_mm[0] + 60.0 * direction)
    np.testing.assert_allclose(shape.tangents, np.broadcast_to(direction, shape.tangents.shape), atol=1e-12)


def test_a_constant_bend_is_a_circle() -> None:
    radius_mm = 50.0
    arc = replace(STRAIGHT, bend_per_mm=Wave(1 / radius_mm)).at(0.0)
    chord_mm = np.linalg.norm(arc.points_mm[-1] - arc.points_mm[0])
    # Each step is a chord as long as its arc: relative error (0.05 / 50)^2 / 24.
    assert chord_mm == pytest.approx(2 * radius_mm * np.sin(60.0 / radius_mm / 2), rel=1e-7)
    np.testing.assert_allclose(arc.curvature_per_mm, 1 / radius_mm)
    assert arc.tangents[0] @ arc.tangents[-1] == pytest.approx(np.cos(60.0 / radius_mm))
    # At plane 0 it bends parallel to the image: its plane holds no depth but the base direction's own.
    normal = np.cross(arc.tangents[0], arc.tangents[-1])
    assert abs(normal[2]) > 0.9 * np.linalg.norm(normal)


def test_torsion_takes_it_out_of_its_plane() -> None:
    bent = replace(STRAIGHT, bend_per_mm=Wave(0.02))
    for torsion, flat in ((0.0, True), (0.02, False)):
        points = replace(bent, torsion_rad_per_mm=Wave(torsion)).at(0.0).points_mm
        out_of_plane_mm = np.linalg.svd(points - points.mean(axis=0))[1][2]
        assert (out_of_plane_mm < 1e-6) == flat


def test_a_needle_drawn_back_has_no_points_but_a_base() -> None:
    shape = replace(STRAIGHT, length_mm=Wave(-2.0)).at(0.0)
    assert shape.points_mm.shape == (0, 3)
    np.testing.assert_allclose(shape.base_mm, [0.0, -30.0, 250.0])


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), t_s=st.floats(0.0, 60.0))
def test_random_needles_are_whole_and_in_view(seed: int, t_s: float) -> None:
    motion = NeedleMotion.random(seed)
    shape = motion.at(t_s)
    np.testing.assert_array_equal(shape.points_mm, NeedleMotion.random(seed).at(t_s).points_mm)
    steps_mm = np.linalg.norm(np.diff(shape.points_mm, axis=0), axis=1)
    np.testing.assert_allclose(steps_mm.sum(), motion.length_mm(t_s), rtol=1e-9)
    np.testing.assert_allclose(steps_mm, steps_mm[0], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shape.tangents, axis=1), 1.0, atol=1e-9)
    # The told tangents are those of the points, but for the central differences' own error.
    np.testing.assert_allclose(spline.tangents(shape.points_mm)[1:-1], shape.tangents[1:-1], atol=1e-6)
    assert 200 < shape.points_mm[:, 2].min() < shape.points_mm[:, 2].max() < 310
    rig = default_rig()
    for camera, pixels in zip((rig.left, rig.right), rig.project(shape.points_mm), strict=True):
        assert camera.contains(pixels).all()


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), t_s=st.floats(0.0, 60.0))
def test_it_moves_smoothly(seed: int, t_s: float) -> None:
    motion = NeedleMotion.random(seed)
    # The tip of a random motion is never faster than about 200 mm/s.
    before, after = motion.at(t_s), motion.at(t_s + 1e-3)
    assert 0 < np.linalg.norm(after.points_mm[-1] - before.points_mm[-1]) < 0.2
