"""Where an image shows thin structures of the needle's width: ridge responses, thresholded.

Second derivatives of the Gaussian-blurred image (Lindeberg 1998; Steger 1998) at scales that the needle's range of
diameters implies in the workspace, for bright and dark lines apart: a needle may be either, and a dark vessel beneath a
bright needle must not swallow it.
"""

import math
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


def _line_responses(image: Gray, sigmas_px: tuple[float, ...]) -> tuple[Gray, Gray]:
    bright = np.zeros_like(image)
    dark = np.zeros_like(image)
    border = cv2.BORDER_REPLICATE
    for sigma in sigmas_px:
        blurred = cv2.GaussianBlur(image, (0, 0), sigma, borderType=border)
        xx = cv2.Sobel(blurred, cv2.CV_32F, 2, 0, ksize=1, scale=sigma**2, borderType=border)
        yy = cv2.Sobel(blurred, cv2.CV_32F, 0, 2, ksize=1, scale=sigma**2, borderType=border)
        xy = cv2.Sobel(blurred, cv2.CV_32F, 1, 1, ksize=3, scale=0.25 * sigma**2, borderType=border)
        # The eigenvalues of the Hessian are mean -+ spread. A line curves across and hardly along: the stronger one is
        # more than twice the other, which is |mean| between a third of the spread and three times it.
        mean = cv2.addWeighted(xx, 0.5, yy, 0.5, 0.0)
        spread = cv2.magnitude(cv2.addWeighted(xx, 0.5, yy, -0.5, 0.0), xy)
        size = np.abs(mean)
        strength = size + spread
        strength *= (3 * size > spread) & (size < 3 * spread)
        sides = [np.where(side, strength, np.float32(0)) for side in (mean < 0, mean > 0)]
        lines = _without_side_lobes(sides[0], sides[1], sigma)
        np.maximum(bright, lines[0], out=bright)
        np.maximum(dark, lines[1], out=dark)
    for response in (bright, dark):
        response[[0, -1]] = 0
        response[:, [0, -1]] = 0
    return bright, dark


def _without_side_lobes(bright: Gray, dark: Gray, sigma: float) -> tuple[Gray, Gray]:
    # Beside a line of one polarity the second derivative has lobes of the other, 0.45 of its height (Gaussian profile),
    # as far as the filter reaches: what is further away, such as a vessel beside a faint needle, has none here.
    size = 2 * math.ceil(_LOBE_REACH * sigma) + 1
    reach = np.ones((size, size), np.uint8)
    share = np.float32(0.6)
    return bright * (bright > share * cv2.dilate(dark, reach)), dark * (dark > share * cv2.dilate(bright, reach))


def _hysteresis(response: Gray, parameters: SegmentParameters) -> Mask:
    # The median of the positive responses is a measure of noise where they are noise: in an overexposed image only
    # the lines themselves respond, and nothing is to be told from them.
    sample = response[::2, ::2]
    positive = sample[sample > 0]
    noise = float(np.median(positive)) if positive.size > _MIN_NOISE_SHARE * sample.size else 0.0
    high = max(parameters.high_threshold_noise * noise, parameters.min_response_gray)
    low = min(high, max(parameters.low_threshold_noise * noise, parameters.min_response_gray / 2))
    candidates = (response > low).astype(np.uint8)
    count, labels = cv2.connectedComponents(candidates, connectivity=8)
    keep = np.zeros(count, np.bool_)
    keep[labels[response > high]] = True
    keep[0] = False
    return np.asarray(keep[labels], dtype=np.bool_)
