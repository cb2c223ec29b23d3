"""From two drawn images to a track, against exact truth: shape, ends, sigmas, status; alone and from pair to pair."""

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import KDTree
from tests.tracking.scenes import (
    ARC,
    BEHIND,
    MIDDLE_MM,
    RIG,
    SIZE_PX,
    WORLDS,
    Scene,
    drawn_at_random,
    scene,
    seen_at,
    steered_fast,
    tracked,
)

from needletrack.geometry import spline
from needletrack.geometry.spline import distance_from_curve
from needletrack.records import Clock, Evidence, Frame, Image, NeedleCurve, NeedleTrack, Reason, Status, StereoPair
from needletrack.scoring import Score, Summary, TrueShape, score
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.render import Material
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import DARK_ON_LIGHT, LIGHT_ON_DARK, STEEL, Lighting, Rod, World
from needletrack.tracking.needle import EntrySide
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import (
    PAIRS_PER_AUDIT,
    PAIRS_PER_AUDIT_OF_WEAK,
    adopted,
    audit,
    follow,
    track,
    track_pair,
)


def scored(name: str) -> Score:
    return score(tracked(name), TrueShape.drawn(scene(name).truth))


def answer(world: World, parameters: TrackingParameters | None = None) -> tuple[NeedleTrack, Score]:
    shown = seen_at(world)
    found = track_pair(shown.pair, world.rig, parameters)
    return found, score(found, TrueShape.drawn(shown.truth))


def with_needle(**changes: object) -> World:
    return replace(WORLDS["dark"], needle=replace(ARC, **changes))  # type: ignore[arg-type]


# One needle, alone. As derived in test_refine.py: 0.03 mm for the curve, 0.15 mm for the tip; for the base the spacing
# at which it is followed and the rim of a sleeve that faces away.
CURVE_MM, TIP_MM, BASE_MM = 0.03, 0.15, 1.5
# The streak moves the axis by up to 0.65 px in one view (test_axis.py): 0.12 mm across, and in depth, where both views
# have it on the same side, less.
STEEL_MM = 0.15


@pytest.mark.parametrize("name", ["dark", "light"])
def test_a_plain_needle_is_found_as_exactly_as_the_noise_allows(name: str) -> None:
    found, result = tracked(name), scored(name)
    assert (found.status, found.reasons) == (Status.OK, ())
    assert not result.false_ok
    assert result.rms_mm is not None
    assert result.rms_mm < CURVE_MM
    assert result.tip_mm is not None
    assert result.tip_mm < TIP_MM
    # A tip direction is that of the last correlation length: 0.005 mm in depth at both its ends, 3 mm apart, doubled.
    assert result.direction_deg is not None
    assert result.direction_deg < 0.5
    assert result.cover is not None
    assert result.cover > 0.99


@pytest.mark.xfail(reason="found 0.035 mm too large where dark, 0.072 mm where bright: widths are tried 4 % apart")
@pytest.mark.parametrize("name", ["dark", "light"])
def test_the_diameter_is_the_needles(name: str) -> None:
    assert tracked(name).diameter_mm == pytest.approx(ARC.diameter_mm, abs=0.03)


def test_steel_is_found_through_its_streak() -> None:
    found, result = tracked("steel"), scored("steel")
    assert found.curve is not None
    assert not result.false_ok
    assert result.rms_mm is not None
    assert result.rms_mm < STEEL_MM
    assert result.cover is not None
    assert result.cover > 0.99


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_track_is_complete_and_agrees_with_itself(name: str) -> None:
    found, truth = tracked(name), scene(name).truth
    curve, tip, base = found.curve, found.tip, found.base
    assert curve is not None
    assert tip is not None
    assert base is not None
    n = len(curve.points_mm)
    assert curve.sigma_mm.shape == curve.seen.shape == curve.curvature_per_mm.shape == (n,)
    assert (curve.sigma_mm > 0).all()
    assert (curve.seen == 2).mean() > 0.95
    assert curve.length_mm == pytest.approx(spline.arc_length(curve.points_mm)[-1])
    # Evenly spaced along the arc, base to tip.
    steps = np.linalg.norm(np.diff(curve.points_mm, axis=0), axis=1)
    assert steps.max() / steps.min() < 1.2
    np.testing.assert_array_equal(curve.points_mm[-1], tip.position_mm)
    np.testing.assert_array_equal(curve.points_mm[0], base.position_mm)
    assert np.linalg.norm(base.position_mm - truth.centerline_mm[0]) < BASE_MM
    # Directions run along the needle: +z of the tip's frame is its direction.
    assert tip.direction @ truth.tip_direction > 0.99
    assert base.direction @ truth.tangents[0] > 0.99
    x, y, z, w = tip.orientation_xyzw
    third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(third, tip.direction, atol=1e-9)
    np.testing.assert_allclose(tip.covariance_mm2, tip.covariance_mm2.T)
    assert np.linalg.eigvalsh(tip.covariance_mm2).min() > 0
    assert tip.velocity_mm_s is None
    assert found.quality.coverage == pytest.approx(1.0, abs=0.05)
    assert found.quality.reprojection_rms_px is not None
    assert found.quality.reprojection_rms_px < 0.3
    assert found.since_detection == 0
    assert found.evidence.left is not None
    assert found.evidence.correspondences is not None
    assert {"segment", "centerline", "match", "refine"} <= set(found.timing_ms)
    assert min(found.timing_ms.values()) >= 0


