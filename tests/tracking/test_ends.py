"""Where a needle begins and ends along its curve: from signals of known ends, and from drawn needles."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter1d
from tests.tracking.scenes import ARC, PX_PER_MM, RIG, WORLDS, Scene, scene, seen_at

from needletrack.geometry import spline
from needletrack.records import Float
from needletrack.synthetic.tube import End
from needletrack.synthetic.world import World
from needletrack.tracking.axis import AxisObservations, AxisParameters, observe_axis
from needletrack.tracking.ends import EndsParameters, Observed, TipFit, base_end, find_tip, needle_stretch
from needletrack.tracking.needle import EntrySide

SPACING_MM = 0.4
N = 200
ARC_MM: Float = np.linspace(0.0, (N - 1) * SPACING_MM, N)
SMOOTHED_MM = AxisParameters().smooth_along_mm
PARAMETERS = EndsParameters()
Mask = npt.NDArray[np.bool_]
EVERYWHERE = np.ones(N, np.bool_)


def view(
    firm: Mask = EVERYWHERE, signal: Float | None = None, flank: Float | None = None, offset_px: Float | None = None
) -> AxisObservations:
    """What one view may show across a straight curve; flank (N,) or (2, N) grey levels."""
    center = np.column_stack([np.full(N, 300.0), ARC_MM * PX_PER_MM])
    normal = np.tile([-1.0, 0.0], (N, 1))
    # Noise departs from a background as well; a line is there or it is not.
    signals = np.stack([np.where(firm, 800.0, 10.0), np.where(firm, 800.0, 0.0)])
    if signal is not None:
        signals = np.stack([signal, signal])
    flanks = np.full((2, N), 200.0) if flank is None else np.broadcast_to(flank, (2, N)).copy()
    offset = np.zeros(N) if offset_px is None else offset_px
    return AxisObservations(
        center, normal, offset, np.where(firm, 0.1, np.inf), np.where(firm, 5.0, np.nan), firm, signals, flanks
    )


def between(start: int, stop: int) -> Mask:
    at = np.arange(N)
    return (at >= start) & (at < stop)


# The visible stretch


def test_the_stretch_is_what_both_views_show() -> None:
    shown = view(between(40, 150))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert (found.start, found.stop, found.sleeve) == (40, 150, None)


@pytest.mark.parametrize("seen_by_one", [0, 1])
def test_what_one_view_shows_is_the_needle_as_well(seen_by_one: int) -> None:
    both, one = view(between(40, 120)), view(between(40, 160))
    found = needle_stretch((one, both) if seen_by_one == 0 else (both, one), SPACING_MM, PARAMETERS)
    # A share of a half is asked to be there for 0.42 of a window of 4 mm: at its end it is seen 1.4 mm late.
    assert found.start == 40
    assert found.stop == pytest.approx(160, abs=1.4 / SPACING_MM)


@pytest.mark.parametrize(("gap_mm", "is_bridged"), [(4.0, True), (7.0, True), (9.0, False), (16.0, False)])
def test_gaps_are_bridged_up_to_their_greatest_length(gap_mm: float, is_bridged: bool) -> None:
    gap = round(gap_mm / SPACING_MM)
    shown = view(between(30, 160) & ~between(120, 120 + gap))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    # Next to a gap, the share of cross sections that show the needle falls to a half over 2 mm.
    assert found.start == 30
    assert found.stop == (160 if is_bridged else pytest.approx(120, abs=1))


def test_the_longer_of_two_stretches_is_the_needle() -> None:
    shown = view(between(5, 50) | between(100, 190))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert (found.start, found.stop) == (100, 190)


def test_accidents_are_no_needle() -> None:
    rng = np.random.default_rng(0)
    for density in (0.1, 0.25):
        views = [view(rng.random(N) < density, offset_px=rng.uniform(-2, 2, N)) for _ in range(2)]
        found = needle_stretch((views[0], views[1]), SPACING_MM, PARAMETERS)
        assert (found.stop - found.start) * SPACING_MM < 8.0
    # On both sides of a needle they do not lengthen it by more than a window.
    needle = between(60, 140)
    firm = needle | (rng.random(N) < 0.2)
    offsets = np.where(needle, 0.0, rng.uniform(-2, 2, N))
    found = needle_stretch((view(firm, offset_px=offsets), view(firm, offset_px=offsets)), SPACING_MM, PARAMETERS)
    assert (60 - found.start) * SPACING_MM < 4.0
    assert (found.stop - 140) * SPACING_MM < 4.0


def test_nothing_seen_is_an_empty_stretch() -> None:
    blind = view(np.zeros(N, np.bool_))
    found = needle_stretch((blind, blind), SPACING_MM, PARAMETERS)
    assert found.stop - found.start == 0
    assert found.sleeve is None


# The sleeve


def stepped(at: int, before: float = 40.0, after: float = 200.0) -> Float:
    """Grey levels (N,) beside the curve that change at an index, blurred as averaging along the needle does."""
    return np.asarray(gaussian_filter1d(np.where(np.arange(N) < at, before, after), SMOOTHED_MM / SPACING_MM))


@pytest.mark.parametrize("before", [40.0, 185.0, 255.0])
def test_the_needle_begins_where_the_flanks_of_both_views_change(before: float) -> None:
    shown = view(between(50, 160), flank=stepped(50, before))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert found.sleeve is not None
    assert found.sleeve.index == pytest.approx(50, abs=1)
    assert found.sleeve.step_gray == pytest.approx(abs(200.0 - before), rel=0.15)
    assert found.start == found.sleeve.index
    assert found.stop == 160


def test_what_shines_on_in_the_sleeve_is_cut_at_the_edge() -> None:
    # A highlight of the sleeve goes on in line with the needle, fainter than it.
    shown = view(between(20, 160), np.where(between(60, 160), 800.0, 200.0), stepped(60))
    assert needle_stretch((shown, shown), SPACING_MM, PARAMETERS).start == pytest.approx(60, abs=1)


def test_where_the_needle_goes_on_as_before_no_sleeve_begins() -> None:
    # Something wide and dark behind it, on whose edge it does not end.
    shown = view(between(20, 160), flank=stepped(60))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert found.sleeve is None
    assert (found.start, found.stop) == (20, 160)


def test_the_sleeve_may_stand_at_the_other_end() -> None:
    shown = view(between(40, 150), flank=stepped(150, 200.0, 40.0))
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert found.sleeve is not None
    assert found.start == 40
    assert found.stop == found.sleeve.index == pytest.approx(150, abs=1)


def test_a_hidden_stretch_beside_the_sleeve_belongs_to_the_needle() -> None:
    shown = view(between(80, 160), flank=stepped(50))
    assert needle_stretch((shown, shown), SPACING_MM, PARAMETERS).start == pytest.approx(50, abs=1)
    far = view(between(110, 190), flank=stepped(40))
    assert needle_stretch((far, far), SPACING_MM, PARAMETERS).start == 110


def crossed(at: int, length_mm: float, level: float = 40.0) -> Float:
    return np.where(between(at, at + round(length_mm / SPACING_MM)), level, 200.0)


@pytest.mark.parametrize(
    ("left_flank", "right_flank"),
    [
        (np.stack([stepped(50), np.full(N, 200.0)]), stepped(50)),
        (stepped(50), stepped(80)),
        (stepped(50, 196.0), stepped(50, 196.0)),
        (crossed(100, 3.0), crossed(100, 3.0)),
        (crossed(60, 3.0), crossed(90, 3.0)),
    ],
    ids=["one side", "two places", "too faint", "a rod across", "a vessel behind"],
)
def test_what_else_changes_beside_the_needle_is_no_sleeve(left_flank: Float, right_flank: Float) -> None:
    firm = between(30, 160)
    found = needle_stretch((view(firm, flank=left_flank), view(firm, flank=right_flank)), SPACING_MM, PARAMETERS)
    assert found.sleeve is None
    assert (found.start, found.stop) == (30, 160)


@pytest.mark.parametrize(
    "flank",
    [np.stack([stepped(50), np.full(N, 200.0)]), np.stack([stepped(50), stepped(50, 255.0)])],
    ids=["one side", "darker and brighter"],
)
def test_where_the_needle_ends_without_a_change_on_both_sides_is_no_sleeve(flank: Float) -> None:
    shown = view(between(50, 160), flank=flank)
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert found.sleeve is None
    assert (found.start, found.stop) == (50, 160)


def test_a_rod_across_does_not_hide_the_sleeve() -> None:
    flank = np.minimum(stepped(50, 60.0), crossed(110, 3.0, 20.0))
    shown = view(between(50, 170), flank=flank)
    found = needle_stretch((shown, shown), SPACING_MM, PARAMETERS)
    assert found.sleeve is not None
    assert found.start == pytest.approx(50, abs=1)


# The tip

TRUE_TIP_MM = 61.23
HEIGHT_GRAY_PX = 800.0
LENS_BLUR_MM = 0.9 / PX_PER_MM


def tip_signal(taper_mm: float, noise: float, rng: np.random.Generator, tip_mm: float = TRUE_TIP_MM) -> Float:
    """How much of the needle is there (N,): all of it, nothing beyond the apex, a line in between, blurred; noisy."""
    fine = np.linspace(0.0, ARC_MM[-1], 20 * (N - 1) + 1)
    ramp = np.clip((tip_mm - fine) / taper_mm, 0, 1)
    blurred = gaussian_filter1d(ramp, np.hypot(SMOOTHED_MM, LENS_BLUR_MM) / (fine[1] - fine[0]))[::20]
    # The noise of neighbours is alike over the length that was averaged.
    alike = gaussian_filter1d(rng.normal(size=N), SMOOTHED_MM / SPACING_MM)
    return np.asarray(HEIGHT_GRAY_PX * blurred + 15.0 + noise * alike / alike.std())


def tip_of(left: Float, right: Float, rough_mm: float = TRUE_TIP_MM, flank: Float | None = None) -> TipFit:
    views = (view(signal=left, flank=flank), view(signal=right, flank=flank))
    return find_tip(views, ARC_MM, rough_mm, SMOOTHED_MM, PARAMETERS)


@pytest.mark.parametrize("taper_mm", [0.2, 0.4, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("rough_mm", [-1.2, 0.0, 1.0])
def test_the_apex_is_where_the_signal_reaches_zero(taper_mm: float, rough_mm: float) -> None:
    rng = np.random.default_rng(0)
    clean = tip_signal(taper_mm, 1e-3, rng)
    found = tip_of(clean, clean, TRUE_TIP_MM + rough_mm)
    # Tips are tried every 0.05 mm; samples 0.4 mm apart and a slightly other blur than assumed move the best of them.
    assert found.at_mm == pytest.approx(TRUE_TIP_MM, abs=0.15)
    assert found.taper_mm == pytest.approx(taper_mm, abs=0.5)
    assert found.is_free


@pytest.mark.parametrize("taper_mm", [0.4, 2.5])
@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_the_tips_sigma_covers_its_scatter(taper_mm: float, noise: float) -> None:
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        found = tip_of(tip_signal(taper_mm, noise, rng), tip_signal(taper_mm, noise, rng))
        errors.append((found.at_mm - TRUE_TIP_MM) / max(found.sigma_mm))
    # Two in three within one sigma would be 27 of 40; what is stated includes the doubt about the taper.
    assert np.mean(np.abs(errors) < 2.0) > 0.9
    assert abs(np.mean(errors)) < 1.0


def test_each_view_places_its_own_tip() -> None:
    rng = np.random.default_rng(2)
    found = tip_of(tip_signal(0.4, 2.0, rng), tip_signal(0.4, 2.0, rng, TRUE_TIP_MM + 0.8))
    assert found.each_mm[0] == pytest.approx(TRUE_TIP_MM, abs=0.15)
    assert found.each_mm[1] == pytest.approx(TRUE_TIP_MM + 0.8, abs=0.15)
    assert found.each_mm[0] <= found.at_mm <= found.each_mm[1]


def test_without_an_end_there_is_no_contrast() -> None:
    rng = np.random.default_rng(3)
    end = tip_signal(0.4, 4.0, rng)
    goes_on = np.full(N, HEIGHT_GRAY_PX) + 40.0 * rng.normal(size=N)
    fades = HEIGHT_GRAY_PX * np.linspace(1.0, 0.0, N) + 40.0 * rng.normal(size=N)
    assert min(tip_of(end, end).contrast) > 60.0
    for other in (goes_on, fades):
        assert tip_of(end, other).contrast[1] < 15.0


def test_something_that_begins_beside_the_tip_may_hide_the_rest() -> None:
    rng = np.random.default_rng(4)
    signal = tip_signal(0.4, 2.0, rng)
    at = round(TRUE_TIP_MM / SPACING_MM)
    assert tip_of(signal, signal).is_free
    assert not tip_of(signal, signal, flank=crossed(at, 4.0, 120.0)).is_free
    assert tip_of(signal, signal, flank=crossed(at - 40, 4.0, 120.0)).is_free


def extended(shown: Scene, beyond_mm: float = 8.0) -> tuple[Float, float, float]:
    """The drawn needle's curve, straight on beyond both ends, and where on it the needle begins and ends, mm."""
    truth = shown.truth
    ahead = np.arange(1, round(beyond_mm / 0.1) + 1)[:, None] * 0.1
    whole = np.concatenate(
        [
            truth.centerline_mm[0] - ahead[::-1] * truth.tangents[0],
            truth.centerline_mm,
            truth.tip_mm + ahead * truth.tip_direction,
        ]
    )
    length_mm = float(spline.arc_length(truth.centerline_mm)[-1])
    start_mm = float(len(ahead) * 0.1)
    return spline.resample(whole, round((length_mm + 2 * start_mm) / SPACING_MM) + 1), start_mm, start_mm + length_mm


