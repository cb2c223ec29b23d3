"""Cross sections of a straightened needle: its silhouette's edges, and the line that stands out within it.

All functions take a strip (N, M) of grey levels, one cross section a row, and the offsets (M,) px of its columns.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, median_filter

from needletrack.records import Float

Mask = npt.NDArray[np.bool_]

# Lens blur and interpolation spread an edge over about this much to either side.
EDGE_SPREAD_PX = 1.5
# Width of the bands beside the needle that give its background and show a sleeve.
FLANK_PX = 4.0
# Uneven light tilts the background by at most so many grey levels a pixel; more is clutter.
_MAX_TILT = 0.6
# An edge of height h rises over about 3 px, so that an error of the background moves it by 3 px / h times that.
_EDGE_RISE_PX = 3.0
# A streak so many times stronger than the rim beside it begins, and is certain, to push the rim's edge outwards.
_STREAK_RATIO = (2.0, 4.0)
_STREAK_REACH_PX = 4.0
# Beside a streak as strong as the rim an edge is uncertain by this much, whatever the noise.
_STREAK_SIGMA_PX = 0.6
_STREAK_STATIONS = 15
_GLARE_SHARE = 0.06
_EDGE_STATIONS = 11
_STRAY_PX = 0.6


@dataclass(frozen=True, slots=True)
class Silhouette:
    """Both edges (2, N) px, NaN where there is none, their sigma_px (2, N), and the grey levels beside them (2, N)."""

    edges_px: Float
    sigma_px: Float
    background: Float


@dataclass(frozen=True, slots=True)
class Line:
    """The strongest line across each cross section: where there is one, its middle, width and height, all (N,)."""

    found: Mask
    middle_px: Float
    width_px: Float
    height_gray: Float


def noise_gray(strip: Float) -> float:
    """Standard deviation of one pixel's noise, from second differences across the strip's rim."""
    rim = np.stack([strip[:, :10:2], strip[:, -10::2]])
    second = np.sort(np.abs(np.diff(rim, n=2, axis=2)), axis=None)
    quiet = second[: max(1, int(0.8 * second.size))]
    # A smooth background cancels in a second difference, whose variance is 6 sigma^2; the mean of the lower 80 % of a
    # half-normal is 0.5586 sigma, and the upper fifth is left to what crosses the rim.
    return max(0.3, float(quiet.mean()) / 0.5586 / math.sqrt(6))


def flanks(strip: Float, offsets: Float, width_px: float) -> Float:
    """Mean grey level (2, N) of a band close beside a needle of the given width, on its low and its high side."""
    inner = width_px / 2 + EDGE_SPREAD_PX + 0.5
    return np.stack([strip[:, band].mean(axis=1) for band in _bands(offsets, inner)])


def find_silhouette(strip: Float, offsets: Float, limit_px: float, threshold_gray: float) -> Silhouette:
    """The outermost significant departures from each side's own background, within limit_px of the middle."""
    inner = limit_px + EDGE_SPREAD_PX
    bands = [strip[:, band] for band in _bands(offsets, inner)]
    background = np.stack([band.mean(axis=1) for band in bands])
    spread = np.stack([band.std(axis=1) for band in bands])
    # A tilt beyond that of uneven light is clutter on one side, which the other side must not inherit.
    tilt = np.clip((background[1] - background[0]) / (2 * inner + FLANK_PX), -_MAX_TILT, _MAX_TILT)
    level = strip - tilt[:, None] * offsets
    to_band = tilt * (inner + FLANK_PX / 2)
    # Both sides at once: the high one is the low one of the mirrored strip.
    both = np.concatenate([level, level[:, ::-1]])
    edges, height, streak = _outermost_edges(
        both - np.concatenate([background[0] + to_band, background[1] - to_band])[:, None],
        offsets,
        limit_px,
        threshold_gray,
    )
    n = len(strip)
    heights = np.maximum(np.stack([height[:n], height[n:]]), 1.0)
    edges = np.stack([_without_strays(edges[:n]), _without_strays(-edges[n:])])
    doubt = _STREAK_SIGMA_PX * np.minimum(np.stack([streak[:n], streak[n:]]), 1.0)
    return Silhouette(edges, np.hypot(_EDGE_RISE_PX * spread / heights, doubt), background)


def _without_strays(edge_px: Float) -> Float:
    """The edge (N,) without what leaps from its neighbours: in a straightened strip an edge is nearly straight."""
    there = np.isfinite(edge_px)
    if not there.any():
        return edge_px
    at = np.arange(len(edge_px))
    filled = np.interp(at, at[there], edge_px[there])
    typical = median_filter(filled, _EDGE_STATIONS, mode="nearest")
    return np.where(there & (np.abs(filled - typical) < _STRAY_PX), edge_px, np.nan)


def _bands(offsets: Float, inner_px: float) -> list[slice]:
    low = slice(*np.searchsorted(offsets, [-inner_px - FLANK_PX, -inner_px]))
    high = slice(*np.searchsorted(offsets, [inner_px, inner_px + FLANK_PX]))
    return [low, high]


