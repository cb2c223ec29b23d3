"""A needle that was seen whole in the pair before, looked at again: against truth, and against the thorough look."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.tracking.scenes import ARC, RIG, WORLDS, Scene, drawn_at_random, scene, seen_at, tracked

from needletrack.errors import NeedleNotFound
from needletrack.geometry import spline
from needletrack.geometry.spline import distance_from_curve
from needletrack.records import Frame, NeedleTrack, Reason, Status, StereoPair
from needletrack.scoring import TrueShape, score
from needletrack.synthetic.needle import Wave
from needletrack.synthetic.world import World
from needletrack.tracking.glance import MOST_LOOKS, SETTLED_MM, Glance, GlanceParameters, Steady, glance
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import follow, track_pair

P = TrackingParameters()
PARAMETERS = GlanceParameters(P.needle, P.fit, P.ends, P.tip, P.beside, P.refine.spacing_mm)
STEP_S = 1 / 60


def steady(track: NeedleTrack, **changes: object) -> Steady:
    """What a track tells of the next pair, STEP_S later."""
    assert track.curve is not None
    assert track.appearance is not None
    assert track.appearance.taper_mm is not None
    told = Steady(track.curve.points_mm, track.appearance, track.appearance.taper_mm, STEP_S, 0.0)
    return replace(told, **changes)  # type: ignore[arg-type]


@cache
def glanced(name: str) -> Glance:
    found = glance(scene(name).images, RIG, steady(tracked(name)), PARAMETERS)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("name", "curve_mm", "tip_mm"), [("dark", 0.03, 0.15), ("light", 0.03, 0.15), ("steel", 0.15, 0.3)]
)
def test_it_finds_what_a_thorough_look_finds(name: str, curve_mm: float, tip_mm: float) -> None:
    found, truth = glanced(name), scene(name).truth
    assert np.median(distance_from_curve(found.fit.points_mm, truth.centerline_mm)) < curve_mm
    assert np.linalg.norm(found.fit.points_mm[-1] - truth.tip_mm) < tip_mm
    assert found.tip_is_free
    for px, true_px in zip(found.tip_px, RIG.project(truth.tip_mm[None]), strict=True):
        assert np.linalg.norm(px - true_px) < 5.6 * tip_mm + 0.5


@pytest.mark.parametrize("name", ["dark", "steel"])
def test_its_parts_belong_together(name: str) -> None:
    found = glanced(name)
    points_mm = found.fit.points_mm
    steps_mm = np.diff(spline.arc_length(points_mm))
    np.testing.assert_allclose(steps_mm, P.refine.spacing_mm, rtol=0.1)
    assert found.shown.shape == found.support.shape == found.fit.residual_px.shape == (2, len(points_mm))
    size = 3 * len(found.fit.control_mm)
    assert found.fit.covariance_mm2.shape == (size, size)
    assert (np.linalg.eigvalsh(found.fit.covariance_mm2) > 0).all()
    basis = spline.basis(found.fit.parameters, len(found.fit.control_mm))
    np.testing.assert_allclose(basis @ found.fit.control_mm, points_mm, atol=1e-9)


@pytest.mark.parametrize("moved_mm", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.6), (-0.2, 0.8, 0.2)])
def test_it_goes_with_the_needle(moved_mm: tuple[float, float, float]) -> None:
    # By up to two thirds of its own width between two pairs, or along itself.
    base_mm = (np.array(ARC.base_mm) + moved_mm).tolist()
    shown = seen_at(replace(WORLDS["dark"], needle=replace(ARC, base_mm=tuple(base_mm))), STEP_S)
    track = follow(shown.pair, RIG, P, tracked("dark"))
    result = score(track, TrueShape.drawn(shown.truth))
    assert track.status is Status.OK
    assert result.rms_mm == pytest.approx(0.0, abs=0.05)
    assert result.tip_mm == pytest.approx(0.0, abs=0.2)
    assert track.since_detection == 1


def test_the_same_glance_twice_is_the_same() -> None:
    again = glance(scene("steel").images, RIG, steady(tracked("steel")), PARAMETERS)
    assert again is not None
    np.testing.assert_array_equal(again.fit.points_mm, glanced("steel").fit.points_mm)
    np.testing.assert_array_equal(again.fit.covariance_mm2, glanced("steel").fit.covariance_mm2)
    assert again.tip == glanced("steel").tip


def test_where_it_was_is_nothing_any_more() -> None:
    nothing = seen_at(replace(WORLDS["dark"], needle=None))
    with pytest.raises(NeedleNotFound):
        glance(nothing.images, RIG, steady(tracked("dark")), PARAMETERS)
    lost = follow(nothing.pair, RIG, P, tracked("dark"))
    assert lost.status is Status.INVALID
    assert lost.reasons


def test_an_image_without_any_contrast_shows_nothing() -> None:
    flat = np.full(RIG.left.size_px[::-1], 128, np.uint8)
    pair = StereoPair(Frame(flat, 0), Frame(flat, 0), 1)
    assert follow(pair, RIG, P, tracked("dark")).status is Status.INVALID


def test_a_tip_beyond_what_was_looked_at_is_not_guessed() -> None:
    # Seven millimetres of the needle were not there a moment ago.
    short = tracked("dark")
    assert short.curve is not None
    with pytest.raises(NeedleNotFound) as lost:
        glance(scene("dark").images, RIG, steady(short, points_mm=short.curve.points_mm[:-10]), PARAMETERS)
    assert lost.value.reason in {Reason.JUMP, Reason.TIP_NOT_SEEN}


def test_a_curve_behind_the_cameras_is_refused() -> None:
    away = steady(tracked("dark"))
    with pytest.raises(NeedleNotFound) as lost:
        glance(scene("dark").images, RIG, replace(away, points_mm=away.points_mm - [0.0, 0.0, 300.0]), PARAMETERS)
    assert lost.value.reason == Reason.OUTSIDE_WORKSPACE


# Half of its own width aside: seen at once, but not well.
FAR_MM = (0.5, 0.0, 0.2)


@pytest.mark.parametrize("aside_mm", [0.5, 0.8, 1.2])
def test_what_moved_all_at_once_is_found_at_one_look(aside_mm: float) -> None:
    moved = replace(ARC, shift_mm=(Wave(aside_mm), Wave(0.0), Wave(0.0)))
    shown = seen_at(replace(WORLDS["dark"], needle=moved), STEP_S)
    found = glance(shown.images, RIG, steady(tracked("dark")), PARAMETERS)
    assert found is not None
    assert (found.looks, found.aside_mm < SETTLED_MM) == (1, True)
    assert np.median(distance_from_curve(found.fit.points_mm, shown.truth.centerline_mm)) < 0.03


@cache
def swung() -> tuple[World, Scene, Steady]:
    """A needle whose tip swings by 2.5 mm, which is not seen whole at one look; and what was known of it before."""
    world = drawn_at_random(4)
    before = track_pair(seen_at(world).pair, world.rig)
    return world, seen_at(world, 1 / 30), steady(before, since_s=1 / 30, is_moving=True)


def test_what_has_swung_far_is_looked_at_until_it_stays() -> None:
    world, shown, before = swung()
    once = glance(shown.images, world.rig, before, PARAMETERS, most_looks=1)
    found = glance(shown.images, world.rig, before, PARAMETERS)
    assert once is not None
    assert found is not None
    assert (once.looks, once.aside_mm > SETTLED_MM) == (1, True)
    assert 1 < found.looks <= MOST_LOOKS
    assert found.aside_mm < SETTLED_MM
    errors_mm = [
        np.percentile(distance_from_curve(g.fit.points_mm, shown.truth.centerline_mm), 95) for g in (once, found)
    ]
    assert errors_mm[1] < 0.1
    assert errors_mm[0] > 0.5


def test_further_looks_are_glances_from_where_the_one_before_ended() -> None:
    world, shown, before = swung()
    found = glance(shown.images, world.rig, before, PARAMETERS)
    assert found is not None
    length_mm, by_hand, from_here = float(spline.arc_length(before.points_mm)[-1]), None, before
    for _ in range(found.looks):
        by_hand = glance(shown.images, world.rig, from_here, PARAMETERS, most_looks=1)
        assert by_hand is not None
        from_here = replace(before, points_mm=by_hand.fit.points_mm, length_mm=length_mm)
    assert by_hand is not None
    np.testing.assert_allclose(found.fit.points_mm, by_hand.fit.points_mm, atol=1e-9)
    np.testing.assert_allclose(found.fit.covariance_mm2, by_hand.fit.covariance_mm2, rtol=1e-6, atol=1e-12)
    assert found.tip == by_hand.tip
