"""Where one view puts the axis of a straight needle whose picture is drawn exactly, whatever its inside shows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.tracking.sections import CAMERA, DEPTH_MM, LENS_BLUR_PX, PX_PER_MM, Look, line_mm, picture

from needletrack.records import Appearance, Float
from needletrack.tracking.evidence import BLURS, HALF_WIDTHS, NEAR, OFFSETS, WIDE, Grid
from needletrack.tracking.needle import Needle
from needletrack.tracking.silhouette import (
    AxisEvidence,
    Sections,
    axis_evidence,
    cut_sections,
    diameter_mm,
    estimate_appearance,
    unit_mm,
)

NEEDLE = Needle()
UNIT_PX = unit_mm(NEEDLE) * PX_PER_MM
DARK, BRIGHT, STEEL = Look(200.0, 200.0, 35.0), Look(50.0, 50.0, 235.0), Look(115.0, 115.0, 55.0)
COUNT = 50
SPREADS = (0.7, 0.5, 0.4)


def sections(look: Look, wide_mm: float = 0.9, aside_mm: float = 0.0, seed: int = 0) -> Sections:
    """Sections across a line beside the needle, or on it."""
    image = picture(look, wide_mm, np.random.default_rng(seed))
    return cut_sections(image, CAMERA, line_mm(COUNT, aside_mm), NEEDLE)


def evidence(cut: Sections, appearance: Appearance, grid: Grid = WIDE) -> AxisEvidence:
    return axis_evidence(cut, appearance, np.full(COUNT, appearance.half_width), grid)


def common_offset_px(view: AxisEvidence) -> tuple[float, float]:
    """The offset that all sections of a straight line have in common, found as `adjust` does, and one's sigma."""
    at = view.likeliest_path_px()
    offset, sigma = 0.0, np.inf
    for spread in SPREADS:
        seen, _ = view.offsets(at, spread)
        assert seen.seen.any()
        offset = float(np.average(seen.offset_px[seen.seen], weights=seen.sigma_px[seen.seen] ** -2.0))
        sigma = float(np.median(seen.sigma_px[seen.seen]))
        at = np.full(COUNT, offset)
    return offset, sigma


# The noise of 1.8 grey levels at an edge of 165, blurred over 0.8 px, moves it by 1.8 * 0.8 * sqrt(2 pi) / 165 px =
# 0.022 px; the mean of five rows, of two edges and of 50 sections by a twentieth of that. What is left is how the
# image is interpolated, and the evidence between its shifts of a quarter of a pixel and more.
PLAIN_PX = 0.03


@pytest.mark.parametrize("look", [DARK, BRIGHT, STEEL], ids=["dark", "bright", "dull steel"])
@pytest.mark.parametrize("wide_mm", [0.7, 1.1])
@pytest.mark.parametrize("aside_mm", [-0.15, 0.0, 0.1])
def test_the_axis_is_found_from_a_line_beside_it(look: Look, wide_mm: float, aside_mm: float) -> None:
    cut = sections(look, wide_mm, aside_mm)
    found = estimate_appearance((cut, cut), NEEDLE, None, WIDE)
    offset_px, sigma_px = common_offset_px(evidence(cut, found))
    # The normal points to the left of what runs down the image.
    across = PX_PER_MM / np.hypot(1.0, 0.12)
    assert offset_px == pytest.approx(aside_mm * across, abs=PLAIN_PX)
    assert sigma_px < 0.2


@pytest.mark.parametrize("look", [DARK, BRIGHT, STEEL], ids=["dark", "bright", "dull steel"])
@pytest.mark.parametrize("wide_mm", [0.6, 0.75, 0.9, 1.2])
def test_diameter_and_blur_are_those_of_the_needle(look: Look, wide_mm: float) -> None:
    cut = sections(look, wide_mm)
    found = estimate_appearance((cut, cut), NEEDLE, None, WIDE)
    # Widths are 4 % apart, and what is a bit too narrow is made up for by a bit more blur.
    assert diameter_mm(found, NEEDLE) == pytest.approx(wide_mm, rel=0.085)
    # Blurs are a quarter apart.
    assert BLURS[found.blur] * UNIT_PX == pytest.approx(LENS_BLUR_PX, rel=0.35)
    # From what it was before, a little off, it is found again.
    before = Appearance(found.half_width + 2, max(0, found.blur - 1), 1 - found.inside)
    assert estimate_appearance((cut, cut), NEEDLE, before, WIDE) == found


