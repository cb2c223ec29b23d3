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
from needletrack.tracking.silhouette import likeliest_path

# A line of light this wide, units across, and this much above what is beside it, in noise.
_LINE_SIGMA, _LEAST_CONTRAST, _MOST_CONTRAST = 0.8, 10.0, 40.0
# Within this share of the half width, and what turning aside costs per unit, in contrast.
_WITHIN_SHARE, _TURN_PRICE = 0.95, 6.0
# Where fewer sections of a view show it, there is none.
_LEAST_SHARE = 0.4
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
    contrast = np.empty_like(values)
    call("contrast", values, *values.shape, _LINE, len(_LINE), contrast)
    within = np.abs(OFFSETS - axis[:, None]) < _WITHIN_SHARE * half_widths[:, None]
    worth = np.where(within, np.clip(contrast, 0.0, _MOST_CONTRAST), -_MOST_CONTRAST)
    ever = np.flatnonzero(within.any(axis=0))
    if len(ever) == 0:
        return None
    path = likeliest_path(worth[:, ever], _TURN_PRICE * ACROSS_STEP)
    at = np.clip(ever[path], 1, len(OFFSETS) - 2)
    rows = np.arange(len(at))
    for _ in range(2):
        beside = contrast[rows[:, None], at[:, None] + np.arange(-1, 2)]
        at = np.clip(at + beside.argmax(axis=1) - 1, 1, len(OFFSETS) - 2)
    before, here, after = (contrast[rows, at + k] for k in (-1, 0, 1))
    bend = 2 * here - before - after
    is_peak = (here >= before) & (here >= after) & (bend > 0) & within[rows, at]
    seen = is_peak & (here > _LEAST_CONTRAST)
    if seen.mean() < _LEAST_SHARE:
        return None
    offset = OFFSETS[at] + np.where(seen, 0.5 * ACROSS_STEP * (after - before) / np.where(seen, bend, 1.0), 0.0)
    # The peak of a parabola through noisy samples.
    sigma = np.hypot(_LEAST_SIGMA, ACROSS_STEP / np.sqrt(2) / np.where(seen, bend, 1.0))
    return Streak(offset, np.where(seen, sigma, np.inf))


def _line() -> Float:
    at = np.arange(-3.0, 3.01, ACROSS_STEP) / _LINE_SIGMA
    line = (1 - at**2) * np.exp(-0.5 * at**2)
    line -= line.mean()
    return np.asarray(line / np.linalg.norm(line))


_LINE = _line()