def test_curvature_is_that_of_the_needle() -> None:
    curve = tracked("dark").curve
    assert curve is not None
    # An arc of 0.004 per mm. An error of 0.02 mm over two spacings of control points is 8 * 0.02 / 14^2 = 0.0008 / mm.
    inner = curve.curvature_per_mm[20:-20]
    np.testing.assert_allclose(inner.mean(), 0.004, atol=2e-4)
    assert np.abs(inner - 0.004).max() < 2e-3


# The stated sigmas


@cache
def random_scores(lighting: Lighting, seeds: range) -> tuple[Score, ...]:
    """Needles of every direction, length and bend before a mild texture, each tracked alone."""
    results = []
    for seed in seeds:
        needle = NeedleMotion.random(seed, MIDDLE_MM)
        world = World(RIG, needle, BEHIND, lighting, seed=seed)
        shown = seen_at(world, 1.0)
        results.append(score(track_pair(shown.pair, RIG), TrueShape.drawn(shown.truth)))
    return tuple(results)


QUICK, MANY = range(6), range(40)


@pytest.mark.parametrize(
    ("lighting", "seeds"),
    [
        (DARK_ON_LIGHT, QUICK),
        (STEEL, QUICK),
        pytest.param(DARK_ON_LIGHT, MANY, marks=pytest.mark.slow),
        pytest.param(LIGHT_ON_DARK, MANY, marks=pytest.mark.slow),
        pytest.param(STEEL, MANY, marks=pytest.mark.slow),
    ],
    ids=["dark", "steel", "dark many", "light many", "steel many"],
)
def test_the_sigmas_hold_over_many_needles(lighting: Lighting, seeds: range) -> None:
    results = random_scores(lighting, seeds)
    assert [result for result in results if result.false_ok] == []
    summary = Summary.of(results)
    assert summary.ok > len(seeds) / 2
    # The errors of one needle are alike, so that a few needles are a few samples: 0.8 of all points, where a Gaussian
    # of two dimensions whose larger sigma is stated has 0.86 to 0.95.
    assert summary.within_two_sigma >= 0.8
    # And they do not hide: what is called ok is known to a fraction of what a controller needs.
    assert summary.rms_mm < (STEEL_MM if lighting is STEEL else CURVE_MM)
    assert summary.tip_mm < 0.3
    assert summary.cover > 0.95


def streaked(toward_light_deg: float, diameter_mm: float) -> World:
    turn = np.radians(2 * toward_light_deg)
    light = (float(np.sin(turn)), 0.0, float(-np.cos(turn)))
    needle = replace(ARC, diameter_mm=diameter_mm, bend_per_mm=Wave(0.002))
    return World(RIG, needle, BEHIND, replace(STEEL, toward_light=light))


@pytest.mark.slow
@pytest.mark.parametrize(("diameter_mm", "within_two_sigma"), [(0.7, 0.5), (0.9, 0.8), (1.1, 0.8)])
def test_the_sigmas_hold_wherever_the_streak_lies(diameter_mm: float, within_two_sigma: float) -> None:
    # Below four pixels of width a streak at the rim passes for the needle: docs/tracking.md, "Known weaknesses".
    results = [answer(streaked(place_deg, diameter_mm))[1] for place_deg in range(-70, 71, 14)]
    assert [result for result in results if result.false_ok] == []
    assert Summary.of(results).within_two_sigma >= within_two_sigma


# Base and tip


ENTERING = {
    "top": NeedleMotion((8.0, -75.0, 250.0), (0.08, 1.0, 0.05), Wave(95.0)),
    "left": NeedleMotion((-75.0, -12.0, 250.0), (1.0, 0.45, 0.05), Wave(105.0)),
    "bottom": NeedleMotion((20.0, 75.0, 250.0), (-0.1, -1.0, 0.05), Wave(95.0)),
}


def entering(side: EntrySide) -> TrackingParameters:
    return TrackingParameters.model_validate({"workspace": {"entry_side": side}})


LEFT = pytest.param("left", marks=pytest.mark.xfail(reason="its base is 3.0 mm inside, where it was within 2.5"))