@cache
def streaked_bias_px(streak: float) -> tuple[tuple[float, float], ...]:
    """(place, bias) for a streak at each place across a needle of 0.9 mm, whose appearance has to be found as well."""
    biases = []
    for place in PLACES:
        cut = sections(Look(115.0, 115.0, 55.0, streak, place))
        found = estimate_appearance((cut, cut), NEEDLE, None, WIDE)
        biases.append((place, common_offset_px(evidence(cut, found))[0]))
    return tuple(biases)


PLACES = (-0.9, -0.75, -0.6, -0.3, 0.0, 0.45, 0.6, 0.75, 0.9)


# A needle of 5 px whose streak is at a share of its half width: the middle of the light is up to 2.3 px off the axis,
# and what tells edges by their steps is pulled by up to 0.65 px. A streak of 0.8 px shows half of its height through
# the lens. Of 50 it only dulls an edge; of 110 it is about as bright as the background: at the rim it takes one edge
# away and leaves what looks like a narrower needle; brighter ones have edges of their own. Measured are 0.25, 0.76,
# 0.27 and 0.33 px.
@pytest.mark.parametrize(("streak", "most_px"), [(50.0, 0.3), (110.0, 0.85), (170.0, 0.33), (240.0, 0.4)])
def test_the_bias_of_the_axis_is_small_wherever_the_streak_lies(streak: float, most_px: float) -> None:
    biases = streaked_bias_px(streak)
    assert max(abs(bias) for _, bias in biases) < most_px, biases
    # Over all places it cancels, and within the middle of the needle there is hardly any.
    assert abs(np.mean([bias for _, bias in biases])) < 0.1
    assert max(abs(bias) for place, bias in biases if abs(place) < 0.5) < 0.12, biases


@pytest.mark.parametrize("by_px", [-1.2, 0.8])
def test_the_likeliest_path_follows_an_axis_that_turns_aside(by_px: float) -> None:
    # The line is beside the needle at its ends, by as much on one side as on the other.
    along = np.linspace(-1.0, 1.0, COUNT)
    image = picture(DARK, 0.9, np.random.default_rng(0))
    skewed = line_mm(COUNT)
    skewed[:, 0] += by_px / PX_PER_MM * along
    cut = cut_sections(image, CAMERA, skewed, NEEDLE)
    found = estimate_appearance((cut, cut), NEEDLE, None, WIDE)
    path_px = evidence(cut, found).likeliest_path_px()
    # Half a shift of the grid, which is a quarter of a unit.
    np.testing.assert_allclose(path_px, by_px * along, atol=0.5 * 0.25 * UNIT_PX + 0.06)


def test_the_likeliest_path_stays_on_the_needle_where_it_is_hidden() -> None:
    image = picture(DARK, 0.9, np.random.default_rng(0))
    image[180:220] = 200
    cut = cut_sections(image, CAMERA, line_mm(COUNT, 0.1), NEEDLE)
    found = estimate_appearance((cut, cut), NEEDLE, None, WIDE)
    assert np.abs(evidence(cut, found).likeliest_path_px() - 0.1 * PX_PER_MM).max() < 0.25 * UNIT_PX + 0.06


@pytest.mark.parametrize("by_px", [-2.5, 0.0, 2.0])
@pytest.mark.parametrize("drift_px", [-2.0, 0.0, 1.5])
def test_a_motion_as_a_whole_is_found_past_what_leads_aside(by_px: float, drift_px: float) -> None:
    along = np.linspace(-0.5, 0.5, COUNT)
    moved = line_mm(COUNT)
    moved[:, 0] += (by_px + drift_px * along) / PX_PER_MM
    image = picture(DARK, 0.9, np.random.default_rng(0))
    # A dark line crosses at the end of the needle.
    v, u = np.indices(image.shape)
    image[(np.abs(u - 60 - 0.5 * (v - 330)) < 3) & (v > 330)] = 35
    cut = cut_sections(image, CAMERA, moved, NEEDLE)
    found = Appearance(16, 2, 0)
    motion_px = evidence(cut, found).likeliest_motion_px()
    # A shift of the grid, half a step of what is tried of drifts, and what the slope of the line makes of a pixel.
    np.testing.assert_allclose(motion_px, by_px + drift_px * along, atol=(0.25 + 0.25) * UNIT_PX + 0.1)