def observed(shown: Scene, points_mm: Float, diameter_mm: float) -> Observed:
    views = []
    for image, camera, local in zip(
        shown.images, (RIG.left, RIG.right), (points_mm, RIG.right_from_left.apply(points_mm)), strict=True
    ):
        px_per_mm = camera.focal_px / local[:, 2]
        views.append(
            observe_axis(image, camera, local, 1.7 * px_per_mm.max(), diameter_mm * px_per_mm, AxisParameters())
        )
    return views[0], views[1]


def drawn_tip(world: World) -> tuple[TipFit, float]:
    """The tip found on a drawn needle, and how far beyond the true one it lies along it, mm."""
    shown = seen_at(world)
    points_mm, _, tip_mm = extended(shown)
    assert world.needle is not None
    views = observed(shown, points_mm, world.needle.diameter_mm)
    found = find_tip(views, spline.arc_length(points_mm), tip_mm - 0.7, SMOOTHED_MM, PARAMETERS)
    return found, found.at_mm - tip_mm


@pytest.mark.parametrize("tip", [End.CONE, End.ROUND])
@pytest.mark.parametrize("depth_slope", [-0.5, 0.0, 0.5])
def test_a_drawn_tip_is_found(tip: End, depth_slope: float) -> None:
    needle = replace(ARC, tip=tip, direction=(0.12, 1.0, depth_slope), length_mm=ARC.length_mm)
    found, beyond_mm = drawn_tip(replace(WORLDS["dark"], needle=needle))
    # A cone's thin end falls below the noise, and tapers of 2, 2.5 and 3 mm are hardly told apart: 0.1 mm. A ball of
    # 0.45 mm that is turned by 27 degrees towards or from a camera reaches r (1 / cos - 1) = 0.05 mm further in its
    # picture than its apex, and what is half a ball is no straight ramp: 0.15 mm.
    assert abs(beyond_mm) < (0.1 if tip is End.CONE else 0.2)
    assert abs(beyond_mm) < 3 * max(found.sigma_mm)
    assert found.is_free
    assert min(found.contrast) > 15.0


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_drawn_sleeves_edge_is_the_base(name: str) -> None:
    shown = scene(name)
    points_mm, base_mm, tip_mm = extended(shown)
    found = needle_stretch(observed(shown, points_mm, ARC.diameter_mm), SPACING_MM, PARAMETERS)
    assert found.sleeve is not None
    # It faces away from the cameras: its rim, 2.5 mm off the axis, hides 2.5 mm times the slope of 0.12 or, for the
    # right camera, 0.25; the edge is found to one spacing, where it is blurred over 0.5 mm.
    assert -0.5 < found.start * SPACING_MM - base_mm < 2.5 * 0.25 + 0.5
    # The rough end lies beyond the tip as far as blur and averaging carry the needle's signal: two of their sigmas.
    assert -1.0 < found.stop * SPACING_MM - tip_mm < 2 * np.hypot(SMOOTHED_MM, LENS_BLUR_MM) + SPACING_MM


