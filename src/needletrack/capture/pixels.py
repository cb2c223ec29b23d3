"""Driver buffers to gray images."""

from dataclasses import dataclass

import cv2
import numpy as np

from needletrack.reading import picture
from needletrack.records import Image, Image16, Pixels

_END_OF_JPEG = b"\xff\xd9"
# Where the first luminance byte lies in two, for the packed formats.
_LUMINANCE = {"YUYV": 0, "UYVY": 1}
_BITS = {"Y10": 10, "Y12": 12}


@dataclass(frozen=True, slots=True)
class Layout:
    """How a driver lays out a picture: a format of `PixelFormat`, pixels, bytes a row; bits: of Y16, those in use."""

    format: str
    width: int
    height: int
    stride: int
    bits: int = 16


def decoded(data: bytes | memoryview, layout: Layout) -> Pixels:
    """The picture in a buffer as a new read-only array (rows, columns); nothing of the buffer is kept.

    uint8; of more than eight bits uint16, the bits in use moved up to the full range, more than those being white.
    Raises ValueError where the buffer is too short, or no whole JPEG of the size.
    """
    image: Pixels = _jpeg(data, layout) if layout.format == "MJPG" else _packed(data, layout)
    image.flags.writeable = False
    return image


def _packed(data: bytes | memoryview, layout: Layout) -> Pixels:
    wanted = layout.stride * layout.height
    if len(data) < wanted:
        raise ValueError(f"{len(data)} bytes in place of {wanted}")
    rows = np.frombuffer(data, np.uint8, wanted).reshape(layout.height, layout.stride)
    if layout.format == "GREY":
        return rows[:, : layout.width].copy()
    row_bytes = rows[:, : 2 * layout.width]
    if layout.format in _LUMINANCE:
        return np.ascontiguousarray(row_bytes[:, _LUMINANCE[layout.format] :: 2])
    bits = _BITS.get(layout.format, layout.bits)
    words = np.ascontiguousarray(row_bytes).view("<u2")
    full: Image16 = np.minimum(words, np.uint16((1 << bits) - 1)).astype(np.uint16, copy=False)
    return np.left_shift(full, 16 - bits, out=full)


def _jpeg(data: bytes | memoryview, layout: Layout) -> Image:
    # libjpeg fills what is missing with gray and says nothing.
    if _END_OF_JPEG not in bytes(data[-64:]):
        raise ValueError("the JPEG has no end")
    pixels = picture(data, cv2.IMREAD_GRAYSCALE, ("JPEG",))
    if pixels.shape != (layout.height, layout.width):
        raise ValueError(f"a JPEG of {pixels.shape[1]}x{pixels.shape[0]}")
    return np.asarray(pixels, np.uint8)
