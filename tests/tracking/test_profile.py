"""Cross sections of known edges: an ideal needle under a Gaussian blur, with noise."""

import numpy as np
import pytest
from scipy.special import ndtr

from needletrack.records import Float
from needletrack.tracking.profile import find_line, flanks, noise_gray

OFFSETS: Float = np.linspace(-14.0, 14.0, 57)
ROWS = 60
WIDTH_PX = 5.0
BLUR_PX = 1.0
BACKGROUND = 150.0


def band(low_px: float, high_px: float, blur_px: float = BLUR_PX) -> Float:
    """A band from one offset to the other under the blur, 0 .. 1, at every offset of the strip (M,)."""
    return np.asarray(ndtr((OFFSETS - low_px) / blur_px) - ndtr((OFFSETS - high_px) / blur_px))


def needle(contrast: float, middle_px: float = 0.0, width_px: float = WIDTH_PX, blur_px: float = BLUR_PX) -> Float:
    """Grey levels (ROWS, M) of a plain needle."""
    profile = BACKGROUND + contrast * band(middle_px - width_px / 2, middle_px + width_px / 2, blur_px)
    return np.tile(profile, (ROWS, 1))


def noisy(strip: Float, sigma: float, seed: int = 0) -> Float:
    return np.asarray(strip + np.random.default_rng(seed).normal(0.0, sigma, strip.shape))


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


def with_streak(streak_px: float) -> Float:
    """Dark steel with a streak, 0.8 px wide, that is as bright over its background as the steel is dark."""
    return needle(-80.0) + 160.0 * band(streak_px - 0.4, streak_px + 0.4)


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
