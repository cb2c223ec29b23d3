"""A needle so bright that the picture saturates: its axis, its diameter and its end from what is left of its flanks.

Where the needle is clipped only the outer slope of the blurred edge is left, which lies beyond the edge by as much as
the needle is brighter than white: it looks too wide, more so on its brighter side. How steeply the slope falls off
tells how bright it is. Each flank is an edge of unknown brightness behind the blur of the lens; the raw pixels that
are not clipped have its value, those that are at least white (a censored or Tobit model, Tobin 1958, Econometrica 26).
Interpolation between pixels would ring at clipped ones.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import call
from needletrack.records import Float, Image
from needletrack.tracking.axis import CLIPPED_GRAY, FOUND, NO_MEMORY, D, I, Kept, P, two_eyes
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import AxisOffsets

# The background is seen this far beside the needle as wide as it looks, px; what lies deeper inside than that is
# clipped whatever the edge: two sigmas of the widest blur and the widening.
_RIM_PX, _DEEP_PX = 4.5, 2.5
# A section is clipped where this share of its pixels is, of those within this share of its half width as it looks. A
# streak of light on steel leaves a rim unclipped that is wider.
_CLIPPED_SHARE, _CORE = 0.95, 0.6
# A needle is clipped along most of itself, or has a glint on it, which is narrower and says nothing of its edges.
_CLIPPED_ALONG = 0.6
# Below this share of its middle a needle is not looked at more closely; from this share on it is white all over.
WORTH_A_LOOK, WHITE = 0.3, 0.85
# So many points of the curve make a window: errors of neighbouring axis points count as one over that length.
_POINTS_PER_WINDOW = 3
# Fewer windows in both views than that do not hold a diameter.
_LEAST_WINDOWS = 4
# The blur, px, and its standard deviation (log): that of lenses in and nearly in focus, 0.45 to 1.1.
_BLUR_PX, _BLUR_LOG = 0.7, 0.3
# It is never beyond these, px. A needle of which nothing more is known is taken to look wider by so much of it.
_BLURS_PX, _LOOKS_WIDER = (0.3, 2.0), 0.6
# How bright a flank is over its background, in units of what is left to white, and standard deviations (log): of a
# side as a whole, of which next to nothing is known; of one window after another, 3 mm on, which a bend of 0.01 per mm
# turns by 0.03 rad towards the light.
_BRIGHT, _BRIGHT_LOG, _BRIGHT_STEP_LOG = 3.0, 3.0, 0.03
# What is left to white is at least this at first, where the background is nearly as bright.
_LEAST_WHITE_GRAY = 10.0
# Background's tilt away from the needle, grey per px.
_TILT_GRAY = 1.0
# The blur is a Gaussian and the flank evenly bright to this share.
_SHAPE_SHARE = 0.03
_LEAST_NOISE_GRAY = 1.0
# So many neighbouring pixels err together, for what the model leaves out is as wide as the blur: for sigmas.
_CORRELATED = 4.0
# Residuals beyond so many sigmas count for less and less (Cauchy).
_ROBUST = 4.0
# A clipped pixel is as good as certain so many sigmas above white.
_MOST_ABOVE = 30.0
# The axis was known to this before, px.
_MIDDLE_PX = 1.0
# One step moves radius, log blur and middle, and background, tilt and log brightness of a flank, by no more than this:
# so far the model is nearly linear.
_RADIUS_STEP_PX, _BLUR_STEP_LOG, _MIDDLE_STEP_PX, _FLANK_STEP = 0.4, 0.15, 0.5, (50.0, 3.0, 0.7)
# A contour is drawn in steps of this share of the blur.
_CONTOUR_STEP = 0.1
_ROUNDS, _UNTIL_PX, _NEAR_PX = 20, 5e-3, 5e-2
# An axis point is no better than this, px: pixels are not exactly square and evenly sensitive.
_LEAST_SIGMA_PX = 0.03
# Clipping widens each side by at most so many sigmas of the blur, at an edge some ten times brighter than white.
_MOST_WIDENING = 1.7


@dataclass(frozen=True, slots=True)
class Flanks:
    """A clipped needle: its true diameter_mm, and the blur_px of the lens in the left and in the right view."""

    diameter_mm: float
    blur_px: tuple[float, float]


class _Rules(ctypes.Structure):
    """What the model takes for granted and how it is solved, as `clipped.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("clipped_gray", D),
        ("rim_px", D),
        ("deep_px", D),
        ("clipped_share", D),
        ("core", D),
        ("clipped_along", D),
        ("points_per_window", I),
        ("least_windows", I),
        ("looks_wider", D),
        ("blur_px", D),
        ("blur_log", D),
        ("least_blur_px", D),
        ("most_blur_px", D),
        ("bright", D),
        ("bright_log", D),
        ("bright_step_log", D),
        ("least_white_gray", D),
        ("tilt_gray", D),
        ("middle_px", D),
        ("shape_share", D),
        ("least_noise_gray", D),
        ("correlated", D),
        ("robust", D),
        ("most_above", D),
        ("radius_step_px", D),
        ("blur_step_log", D),
        ("middle_step_px", D),
        ("flank_step", D * 3),
        ("rounds", I),
        ("until_px", D),
        ("near_px", D),
        ("least_sigma_px", D),
    ]


_RULES = _Rules(
    CLIPPED_GRAY,
    _RIM_PX,
    _DEEP_PX,
    _CLIPPED_SHARE,
    _CORE,
    _CLIPPED_ALONG,
    _POINTS_PER_WINDOW,
    _LEAST_WINDOWS,
    _LOOKS_WIDER,
    _BLUR_PX,
    _BLUR_LOG,
    *_BLURS_PX,
    _BRIGHT,
    _BRIGHT_LOG,
    _BRIGHT_STEP_LOG,
    _LEAST_WHITE_GRAY,
    _TILT_GRAY,
    _MIDDLE_PX,
    _SHAPE_SHARE,
    _LEAST_NOISE_GRAY,
    _CORRELATED,
    _ROBUST,
    _MOST_ABOVE,
    _RADIUS_STEP_PX,
    _BLUR_STEP_LOG,
    _MIDDLE_STEP_PX,
    _FLANK_STEP,
    _ROUNDS,
    _UNTIL_PX,
    _NEAR_PX,
    _LEAST_SIGMA_PX,
)


class _Found(ctypes.Structure):
    """What was found, as `clipped.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("radius_mm", D),
        ("blur_px", D * 2),
        ("px_per_mm", D),
        ("is_clipped", ctypes.c_uint8 * 2),
        ("middle_px", P),
        ("sigma_px", P),
    ]