@pytest.mark.parametrize("side", ["top", LEFT, "bottom"])
def test_a_needle_without_a_sleeve_has_its_base_at_the_entry_side(side: EntrySide) -> None:
    shown = seen_at(World(RIG, ENTERING[side], BEHIND, sleeve=None))
    found = track_pair(shown.pair, RIG, entering(side))
    result = score(found, TrueShape.drawn(shown.truth))
    assert Reason.AMBIGUOUS_BASE not in found.reasons
    assert not result.false_ok
    assert found.tip is not None
    assert np.linalg.norm(found.tip.position_mm - shown.truth.tip_mm) < TIP_MM
    # The base is where it leaves the images: the last point that one of them shows, to within blur and averaging.
    assert found.base is not None
    first_mm = shown.truth.centerline_mm[shown.truth.visible.any(axis=0)][0]
    assert np.linalg.norm(found.base.position_mm - first_mm) < 2.5


def test_without_an_entry_side_base_and_tip_may_be_exchanged_and_that_is_told() -> None:
    shown = seen_at(World(RIG, ENTERING["top"], BEHIND, sleeve=None))
    found = track_pair(shown.pair, RIG)
    assert found.status is Status.DEGRADED
    assert Reason.AMBIGUOUS_BASE in found.reasons
    # Told once, the base is remembered.
    known = track_pair(shown.pair, RIG, entering("top"))
    later = track_pair(shown.pair, RIG, None, known)
    assert Reason.AMBIGUOUS_BASE not in later.reasons
    assert later.tip is not None
    assert np.linalg.norm(later.tip.position_mm - shown.truth.tip_mm) < TIP_MM


def test_two_needles_are_ambiguous() -> None:
    # What hangs beside it from the same side is as thick, as dark and as free at its end.
    lighting = replace(DARK_ON_LIGHT, rod=DARK_ON_LIGHT.needle)
    other = Rod((-40.0, -75.0, 245.0), (-2.0, 10.0, 255.0), diameter_mm=0.9)
    world = World(RIG, ENTERING["top"], BEHIND, lighting, sleeve=None, rods=(other,))
    found, _ = answer(world, entering("top"))
    assert (found.status, found.reasons) == (Status.DEGRADED, (Reason.AMBIGUOUS_SHAPE,))
    alone, _ = answer(replace(world, rods=()), entering("top"))
    assert alone.status is Status.OK


# Something else than a needle, or none


NOTHING = {
    "empty": replace(WORLDS["dark"], needle=None),
    "drawn back": with_needle(length_mm=Wave(0.0)),
    "vessels": World(RIG, None, Background(contrast=8.0, vessels=8)),
    "a rod of 3 mm": World(RIG, None, BEHIND, rods=(Rod((-50.0, 2.0, 215.0), (80.0, -6.0, 215.0), 3.0),)),
}


@pytest.mark.parametrize("name", NOTHING)
def test_without_a_needle_there_is_no_track(name: str) -> None:
    found, _ = answer(NOTHING[name])
    if name == "vessels":
        # Four faint walls that happen to meet: offered, and refused because it has no base, and no tip on which both
        # views agree.
        assert found.status is not Status.OK
        weak_tip = {Reason.TIP_NOT_SEEN, Reason.TIP_DISAGREES} & set(found.reasons)
        assert (Reason.AMBIGUOUS_BASE in found.reasons and weak_tip) or found.curve is None
        return
    assert found.status is Status.INVALID
    assert found.reasons[0] in {Reason.NO_CANDIDATE, Reason.NO_STEREO_MATCH, Reason.OUTSIDE_WORKSPACE}
    if name == "empty":
        assert found.reasons == (Reason.NO_CANDIDATE,)


def test_a_needle_behind_or_before_the_workspace_is_outside() -> None:
    for depth_mm, length_mm in ((350.0, 68.0), (175.0, 35.0)):
        world = with_needle(base_mm=(8.0, -20.0, depth_mm), length_mm=Wave(length_mm))
        found, _ = answer(replace(world, background=Background(distance_mm=450.0)))
        assert (found.status, found.reasons) == (Status.INVALID, (Reason.OUTSIDE_WORKSPACE,)), depth_mm


def test_a_needle_that_leaves_the_workspace_is_outside() -> None:
    truth_mm = scene("dark").truth.centerline_mm
    far_mm = float(np.percentile(truth_mm[:, 2], 80))
    near = TrackingParameters.model_validate({"workspace": {"z_mm": {"min": 200.0, "max": far_mm}}})
    found = track_pair(scene("dark").pair, RIG, near)
    assert (found.status, found.reasons) == (Status.INVALID, (Reason.OUTSIDE_WORKSPACE,))


@pytest.mark.parametrize(
    ("diameter_mm", "needle"),
    [
        (1.8, {}),
        (0.9, {"min_diameter_mm": 1.3, "max_diameter_mm": 1.5}),
        (0.2, {}),
    ],
    ids=["too wide", "thinner than configured", "a hair"],
)
def test_a_needle_of_another_width_is_never_ok(diameter_mm: float, needle: dict[str, float]) -> None:
    found, _ = answer(with_needle(diameter_mm=diameter_mm), TrackingParameters.model_validate({"needle": needle}))
    assert found.status is not Status.OK


