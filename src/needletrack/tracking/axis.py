"""Where the needle's axis lies across a predicted curve, in each view, to a fraction of a pixel.

The image is straightened along the projected curve. In each cross section the needle's two silhouette edges are the
outermost significant departures from that side's own background, and the axis is midway: what lies inside the
silhouette, such as a streak of light on steel, has no say. Where the background is cluttered, the line that stands out
within the needle's width serves instead, at a sigma that allows for it to lie anywhere in that width.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.records import Float, Image
from needletrack.tracking.needle import Positive
from needletrack.tracking.profile import (
    EDGE_SPREAD_PX,
    FLANK_PX,
    Line,
    Silhouette,
    departure_area,
    find_line,
    find_silhouette,
    flanks,
    noise_gray,
)

Mask = npt.NDArray[np.bool_]
_ACROSS_STEP_PX = 0.5
# An edge without its partner is believed only this near to where it should be.
_ONE_EDGE_PX = 1.5
# A streak may lie anywhere within the needle's width, which is a sigma of 0.29 of what is missing; but it keeps to its
# side all along the needle, and what does not average out counts for more.
_STREAK_SIGMA = 0.4


class AxisParameters(BaseModel):
    """What counts as an edge of the needle."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_px: Positive = Field(
        3.5, description="The needle is looked for this far to either side of a rough prediction, px."
    )
    settled_search_px: Positive = Field(
        2.0,
        description="And this far once the diameter is known: clutter beside the needle then matters less, px.",
    )
    edge_threshold_noise: Positive = Field(
        3.0, description="An edge departs from its background by so many times one pixel's noise."
    )
    edge_threshold_gray: Positive = Field(2.5, description="And by at least so many grey levels.")
    line_height_gray: Positive = Field(
        8.0, description="A line within the needle stands out from both sides by so many grey levels."
    )
    smooth_along_mm: Positive = Field(0.5, description="Sigma of the averaging along the needle, mm.")
    edge_sigma_px: Positive = Field(
        0.1,
        description="Standard deviation of an axis point from two edges, px, where noise alone would say less.",
    )
    min_width_share: Positive = Field(
        0.35, description="Edges closer than this share of the expected width are not the needle's."
    )
    max_width_share: Positive = Field(1.25, description="Nor are edges further apart than this share of it.")
    width_slack_px: Positive = Field(
        0.6,
        description="Edges closer than expected by more than this are a streak within the needle and weigh less, px.",
    )


@dataclass(frozen=True, slots=True)
class AxisObservations:
    """What one view shows across a curve of N points.

    center_px, normal (N, 2): where each cross section was taken and its direction, raw px; offset_px (N,) of the axis
    along the normal, with sigma_px (N,), infinite where the needle is not seen; width_px (N,) between the edges, NaN
    without both; firm (N,) where there are both edges or a line; signals_gray_px (2, N) two measures of how much of the
    needle is there, the departure from the background and the line that stands out; flank_gray (2, N) mean grey levels
    close beside the needle.
    """

    center_px: Float
    normal: Float
    offset_px: Float
    sigma_px: Float
    width_px: Float
    firm: Mask
    signals_gray_px: Float
    flank_gray: Float

    @property
    def seen(self) -> Mask:
        """Where the view shows the needle, (N,) bool."""
        return np.isfinite(self.sigma_px)

    def part(self, start: int, stop: int) -> "AxisObservations":
        """The observations of the points start <= i < stop."""
        return self._taken(slice(start, stop))

    def turned(self) -> "AxisObservations":
        """The observations of the same points in the opposite order; left and right of the curve change places."""
        turned = self._taken(slice(None, None, -1))
        return AxisObservations(
            turned.center_px,
            -turned.normal,
            -turned.offset_px,
            turned.sigma_px,
            turned.width_px,
            turned.firm,
            turned.signals_gray_px,
            turned.flank_gray[::-1],
        )

    def _taken(self, cut: slice) -> "AxisObservations":
        return AxisObservations(
            self.center_px[cut],
            self.normal[cut],
            self.offset_px[cut],
            self.sigma_px[cut],
            self.width_px[cut],
            self.firm[cut],
            self.signals_gray_px[:, cut],
            self.flank_gray[:, cut],
        )


