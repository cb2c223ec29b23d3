"""Cross sections of a straightened needle: their noise, what lies beside it, and the line that stands out.

All functions take a strip (N, M) of grey levels, one cross section a row, and the offsets (M,) px of its columns.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.records import Float

Mask = npt.NDArray[np.bool_]

# Lens blur and interpolation spread an edge over about this much to either side.
EDGE_SPREAD_PX = 1.5
# Width of the bands beside the needle that give its background and show a sleeve.
FLANK_PX = 4.0


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


def _bands(offsets: Float, inner_px: float) -> list[slice]:
    low = slice(*np.searchsorted(offsets, [-inner_px - FLANK_PX, -inner_px]))
    high = slice(*np.searchsorted(offsets, [inner_px, inner_px + FLANK_PX]))
    return [low, high]


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
