"""Needles so bright that the picture saturates, against the truth of what was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from tests.tracking.scenes import ARC, BEHIND, RIG, Scene, scene, seen_at

from needletrack.records import Float
from needletrack.synthetic.render import Material
from needletrack.synthetic.world import LIGHT_ON_DARK, World
from needletrack.tracking.clipped import clipped_axis, outline
from needletrack.tracking.silhouette import AxisOffsets

# Looks wider than it is by half a sigma of the blur on either side, and more.
SEEN_WIDER_MM = 0.2


def bright(level: float) -> Scene:
    return seen_at(World(RIG, ARC, BEHIND, replace(LIGHT_ON_DARK, needle=Material(level), sleeve=Material(90.0))))


def unseen(points_mm: Float) -> tuple[AxisOffsets, AxisOffsets]:
    n = len(points_mm)
    left, right = (AxisOffsets(px, np.zeros((n, 2)), np.zeros(n), np.full(n, np.inf)) for px in RIG.project(points_mm))
    return left, right


def shaft(shown: Scene) -> Float:
    """Points about a millimetre apart, without sleeve and tip."""
    return shown.truth.centerline_mm[6:-10:2]


@pytest.mark.parametrize("level", [400.0, 700.0, 1200.0])
def test_axis_and_diameter_of_a_clipped_needle(level: float) -> None:
    shown = bright(level)
    points_mm = shaft(shown)
    at = [np.zeros(len(points_mm))] * 2
    everywhere = np.ones(len(points_mm), dtype=np.bool_)
    seen_mm = shown.truth.diameter_mm + SEEN_WIDER_MM
    found = clipped_axis(shown.images, RIG, points_mm, unseen(points_mm), at, seen_mm, everywhere)
    assert found is not None
    flanks, observed = found
    # A blur that is off by 0.01 px puts either edge off by 0.03 px, which is 0.006 mm.
    assert flanks.diameter_mm == pytest.approx(shown.truth.diameter_mm, abs=0.06)
    for view in observed:
        assert view.seen.mean() > 0.9
        assert np.abs(view.offset_px[view.seen]).max() < 0.15
        assert np.mean(np.abs(view.offset_px[view.seen]) < 2 * view.sigma_px[view.seen]) > 0.8


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_needle_that_is_not_clipped_is_left_alone(name: str) -> None:
    points_mm = shaft(scene(name))
    everywhere = np.ones(len(points_mm), dtype=np.bool_)
    at = [np.zeros(len(points_mm))] * 2
    diameter_mm = scene(name).truth.diameter_mm
    assert clipped_axis(scene(name).images, RIG, points_mm, unseen(points_mm), at, diameter_mm, everywhere) is None


def test_an_outline_is_that_of_the_shaft_and_draws_in_at_the_apex() -> None:
    before = np.arange(-3.0, 12.0, 0.05)
    cone = 2.0 * np.clip(before / 5.0, 0.0, 1.0)
    seen = outline(cone, (0.7, 0.7 / 0.05), 2.6)
    np.testing.assert_allclose(seen[-20:], 2.6, atol=0.01)
    assert (np.diff(seen) >= -1e-9).all()
    # Nothing is seen further beyond the apex than the outline lies beside the shaft.
    assert -0.6 < before[np.argmax(seen > 0)] < 0.6