def observe_axis(
    image: Image,
    camera: Camera,
    points_mm: Float,
    max_width_px: float,
    expected_width_px: Float | None,
    parameters: AxisParameters,
) -> AxisObservations:
    """The axis across a predicted curve (N, 3), given in this camera's frame and evenly spaced.

    expected_width_px (N,) or None where the diameter is not known yet; widths then only have to stay below
    max_width_px.
    """
    center = camera.project(points_mm)
    along = tangents(center)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    known = expected_width_px is not None
    width = expected_width_px if expected_width_px is not None else np.full(len(center), max_width_px)
    middle_width = float(np.median(width))
    search_px = parameters.settled_search_px if known else parameters.search_px
    limit_px = middle_width / 2 + search_px

    steps = np.ceil((limit_px + EDGE_SPREAD_PX + FLANK_PX) / _ACROSS_STEP_PX) + 1
    offsets = np.arange(-steps, steps + 1) * _ACROSS_STEP_PX
    x, y = ((center[:, None, k] + offsets * normal[:, None, k]).astype(np.float32) for k in (0, 1))
    strip = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float64)
    threshold = max(parameters.edge_threshold_noise * noise_gray(strip), parameters.edge_threshold_gray)
    spacing_mm = float(np.linalg.norm(points_mm[1] - points_mm[0]))
    sigma_rows = parameters.smooth_along_mm / spacing_mm
    strip = np.asarray(
        cv2.GaussianBlur(strip, (1, 0), sigmaX=1e-6, sigmaY=sigma_rows, borderType=cv2.BORDER_REPLICATE),
        dtype=np.float64,
    )

    silhouette = find_silhouette(strip, offsets, limit_px, threshold)
    line = find_line(strip, offsets, middle_width, search_px, parameters.line_height_gray)
    line_fits = line.found & (line.width_px < parameters.max_width_share * width + 0.5)
    offset, sigma, seen_width = _from_edges(silhouette, line, line_fits, width, known, parameters)
    line_sigma = np.hypot(2 * parameters.edge_sigma_px, np.maximum(width - line.width_px, 0.0) * _STREAK_SIGMA)
    by_line = line_fits & ~(sigma < line_sigma)
    offset, sigma = np.where(by_line, line.middle_px, offset), np.where(by_line, line_sigma, sigma)
    sigma = np.where(camera.contains(center, margin_px=1.0) & (np.abs(offset) <= search_px), sigma, np.inf)
    seen = np.isfinite(sigma)
    return AxisObservations(
        center,
        normal,
        np.where(seen, offset, 0.0),
        sigma,
        seen_width,
        seen & (line_fits | np.isfinite(seen_width)),
        np.stack(
            [
                departure_area(strip, offsets, silhouette.background, middle_width),
                np.where(line_fits, line.height_gray * line.width_px, 0.0),
            ]
        ),
        flanks(strip, offsets, middle_width),
    )


def _from_edges(
    silhouette: Silhouette, line: Line, line_fits: Mask, width: Float, known: bool, parameters: AxisParameters
) -> tuple[Float, Float, Float]:
    """Axis offset, sigma and width, all (N,), from the silhouette's edges; infinite and NaN where there are none."""
    low, high = silhouette.edges_px
    # The line that stands out lies between the needle's edges, or these are edges of something else.
    outside = line_fits & ~((line.middle_px > low) & (line.middle_px < high))
    low, high = np.where(outside, np.nan, low), np.where(outside, np.nan, high)
    seen_width, middle = high - low, (low + high) / 2
    variance = parameters.edge_sigma_px**2 + (silhouette.sigma_px**2).sum(axis=0) / 4
    if known:
        # Narrower than the needle: a streak or one shaded side of it, which may lie anywhere within its width.
        missing = np.maximum(width - seen_width, 0.0)
        both = missing < (1 - parameters.min_width_share) * width
        both &= seen_width < width * parameters.max_width_share + 0.5
        variance = variance + np.where(missing > parameters.width_slack_px, missing * _STREAK_SIGMA, 0.0) ** 2
    else:
        both = (seen_width > 1.0) & (seen_width < width + 2.0)
    sigma = np.where(both, np.sqrt(variance), np.inf)
    # One edge: the one that leaves the axis nearer to the prediction, at the expected width.
    from_low, from_high = low + width / 2, high - width / 2
    nearer = np.where(
        np.nan_to_num(np.abs(from_low), nan=np.inf) <= np.nan_to_num(np.abs(from_high), nan=np.inf),
        from_low,
        from_high,
    )
    one = known & ~both & np.isfinite(nearer) & (np.abs(np.nan_to_num(nearer)) < _ONE_EDGE_PX)
    sigma = np.where(one, 4 * parameters.edge_sigma_px + 0.1 * width, sigma)
    return np.where(both, middle, np.where(one, nearer, 0.0)), sigma, np.where(both, seen_width, np.nan)