def test_something_four_times_too_wide_is_no_needle() -> None:
    assert answer(with_needle(diameter_mm=3.6))[0].status is Status.INVALID


def test_a_stub_is_no_needle_and_a_short_needle_is() -> None:
    assert answer(with_needle(length_mm=Wave(4.0)))[0].status is Status.INVALID
    short, result = answer(with_needle(length_mm=Wave(12.0)))
    assert short.status is Status.OK
    assert not result.false_ok


def test_a_needle_longer_than_configured_is_refused() -> None:
    short = TrackingParameters.model_validate({"needle": {"max_length_mm": 50.0}})
    found = track_pair(scene("dark").pair, RIG, short)
    assert (found.status, found.reasons) == (Status.INVALID, (Reason.TOO_LONG,))


# Images that show nothing

SHAPE = SIZE_PX[::-1]


def noise_images() -> tuple[Image, Image]:
    rng = np.random.default_rng(6)
    return rng.integers(0, 256, SHAPE, dtype=np.uint8), rng.integers(0, 256, SHAPE, dtype=np.uint8)


def dusty(seed: int) -> Image:
    return np.where(np.random.default_rng(seed).random(SHAPE) < 0.02, 255, 20).astype(np.uint8)


def stripes(period: int) -> Image:
    return np.tile((np.arange(SHAPE[1]) // period % 2 * 255).astype(np.uint8), (SHAPE[0], 1))


def checkers() -> Image:
    rows, columns = np.indices(SHAPE) // 4
    return np.asarray((rows + columns) % 2 * 255, dtype=np.uint8)


@pytest.mark.parametrize(
    "images",
    [
        pytest.param((np.full(SHAPE, 0, np.uint8),) * 2, id="black"),
        pytest.param((np.full(SHAPE, 128, np.uint8),) * 2, id="gray"),
        pytest.param((np.full(SHAPE, 255, np.uint8),) * 2, id="saturated"),
        pytest.param(noise_images(), id="noise"),
        pytest.param((dusty(1), dusty(2)), id="dust"),
        pytest.param((stripes(5),) * 2, id="stripes"),
        pytest.param((stripes(3),) * 2, id="stripes as thin as needles", marks=pytest.mark.slow),
        pytest.param((checkers(),) * 2, id="checkers"),
    ],
)
def test_images_without_a_scene_are_invalid_and_no_error(images: tuple[Image, Image]) -> None:
    found = track(*images, RIG)
    assert found.status is Status.INVALID
    assert found.reasons
    assert found.curve is None
    # Along the curve of the pair before, accidents may look like some millimetres of needle; they are not acted on.
    assert track(*images, RIG, previous=tracked("dark")).status is not Status.OK


def test_one_dark_view_is_invalid() -> None:
    left, right = scene("dark").images
    black = np.zeros_like(left)
    assert track(left, black, RIG).status is Status.INVALID
    assert track(black, right, RIG).status is Status.INVALID


@pytest.mark.parametrize("lighting", [DARK_ON_LIGHT, LIGHT_ON_DARK, STEEL], ids=["dark", "light", "steel"])
def test_exchanged_images_are_never_ok(lighting: Lighting) -> None:
    # Whole images: what both cameras have in the middle of close-ups is as deep either way round.
    rig = default_rig((640, 512))
    shown = seen_at(World(rig, ARC, BEHIND, lighting))
    assert track(*shown.images, rig).curve is not None
    left, right = shown.images
    assert track(right, left, rig).status is not Status.OK


@pytest.mark.parametrize("cut", ["left", "right"])
def test_images_of_another_size_are_refused(cut: str) -> None:
    left, right = scene("dark").images
    narrower = {"left": (left[:, :-1], right), "right": (left, right[:-1])}[cut]
    with pytest.raises(ValueError, match=f"the {cut} image is"):
        track(*narrower, RIG)


@pytest.mark.parametrize(
    "level", [262.0, pytest.param(300.0, marks=pytest.mark.xfail(reason="degraded, 0.13 mm of rms, 1.05 mm wide"))]
)
def test_an_overexposed_background_does_not_hide_a_dark_needle(level: float) -> None:
    found, result = answer(replace(WORLDS["dark"], lighting=replace(DARK_ON_LIGHT, background_level=level)))
    assert found.status is Status.OK
    assert not result.false_ok


@pytest.mark.parametrize("level", [262.0, 300.0])
def test_before_an_overexposed_background_nothing_misleads(level: float) -> None:
    found, result = answer(replace(WORLDS["dark"], lighting=replace(DARK_ON_LIGHT, background_level=level)))
    assert found.curve is not None
    assert not result.false_ok
    assert result.rms_mm is not None
    assert result.rms_mm < 0.25


def test_an_underexposed_background_does_not_hide_a_bright_needle() -> None:
    lighting = replace(LIGHT_ON_DARK, background_level=0.0, sleeve=Material(30.0))
    found, result = answer(replace(WORLDS["light"], lighting=lighting, background=Background()))
    assert found.status is Status.OK
    assert not result.false_ok


# Something in front

ROD = Rod((-50.0, 2.0, 215.0), (80.0, -6.0, 215.0), diameter_mm=4.0)


def test_behind_a_rod_the_needle_goes_on_less_surely() -> None:
    shown = seen_at(replace(WORLDS["dark"], rods=(ROD,)))
    found = track_pair(shown.pair, RIG)
    result = score(found, TrueShape.drawn(shown.truth))
    assert found.status is Status.OK
    assert not result.false_ok
    assert result.rms_mm is not None
    assert result.rms_mm < CURVE_MM
    curve = found.curve
    assert curve is not None
    hidden = (
        np.interp(
            np.linspace(0, 1, len(curve.points_mm)),
            np.linspace(0, 1, len(shown.truth.centerline_mm)),
            shown.truth.visible.any(axis=0),
        )
        < 0.5
    )
    assert hidden.sum() > 2
    assert curve.seen[hidden].mean() < 1.0
    assert curve.sigma_mm[hidden].max() > 1.1 * np.median(curve.sigma_mm[~hidden])


@pytest.mark.parametrize("y_mm", [-15.0, 5.0, 20.0])
@pytest.mark.parametrize(("diameter_mm", "highlight"), [(3.0, 60.0), (5.0, 60.0), (5.0, 0.0), (6.5, 0.0)])
def test_a_dark_rod_is_not_taken_for_the_sleeve(y_mm: float, diameter_mm: float, highlight: float) -> None:
    # A plain black rod as wide as a sleeve differs from it in one thing only: the needle goes on behind it.
    lighting = replace(DARK_ON_LIGHT, sleeve=Material(60.0), rod=Material(20.0, highlight, 0.4))
    rod = Rod((-50.0, y_mm, 215.0), (80.0, y_mm - 4.0, 215.0), diameter_mm)
    found, result = answer(World(RIG, ARC, lighting=lighting, rods=(rod,)))
    assert not result.false_ok
    assert result.turned in {None, False} or found.status is not Status.OK


def misled(seed: int) -> list[int]:
    """The pairs, of three, in which a needle drawn at random was called ok and was not there."""
    world, track, wrong = drawn_at_random(seed), None, []
    for number, (pair, truth) in enumerate(world.pairs(30.0, 3)):
        track = track_pair(pair, world.rig, None, track)
        if score(track, TrueShape.drawn(truth)).false_ok:
            wrong.append(number)
    return wrong


@pytest.mark.parametrize("seed", [5, 132], ids=["streak of the sleeve", "streak of a rod"])
def test_a_streak_of_light_on_what_is_no_needle_does_not_mislead(seed: int) -> None:
    assert not misled(seed)


@pytest.mark.parametrize("seed", [4, 419])
def test_a_tip_that_swings_farther_than_a_look_reaches_is_followed(seed: int) -> None:
    # By 2.3 to 2.8 mm from pair to pair; a curve a millimetre aside of the needle explains what was looked at.
    world, track = drawn_at_random(seed), None
    for pair, truth in world.pairs(30.0, 3):
        track = track_pair(pair, world.rig, None, track)
        assert track.status is Status.OK
        assert score(track, TrueShape.drawn(truth)).tip_mm == pytest.approx(0.0, abs=TIP_MM)


@pytest.mark.parametrize("seed", [610, 638])
def test_a_rod_that_passes_by_ahead_of_the_tip_does_not_hide_it(seed: int) -> None:
    found, result = answer(drawn_at_random(seed))
    assert found.status is Status.OK
    assert result.tip_mm == pytest.approx(0.0, abs=TIP_MM)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 120, 30))
