"""Where an image shows thin structures of the needle's width: ridge responses, thresholded.

Second derivatives of the Gaussian-blurred image (Lindeberg 1998; Steger 1998) at scales that the needle's range of
diameters implies in the workspace, for bright and dark lines apart: a needle may be either, and a dark vessel beneath a
bright needle must not swallow it.
"""

import math
from contextvars import ContextVar
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.kernels import call
from needletrack.records import Image
from needletrack.tracking.needle import Positive

Mask = npt.NDArray[np.bool_]
Gray = npt.NDArray[np.float32]
# Reduced images keep the thinnest needle about this wide, px: thinner ones drown in noise, wider ones only cost time.
_REDUCED_WIDTH_PX = 0.9
# The side lobes of a line reach so many sigmas of the filter; a line is more than this share of another beside it.
_LOBE_REACH, _LOBE_SHARE = 2.5, 0.6


# Lines cover a few percent of an image; noise makes about a third of its pixels respond.
_MIN_NOISE_SHARE = 0.1


class SegmentParameters(BaseModel):
    """How faint a line may be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    high_threshold_noise: Positive = Field(
        8.0, description="A line must somewhere answer by this many times the image's typical ridge response."
    )
    low_threshold_noise: Positive = Field(4.0, description="It is followed down to this many times that response.")
    min_response_gray: Positive = Field(
        1.5, description="Lowest ridge response, grey levels, that starts a line, however quiet the image."
    )


@dataclass(frozen=True, slots=True)
class Ridges:
    """Thin structures of one image at 1 / reduction of its size.

    bright, dark (rows, columns): masks of the two polarities; reduced: the reduced image, float32.
    """

    bright: Mask
    dark: Mask
    reduced: Gray
    reduction: int


def find_ridges(image: Image, width_range_px: tuple[float, float], parameters: SegmentParameters) -> Ridges:
    """Masks of the thin bright and thin dark structures of an image (rows, columns) of the given widths, raw px."""
    reduction = max(1, round(width_range_px[0] / _REDUCED_WIDTH_PX))
    reduced = _reduced(np.ascontiguousarray(image), reduction)
    widths = np.array(width_range_px) / reduction
    bright, dark = _line_responses(reduced, (max(1.0, widths[0] / 2), max(2.0, widths[1] / 2)))
    return Ridges(_hysteresis(bright, parameters), _hysteresis(dark, parameters), reduced, reduction)


class _Scratch:
    """Arrays for what is computed on the way, kept from call to call: fresh ones cost more than what fills them.

    Handed back to the system and fetched again page by page they took three quarters of this stage's time.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.grays = [np.empty(shape, np.float32) for _ in range(4)]
        self.responses = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self.pixels = np.empty(shape, np.int32)

    @staticmethod
    def of(shape: tuple[int, int]) -> "_Scratch":
        """The arrays for images of a shape (rows, columns); every thread has its own."""
        kept = _kept.get(None)
        if kept is None or kept.shape != shape:
            kept = _Scratch(shape)
            _kept.set(kept)
        return kept


_kept: ContextVar[_Scratch] = ContextVar("_kept")


def _reduced(image: Image, reduction: int) -> Gray:
    """The means (rows, columns) of whole squares of pixels, in whole grey levels."""
    rows, columns = image.shape[0] // reduction, image.shape[1] // reduction
    reduced = np.empty((rows, columns), np.float32)
    sums = np.empty(columns * reduction, np.uint16)
    call("reduce", image, image.shape[1], reduction, rows, columns, sums, reduced)
    return reduced


def _line_responses(image: Gray, sigmas_px: tuple[float, ...]) -> tuple[Gray, Gray]:
    scratch = _Scratch.of(image.shape)
    bright, dark = scratch.responses
    bright.fill(0)
    dark.fill(0)
    for sigma in sigmas_px:
        blurred, bright_lines, dark_lines, nearby = scratch.grays
        cv2.GaussianBlur(image, (0, 0), sigma, dst=blurred, borderType=cv2.BORDER_REPLICATE)
        call("line_answers", blurred, *image.shape, float(sigma**2), bright_lines, dark_lines)
        # Beside a line of one polarity the second derivative has lobes of the other, 0.45 of its height (Gaussian
        # profile), as far as the filter reaches: what is further away, such as a vessel beside a faint needle, has none
        # here.
        size = 2 * math.ceil(_LOBE_REACH * sigma) + 1
        reach = np.ones((size, size), np.uint8)
        cv2.dilate(dark_lines, reach, dst=nearby)
        call("add_lines", bright_lines, nearby, _LOBE_SHARE, image.size, bright)
        cv2.dilate(bright_lines, reach, dst=nearby)
        call("add_lines", dark_lines, nearby, _LOBE_SHARE, image.size, dark)
    for response in (bright, dark):
        response[[0, -1]] = 0
        response[:, [0, -1]] = 0
    return bright, dark


def _hysteresis(response: Gray, parameters: SegmentParameters) -> Mask:
    # The median of the positive responses is a measure of noise where they are noise: in an overexposed image only
    # the lines themselves respond, and nothing is to be told from them.
    sample = response[::2, ::2]
    positive = sample[sample > 0]
    noise = float(np.median(positive)) if positive.size > _MIN_NOISE_SHARE * sample.size else 0.0
    high = max(parameters.high_threshold_noise * noise, parameters.min_response_gray)
    low = min(high, max(parameters.low_threshold_noise * noise, parameters.min_response_gray / 2))
    mask = np.empty(response.shape, np.bool_)
    call("hysteresis", response, *response.shape, float(low), float(high), _Scratch.of(response.shape).pixels, mask)
    return mask
