"""How a needle moves: what a motion that is known is told as, and where it leads to."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.tracking.scenes import ARC, RIG, WORLDS, seen_at, tracked

from needletrack.geometry.spline import arc_length, distance_from_curve, tangents
from needletrack.records import Float, NeedleCurve, Status
from needletrack.synthetic.needle import Wave
from needletrack.tracking.motion import MOST_FORESEEN_S, foreseen_mm, moved_aside_mm, moving_like
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import follow, track_pair

P = TrackingParameters()
component = st.floats(-1.5, 1.5)
terms = st.lists(st.tuples(component, component), min_size=3, max_size=3)


def bent(points: int = 60, length_mm: float = 70.0, bend_per_mm: float = 0.006) -> Float:
    s = np.linspace(0.0, length_mm, points)
    angle = bend_per_mm * s
    return np.column_stack([np.sin(angle) / bend_per_mm, (1 - np.cos(angle)) / bend_per_mm, np.full(points, 250.0)])


def aside(curve_mm: Float, across: list[tuple[float, float]]) -> Float:
    """A motion (N, 3) aside of a curve, that is a parabola over its length: in its plane and out of it, mm."""
    share = np.linspace(0.0, 1.0, len(curve_mm))[:, None] ** [0, 1, 2]
    along = tangents(curve_mm)
    normal = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(along))])
    by = share @ np.array(across)
    return np.asarray(by[:, :1] * normal + by[:, 1:] * [0.0, 0.0, 1.0])


def curve_of(points_mm: Float, velocity_mm_s: Float | None = None) -> NeedleCurve:
    n = len(points_mm)
    length_mm = float(arc_length(points_mm)[-1])
    return NeedleCurve(points_mm, np.full(n, 0.05), np.full(n, 2), np.zeros(n), length_mm, velocity_mm_s)


@given(terms)
def test_a_smooth_motion_aside_is_told(across: list[tuple[float, float]]) -> None:
    before = bent()
    moved = aside(before, across)
    told = moved_aside_mm(before + moved, before)
    # What turns slides along itself a little as well, and is told apart; so do distances from the base.
    assert np.abs(told - moved).max() < 0.02 + 0.12 * np.abs(moved).max()


@given(st.integers(0, 2**32 - 1))
def test_noise_of_single_points_is_not_motion(seed: int) -> None:
    before, sigma_mm = bent(), 0.05
    now = before + np.random.default_rng(seed).normal(0.0, sigma_mm, before.shape)
    # Three terms of 32 places: each is off by less than sigma, at the ends by no more than 3 / sqrt(32) of it.
    assert np.abs(moved_aside_mm(now, before)).max() < 4 * sigma_mm * 3 / np.sqrt(32)


def test_a_needle_that_is_pushed_forward_along_itself_does_not_move_aside() -> None:
    whole = bent(90, 105.0)
    np.testing.assert_allclose(moved_aside_mm(whole[:66], whole[:60]), 0.0, atol=1e-9)


def test_what_moves_is_expected_to_go_on() -> None:
    before = bent()
    step = aside(before, [(0.2, 0.1), (0.3, 0.0), (0.4, -0.2)])
    now = curve_of(before + step, moved_aside_mm(before + step, before) / 0.02)
    assert distance_from_curve(before + 2 * step, foreseen_mm(now, 0.02)).max() < 0.05
    assert distance_from_curve(before + 3 * step, foreseen_mm(now, 0.04)).max() < 0.12


@pytest.mark.parametrize("since_s", [-0.02, 0.0, 1.01 * MOST_FORESEEN_S])
def test_no_motion_is_foreseen_of_the_past_nor_for_long(since_s: float) -> None:
    moving = curve_of(bent(), np.ones((60, 3)))
    np.testing.assert_array_equal(foreseen_mm(moving, since_s), moving.points_mm)
    still = replace(moving, velocity_mm_s=None)
    np.testing.assert_array_equal(foreseen_mm(still, 0.02), still.points_mm)


def test_another_fit_of_a_needle_moves_as_that_does() -> None:
    moving = curve_of(bent(60), np.linspace(0.0, 1.0, 60)[:, None] * [3.0, 0.0, 1.0])
    longer = moving_like(curve_of(bent(72, 84.0)), moving)
    assert longer.velocity_mm_s is not None
    assert moving.velocity_mm_s is not None
    np.testing.assert_allclose(longer.velocity_mm_s[:60], moving.velocity_mm_s, atol=0.1)
    # Beyond its end nothing is known but how that moves.
    np.testing.assert_allclose(longer.velocity_mm_s[60:], [[3.0, 0.0, 1.0]] * 12, atol=0.1)
    assert moving_like(curve_of(bent()), curve_of(bent())).velocity_mm_s is None


def test_a_needle_that_sweeps_aside_is_looked_for_where_it_has_gone_to() -> None:
    # At 50 mm/s it comes 0.8 mm from pair to pair: more than what one look sees well.
    step_s, sweeping = 1 / 60, replace(ARC, shift_mm=(Wave(0.0, 5.0, 2 * np.pi * 0.1), Wave(0.0), Wave(0.0)))
    world = replace(WORLDS["dark"], needle=sweeping)
    track = tracked("dark")
    for number in range(1, 4):
        shown = seen_at(world, number * step_s)
        track = track_pair(shown.pair, RIG, None, track)
        assert track.status is Status.OK
    assert track.curve is not None
    shown = seen_at(world, 4 * step_s)
    expected_mm = foreseen_mm(track.curve, step_s)
    was_off_mm = np.median(distance_from_curve(track.curve.points_mm, shown.truth.centerline_mm))
    assert was_off_mm > 0.5
    assert np.median(distance_from_curve(expected_mm, shown.truth.centerline_mm)) < 0.15 * was_off_mm
    assert follow(shown.pair, RIG, P, track).status is Status.OK
