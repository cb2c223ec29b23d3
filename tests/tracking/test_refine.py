"""From curves that are nearly, partly or not at all the needle's to the needle."""

from dataclasses import replace

import numpy as np
import pytest
from tests.tracking.scenes import ARC, BEHIND, RIG, WORLDS, Scene, scene, seen_at

from needletrack.errors import NeedleNotFound
from needletrack.geometry import spline
from needletrack.geometry.spline import distance_from_curve
from needletrack.records import BasePose, Float, NeedleCurve, NeedleTrack, Reason, Status
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.world import World
from needletrack.tracking.needle import Workspace
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import Refined, RefineModels, refine


def models(parameters: TrackingParameters | None = None) -> RefineModels:
    p = parameters or TrackingParameters()
    return RefineModels(p.needle, p.workspace, p.beside, p.fit, p.ends, p.tip, p.refine)


def refined(shown: Scene, rough_mm: Float, parameters: TrackingParameters | None = None) -> Refined:
    return refine(shown.images, RIG, rough_mm, models(parameters))


def remembered(points_mm: Float) -> NeedleTrack:
    """A track of the pair before, base -> tip."""
    n = len(points_mm)
    along = spline.unit(points_mm[1] - points_mm[0])
    curve = NeedleCurve(points_mm, np.full(n, 0.1), np.full(n, 2), np.zeros(n), float(spline.arc_length(points_mm)[-1]))
    return NeedleTrack(0, Status.DEGRADED, (Reason.TIP_NOT_SEEN,), curve, base=BasePose(points_mm[0], along))


def wavering(points_mm: Float, by_mm: float) -> Float:
    """A curve beside the given one, about so far: as a staircase of skeletons triangulates."""
    u = np.linspace(0.0, 1.0, len(points_mm))[:, None]
    return points_mm + by_mm * np.column_stack([np.sin(9 * u), np.zeros_like(u), 3 * np.cos(7 * u)])


# On these plain scenes one axis point is off by 0.014 px; a curve of 13 control points through 170 of them in each
# view by 0.005 px, which is 0.001 mm across and 0.005 mm in depth. The taper, and an end held from one side only,
# double that.
CURVE_MM = 0.03
# Tip: grid of 0.05 mm, tapers hardly told apart. Base: one spacing of the cross sections while the needle is followed,
# 0.8 mm, and the rim of 2.5 mm under slopes of 0.12 and 0.25.
TIP_MM = 0.15
BASE_MM = 0.8 + 2.5 * 0.25


