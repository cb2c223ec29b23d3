"""What each view says about the needle's axis across a curve that is nearly right, its inside left out of account.

The image is straightened along the projected curve and averaged over short sections of the needle; for each the
evidence (`evidence.py`) tells how likely the axis is at each offset, given the width that diameter and depth imply.
Diameter, blur of the lens and liveliness of the inside are the same all along the needle and are found first.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.records import Appearance, Float, Image, Int
from needletrack.tracking.evidence import (
    BLURS,
    DULL,
    HALF_WIDTHS,
    LIVELY,
    OFFSETS,
    UNITS_PER_MAX_DIAMETER,
    Grid,
    either,
    log_evidence,
    log_evidence_by_background,
    log_evidence_of_no_needle,
    products,
)
from needletrack.tracking.needle import Needle
from needletrack.tracking.profile import Mask, noise_gray

# A section is the mean of so many rows across the needle, about a pixel apart.
_ROWS_PER_SECTION = 5
# The unit in which a section is measured: its noise, and what the model leaves out, which is at least so many greys.
_LEAST_UNIT_GRAY = 1.0
_UNIT_PER_NOISE = 0.7
# Log Bayes factor of a needle over none from which on a section has a say.
_USED = 2.0
# A section may be of something else altogether, at this log density.
_LOG_OUTLIER = -12.0
_LOG_NEVER = -1e4
# Log odds against the axis turning aside from a nearly right curve, per unit.
_TURN_PRICE = 6.0
# Differences between the motions of the two ends that are tried, units; log odds against a motion, per unit squared.
_DRIFTS = np.linspace(-4.0, 4.0, 17)
_MOTION_PRICE = 1.0
# What is not noise, such as the interpolation between pixels: an axis point is no better than this, units.
_LEAST_SIGMA = 0.03
# What lies about the needle before clutter misleads neighbouring sections alike: together they are worth fewer of them.
_CLUTTERED = 2.0
# A section that narrows the expectation by less than this share tells nothing.
_LEAST_GAIN = 0.3
# So many sections of each view decide on the appearance; a section has at most so much of a say.
_DECIDING = 16
# An inside is lively where this share of sections says so, by this much each, and the others do not deny it: where
# nothing shines, a dull one is likelier by two or more.
_LIVELY_SHARE, _LIVELY_SAY, _DULL_SAY = 0.05, 4.0, -1.5
_MOST_SAY = 40.0
# Blurs of lenses in and nearly in focus, px; diameters are looked for a little beyond those in use: saturation widens.
_BLURS_PX = (0.45, 1.1)
_DIAMETER_MARGIN = (0.9, 1.3)


@dataclass(frozen=True, slots=True)
class Sections:
    """Cross sections of one view, one about each point of a curve.

    center_px, normal (N, 2), raw px; values (N, len(OFFSETS)) grey levels in units of their noise; px_per_unit (N,)
    length of a unit across (`evidence.py`); inside (N,) whether the point is in the image.
    """

    center_px: Float
    normal: Float
    values: Float
    px_per_unit: Float
    inside: Mask


@dataclass(frozen=True, slots=True)
class AxisOffsets:
    """Where one view places the axis across a curve of N points.

    center_px, normal (N, 2): where each cross section was taken and its direction, raw px; offset_px (N,) of the axis
    along the normal, with sigma_px (N,), infinite where the needle is not seen.
    """

    center_px: Float
    normal: Float
    offset_px: Float
    sigma_px: Float

    @property
    def seen(self) -> Mask:
        """Where the view shows the needle, (N,) bool."""
        return np.isfinite(self.sigma_px)

    def part(self, cut: slice | Int) -> "AxisOffsets":
        """The points of the cut alone."""
        return AxisOffsets(self.center_px[cut], self.normal[cut], self.offset_px[cut], self.sigma_px[cut])


def unit_mm(needle: Needle) -> float:
    """Length across the needle of one unit of `evidence.py`, mm."""
    return needle.max_diameter_mm / UNITS_PER_MAX_DIAMETER


def diameter_mm(appearance: Appearance, needle: Needle) -> float:
    """The needle's diameter, as wide as it looks, mm."""
    return float(2 * HALF_WIDTHS[appearance.half_width] * unit_mm(needle))


def cut_sections(image: Image, camera: Camera, local_mm: Float, needle: Needle) -> Sections:
    """The sections across a curve (N, 3) in this camera's frame, evenly spaced, one about each point."""
    step = np.gradient(local_mm, axis=0) / _ROWS_PER_SECTION
    at = np.arange(_ROWS_PER_SECTION) - (_ROWS_PER_SECTION - 1) / 2
    strip = straightened(
        image, camera, (local_mm[:, None] + at[:, None] * step[:, None]).reshape(-1, 3), OFFSETS, needle
    )
    unit_gray = max(_LEAST_UNIT_GRAY, _UNIT_PER_NOISE * noise_gray(strip))
    center = camera.project(local_mm)
    along = tangents(center)
    return Sections(
        center,
        np.column_stack([-along[:, 1], along[:, 0]]),
        strip.reshape(len(local_mm), _ROWS_PER_SECTION, -1).mean(axis=1) / unit_gray,
        camera.focal_px / local_mm[:, 2] * unit_mm(needle),
        camera.contains(center, margin_px=2.0),
    )


