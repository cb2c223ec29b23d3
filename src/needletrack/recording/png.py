"""One recorded image: a whole PNG of the expected size, as gray, or the reason why not."""

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.errors import RecordingError
from needletrack.reading import opened, picture
from needletrack.records import DropReason, Pixels

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33  # signature and the whole IHDR chunk
# Incompressible 16-bit RGBA, and room for the chunks around it; a larger file is no such image.
_MAX_BYTES_PER_PIXEL = 9
_MAX_OVERHEAD_BYTES = 1 << 20


class UnusableImage(RecordingError):
    """An image that cannot become a frame; the message names file and fault, `reason` the code."""

    def __init__(self, path: Path, reason: DropReason, fault: str) -> None:
        super().__init__(f"{path}: {fault}")
        self.reason = reason
        self.fault = fault


def png_size(path: Path) -> tuple[int, int] | None:
    """Width and height that a file's PNG header claims; None where there is no such header or file."""
    try:
        with opened(path) as file:
            return _size_in(file.read(_HEADER_BYTES))
    except OSError:
        return None


def read_gray(path: Path, size_px: tuple[int, int]) -> Pixels:
    """The image (rows, columns) of uint8, of a gray one of 16 bits uint16; read-only; raises UnusableImage.

    Colour is weighed as OpenCV's BGR2GRAY does (ITU-R BT.601: 0.299 R + 0.587 G + 0.114 B), alpha is left
    out, and 16 bits of it keep their upper 8. Nothing is decoded before the header's size is the expected one and
    every chunk's checksum right: whether a decoder refuses half a picture depends on its version.
    """
    width, height = size_px
    try:
        with opened(path) as file:
            header = file.read(_HEADER_BYTES)
            size = _size_in(header)
            if size is None:
                raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, "no PNG, or not even its header is whole")
            if size != size_px:
                fault = f"the image is {size[0]}x{size[1]}, the rig says {width}x{height}"
                raise UnusableImage(path, DropReason.WRONG_SIZE, fault)
            most = width * height * _MAX_BYTES_PER_PIXEL + _MAX_OVERHEAD_BYTES
            if os.fstat(file.fileno()).st_size > most:
                fault = f"the file is too long for a {width}x{height} image"
                raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, fault)
            data = header + file.read()
    except FileNotFoundError:
        raise UnusableImage(path, DropReason.MISSING_IMAGE, "there is no such image") from None
    except OSError as error:
        raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, error.strerror or str(error)) from error
    try:
        pixels = picture(data)
    except ValueError as error:
        raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, str(error)) from error
    return as_gray(pixels)


def as_gray(pixels: npt.NDArray[Any]) -> Pixels:
    """A picture as OpenCV decodes it, as gray, read-only: uint8, of a gray one of 16 bits uint16."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_BGR2GRAY)
        if pixels.dtype == np.uint16:
            pixels = np.right_shift(pixels, 8).astype(np.uint8)
    pixels.flags.writeable = False
    return pixels


def _size_in(header: bytes) -> tuple[int, int] | None:
    whole = len(header) == _HEADER_BYTES and header[:8] == _SIGNATURE and header[12:16] == b"IHDR"
    if not whole or zlib.crc32(header[12:29]) != int.from_bytes(header[29:], "big"):
        return None
    width, height = struct.unpack(">II", header[16:24])
    return width, height