# Base and tip without a sleeve

ENDS_MM = np.array([[-30.0, -20.0, 250.0], [20.0, 35.0, 250.0]])
LINE_MM = ENDS_MM[0] + np.linspace(0, 1, 50)[:, None] * (ENDS_MM[1] - ENDS_MM[0])


@pytest.mark.parametrize(("side", "end"), [("left", 0), ("top", 0), ("right", -1), ("bottom", -1), ("none", None)])
def test_the_entry_side_tells_base_from_tip(side: EntrySide, end: int | None) -> None:
    assert base_end(LINE_MM, RIG, side, None) == end
    turned = {0: -1, -1: 0, None: None}[end]
    assert base_end(LINE_MM[::-1], RIG, side, None) == turned


def test_the_base_is_where_it_was() -> None:
    assert base_end(LINE_MM, RIG, "none", ENDS_MM[0] + 2.0) == 0
    assert base_end(LINE_MM, RIG, "none", ENDS_MM[1] - 2.0) == -1
    # Where it was has more to say than the side of the image.
    assert base_end(LINE_MM, RIG, "left", ENDS_MM[1] - 2.0) == -1


def test_a_base_that_was_elsewhere_says_nothing() -> None:
    far = ENDS_MM[0] - [40.0, 0.0, 0.0]
    assert base_end(LINE_MM, RIG, "none", far) is None
    assert base_end(LINE_MM, RIG, "right", far) == -1
    # Both ends of a short needle are near to it.
    short = LINE_MM[:4]
    assert base_end(short, RIG, "none", short[0]) is None
