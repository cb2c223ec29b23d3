"""What each view shows beside a curve, and how strong a line along it: what tells sleeves and crossing things.

The image is straightened along the projected curve. The needle's own axis is `silhouette.py`'s.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.records import Float, Image
from needletrack.tracking.needle import Positive
from needletrack.tracking.profile import EDGE_SPREAD_PX, FLANK_PX, find_line, flanks

_ACROSS_STEP_PX = 0.5


class BesideParameters(BaseModel):
    """What counts as a line along the curve."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_px: Positive = Field(2.0, description="A line is looked for this far to either side of the curve, px.")
    line_height_gray: Positive = Field(8.0, description="It stands out from both its sides by so many grey levels.")
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
    center = camera.project(points_mm)
    along = tangents(center)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    width_px = diameter_mm * camera.focal_px / points_mm[:, 2]
    middle_px = float(np.median(width_px))
    reach_px = middle_px / 2 + parameters.search_px + EDGE_SPREAD_PX + FLANK_PX
    steps = np.ceil(reach_px / _ACROSS_STEP_PX) + 1
    offsets = np.arange(-steps, steps + 1) * _ACROSS_STEP_PX
    x, y = ((center[:, None, k] + offsets * normal[:, None, k]).astype(np.float32) for k in (0, 1))
    strip = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float64)
    sigma_rows = parameters.smooth_along_mm / float(np.linalg.norm(points_mm[1] - points_mm[0]))
    smooth = cv2.GaussianBlur(strip, (1, 0), sigmaX=1e-6, sigmaY=sigma_rows, borderType=cv2.BORDER_REPLICATE)
    strip = np.asarray(smooth, dtype=np.float64)
    line = find_line(strip, offsets, middle_px, parameters.search_px, parameters.line_height_gray)
    fits = line.found & (line.width_px < parameters.max_width_share * width_px + 0.5)
    return Beside(flanks(strip, offsets, middle_px), np.where(fits, line.height_gray * line.width_px, 0.0))
