"""Cross sections of a straightened needle: their noise, what lies beside it, and the line that stands out.

All functions take a strip (N, M) of grey levels, one cross section a row, and the offsets (M,) px of its columns.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from needletrack.kernels import call
from needletrack.records import Float

Mask = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

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


def flanks(strip: Float | Float32, offsets: Float, width_px: float) -> Float:
    """Mean grey level (2, N) of a band close beside a needle of the given width, on its low and its high side."""
    inner = width_px / 2 + EDGE_SPREAD_PX + 0.5
    return np.stack([strip[:, band].mean(axis=1) for band in _bands(offsets, inner)])


def _bands(offsets: Float, inner_px: float) -> list[slice]:
    low = slice(*np.searchsorted(offsets, [-inner_px - FLANK_PX, -inner_px]))
    high = slice(*np.searchsorted(offsets, [inner_px, inner_px + FLANK_PX]))
    return [low, high]


def find_line(
    strip: Float | Float32, offsets: Float, width_px: float, search_px: float, min_height_gray: float
) -> Line:
    """The bright or dark line that stands out most from both its sides, whatever lies further out.

    Its height is that over the nearer to it of the extremes on its two sides (a top-hat), its edges are at half height.
    offsets: evenly spaced.
    """
    count, columns = strip.shape
    step_px = float(offsets[1] - offsets[0])
    reach = max(2, round((width_px / 2 + 2 * EDGE_SPREAD_PX) / step_px))
    found, (middle, width, height) = np.empty(count, np.bool_), np.empty((3, count))
    call(
        "find_lines",
        np.ascontiguousarray(strip, dtype=np.float32),
        count,
        columns,
        float(offsets[0]),
        step_px,
        reach,
        search_px,
        min_height_gray,
        found,
        middle,
        width,
        height,
    )
    return Line(found, middle, width, height)