def test_what_is_called_ok_is_the_needle(first: int) -> None:
    assert {seed: pairs for seed in range(first, first + 30) if (pairs := misled(seed))} == {}


def test_a_tip_behind_a_rod_is_not_given() -> None:
    tip_px = RIG.left.project(scene("dark").truth.tip_mm[None])[0]
    ray = RIG.left.normalize(tip_px[None])[0]
    x, y = 215.0 * ray
    rod = Rod((float(x) - 60.0, float(y), 215.0), (float(x) + 60.0, float(y), 215.0), diameter_mm=6.0)
    found, _ = answer(replace(WORLDS["dark"], rods=(rod,)))
    assert Reason.TIP_NOT_SEEN in found.reasons
    assert found.curve is not None
    assert found.tip is None


# From pair to pair

# A tip at 32 mm/s, and a bend that changes: within 50 ms the tip moves 1.6 mm, half the control points' spacing less.
MOVING = replace(ARC, length_mm=Wave(62.0, 20.0, 4.0), bend_per_mm=Wave(0.003, 0.002, 3.0))
STEP_S = 0.05


@cache
def sequence() -> tuple[tuple[Scene, NeedleTrack, NeedleTrack], ...]:
    """Five pairs in order: what is shown, its track from the pair before, and its track alone."""
    world = replace(WORLDS["dark"], needle=MOVING)
    found: list[tuple[Scene, NeedleTrack, NeedleTrack]] = []
    previous = None
    for number in range(5):
        shown = seen_at(world, number * STEP_S)
        alone = track_pair(shown.pair, RIG)
        previous = alone if previous is None else track_pair(shown.pair, RIG, None, previous)
        found.append((shown, previous, alone))
    return tuple(found)