def _outermost_edges(
    departure: Float, offsets: Float, limit_px: float, threshold_gray: float
) -> tuple[Float, Float, Float]:
    """First edge (K,) px from the low end inwards, NaN where none, its height (K,), of departures (K, M), and how
    many times as strong a streak is behind it (K,)."""
    rows, columns = np.arange(len(departure)), np.arange(departure.shape[1])
    step_px = float(offsets[1] - offsets[0])
    reach = (offsets >= -limit_px - EDGE_SPREAD_PX) & (offsets <= limit_px)
    strength = np.where(reach, np.abs(departure), 0.0)
    # Beside a strong line lies a faint rim of blur and glare, which is no edge of anything.
    beyond = strength > np.maximum(threshold_gray, _GLARE_SHARE * strength.max(axis=1))[:, None]
    exists = beyond.any(axis=1)
    first = beyond.argmax(axis=1)
    signed = departure * np.sign(departure[rows, first])[:, None]
    # The edge's height is that of the first extremum behind the threshold, for what follows lies inside the silhouette;
    # a bump of the noise on the way up is no extremum.
    highest = np.maximum.accumulate(np.where(columns >= first[:, None], signed, 0.0), axis=1)
    fallen = highest - signed > threshold_gray / 4
    fallen = (fallen & (columns > first[:, None])) | (columns == departure.shape[1] - 1)
    height = highest[rows, fallen.argmax(axis=1)]
    top = (highest >= height[:, None]).argmax(axis=1)
    reached = (signed >= height[:, None] / 2) & (columns >= np.maximum(first - 4, 0)[:, None])
    after = np.maximum(reached.argmax(axis=1), 1)
    low, high = signed[rows, after - 1], signed[rows, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(high > low, (height / 2 - low) / (high - low), 0.5)
    position = offsets[after - 1] + np.clip(fraction, 0, 1) * step_px
    # The blur of a much stronger streak covers the inner side of a weak rim and spreads it outwards by about half its
    # width: the extremum is then nearer to the silhouette than the half height is.
    ahead = np.minimum(top[:, None] + np.arange(1, round(_STREAK_REACH_PX / step_px) + 1), departure.shape[1] - 1)
    streak = np.maximum(-signed[rows[:, None], ahead].min(axis=1), 0.0) / np.maximum(height, 1e-6)
    streak = median_filter(np.minimum(streak, 10.0), _STREAK_STATIONS, mode="nearest")
    streak = gaussian_filter1d(streak, 4.0, mode="nearest")
    blend = np.clip((streak - _STREAK_RATIO[0]) / (_STREAK_RATIO[1] - _STREAK_RATIO[0]), 0, 1)
    position = (1 - blend) * position + blend * offsets[top]
    return np.where(exists, position, np.nan), np.where(exists, height, 0.0), np.where(exists, streak, 0.0)


def find_line(strip: Float, offsets: Float, width_px: float, search_px: float, min_height_gray: float) -> Line:
    """The bright or dark line that stands out most from both its sides, whatever lies further out.

    Its height is that over the nearer to it of the extremes on its two sides (a top-hat), its edges are at half height.
    """
    n = len(strip)
    step_px = float(offsets[1] - offsets[0])
    reach = max(2, round((width_px / 2 + 2 * EDGE_SPREAD_PX) / step_px))
    # Bright lines are looked for in the strip, dark ones in its negative.
    both = np.concatenate([strip, -strip]).astype(np.float32)
    kernel = np.ones((1, reach + 1), np.uint8)
    bases = [
        cv2.erode(both, kernel, anchor=(anchor, 0), borderType=cv2.BORDER_REPLICATE).astype(np.float64)
        for anchor in (reach, 0)
    ]
    signed = both.astype(np.float64)
    height = np.where(np.abs(offsets) <= search_px + 1.0, signed - np.maximum(*bases), 0.0)
    best = height.argmax(axis=1)
    rows = np.arange(2 * n)
    heights = height[rows, best]
    chosen = np.where(heights[:n] >= heights[n:], np.arange(n), np.arange(n, 2 * n))
    signed, top, bases = signed[chosen], best[chosen], [base[chosen] for base in bases]
    low_px = _half_height(signed[:, ::-1], -offsets[::-1], len(offsets) - 1 - top, bases[0][:, ::-1])
    high_px = _half_height(signed, offsets, top, bases[1])
    middle, width = (high_px - low_px) / 2, high_px + low_px
    found = (heights[chosen] > min_height_gray) & (width > 0.5) & (np.abs(middle) <= search_px)
    return Line(found, middle, width, heights[chosen])


def _half_height(signed: Float, offsets: Float, top: npt.NDArray[np.int64], base: Float) -> Float:
    """Offset (N,) at which each row, followed upwards from `top`, has fallen half way to its base there."""
    rows, columns = np.arange(len(signed)), np.arange(signed.shape[1])
    level = (signed[rows, top] + base[rows, top]) / 2
    below = (signed < level[:, None]) & (columns > top[:, None])
    out = np.maximum(below.argmax(axis=1), 1)
    step = signed[rows, out - 1] - signed[rows, out]
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(step > 0, (signed[rows, out - 1] - level) / step, 0.5)
    return np.asarray(offsets[out - 1] + (offsets[out] - offsets[out - 1]) * np.clip(fraction, 0, 1))


def departure_area(strip: Float, offsets: Float, background: Float, width_px: float) -> Float:
    """Integral (N,) grey px of |grey - background| over the needle's width; background (2, N), linear across."""
    near = np.abs(offsets) <= width_px / 2 + EDGE_SPREAD_PX
    across = (offsets[near] - offsets[0]) / (offsets[-1] - offsets[0])
    level = background[0][:, None] * (1 - across) + background[1][:, None] * across
    return np.asarray(np.abs(strip[:, near] - level).sum(axis=1) * (offsets[1] - offsets[0]))