def test_what_is_before_clutter_counts_for_less_where_a_streak_leads() -> None:
    image = picture(STEEL, 0.9, np.random.default_rng(0))
    v, u = np.indices(image.shape)
    from_needle = u - (80 + 0.12 * (v - 200))
    image[(np.abs(from_needle - 9) < 3) & (v > 200)] = 100
    cut = cut_sections(image, CAMERA, line_mm(COUNT), NEEDLE)
    found = Appearance(16, 2, 0)
    half_widths = np.full(COUNT, found.half_width)
    alone, led = (
        replace(axis_evidence(cut, found, half_widths, NEAR), shines=np.full(COUNT, shines)).offsets(
            np.zeros(COUNT), 0.4
        )[0]
        for shines in (False, True)
    )
    seen = alone.seen & led.seen
    ratio = led.sigma_px[seen] / alone.sigma_px[seen]
    even = np.arange(COUNT)[seen] < COUNT // 2 - 3
    np.testing.assert_allclose(ratio[even], 1.0)
    assert np.median(ratio[np.arange(COUNT)[seen] > COUNT // 2 + 3]) == 2.0


def expected(view: AxisEvidence, at_px: float = 0.0) -> Float:
    return view.offsets(np.full(COUNT, at_px), SPREADS[-1])[1]


@pytest.mark.parametrize("look", [DARK, BRIGHT, STEEL], ids=["dark", "bright", "dull steel"])
def test_support_is_high_on_a_needle_and_negative_beside_it(look: Look) -> None:
    on = sections(look)
    found = estimate_appearance((on, on), NEEDLE, None, WIDE)
    view = evidence(on, found)
    shown = expected(view)[on.inside]
    assert on.inside.sum() > 0.9 * COUNT
    # A log Bayes factor of 15: three million to one, in each section.
    assert shown.min() > 15.0
    # Expected half its width beside where it is, it is there no more, nor along a line 4 mm beside it.
    assert np.median(expected(view, 0.45 * PX_PER_MM)) < np.median(shown) - 10.0
    for aside_mm in (-4.0, 4.0):
        beside = sections(look, aside_mm=aside_mm)
        assert np.median(expected(evidence(beside, found))) < 0.0
        assert not evidence(beside, found).offsets(np.zeros(COUNT), 0.4)[0].seen.any()


def test_what_is_outside_the_image_or_too_thin_is_not_seen() -> None:
    image = picture(DARK, 0.9, np.random.default_rng(0))
    found = Appearance(16, 2, 0)
    local_mm = line_mm(COUNT) * [1.0, 1.3, 1.0]
    local_mm[:, 0] = 0.12 * local_mm[:, 1]
    cut = cut_sections(image, CAMERA, local_mm, NEEDLE)
    out = ~CAMERA.contains(CAMERA.project(local_mm))
    assert out.any()
    view = evidence(cut, found)
    assert np.isneginf(expected(view)[out]).all()
    assert not view.offsets(np.zeros(COUNT), 0.4)[0].seen[out].any()
    half_widths = np.where(np.arange(COUNT) < 10, -1, found.half_width)
    thin = axis_evidence(cut, found, half_widths, NEAR)
    seen = thin.offsets(np.zeros(COUNT), 0.4)[0].seen
    assert not seen[:10].any()
    assert seen[15:35].all()


def test_sections_are_in_units_of_the_thickest_needle() -> None:
    cut = sections(DARK)
    np.testing.assert_allclose(cut.px_per_unit, UNIT_PX)
    assert unit_mm(NEEDLE) == pytest.approx(NEEDLE.max_diameter_mm / 6)
    assert CAMERA.focal_px * unit_mm(NEEDLE) / DEPTH_MM == pytest.approx(UNIT_PX)
    # Edges are where half of the step is; samples are half a unit apart.
    middle = np.median(cut.values[cut.inside], axis=0)
    half = (middle.min() + middle.max()) / 2
    assert np.ptp(OFFSETS[middle < half]) == pytest.approx(0.9 / unit_mm(NEEDLE), abs=0.51)
    assert HALF_WIDTHS[0] * unit_mm(NEEDLE) * 2 < NEEDLE.min_diameter_mm