def test_from_the_pair_before_comes_the_same_shape_as_alone() -> None:
    for number, (shown, followed, alone) in enumerate(sequence()):
        assert (followed.status, followed.reasons) == (Status.OK, ())
        assert followed.since_detection == number
        assert followed.curve is not None
        assert alone.curve is not None
        # But for the base, a stretch of whose first spacing is in one of them only. Both err, each by its sigma.
        apart_mm = distance_from_curve(followed.curve.points_mm[4:], alone.curve.points_mm)
        assert (apart_mm <= np.sqrt(2) * followed.curve.sigma_mm[4:]).all()
        off_mm = distance_from_curve(followed.curve.points_mm[4:], shown.truth.centerline_mm)
        assert (off_mm <= 2 * followed.curve.sigma_mm[4:]).all()
        assert (off_mm <= followed.curve.sigma_mm[4:]).mean() > 0.9
        assert score(followed, TrueShape.drawn(shown.truth)).tip_mm == pytest.approx(0.0, abs=TIP_MM)


def test_following_searches_no_image() -> None:
    for _, followed, alone in sequence()[1:]:
        assert "segment" not in followed.timing_ms
        assert "segment" in alone.timing_ms
        assert followed.evidence.left is None


def test_the_tips_velocity_is_its_motion() -> None:
    tips_mm = [shown.truth.tip_mm for shown, _, _ in sequence()]
    for (_, followed, alone), before_mm, after_mm in zip(sequence()[1:], tips_mm, tips_mm[1:], strict=False):
        assert followed.tip is not None
        assert followed.tip.velocity_mm_s is not None
        # Two tips of 0.05 mm each, 50 ms apart; what both are off by cancels.
        np.testing.assert_allclose(followed.tip.velocity_mm_s, (after_mm - before_mm) / STEP_S, atol=3.0)
        assert alone.tip is not None
        assert alone.tip.velocity_mm_s is None


def test_a_velocity_needs_two_tips_in_order_and_close_in_time() -> None:
    (first, before, _), (second, _, _) = sequence()[:2]

    def velocity(stamp_ns: int, previous: NeedleTrack) -> npt.NDArray[np.float64] | None:
        pair = second.pair
        moved = StereoPair(Frame(pair.left.image, stamp_ns), Frame(pair.right.image, stamp_ns), 1, Clock.RECORDED)
        tip = track_pair(moved, RIG, None, previous).tip
        assert tip is not None
        return tip.velocity_mm_s

    start_ns = first.pair.captured_at_ns
    assert velocity(start_ns + 50_000_000, before) is not None
    assert velocity(start_ns, before) is None
    assert velocity(start_ns - 50_000_000, before) is None
    assert velocity(start_ns + 2_000_000_000, before) is None


def test_a_hidden_needle_is_lost_and_found_again() -> None:
    _, before, _ = sequence()[0]
    empty = seen_at(replace(WORLDS["dark"], needle=None), STEP_S)
    lost = track_pair(empty.pair, RIG, None, before)
    assert (lost.status, lost.reasons, lost.curve) == (Status.INVALID, (Reason.NO_CANDIDATE,), None)
    shown, _, alone = sequence()[2]
    again = track_pair(shown.pair, RIG, None, lost)
    assert again.status is Status.OK
    assert again.since_detection == 0
    assert again.tip is not None
    assert again.tip.velocity_mm_s is None
    assert again.curve is not None
    assert alone.curve is not None
    np.testing.assert_array_equal(again.curve.points_mm, alone.curve.points_mm)


def test_a_needle_that_leaps_is_found_and_the_leap_is_told() -> None:
    _, before, _ = sequence()[0]
    elsewhere = seen_at(with_needle(base_mm=(-22.0, -30.0, 238.0)), STEP_S)
    found = track_pair(elsewhere.pair, RIG, None, before)
    assert (found.status, found.reasons) == (Status.DEGRADED, (Reason.JUMP,))
    assert score(found, TrueShape.drawn(elsewhere.truth)).tip_mm == pytest.approx(0.0, abs=TIP_MM)
    # Once told, it is where the needle is.
    assert track_pair(elsewhere.pair, RIG, None, found).status is Status.OK


def test_a_track_that_holds_is_audited_once_in_a_few_pairs() -> None:
    track, since = tracked("dark"), []
    for _ in range(2 * PAIRS_PER_AUDIT):
        track = track_pair(scene("dark").pair, RIG, None, track)
        assert track.status is Status.OK
        since.append(track.since_detection)
    assert since == [*range(1, PAIRS_PER_AUDIT), 0] * 2


