"""Files that somebody else wrote, read so that none of them can hang, exhaust or crash whoever reads it.

What a parser says to a hostile file is up to its authors: here it all becomes an OSError or a ValueError in words.
"""

import errno
import io
import json
import os
import stat
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image as PictureFile
from PIL import UnidentifiedImageError

# A rig with its uncertainty takes 10 kB; PyYAML takes a second for 100.
MOST_DOCUMENT_BYTES = 300_000
# 67 million: more than the cameras have that can be had, and 64 MB as gray.
MOST_PIXELS = 1 << 26

# Aliases multiply what the constructor makes of it.
_MOST_NODES, _DEEPEST = 100_000, 64
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PICTURE_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM")
_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def opened(path: Path | str) -> IO[bytes]:
    """A regular file, open for reading; no read asks for more than it has. OSError for anything else, without waiting.

    The lengths that a file states of its own parts are then harmless: nothing is allocated for what is not there.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, f"no name of a file ({error})") from error
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            what = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
            raise OSError(errno.EINVAL, f"it is {what}: name a regular file")
        return _WholeFile(descriptor)
    except BaseException:
        os.close(descriptor)
        raise


class _WholeFile(io.BufferedReader):
    def __init__(self, descriptor: int) -> None:
        super().__init__(io.FileIO(descriptor))
        self._size = os.fstat(descriptor).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > 0:
            size = max(min(size, self._size - self.tell()), 0)
        return super().read(size)


def bytes_of(path: Path | str, most_bytes: int = MOST_DOCUMENT_BYTES) -> bytes:
    """A regular file's content; raises OSError, also where it is larger than most_bytes."""
    with opened(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > most_bytes:
            raise OSError(
                errno.EFBIG, f"it has {size / 1e6:.1f} MB, more than the {most_bytes / 1e6:g} MB that are taken"
            )
        return file.read(most_bytes)


def text_of(path: Path | str, most_bytes: int = MOST_DOCUMENT_BYTES, encoding: str = "utf-8") -> str:
    """The same as text, with line ends as they are on Linux; raises OSError, UnicodeDecodeError."""
    return bytes_of(path, most_bytes).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def yaml_document(text: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """What a YAML text holds; ValueError where it is none, nests too deep, or multiplies itself by aliases."""
    try:
        reader = loader(text)
        node = reader.get_single_node()
        if node is None:
            return None
        _require_small(node)
        return reader.construct_document(node)
    except (yaml.YAMLError, _TooLarge) as error:
        raise ValueError(str(error)) from error
    except RecursionError as error:
        raise ValueError(f"it nests more than {_DEEPEST} deep") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        # `!!int abc`, 2026-13-45 and their like: PyYAML lets out whatever Python says to them.
        raise ValueError(f"a value that YAML does not know how to read: {error}") from error


class _TooLarge(ValueError):
    """A document with more in it than any of ours."""


def _require_small(root: yaml.Node) -> None:
    """_TooLarge where a document, its aliases written out, is no document of ours."""
    sizes: dict[int, int] = {}
    inside: set[int] = set()

    def size(node: yaml.Node, depth: int) -> int:
        if id(node) in sizes:
            return sizes[id(node)]
        if depth > _DEEPEST or id(node) in inside:
            raise _TooLarge(f"it nests more than {_DEEPEST} deep, or contains itself")
        inside.add(id(node))
        below = 0
        if isinstance(node, yaml.MappingNode):
            below = sum(size(key, depth + 1) + size(value, depth + 1) for key, value in node.value)
        elif isinstance(node, yaml.SequenceNode):
            below = sum(size(value, depth + 1) for value in node.value)
        inside.remove(id(node))
        sizes[id(node)] = 1 + below
        if sizes[id(node)] > _MOST_NODES:
            raise _TooLarge(f"its aliases make more than {_MOST_NODES} values of it")
        return sizes[id(node)]

    size(root, 0)


def json_document(text: str | bytes) -> Any:
    """What a JSON text holds; ValueError where it is none or nests too deep."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it nests too deep") from error


def picture(
    data: bytes | memoryview, flags: int = cv2.IMREAD_UNCHANGED, formats: tuple[str, ...] = _PICTURE_FORMATS
) -> npt.NDArray[Any]:
    """The pixels of an encoded picture, as cv2.imdecode gives them; ValueError before anything large is allocated.

    formats: those to take, as Pillow names them. All of a PNG must be whole: OpenCV (5.0.0) allocates, and fills, the
    gigabytes that a chunk claims to have.
    """
    if bytes(data[: len(_PNG_SIGNATURE)]) == _PNG_SIGNATURE and (damage := _png_damage(bytes(data))):
        raise ValueError(damage)
    try:
        with PictureFile.open(io.BytesIO(data), formats=formats) as file:
            width, height = file.size
    except PictureFile.DecompressionBombError as error:
        raise ValueError(f"it claims more than {MOST_PIXELS >> 20} million pixels") from error
    except UnidentifiedImageError as error:
        raise ValueError(f"no {' or '.join(formats)}, or not even its header is whole") from error
    except Exception as error:  # a header that Pillow's plugins stumble over
        raise ValueError(f"its header is damaged: {error}") from error
    if width * height > MOST_PIXELS:
        raise ValueError(f"it claims {width}x{height} pixels, more than {MOST_PIXELS >> 20} million")
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"its pixels cannot be decoded: {error.err}") from error
    if decoded is None:
        raise ValueError("its pixels cannot be decoded")
    return decoded


def _png_damage(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG (ISO/IEC 15948, section 5); None where they are whole."""
    at = len(_PNG_SIGNATURE)
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
