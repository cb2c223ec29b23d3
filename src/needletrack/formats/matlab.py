"""MATLAB: what stereoParametersToOpenCV returns, in a .mat file, and what stereoParametersFromOpenCV takes.

Those functions move the principal point by one pixel between MATLAB's origin (1, 1) and OpenCV's (0, 0): the numbers in
the file are OpenCV's. Lengths are millimetres. A stereoParameters object itself cannot be read outside of MATLAB.

The six arrays are read here: SciPy's loadmat (1.17.1) reads beyond its memory in a damaged file, and ends the process.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.io import savemat

from needletrack.errors import CalibrationError
from needletrack.formats.geometry import camera_of, rig_of, rotation_of
from needletrack.geometry.transform import RigidTransform
from needletrack.reading import bytes_of
from needletrack.records import Float
from needletrack.rig import Rig

_MOST_BYTES = 50_000_000
_MOST_UNPACKED_BYTES = 1 << 16
_HEADER_BYTES, _MATRIX, _COMPRESSED = 128, 14, 15
# mxDOUBLE_CLASS to mxUINT64_CLASS; the types that numbers are stored in, of whatever class they are.
_NUMERIC_CLASSES = range(6, 16)
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
KEYS = (
    "intrinsicMatrix1",
    "distortionCoefficients1",
    "intrinsicMatrix2",
    "distortionCoefficients2",
    "rotationOfCamera2",
    "translationOfCamera2",
)


def read_matlab(path: Path, name: str, size_px: tuple[int, int] | None) -> Rig:
    """The rig of a .mat file; size_px (width, height) where it has no imageSize (rows, columns, as in MATLAB)."""
    try:
        data = bytes_of(path, _MOST_BYTES)
        found = _variables(data)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: cannot be read: {error}; save it with -v7 or -v6") from error
    if missing := [key for key in KEYS if key not in found]:
        raise CalibrationError(
            f"{path}: {', '.join(missing)} missing: save what stereoParametersToOpenCV(stereoParams) returns"
        )
    if size_px is None and "imageSize" not in found:
        raise CalibrationError(f"{path}: the images' size is not in it: give it, e.g. --size 1280x1024")
    try:
        if size_px is None:
            rows, columns = np.ravel(found["imageSize"])[:2]
            size_px = int(columns), int(rows)
        values = [np.asarray(found[key], dtype=np.float64) for key in KEYS]
        left, right = (camera_of(values[i], values[i + 1], size_px) for i in (0, 2))
        pose = RigidTransform(rotation_of(values[4], KEYS[4]), values[5].ravel())
        return rig_of(left, right, pose, name, "matlab", [path])
    except (ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(f"{path}: {error}") from error


def _variables(data: bytes) -> dict[str, Float]:
    """The real numeric arrays among KEYS and imageSize in a file of level 5; raises ValueError.

    MathWorks, MAT-File Format, "Level 5 MAT-File Format".
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        raise ValueError("no MAT file of level 5")
    found: dict[str, Float] = {}
    for kind, content in _elements(memoryview(data)[_HEADER_BYTES:], order):
        variable = content
        if kind == _COMPRESSED:
            try:
                unpacked = zlib.decompressobj().decompress(content, _MOST_UNPACKED_BYTES)
            except zlib.error as error:
                raise ValueError(str(error)) from error
            if len(unpacked) < 8:
                raise ValueError("a compressed variable is cut off")
            # One that is not asked for may go on beyond what was unpacked: its name comes first.
            variable = memoryview(unpacked)[8:]
        if kind in (_MATRIX, _COMPRESSED):
            name, values = _array(variable, order)
            if values is not None:
                found[name] = values
    return found


def _array(content: memoryview, order: str) -> tuple[str, Float | None]:
    """A variable's name and, where it is one of ours, its values."""
    parts = _elements(content, order)
    try:
        (_, flags), (_, shape), (_, name_bytes) = (next(parts) for _ in range(3))
        name = bytes(name_bytes).decode("latin-1")
        if name not in (*KEYS, "imageSize"):
            return name, None
        kind, values = next(parts)
    except (StopIteration, RuntimeError) as error:
        raise ValueError("a variable is cut off") from error
    if len(flags) < 4 or struct.unpack_from(f"{order}I", flags)[0] & 0xFF not in _NUMERIC_CLASSES or kind not in _TYPES:
        raise ValueError(f"{name} holds no numbers")
    numbers = np.frombuffer(values, f"{order}{_TYPES[kind]}").astype(np.float64)
    return name, numbers.reshape(np.frombuffer(shape, f"{order}i4").tolist(), order="F")


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """(type, content) of each data element; raises ValueError where one is cut off."""
    at = 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            # A small element has its length beside its type, and its content in the tag.
            kind, length, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            start = at + 8
            # All but compressed ones are filled up to eight bytes.
            after = start + length + (-length % 8 if kind != _COMPRESSED else 0)
        if start + length > len(data):
            raise ValueError("the file is cut off, or states a length that it does not have")
        yield kind, data[start : start + length]
        at = after


def write_matlab(rig: Rig, path: Path) -> None:
    """Write a .mat file for stereoParametersFromOpenCV; raises CalibrationError for a rational lens, unknown there."""
    lenses = []
    for camera in (rig.left, rig.right):
        if np.any(camera.distortion[5:]):
            raise CalibrationError(f"{path}: MATLAB knows k1 k2 p1 p2 k3, this lens has more: calibrate with --lens 5")
        lens = np.zeros(5)
        kept = camera.distortion[:5]
        lens[: len(kept)] = kept
        lenses.append(lens[None])
    width, height = rig.left.size_px
    pose = rig.right_from_left
    values = (
        rig.left.matrix,
        lenses[0],
        rig.right.matrix,
        lenses[1],
        pose.rotation,
        pose.translation_mm.reshape(3, 1),
    )
    content = {**dict(zip(KEYS, values, strict=True)), "imageSize": np.array([[height, width]], dtype=np.float64)}
    try:
        savemat(path, content, appendmat=False)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror or error}") from error