def test_a_track_that_is_weak_is_audited_sooner() -> None:
    strict = TrackingParameters.model_validate({"gates": {"max_reprojection_rms_px": 1e-6}})
    weak = track_pair(scene("dark").pair, RIG, strict)
    assert weak.status is Status.DEGRADED
    for number in range(1, PAIRS_PER_AUDIT_OF_WEAK + 1):
        weak = track_pair(scene("dark").pair, RIG, strict, weak)
        assert weak.since_detection == number % PAIRS_PER_AUDIT_OF_WEAK


def test_only_an_audit_that_is_good_itself_makes_a_weak_track_good_again() -> None:
    good = tracked("dark")
    weak = replace(good, status=Status.DEGRADED, reasons=(Reason.HIGH_RESIDUAL,))
    later = replace(scene("dark").pair, sequence=1)
    stamped = replace(
        later,
        left=replace(later.left, captured_at_ns=good.captured_at_ns + 33_000_000),
        right=replace(later.right, captured_at_ns=good.captured_at_ns + 33_000_000),
    )
    followed = follow(stamped, RIG, TrackingParameters(), weak)
    assert followed.reasons == (Reason.AMBIGUOUS_SHAPE,)
    # Audits of the pair before, which come a pair later.
    assert adopted(followed, good).status is Status.OK
    assert adopted(followed, weak).reasons == (Reason.AMBIGUOUS_SHAPE,)


def test_an_audit_that_ends_the_needle_elsewhere_is_gone_on_from() -> None:
    # Followed to 4 mm before its tip, along the same needle: the audit of the pair before comes a pair later.
    audited = tracked("dark")
    assert audited.curve is not None
    curve = audited.curve
    short = replace(
        audited,
        curve=NeedleCurve(
            curve.points_mm[:-4],
            curve.sigma_mm[:-4],
            curve.seen[:-4],
            curve.curvature_per_mm[:-4],
            curve.length_mm - 4.0,
        ),
        evidence=Evidence(),
    )
    now = replace(short, captured_at_ns=short.captured_at_ns + 33_000_000)
    assert adopted(now, audited, short) is audited
    # Where it confirms the end that was followed there, what has been followed since stands.
    assert adopted(now, short, short).curve is now.curve


def hidden(shown: Scene) -> StereoPair:
    """The same pair where the needle lies under something even: but for its noise there is background alone."""
    covered = seen_at(replace(WORLDS["dark"], needle=None))
    return replace(covered.pair, sequence=shown.pair.sequence)


def test_a_needle_that_is_hidden_moves_and_is_uncovered_is_found_again() -> None:
    elsewhere = seen_at(with_needle(base_mm=(-22.0, -30.0, 238.0)))
    track = tracked("dark")
    for _ in range(4):
        track = track_pair(hidden(scene("dark")), RIG, None, track)
        assert track.status is Status.INVALID
    for _ in range(3):
        track = track_pair(elsewhere.pair, RIG, None, track)
    assert track.status is Status.OK
    assert score(track, TrueShape.drawn(elsewhere.truth)).tip_mm == pytest.approx(0.0, abs=TIP_MM)


@pytest.mark.parametrize("diameter_mm", [0.9, 2.0])
def test_a_track_that_slid_onto_something_else_is_noticed_within_ten_pairs(diameter_mm: float) -> None:
    # As if it had slid: the shape that is followed is that of a rod, as thin as the needle or not.
    start_mm, end_mm = (-28.0, -30.0, 246.0), (-20.0, 25.0, 252.0)
    shown = seen_at(replace(WORLDS["dark"], rods=(Rod(start_mm, end_mm, diameter_mm),)))
    needle = tracked("dark")
    assert needle.curve is not None
    rod_mm = spline.resample(np.array([start_mm, end_mm]), len(needle.curve.points_mm))
    track = replace(needle, curve=replace(needle.curve, points_mm=rod_mm), since_detection=0)
    for number in range(1, 11):
        track = track_pair(replace(shown.pair, sequence=number), RIG, None, track)
    assert track.curve is not None
    is_the_needle = np.median(distance_from_curve(track.curve.points_mm, needle.curve.points_mm)) < 1.0
    # What is as thin as the needle may be it: then it is told that it is not the only one.
    assert is_the_needle or (diameter_mm == 0.9 and Reason.AMBIGUOUS_SHAPE in track.reasons)


def false_oks(seed: int, count: int) -> tuple[int, list[int]]:
    """Of a sequence at 30 pairs a second: how many tracks are ok, and the pairs at which that is wrong."""
    world, track, good, wrong = steered_fast(seed), None, 0, []
    for number, (pair, truth) in enumerate(world.pairs(30.0, count)):
        track = track_pair(pair, world.rig, None, track)
        good += track.status is Status.OK
        if score(track, TrueShape.drawn(truth)).false_ok:
            wrong.append(number)
    return good, wrong