def straightened(image: Image, camera: Camera, local_mm: Float, offsets: Float, needle: Needle) -> Float:
    """Grey levels (N, len(offsets)) across a curve (N, 3) in this camera's frame; offsets in units (`evidence.py`)."""
    rows_px = camera.project(local_mm)
    along = tangents(rows_px)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    across = offsets * (camera.focal_px / local_mm[:, 2] * unit_mm(needle))[:, None]
    x, y = ((rows_px[:, None, k] + across * normal[:, None, k]).astype(np.float32) for k in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.float64)


def estimate_appearance(
    views: tuple[Sections, Sections], needle: Needle, near: Appearance | None, grid: Grid, *, is_white: bool = False
) -> Appearance:
    """Diameter, blur and inside under which the sections of both views are likeliest; `near`: what they were before.

    A white needle that saturates is dull, though its profile is cut off.
    """
    decisive = [np.unique(np.linspace(0, len(v.values) - 1, _DECIDING).astype(np.int64)) for v in views]
    shown = products(np.concatenate([view.values[pick] for view, pick in zip(views, decisive, strict=True)]))
    px_per_unit = float(np.median(np.concatenate([view.px_per_unit for view in views])))
    low, high = (
        margin * d / 2 / unit_mm(needle)
        for margin, d in zip(_DIAMETER_MARGIN, (needle.min_diameter_mm, needle.max_diameter_mm), strict=True)
    )
    widths = [i for i, w in enumerate(HALF_WIDTHS) if low <= w <= high]
    blurs = [i for i, b in enumerate(BLURS) if _BLURS_PX[0] <= b * px_per_unit <= _BLURS_PX[1]] or [len(BLURS) - 1]
    likely: dict[Appearance, Float] = {}

    def best(tried: list[Appearance]) -> Appearance:
        for each in tried:
            if each not in likely:
                likely[each] = log_evidence(shown, each, grid).max(axis=1)
        table = np.stack([likely[each] for each in tried], axis=1)
        # A section of something else has no more of a say than _MOST_SAY.
        say = np.maximum(table - table.max(axis=1, keepdims=True), -_MOST_SAY).sum(axis=0)
        return tried[int(np.argmax(say))]

    insides = (DULL,) if is_white else (DULL, LIVELY)
    if near is None:
        near = best([Appearance(w, b, i) for w in widths[1::3] for b in blurs for i in insides])
    # What is seen of a needle that is followed may look different from its first stretch. Each inside has a width and
    # a blur of its own at which it explains the sections best.
    each = [
        best(
            [
                Appearance(w, b, inside)
                for w in widths
                if abs(w - near.half_width) <= 2
                for b in blurs
                if abs(b - near.blur) <= 1
            ]
        )
        for inside in insides
    ]
    if is_white:
        return each[0]
    dull, lively = each
    # A stretch with a streak misleads where a dull inside is taken for granted; the other way round costs little.
    gain = likely[lively] - likely[dull]
    streaked = float(np.mean(gain > _LIVELY_SAY)) > _LIVELY_SHARE and float(np.mean(gain)) > _DULL_SAY
    return lively if streaked else dull


