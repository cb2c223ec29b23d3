"""Cross sections of known edges: an ideal needle under a Gaussian blur, with streak, noise, tilt and clutter."""

import numpy as np
import pytest
from scipy.special import ndtr

from needletrack.records import Float
from needletrack.tracking.profile import (
    Silhouette,
    departure_area,
    find_line,
    find_silhouette,
    flanks,
    noise_gray,
)

OFFSETS: Float = np.linspace(-14.0, 14.0, 57)
ROWS = 60
WIDTH_PX = 5.0
LIMIT_PX = WIDTH_PX / 2 + 2.0
BLUR_PX = 1.0
BACKGROUND = 150.0
THRESHOLD = 3.0


def band(low_px: float, high_px: float, blur_px: float = BLUR_PX) -> Float:
    """A band from one offset to the other under the blur, 0 .. 1, at every offset of the strip (M,)."""
    return np.asarray(ndtr((OFFSETS - low_px) / blur_px) - ndtr((OFFSETS - high_px) / blur_px))


def needle(contrast: float, middle_px: float = 0.0, width_px: float = WIDTH_PX, blur_px: float = BLUR_PX) -> Float:
    """Grey levels (ROWS, M) of a plain needle."""
    profile = BACKGROUND + contrast * band(middle_px - width_px / 2, middle_px + width_px / 2, blur_px)
    return np.tile(profile, (ROWS, 1))


def noisy(strip: Float, sigma: float, seed: int = 0) -> Float:
    return np.asarray(strip + np.random.default_rng(seed).normal(0.0, sigma, strip.shape))


def silhouette_of(strip: Float, threshold_gray: float = THRESHOLD) -> Silhouette:
    return find_silhouette(strip, OFFSETS, LIMIT_PX, threshold_gray)


