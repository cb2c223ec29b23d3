"""One recorded image: a whole PNG of the expected size, as 8-bit gray, or the reason why not."""

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.errors import RecordingError
from needletrack.records import DropReason, Image

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
        with path.open("rb") as file:
            return _size_in(file.read(_HEADER_BYTES))
    except OSError:
        return None


def read_gray(path: Path, size_px: tuple[int, int]) -> Image:
    """The image (rows, columns) of uint8, read-only; raises UnusableImage.

    Colour is weighed as OpenCV's BGR2GRAY does (ITU-R BT.601: 0.299 R + 0.587 G + 0.114 B), alpha is left
    out, and 16 bits keep their upper 8. Nothing is decoded before the header's size is the expected one and
    every chunk's checksum right: whether a decoder refuses half a picture depends on its version.
    """
    width, height = size_px
    try:
        with path.open("rb") as file:
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
    if damage := _damage(data):
        raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, damage)
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, f"cannot be decoded: {error}") from error
    if decoded is None:
        raise UnusableImage(path, DropReason.UNREADABLE_IMAGE, "its pixels cannot be decoded")
    pixels: npt.NDArray[Any] = decoded
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_BGR2GRAY)
    gray: Image = (pixels >> 8 if pixels.dtype == np.uint16 else pixels).astype(np.uint8, copy=False)
    gray.flags.writeable = False
    return gray


def _size_in(header: bytes) -> tuple[int, int] | None:
    whole = len(header) == _HEADER_BYTES and header[:8] == _SIGNATURE and header[12:16] == b"IHDR"
    if not whole or zlib.crc32(header[12:29]) != int.from_bytes(header[29:], "big"):
        return None
    width, height = struct.unpack(">II", header[16:24])
    return width, height


def _damage(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG (ISO/IEC 15948, section 5); None where they are whole."""
    at = len(_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return f"corrupt: wrong checksum of the part at byte {at}"
        if kind == b"IEND":
            return None
        at = end
    return f"truncated: it ends within a part, after {len(data)} bytes"