@dataclass(frozen=True, eq=False)
class AxisEvidence:
    """One view's sections with the log evidence (N, S) of the axis in each, over that of no needle there.

    cluttered (N,): where it is seen before a background that is not even. shines (N,): where a streak of light shows
    its way as well.
    """

    sections: Sections
    log_evidence: Float
    cluttered: Mask
    grid: Grid
    shines: Mask

    def offsets(self, expected_px: Float, spread: Float) -> AxisOffsets:
        """The axis where it is expected at expected_px (N,), give or take spread (N,) units."""
        scale = self.sections.px_per_unit
        offset, sigma = _sites(self._likelihood, self.grid.fine_shifts, expected_px / scale, spread)
        seen = np.isfinite(sigma) & (self.support(expected_px, spread) > _USED)
        return AxisOffsets(
            self.sections.center_px,
            self.sections.normal,
            np.where(seen, offset, 0.0) * scale,
            np.where(seen, sigma * np.where(self.cluttered & self.shines, _CLUTTERED, 1.0), np.inf) * scale,
        )

    def likeliest_path_px(self) -> Float:
        """Offsets (N,) px of the likeliest axis from end to end, which may turn aside, at a price (Viterbi 1967)."""
        most, _ = self._relative
        log = np.maximum(self.log_evidence - most[:, None], _LOG_OUTLIER)
        shifts = self.grid.shifts
        price = _TURN_PRICE * np.abs(shifts[:, None] - shifts)
        for i in range(1, len(log)):
            log[i] += (log[i - 1][:, None] - price).max(axis=0)
        path = np.empty(len(log), np.int64)
        path[-1] = log[-1].argmax()
        for i in range(len(log) - 1, 0, -1):
            path[i - 1] = (log[i - 1] - price[path[i]]).argmax()
        return np.asarray(shifts[path] * self.sections.px_per_unit)

    def likeliest_motion_px(self) -> Float:
        """Offsets (N,) px of the likeliest axis that moved as a whole: alike everywhere, or ever more to one end."""
        most, _ = self._relative
        log = np.maximum(self.log_evidence - most[:, None], _LOG_OUTLIER)
        count = len(self.grid.shifts)
        step = self.grid.shifts[1] - self.grid.shifts[0]
        along = np.linspace(-0.5, 0.5, len(log))
        drift = np.rint(_DRIFTS[:, None] * along / step).astype(np.int64)
        index = np.arange(count)[:, None] + drift[:, None]
        told = np.where(
            (index >= 0) & (index < count), log[np.arange(len(log)), np.clip(index, 0, count - 1)], _LOG_OUTLIER
        )
        worth = told.sum(axis=2) - _MOTION_PRICE * self.grid.shifts**2
        best = np.unravel_index(int(worth.argmax()), worth.shape)
        return np.asarray((self.grid.shifts[best[1]] + drift[best[0]] * step) * self.sections.px_per_unit)

    def support(self, expected_px: Float, spread: Float) -> Float:
        """Log Bayes factor (N,) of a needle about expected_px (N,), give or take spread (N,) units, over none there."""
        expected = expected_px / self.sections.px_per_unit
        near = _bell(self.grid.shifts, expected, spread)
        most, relative = self._relative
        mean = (relative * near).sum(axis=1) / near.sum(axis=1)
        support = most + np.log(np.maximum(mean, 1e-300))
        return np.where(self.sections.inside & (np.abs(expected) < self.grid.shifts[-1]), support, -np.inf)

    @cached_property
    def _relative(self) -> tuple[Float, Float]:
        """The most log evidence (N,) of each section, and the evidence (N, S) over that."""
        most = np.maximum(self.log_evidence.max(axis=1), _LOG_NEVER)
        return most, np.exp(self.log_evidence - most[:, None])

    @cached_property
    def _likelihood(self) -> Float:
        """The evidence (N, F) at finer shifts, over its most, or of something else altogether."""
        curve = np.maximum(self.log_evidence, _LOG_NEVER) @ self.grid.refine.T
        return np.asarray(np.exp(curve - curve.max(axis=1, keepdims=True)) + np.exp(_LOG_OUTLIER))


def axis_evidence(sections: Sections, appearance: Appearance, half_widths: Int, grid: Grid) -> AxisEvidence:
    """The evidence of sections whose half widths (N,), as indices into HALF_WIDTHS, differ; -1: too thin to say."""
    log = np.full((len(sections.values), len(grid.shifts)), -np.inf)
    cluttered = np.zeros(len(log), dtype=np.bool_)
    for width in np.unique(half_widths[half_widths >= 0]):
        rows = half_widths == width
        each = Appearance(int(width), appearance.blur, appearance.inside)
        shown = products(sections.values[rows])
        before_even, before_clutter = log_evidence_by_background(shown, each, grid)
        log[rows] = either(before_even, before_clutter) - log_evidence_of_no_needle(shown, appearance.blur)[:, None]
        cluttered[rows] = before_clutter.max(axis=1) > before_even.max(axis=1)
    return AxisEvidence(sections, log, cluttered, grid, np.zeros(len(log), dtype=np.bool_))


def _bell(shifts: Float, expected: Float, spread: Float) -> Float:
    """Gaussians (N, S) about the expected places (N,), over their most at any shift."""
    squared = ((shifts - expected[:, None]) / spread[:, None]) ** 2
    return np.asarray(np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True))))


def _sites(likelihood: Float, shifts: Float, expected: Float, spread: Float) -> tuple[Float, Float]:
    """Offset and sigma (N,), units, that each section contributes, where the axis is expected at expected +- spread.

    Moments of evidence times expectation, with the expectation taken out again (expectation propagation, Minka 2001):
    of several places that the evidence allows, the one that is expected counts. sigma is infinite where the section
    adds nothing.
    """
    weight = likelihood * _bell(shifts, expected, spread)
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ shifts
    variance = (weight * (shifts - mean[:, None]) ** 2).sum(axis=1)
    variance = np.maximum(variance, _LEAST_SIGMA**2 / 4)
    precision = 1 / variance - 1 / spread**2
    told = precision > _LEAST_GAIN / spread**2
    precision = np.where(told, precision, 1.0)
    offset = np.where(told, (mean / variance - expected / spread**2) / precision, 0.0)
    return offset, np.where(told, np.hypot(precision**-0.5, _LEAST_SIGMA), np.inf)