@pytest.mark.parametrize("sigma", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("contrast", [0.0, -110.0])
def test_noise_is_told_whatever_the_needle(sigma: float, contrast: float) -> None:
    rim = 2 * 5 * (ROWS - 2)
    found = [noise_gray(noisy(needle(contrast), sigma, seed)) for seed in range(20)]
    # The mean absolute second difference of n values, each pixel in three of them, is known to about 1 / sqrt(n / 3).
    assert np.mean(found) == pytest.approx(sigma, rel=0.05)
    assert np.std(found) / sigma < 3 / np.sqrt(rim / 3)


def test_noise_beside_the_needle_ignores_a_slope_and_has_a_floor() -> None:
    slope = np.linspace(0.0, 80.0, ROWS)[:, None]
    assert noise_gray(noisy(needle(0.0) + slope, 2.0)) == pytest.approx(2.0, rel=0.2)
    assert noise_gray(needle(0.0)) == 0.3


@pytest.mark.parametrize("middle_px", [-1.5, -0.3, 0.0, 0.45, 1.2])
@pytest.mark.parametrize("contrast", [-110.0, 80.0])
def test_edges_are_where_half_the_step_is(contrast: float, middle_px: float) -> None:
    low, high = silhouette_of(needle(contrast, middle_px)).edges_px
    # The blur of both edges lowers the middle by 2 ndtr(-2.5) of the contrast, and with it the half height: 0.02 px.
    # A straight line between samples 0.5 px apart is off the error function by less than 0.01 px.
    np.testing.assert_allclose(low, middle_px - WIDTH_PX / 2, atol=0.03)
    np.testing.assert_allclose(high, middle_px + WIDTH_PX / 2, atol=0.03)
    np.testing.assert_allclose((low + high) / 2, middle_px, atol=0.01)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_edges_scatter_as_the_noise_says(sigma: float) -> None:
    contrast = -110.0
    strip = noisy(needle(contrast), sigma)
    low, high = silhouette_of(strip).edges_px
    # Of a step of height h under a blur b the slope is h / (b sqrt(2 pi)): that turns a level's noise into pixels. The
    # half height itself is off by half of what background and extremum are, together about as much again.
    expected = sigma * BLUR_PX * np.sqrt(2 * np.pi) / abs(contrast)
    for edge, true in ((low, -WIDTH_PX / 2), (high, WIDTH_PX / 2)):
        assert np.isfinite(edge).mean() > 0.9
        assert np.nanstd(edge) < 2.0 * expected
        assert abs(np.nanmean(edge) - true) < 0.03 + 4 * expected / np.sqrt(ROWS)


def with_streak(streak_px: float) -> Float:
    """Dark steel with a streak, 0.8 px wide, that is as bright over its background as the steel is dark."""
    return needle(-80.0) + 160.0 * band(streak_px - 0.4, streak_px + 0.4)


@pytest.mark.parametrize("streak_px", [-0.8, -0.4, 0.0, 0.4, 0.8])
def test_a_streak_inside_has_no_say(streak_px: float) -> None:
    low, high = silhouette_of(with_streak(streak_px)).edges_px
    # The streak's blur covers the inner side of the rims beside it; the nearer rim loses more. What is left of a rim is
    # its outer blur, whose half height lies further out, by less than the blur itself; the axis moves by half of that.
    assert np.abs(low + WIDTH_PX / 2).max() < BLUR_PX
    assert np.abs(high - WIDTH_PX / 2).max() < BLUR_PX
    assert np.abs((low + high) / 2).max() < 0.5 * BLUR_PX
    if streak_px == 0.0:
        np.testing.assert_allclose((low + high) / 2, 0.0, atol=0.01)


@pytest.mark.parametrize("streak_px", [0.0, 0.4, 0.8])
def test_an_edge_beside_a_streak_owns_up_to_it(streak_px: float) -> None:
    # Brighter than the background by half of what the steel is darker: the rims' edges lie outside the needle's.
    streak = silhouette_of(needle(-80.0) + 400.0 * band(streak_px - 0.4, streak_px + 0.4))
    for edge_px, sigma_px, true_px in zip(streak.edges_px, streak.sigma_px, (-WIDTH_PX / 2, WIDTH_PX / 2), strict=True):
        assert np.abs(edge_px - true_px).max() < 2 * np.median(sigma_px)
    assert silhouette_of(needle(-80.0)).sigma_px.max() < 0.1


@pytest.mark.parametrize("streak_px", [-1.2, 1.2])
def test_a_streak_that_swallows_a_rim_shows_by_the_width(streak_px: float) -> None:
    # The rim is narrower than the blur: what is left of it is a shoulder, and the edge found lies behind the streak.
    low, high = silhouette_of(with_streak(streak_px)).edges_px
    far = high if streak_px < 0 else -low
    np.testing.assert_allclose(far, WIDTH_PX / 2, atol=0.5 * BLUR_PX)
    # Narrower than the needle by more than any blur explains: so it is told from a pair of edges.
    assert ((high - low) < WIDTH_PX - 0.6).all()


def test_a_background_without_a_needle_has_no_edges() -> None:
    assert np.isnan(silhouette_of(needle(0.0)).edges_px).all()
    # Of a hundred cross sections of pure noise at a third of the threshold, hardly one departs from it.
    assert np.isfinite(silhouette_of(noisy(needle(0.0), THRESHOLD / 5)).edges_px).mean() < 0.05


def test_a_tilted_background_does_not_move_the_edges() -> None:
    # Uneven light, by 0.5 grey levels a pixel, beside a faint needle: left in, it would be 3 grey levels from the edge
    # to the middle of the band beyond it, a tenth of the needle's height and of an edge's 3 px.
    for tilt in (-0.5, 0.5):
        low, high = silhouette_of(needle(-30.0) + tilt * OFFSETS).edges_px
        np.testing.assert_allclose(low, -WIDTH_PX / 2, atol=0.06)
        np.testing.assert_allclose(high, WIDTH_PX / 2, atol=0.06)


def test_clutter_on_one_side_is_told_by_its_sigma() -> None:
    strip = noisy(needle(-60.0), 0.5)
    clutter = (OFFSETS > LIMIT_PX + 2) & (OFFSETS < LIMIT_PX + 4)
    strip[:, clutter] += np.random.default_rng(1).normal(0.0, 30.0, clutter.sum())
    sigma_low, sigma_high = silhouette_of(strip).sigma_px
    assert np.median(sigma_high) > 5 * np.median(sigma_low)


def test_an_edge_that_leaps_from_its_neighbours_is_a_stray() -> None:
    strip = needle(-110.0)
    strip[20] = needle(-110.0, middle_px=1.2)[0]
    low, high = silhouette_of(strip).edges_px
    assert np.isnan([low[20], high[20]]).all()
    assert np.isfinite(np.delete(low, 20)).all()


@pytest.mark.parametrize("contrast", [-40.0, 60.0])
@pytest.mark.parametrize("middle_px", [-1.3, 0.0, 0.8])
def test_a_line_has_its_middle_width_and_height(contrast: float, middle_px: float) -> None:
    line = find_line(needle(contrast, middle_px), OFFSETS, WIDTH_PX, 2.0, 8.0)
    assert line.found.all()
    np.testing.assert_allclose(line.middle_px, middle_px, atol=0.05)
    np.testing.assert_allclose(line.width_px, WIDTH_PX, atol=0.1)
    # The blur of both edges takes 2 ndtr(-2.5) = 1.2 % of it.
    np.testing.assert_allclose(line.height_gray, abs(contrast), rtol=0.02)


def test_a_line_stands_out_from_both_its_sides() -> None:
    step = np.tile(BACKGROUND - 110.0 * ndtr(OFFSETS / BLUR_PX), (ROWS, 1))
    assert not find_line(step, OFFSETS, WIDTH_PX, 2.0, 8.0).found.any()
    # Out of reach: beyond the search range.
    assert not find_line(needle(-110.0, 6.0), OFFSETS, WIDTH_PX, 2.0, 8.0).found.any()
    # Too faint.
    assert not find_line(needle(-7.0), OFFSETS, WIDTH_PX, 2.0, 8.0).found.any()
    assert find_line(needle(-9.0), OFFSETS, WIDTH_PX, 2.0, 8.0).found.all()


def test_the_stronger_of_two_lines_is_taken() -> None:
    strip = needle(0.0) + 90.0 * band(-1.7, -0.3, 0.6) - 40.0 * band(0.6, 2.0, 0.6)
    line = find_line(strip, OFFSETS, WIDTH_PX, 2.0, 8.0)
    np.testing.assert_allclose(line.middle_px, -1.0, atol=0.3)


def test_flanks_are_the_levels_close_beside() -> None:
    strip = needle(-110.0) + np.where(OFFSETS > 0, 20.0, 0.0)
    low, high = flanks(strip, OFFSETS, WIDTH_PX)
    # Two pixels off an edge of 1 px blur, 2 % of its height are left at most.
    np.testing.assert_allclose(low, BACKGROUND, atol=3.0)
    np.testing.assert_allclose(high, BACKGROUND + 20.0, atol=3.0)


@pytest.mark.parametrize("contrast", [-110.0, 80.0])
def test_the_area_is_width_times_contrast(contrast: float) -> None:
    strip = needle(contrast)
    level = np.full((2, ROWS), BACKGROUND)
    area = departure_area(strip, OFFSETS, level, WIDTH_PX)
    # What the blur spreads further than 1.5 px beyond an edge is 0.06 of a pixel of blur.
    np.testing.assert_allclose(area, abs(contrast) * WIDTH_PX, rtol=0.03)
    np.testing.assert_allclose(departure_area(needle(0.0), OFFSETS, level, WIDTH_PX), 0.0, atol=1e-9)
    tilted = strip + 0.4 * OFFSETS
    ends = BACKGROUND + 0.4 * OFFSETS[[0, -1]]
    same = departure_area(tilted, OFFSETS, np.tile(ends[:, None], ROWS), WIDTH_PX)
    np.testing.assert_allclose(same, area, rtol=1e-9)