def test_a_needle_that_moves_fast_is_not_good_where_a_glance_saw_it_badly() -> None:
    # Its tip was called good 1.0 to 1.3 mm off in four of these, where it was looked at once a pair.
    good, wrong = false_oks(12, 26)
    assert wrong == []
    assert good > 13


@pytest.mark.slow
def test_needles_that_move_fast_are_never_good_and_wrong() -> None:
    # Of 1920 such pairs, of 64 sequences, 1576 were ok, none of them wrong.
    found = [false_oks(seed, 20) for seed in range(100, 112)]
    assert [wrong for _, wrong in found if wrong] == []
    assert sum(good for good, _ in found) > 120


# The same input, the same output


def test_the_same_pair_gives_the_same_arrays() -> None:
    _, before, _ = sequence()[0]
    shown, followed, alone = sequence()[1]
    for previous, first in ((None, alone), (before, followed)):
        again = track_pair(shown.pair, RIG, None, previous)
        assert (again.status, again.reasons, again.quality) == (first.status, first.reasons, first.quality)
        assert again.curve is not None
        assert first.curve is not None
        for name in ("points_mm", "sigma_mm", "seen", "curvature_per_mm"):
            np.testing.assert_array_equal(getattr(again.curve, name), getattr(first.curve, name))
        assert again.tip is not None
        assert first.tip is not None
        np.testing.assert_array_equal(again.tip.position_mm, first.tip.position_mm)
        np.testing.assert_array_equal(again.tip.covariance_mm2, first.tip.covariance_mm2)


def test_a_notebook_needs_no_stamps() -> None:
    shown = scene("dark")
    found = track(*shown.images, RIG)
    assert found.captured_at_ns == 0
    assert found.curve is not None
    curve = tracked("dark").curve
    assert curve is not None
    np.testing.assert_array_equal(found.curve.points_mm, curve.points_mm)


@pytest.mark.parametrize("by_mm", [-6.0, -2.0, 2.0, 7.0])
def test_a_tip_that_leaps_between_two_pairs_is_found_where_it_is(by_mm: float) -> None:
    # Followed at a glance a tip is looked for within 3 mm of where it is expected: beyond, more is looked at.
    first = seen_at(with_needle(length_mm=Wave(64.0)))
    before = track_pair(first.pair, RIG)
    assert before.status is Status.OK
    shown = seen_at(with_needle(length_mm=Wave(64.0 + by_mm)))
    stamp_ns = before.captured_at_ns + 33_333_333
    pair = replace(
        shown.pair,
        left=replace(shown.pair.left, captured_at_ns=stamp_ns),
        right=replace(shown.pair.right, captured_at_ns=stamp_ns),
    )
    found = track_pair(pair, RIG, None, before)
    result = score(found, TrueShape.drawn(shown.truth))
    assert found.status is Status.OK, found.reasons
    assert result.tip_mm is not None
    assert result.tip_mm < TIP_MM


def faded(name: str, from_mm: float, gap_mm: float, shown_share: float) -> StereoPair:
    """A scene whose needle is gone for a stretch of its arc, and beyond it shown with a share of its contrast."""
    shown, empty = scene(name), seen_at(replace(WORLDS[name], needle=None))
    arc = spline.arc_length(shown.truth.centerline_mm)
    share = np.where(arc < from_mm, 1.0, np.where(arc < from_mm + gap_mm, 0.0, shown_share))
    frames = []
    for px, image, without in zip(RIG.project(shown.truth.centerline_mm), shown.images, empty.images, strict=True):
        rows, columns = np.indices(image.shape)
        nearest = KDTree(px).query(np.column_stack([columns.ravel(), rows.ravel()]))[1].reshape(image.shape)
        both = without + share[nearest] * (image.astype(np.float64) - without)
        frames.append(Frame(np.clip(np.rint(both), 0, 255).astype(np.uint8), 0))
    return StereoPair(frames[0], frames[1], 0)


@pytest.mark.parametrize("name", ["dark", "light"])
@pytest.mark.parametrize("share", [0.08, 0.15])
def test_a_needle_that_fades_does_not_end_where_it_fades(name: str, share: float) -> None:
    arc = spline.arc_length(scene(name).truth.centerline_mm)
    pair = faded(name, float(arc[-1]) - 25.0, 2.0, share)
    track = track_pair(pair, RIG)
    tip_mm = scene(name).truth.tip_mm
    assert track.tip is None or np.linalg.norm(track.tip.position_mm - tip_mm) < 0.5
    # And what is followed is told so by its audit.
    followed = follow(pair, RIG, TrackingParameters(), tracked(name))
    if followed.curve is not None:
        audited = audit(pair, RIG, TrackingParameters(), followed)
        assert audited.tip is None or np.linalg.norm(audited.tip.position_mm - tip_mm) < 0.5