def check(found: Refined, shown: Scene) -> None:
    truth = shown.truth
    points_mm = found.fit.points_mm
    assert distance_from_curve(points_mm[3:], truth.centerline_mm).max() < CURVE_MM + TIP_MM
    assert np.median(distance_from_curve(points_mm, truth.centerline_mm)) < CURVE_MM
    assert np.linalg.norm(points_mm[-1] - truth.tip_mm) < TIP_MM
    assert np.linalg.norm(points_mm[0] - truth.centerline_mm[0]) < BASE_MM
    assert found.base_is_known
    assert found.shown.shape == (2, len(points_mm))
    # Widths are 4 % apart.
    assert found.diameter_mm == pytest.approx(truth.diameter_mm, rel=0.09)
    for tip_px, true_px in zip(found.tip_px, RIG.project(truth.tip_mm[None]), strict=True):
        assert np.linalg.norm(tip_px - true_px) < 5.6 * TIP_MM + 0.5
    steps = np.linalg.norm(np.diff(points_mm, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.1)


@pytest.mark.parametrize("name", ["dark", "light"])
@pytest.mark.parametrize("by_mm", [0.0, 0.3])
def test_a_rough_curve_becomes_the_needle(name: str, by_mm: float) -> None:
    rough_mm = wavering(scene(name).truth.centerline_mm, by_mm)
    check(refined(scene(name), rough_mm), scene(name))


@pytest.mark.parametrize("part", [slice(0, 40), slice(60, 100), slice(100, None)], ids=["base", "middle", "tip"])
def test_a_part_grows_to_the_whole_needle(part: slice) -> None:
    check(refined(scene("dark"), scene("dark").truth.centerline_mm[part]), scene("dark"))


def test_what_reaches_beyond_both_ends_is_cut() -> None:
    truth = scene("dark").truth
    ahead = np.arange(1, 13)[:, None] * 0.5
    too_long = [
        truth.centerline_mm[0] - ahead[::-1] * truth.tangents[0],
        truth.centerline_mm,
        truth.tip_mm + ahead * truth.tip_direction,
    ]
    check(refined(scene("dark"), np.concatenate(too_long)), scene("dark"))


def test_the_sleeve_tells_base_from_tip() -> None:
    check(refined(scene("dark"), scene("dark").truth.centerline_mm[::-1]), scene("dark"))


def test_it_does_not_matter_where_it_comes_from() -> None:
    one, other = (
        refined(scene("dark"), rough_mm)
        for rough_mm in (scene("dark").truth.centerline_mm[50:90], wavering(scene("dark").truth.centerline_mm, 0.3))
    )
    assert distance_from_curve(one.fit.points_mm[3:], other.fit.points_mm).max() < CURVE_MM + 0.05


def test_from_the_pair_before() -> None:
    earlier = replace(ARC, length_mm=Wave(66.5), base_mm=(8.2, -34.1, 245.7))
    rough_mm = earlier.at(0.0).points_mm
    check(refine(scene("dark").images, RIG, rough_mm, models(), previous=remembered(rough_mm)), scene("dark"))


def test_each_view_places_the_tip_by_itself() -> None:
    # The last 1.5 mm of the needle are painted over in the right picture.
    shown = scene("dark")
    left, right = shown.images
    truth = shown.truth
    painted = right.copy()
    from_px, to_px = RIG.project(
        np.stack([truth.tip_mm - 1.5 * truth.tip_direction, truth.tip_mm + truth.tip_direction])
    )[1]
    along = (to_px - from_px) / np.linalg.norm(to_px - from_px)
    y, x = np.indices(painted.shape)
    ahead = (x - from_px[0]) * along[0] + (y - from_px[1]) * along[1]
    aside = np.abs((y - from_px[1]) * along[0] - (x - from_px[0]) * along[1])
    painted[(ahead > 0) & (ahead < np.linalg.norm(to_px - from_px)) & (aside < 6)] = 200
    found = refine((left, painted), RIG, truth.centerline_mm, models())
    left_px, right_px = (px[0] for px in RIG.project(truth.tip_mm[None]))
    assert np.linalg.norm(found.tip_px[0] - left_px) < 0.4 * 5.6
    # Of the cone its thick end is left, whose taper points to where the apex was, about which it is found.
    assert abs((right_px - found.tip_px[1]) @ along) < 1.7 * 5.6
    # And the two views are not made to agree.
    assert abs(found.tip.each_mm[0] - found.tip.each_mm[1]) > 0.2


NO_SLEEVE = World(RIG, NeedleMotion((8.0, -70.0, 250.0), (0.08, 1.0, 0.05), Wave(95.0)), BEHIND, sleeve=None)


def test_without_a_sleeve_only_knowledge_tells_the_base() -> None:
    shown = seen_at(NO_SLEEVE)
    inside_mm = shown.truth.centerline_mm[shown.truth.visible.all(axis=0)]
    for rough_mm in (inside_mm, inside_mm[::-1]):
        assert not refined(shown, rough_mm).base_is_known
        by_side = refined(shown, rough_mm, TrackingParameters(workspace=Workspace(entry_side="top")))
        by_memory = refine(shown.images, RIG, rough_mm, models(), previous=remembered(inside_mm))
        for found in (by_side, by_memory):
            assert found.base_is_known
            assert np.linalg.norm(found.fit.points_mm[-1] - shown.truth.tip_mm) < TIP_MM
            assert np.linalg.norm(found.fit.points_mm[0] - inside_mm[0]) < 2.0


def test_a_curve_beside_the_needle_is_none() -> None:
    beside_mm = scene("dark").truth.centerline_mm + np.array([15.0, 0.0, 0.0])
    with pytest.raises(NeedleNotFound) as lost:
        refined(scene("dark"), beside_mm)
    assert lost.value.reason == Reason.LOW_COVERAGE


@pytest.mark.parametrize("depth_mm", [10.0, -200.0])
def test_a_curve_at_or_behind_the_camera_is_none(depth_mm: float) -> None:
    points_mm = scene("dark").truth.centerline_mm + np.array([0.0, 0.0, depth_mm - 250.0])
    with pytest.raises(NeedleNotFound) as lost:
        refined(scene("dark"), points_mm)
    assert lost.value.reason in {Reason.OUTSIDE_WORKSPACE, Reason.LOW_COVERAGE}


def test_an_empty_background_holds_no_needle() -> None:
    empty = replace(WORLDS["dark"], needle=None)
    with pytest.raises(NeedleNotFound) as lost:
        refined(seen_at(empty), scene("dark").truth.centerline_mm)
    assert lost.value.reason == Reason.LOW_COVERAGE


def test_something_without_end_is_too_long() -> None:
    # A wire across the whole picture, longer than twice the greatest length of a needle of 20 mm.
    wire = NeedleMotion((8.0, -70.0, 250.0), (0.1, 1.0, 0.0), Wave(140.0))
    shown = seen_at(World(RIG, wire, sleeve=None))
    short = TrackingParameters.model_validate({"needle": {"max_length_mm": 20.0}})
    with pytest.raises(NeedleNotFound) as lost:
        refined(shown, shown.truth.centerline_mm[120:160], short)
    assert lost.value.reason == Reason.TOO_LONG


def test_each_stretch_knows_its_own_uncertainty() -> None:
    found = refined(scene("dark"), scene("dark").truth.centerline_mm)
    sigma_mm = np.sqrt(np.linalg.eigvalsh(found.fit.point_covariance_mm2)[:, -1])
    off_mm = distance_from_curve(found.fit.points_mm[3:], scene("dark").truth.centerline_mm)
    assert (off_mm < 3 * sigma_mm[3:]).all()
    assert spline.arc_length(found.fit.points_mm)[-1] == pytest.approx(68.0, abs=BASE_MM + TIP_MM)
