"""Where an image shows thin structures of the needle's width: ridge responses, thresholded.

Second derivatives of the Gaussian-blurred image (Lindeberg 1998; Steger 1998) at scales that the needle's range of
diameters implies in the workspace, for bright and dark lines apart: a needle may be either, and a dark vessel beneath a
bright needle must not swallow it.
"""

import math
import threading
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.records import Image
from needletrack.tracking.needle import Positive

Mask = npt.NDArray[np.bool_]
Gray = npt.NDArray[np.float32]
# Reduced images keep the thinnest needle about this wide, px: thinner ones drown in noise, wider ones only cost time.
_REDUCED_WIDTH_PX = 0.9
# The side lobes of a line, in sigmas of the filter.
_LOBE_REACH = 2.5


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
    size = (image.shape[1] // reduction, image.shape[0] // reduction)
    trimmed = image[: size[1] * reduction, : size[0] * reduction]
    reduced = cv2.resize(trimmed, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    widths = np.array(width_range_px) / reduction
    bright, dark = _line_responses(reduced, (max(1.0, widths[0] / 2), max(2.0, widths[1] / 2)))
    return Ridges(_hysteresis(bright, parameters), _hysteresis(dark, parameters), reduced, reduction)


class _Scratch(threading.local):
    """Arrays for what is computed on the way, kept from call to call: fresh ones cost more than what fills them.

    Handed back to the system and fetched again page by page they take three quarters of a search's time here.
    """

    def __init__(self) -> None:
        self.shape = (0, 0)

    def of(self, shape: tuple[int, int]) -> "_Scratch":
        """The arrays for images of a shape (rows, columns)."""
        if self.shape != shape:
            self.shape = shape
            self.grays = [np.empty(shape, np.float32) for _ in range(6)]
            self.responses = np.empty(shape, np.float32), np.empty(shape, np.float32)
            self.masks = [np.empty(shape, np.bool_) for _ in range(2)]
            self.labels = np.empty(shape, np.int32)
        return self


_scratch = _Scratch()


def _line_responses(image: Gray, sigmas_px: tuple[float, ...]) -> tuple[Gray, Gray]:
    bright, dark = _scratch.of(image.shape).responses
    bright.fill(0)
    dark.fill(0)
    for sigma in sigmas_px:
        _add_lines(image, sigma, bright, dark)
    for response in (bright, dark):
        response[[0, -1]] = 0
        response[:, [0, -1]] = 0
    return bright, dark


def _add_lines(image: Gray, sigma: float, bright: Gray, dark: Gray) -> None:
    """Raise the responses to bright and to dark lines to what they are at this scale."""
    scratch = _scratch.of(image.shape)
    a, b, c, d, e, f = scratch.grays
    is_line, is_it = scratch.masks
    border = cv2.BORDER_REPLICATE
    blurred = cv2.GaussianBlur(image, (0, 0), sigma, dst=a, borderType=border)
    xx = cv2.Sobel(blurred, cv2.CV_32F, 2, 0, dst=b, ksize=1, scale=sigma**2, borderType=border)
    yy = cv2.Sobel(blurred, cv2.CV_32F, 0, 2, dst=c, ksize=1, scale=sigma**2, borderType=border)
    xy = cv2.Sobel(blurred, cv2.CV_32F, 1, 1, dst=d, ksize=3, scale=0.25 * sigma**2, borderType=border)
    # The eigenvalues of the Hessian are mean -+ spread. A line curves across and hardly along: the stronger one is
    # more than twice the other, which is |mean| between a third of the spread and three times it.
    mean = cv2.addWeighted(xx, 0.5, yy, 0.5, 0.0, dst=a)
    difference = cv2.addWeighted(xx, 0.5, yy, -0.5, 0.0, dst=e)
    spread = cv2.magnitude(difference, xy, magnitude=b)
    size = np.abs(mean, out=c)
    strength = np.add(size, spread, out=d)
    np.greater(np.multiply(size, 3, out=e), spread, out=is_line)
    is_line &= np.less(size, np.multiply(spread, 3, out=e), out=is_it)
    # Products with masks: selecting (np.where) where masks are as ragged as noise takes ten times as long.
    np.less(mean, 0, out=is_it)
    is_it &= is_line
    np.multiply(strength, is_it, out=e)
    np.greater(mean, 0, out=is_it)
    is_it &= is_line
    np.multiply(strength, is_it, out=f)
    _add_without_side_lobes(e, f, sigma, bright, scratch)
    _add_without_side_lobes(f, e, sigma, dark, scratch)


def _add_without_side_lobes(lines: Gray, others: Gray, sigma: float, response: Gray, scratch: _Scratch) -> None:
    # Beside a line of one polarity the second derivative has lobes of the other, 0.45 of its height (Gaussian profile),
    # as far as the filter reaches: what is further away, such as a vessel beside a faint needle, has none here.
    size = 2 * math.ceil(_LOBE_REACH * sigma) + 1
    high = cv2.dilate(others, np.ones((size, size), np.uint8), dst=scratch.grays[0])
    high *= np.float32(0.6)
    is_it = np.greater(lines, high, out=scratch.masks[0])
    np.maximum(response, np.multiply(lines, is_it, out=high), out=response)


def _hysteresis(response: Gray, parameters: SegmentParameters) -> Mask:
    # The median of the positive responses is a measure of noise where they are noise: in an overexposed image only
    # the lines themselves respond, and nothing is to be told from them.
    sample = response[::2, ::2]
    positive = sample[sample > 0]
    noise = float(np.median(positive)) if positive.size > _MIN_NOISE_SHARE * sample.size else 0.0
    high = max(parameters.high_threshold_noise * noise, parameters.min_response_gray)
    low = min(high, max(parameters.low_threshold_noise * noise, parameters.min_response_gray / 2))
    scratch = _scratch.of(response.shape)
    candidates = np.greater(response, low, out=scratch.masks[0])
    count, labels = cv2.connectedComponents(candidates.view(np.uint8), labels=scratch.labels, connectivity=8)
    keep = np.zeros(count, np.bool_)
    keep[labels[np.greater(response, high, out=scratch.masks[1])]] = True
    keep[0] = False
    return np.take(keep, labels)