def clipped_axis(
    images: tuple[Image, Image],
    rig: StereoRig,
    points_mm: Float,
    observed: tuple[AxisOffsets, AxisOffsets],
    expected_px: Sequence[Float],
    seen_diameter_mm: float,
    is_shaft: Mask,
    before: Flanks | None = None,
) -> tuple[Flanks, tuple[AxisOffsets, AxisOffsets]] | None:
    """The flanks of a needle about a curve (N, 3), and the offsets observed there put right where they are clipped.

    expected_px: offset (N,) of this curve in each view from where it was observed. is_shaft (N,): whether the needle is
    known to have its full thickness there. before: its flanks as they were nearly. None where too little is clipped, or
    it is no evenly bright needle.
    """
    kept, count = Kept(), len(points_mm)
    middle_px, sigma_px = np.empty((2, 2, count))
    found = _Found(middle_px=kept.at(middle_px), sigma_px=kept.at(sigma_px))
    answer = call(
        "clipped_axis",
        _RULES,
        two_eyes(images, rig, kept),
        np.ascontiguousarray(points_mm, dtype=np.float64),
        count,
        seen_diameter_mm,
        np.ascontiguousarray(is_shaft),
        np.zeros(3) if before is None else np.array([before.diameter_mm, *before.blur_px]),
        found,
    )
    if answer == NO_MEMORY:
        raise MemoryError("there is no memory for the kernel that looks at a clipped needle")
    if answer != FOUND:
        return None
    radius_mm, blur_px = float(found.radius_mm), (float(found.blur_px[0]), float(found.blur_px[1]))
    widening_px = (seen_diameter_mm / 2 - radius_mm) * found.px_per_mm
    if not -0.5 * max(blur_px) < widening_px < _MOST_WIDENING * max(blur_px):
        return None
    left, right = (
        _put_right(seen, at + middle, sigma, is_shaft) if is_clipped else seen
        for seen, at, middle, sigma, is_clipped in zip(
            observed, expected_px, middle_px, sigma_px, found.is_clipped, strict=True
        )
    )
    return Flanks(2 * radius_mm, blur_px), (left, right)


def _put_right(seen: AxisOffsets, offset_px: Float, sigma_px: Float, is_shaft: Mask) -> AxisOffsets:
    """What one view showed of the axis, with the offsets (N,) that are known where it is clipped."""
    known = np.isfinite(sigma_px)
    return AxisOffsets(
        seen.center_px,
        seen.normal,
        np.where(known, offset_px, seen.offset_px),
        # On a cone, or where one may be, the silhouette of such a needle is as biased as elsewhere.
        np.where(known, sigma_px, np.where(is_shaft, seen.sigma_px, np.inf)),
    )


def outline(half_width: Float, blur: tuple[float, float], seen: float) -> Float:
    """Half width (S,) as it looks where clipped, of a body of that half width (S,) whose thickest part looks like seen.

    blur: standard deviation across, in the units of the widths, and along, in samples. What is as bright as the edge
    seen is a contour of the blurred picture: about an apex it draws in, where there is too little light to clip.
    """
    across, along = blur
    level = float(ndtr((half_width.max() - seen) / across))
    x = np.arange(0.0, seen + 3 * _CONTOUR_STEP * across, _CONTOUR_STEP * across)
    passed = ndtr((half_width[:, None] - x) / across) + ndtr((half_width[:, None] + x) / across) - 1
    passed = gaussian_filter1d(passed, along, axis=0, mode="nearest")
    beyond = np.argmax(passed < level, axis=1)
    rows = np.arange(len(passed))
    inner, outer = passed[rows, np.maximum(beyond - 1, 0)], passed[rows, beyond]
    share = np.clip((inner - level) / np.maximum(inner - outer, 1e-12), 0.0, 1.0)
    return np.where(beyond > 0, x[np.maximum(beyond - 1, 0)] + share * _CONTOUR_STEP * across, 0.0)
