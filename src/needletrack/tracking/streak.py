"""The streak of light on a shining needle: not the axis, but it keeps its place beside it.

Where light falls on a cylinder it shines along a line. How far from the axis that line lies depends on how the needle
runs between light and camera, and changes as slowly as its direction does (measured on path-traced steel: by less than
a tenth of the radius over 20 mm). So the line says nothing about where the axis is, but nearly all about how it winds,
and it shows where the silhouette does not: before a vessel that runs along the needle, say.
"""

from dataclasses import dataclass

import numpy as np

from needletrack.kernels import call
from needletrack.records import Float
from needletrack.tracking.evidence import ACROSS_STEP, OFFSETS
from needletrack.tracking.profile import Mask

# A line of light this wide, units across, and this much above what is beside it, in noise.
_LINE_SIGMA, _LEAST_CONTRAST, _MOST_CONTRAST = 0.8, 10.0, 40.0
# Within this share of the half width, and what turning aside costs per unit, in contrast.
_WITHIN_SHARE, _TURN_PRICE = 0.95, 6.0
# Where fewer sections of a view show it, there is none.
LEAST_SHARE = 0.4
# Its place is no better known than this, units.
_LEAST_SIGMA = 0.06


@dataclass(frozen=True, slots=True)
class Streak:
    """Where N sections show the streak: offset and sigma (N,), units across; infinite where they do not."""

    offset: Float
    sigma: Float

    @property
    def seen(self) -> Mask:
        """Where it is seen, (N,)."""
        return np.isfinite(self.sigma)


def find_streak(values: Float, half_widths: Float, axis: Float) -> Streak | None:
    """The streak in sections (N, len(OFFSETS)), in units of their noise; None where they show none.

    half_widths (N,) of the needle there, and where its axis is, (N,), units.
    """
    count, places = values.shape
    offset, sigma = np.empty((2, count))
    seen = call(
        "find_streak",
        np.ascontiguousarray(values),
        count,
        places,
        LINE,
        len(LINE),
        float(OFFSETS[0]),
        ACROSS_STEP,
        np.ascontiguousarray(half_widths),
        np.ascontiguousarray(axis),
        RULES,
        offset,
        sigma,
        np.empty((3 * places + 1) * count),
    )
    return Streak(offset, sigma) if seen >= LEAST_SHARE * count and seen > 0 else None


def _line() -> Float:
    at = np.arange(-3.0, 3.01, ACROSS_STEP) / _LINE_SIGMA
    line = (1 - at**2) * np.exp(-0.5 * at**2)
    line -= line.mean()
    return np.asarray(line / np.linalg.norm(line))


LINE = _line()
RULES = np.array([_WITHIN_SHARE, _MOST_CONTRAST, _LEAST_CONTRAST, _TURN_PRICE * ACROSS_STEP, _LEAST_SIGMA])
