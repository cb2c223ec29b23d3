"""What each view shows beside a curve, and how strong a line along it: what tells sleeves and crossing things.

The image is straightened along the projected curve. The needle's own axis is `silhouette.py`'s.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.camera import Camera
from needletrack.kernels import call
from needletrack.records import Float, Image
from needletrack.tracking.needle import Positive
from needletrack.tracking.profile import EDGE_SPREAD_PX, FLANK_PX, Float32, find_line, flanks
from needletrack.tracking.silhouette import rows_of

_ACROSS_STEP_PX = 0.5
# A line beyond the needle's end is looked for within so much of the curve, and its flanks so far from its edges.
_LINE_OFF_PX, _FLANK_FROM_PX, _FLANK_TO_PX = 1.5, 1.5, 4.0

# A side runs along at a distance from here to there beyond the needle's own edge and in steps of, mm; along so much of
# a curve what lies so far beyond it differs from what lies as far within.
_SIDE_FROM_MM, _SIDE_TO_MM, _SIDE_STEP_MM, _SIDE_SHARE, _EDGE_MM = 0.65, 8.0, 0.1, 0.8, (0.1, 0.4)


class BesideParameters(BaseModel):
    """What counts as a line along the curve."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_px: Positive = Field(2.0, description="A line is looked for this far to either side of the curve, px.")
    line_height_gray: Positive = Field(8.0, description="It stands out from both its sides by so many grey levels.")
    faint_line_gray: Positive = Field(
        2.5, description="Beyond the tip a line stands out by so many grey levels in both views: it is not the tip."
    )
    max_width_share: Positive = Field(1.25, description="It is at most this share of the needle's width.")
    smooth_along_mm: Positive = Field(0.5, description="Sigma of the averaging along the curve, mm.")


@dataclass(frozen=True, slots=True)
class Beside:
    """One view about a curve of N points: flank_gray (2, N) close beside the needle, line_gray_px (N,) of a line there.

    The latter is the line's height times its width, 0 where there is none.
    """

    flank_gray: Float
    line_gray_px: Float

    def turned(self) -> "Beside":
        """The same points in the opposite order; left and right of the curve change places."""
        return Beside(self.flank_gray[::-1, ::-1], self.line_gray_px[::-1])


def look_beside(
    image: Image, camera: Camera, points_mm: Float, diameter_mm: float, parameters: BesideParameters
) -> Beside:
    """The view about a curve (N, 3), given in this camera's frame and evenly spaced, of a needle of that diameter."""
    width_px = diameter_mm * camera.focal_px / points_mm[:, 2]
    middle_px = float(np.median(width_px))
    offsets = _offsets_px(middle_px / 2 + parameters.search_px + EDGE_SPREAD_PX + FLANK_PX + _ACROSS_STEP_PX)
    sigma_rows = parameters.smooth_along_mm / float(np.linalg.norm(points_mm[1] - points_mm[0]))
    strip = _strip(image, camera, points_mm, offsets, sigma_rows)
    line = find_line(strip, offsets, middle_px, parameters.search_px, parameters.line_height_gray)
    fits = line.found & (line.width_px < parameters.max_width_share * width_px + 0.5)
    return Beside(flanks(strip, offsets, middle_px), np.where(fits, line.height_gray * line.width_px, 0.0))


def line_height_gray(image: Image, camera: Camera, points_mm: Float, diameter_mm: float) -> float:
    """By how many grey levels a line as wide as the needle stands out along a curve (N, 3) from both its sides.

    The curve is given in this camera's frame. Negative where it is darker; 0 where one side is brighter and one darker,
    as at an edge. The curve's mean profile counts, so that a line that is fainter than the noise is seen.
    """
    half_px = diameter_mm * camera.focal_px / float(np.median(points_mm[:, 2])) / 2
    offsets = _offsets_px(half_px + _FLANK_TO_PX + _LINE_OFF_PX)
    profile = _strip(image, camera, points_mm, offsets, 0.0).mean(axis=0, dtype=np.float64)
    most = 0.0
    for off in np.arange(-_LINE_OFF_PX, _LINE_OFF_PX + 1e-6, _ACROSS_STEP_PX):
        at = offsets - off
        beside = (np.abs(at) >= half_px + _FLANK_FROM_PX) & (np.abs(at) <= half_px + _FLANK_TO_PX)
        middle = float(profile[np.abs(at) <= half_px].mean())
        over = middle - np.array([profile[beside & (at < 0)].mean(), profile[beside & (at > 0)].mean()])
        height = float(np.sign(over[0]) * np.abs(over).min()) if over[0] * over[1] > 0 else 0.0
        most = height if abs(height) > abs(most) else most
    return most


def sides_gray(image: Image, camera: Camera, points_mm: Float, diameter_mm: float) -> Float:
    """How strong an edge runs along a curve (N, 3) on either side (2,), wider than the needle, grey levels.

    The curve is given in this camera's frame. An edge is as strong as four fifths of the curve show it at least, in the
    same sense and at the same distance.
    """
    radii_mm = np.arange(diameter_mm / 2 + _SIDE_FROM_MM, _SIDE_TO_MM, _SIDE_STEP_MM)
    px_per_mm = camera.focal_px / float(np.median(points_mm[:, 2]))
    offsets_px = _offsets_px((radii_mm[-1] + _EDGE_MM[1]) * px_per_mm)
    aside_mm = np.stack([-offsets_px, offsets_px])[:, None, :] / px_per_mm - radii_mm[:, None]
    strip = _strip(image, camera, points_mm, offsets_px, 0.0)
    beyond, within = (
        strip @ (mask / np.maximum(mask.sum(axis=-1, keepdims=True), 1)).reshape(-1, len(offsets_px)).T
        for mask in ((low <= aside_mm) & (aside_mm <= high) for low, high in (_EDGE_MM, (-_EDGE_MM[1], -_EDGE_MM[0])))
    )
    low, high = np.quantile(beyond - within, (1 - _SIDE_SHARE, _SIDE_SHARE), axis=0)
    least = np.where(low * high > 0, np.minimum(np.abs(low), np.abs(high)), 0.0)
    return np.asarray(least.reshape(2, -1).max(axis=1))


def _offsets_px(reach_px: float) -> Float:
    steps = np.ceil(reach_px / _ACROSS_STEP_PX)
    return np.arange(-steps, steps + 1) * _ACROSS_STEP_PX


def _strip(image: Image, camera: Camera, points_mm: Float, offsets_px: Float, sigma_rows: float) -> Float32:
    """Grey levels (N, len(offsets_px)) across a curve, smoothed along it."""
    strip = np.empty((len(points_mm), len(offsets_px)), np.float32)
    failed = call(
        "strip_beside",
        *rows_of(image),
        camera.lens,
        np.ascontiguousarray(points_mm),
        len(points_mm),
        float(offsets_px[0]),
        _ACROSS_STEP_PX,
        len(offsets_px),
        sigma_rows,
        strip,
    )
    if failed:
        raise MemoryError("there is no memory for the kernel that looks beside a curve")
    return strip
