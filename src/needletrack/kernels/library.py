"""The compiled library: found, loaded and called."""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from needletrack.errors import InstallationError

Array = npt.NDArray[Any]

_HERE = Path(__file__).parent
BASELINE, WITH_AVX2 = _HERE / "kernels.so", _HERE / "kernels-v3.so"


def load(path: Path) -> ctypes.CDLL:
    """The library at a path; raises InstallationError where it cannot be loaded."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise InstallationError(
            f"{path}: the compiled kernels cannot be loaded ({error}); install needletrack again, with a C compiler"
            " at hand: make env, or pip install"
        ) from error
    # An item of a library is a new function each time; an attribute is kept.
    library.streak_misfit.restype = ctypes.c_double
    for kernel in (library.told_of_curve, library.covariance_of_tip, library.off_epipolar_px):
        kernel.restype = ctypes.c_double
    library.tip_picture.restype = ctypes.c_double
    library.find_streak.restype = ctypes.c_int64
    return library


def best_library() -> Path:
    """The library for this machine's processor."""
    return WITH_AVX2 if WITH_AVX2.exists() and load(BASELINE).has_x86_64_v3() else BASELINE


_library = load(best_library())


def address(array: Array) -> int:
    """Where the values of a C-contiguous array lie; the caller keeps it alive. Raises ValueError for any other."""
    if not array.flags.c_contiguous:
        raise ValueError("a kernel reads arrays that are contiguous")
    return int(array.__array_interface__["data"][0])


def call(name: str, *arguments: Array | float | int | ctypes.Structure | ctypes.Array[Any] | None) -> Any:
    """What the kernel of that name returns; arrays are handed over as pointers, whole numbers as int64.

    None is a null pointer.
    """
    passed: list[Any] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            passed.append(ctypes.c_void_p(address(argument)))
        elif argument is None:
            passed.append(None)
        elif isinstance(argument, float):
            passed.append(ctypes.c_double(argument))
        elif isinstance(argument, int):
            passed.append(ctypes.c_int64(argument))
        else:
            passed.append(ctypes.byref(argument) if isinstance(argument, ctypes.Structure) else argument)
    return getattr(_library, name)(*passed)


def packed_lens(
    matrix: Array, distortion: Array, tilt: Array, rotation: Array | None = None, translation_mm: Array | None = None
) -> Array:
    """A camera as the kernels know it: matrix (3, 3), distortion (n,) in OpenCV's order, tilt (3, 3), and its pose."""
    terms = np.zeros(12)
    terms[: min(12, len(distortion))] = distortion[:12]
    packed = np.concatenate(
        [
            [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[0, 1]],
            terms,
            tilt.ravel(),
            np.eye(3).ravel() if rotation is None else rotation.ravel(),
            np.zeros(3) if translation_mm is None else translation_mm,
        ]
    )
    packed.flags.writeable = False
    return packed


class Sight(ctypes.Structure):
    """What one view measures of a curve, as `fit.c` lays it out. `keep` holds the arrays it points to."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("camera", ctypes.c_void_p),
        ("here_px", ctypes.c_void_p),
        ("ahead", ctypes.c_void_p),
        ("offset_px", ctypes.c_void_p),
        ("sigma_px", ctypes.c_void_p),
        ("ends", ctypes.c_int64),
        ("end_index", ctypes.c_void_p),
        ("end_here_px", ctypes.c_void_p),
        ("end_ahead", ctypes.c_void_p),
        ("end_sigma_px", ctypes.c_void_p),
        ("lines", ctypes.c_int64),
        ("line_index", ctypes.c_void_p),
        ("line_offset_px", ctypes.c_void_p),
        ("line_weighted", ctypes.c_void_p),
        ("line_normal", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("index", ctypes.c_void_p),
        ("residual", ctypes.c_void_p),
        ("rows", ctypes.c_void_p),
        ("weight", ctypes.c_void_p),
        ("sigma", ctypes.c_void_p),
    ]


def two_sights() -> ctypes.Array[Sight]:
    """Room for what the left and the right view measure; the arrays they point to are kept alive by the caller."""
    return (Sight * 2)()


MOST_SHAPES = 8


class TipView(ctypes.Structure):
    """One view of an end, and pictures of the shapes of end that are tried, as `kernels.h` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("weight", ctypes.c_void_p),
        ("weighted", ctypes.c_void_p),
        ("fixed", ctypes.c_void_p),
        ("noise_gray", ctypes.c_double),
        ("parts", ctypes.c_int64),
        ("pictures", ctypes.c_void_p * MOST_SHAPES),
        ("own", ctypes.c_void_p * MOST_SHAPES),
        ("extent", ctypes.c_void_p * MOST_SHAPES),
        ("distances", ctypes.c_int64 * MOST_SHAPES),
        ("before_mm", ctypes.c_double * MOST_SHAPES),
    ]


def two_tip_views() -> ctypes.Array[TipView]:
    """Room for the left and the right view of an end; the arrays they point to are kept alive by the caller."""
    return (TipView * 2)()
