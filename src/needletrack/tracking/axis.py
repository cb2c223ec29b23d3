"""What the kernels that look at a whole curve know of its axis and its spline, as `curve.h` lays it out."""

import ctypes
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import Array, address
from needletrack.records import Image
from needletrack.tracking.evidence import EDGES, HALF_WIDTHS, OFFSETS, Grid, reference
from needletrack.tracking.fit import ROBUST_SIGMAS, ROUNDS, FitParameters, priors
from needletrack.tracking.needle import Needle
from needletrack.tracking.silhouette import (
    CLUTTERED,
    DRIFTS,
    LEAST_GAIN,
    LEAST_SIGMA,
    LEAST_UNIT_GRAY,
    LOG_NEVER,
    LOG_OUTLIER,
    MOTION_PRICE,
    OUTLIER,
    ROWS_PER_SECTION,
    TURN_PRICE,
    UNIT_PER_NOISE,
    USED,
    unit_mm,
)
from needletrack.tracking.streak import LEAST_SHARE, LINE, RULES

P, I, D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double

# What the kernels say of a curve: found, or why not; more than these, what one of them alone says.
FOUND, NOT_SEEN, NOT_HELD, NO_MEMORY, OTHERS = range(5)
# Control points of a spline at most.
MOST_CONTROL = 30
# A pixel of so much is clipped: the last value but one may still be rounded noise of a clipped one.
CLIPPED_GRAY = 254


class Eye(ctypes.Structure):
    """One view."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("image", P),
        ("rows", I),
        ("columns", I),
        ("stride", I),
        ("own", P),
        ("posed", P),
    ]


class Axis(ctypes.Structure):
    """How sections tell the axis, `evidence.py` and `silhouette.py`; the look of the needle is left open."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("rows_per_section", I),
        ("offsets", P),
        ("samples", I),
        ("unit_mm", D),
        ("least_gray", D),
        ("per_noise", D),
        ("whitener", P),
        ("half_widths", P),
        ("half_width", I),
        ("banks", P),
        ("none_bank", P),
        ("edges", I),
        ("places", I),
        ("fine_shifts", I),
        ("step", D),
        ("fine_step", D),
        ("refine", P),
        ("never", D),
        ("outlier", D),
        ("drifts", P),
        ("drift_count", I),
        ("motion_price", D),
        ("turn_price", D),
        ("floor_log", D),
        ("least_gain", D),
        ("least_sigma", D),
        ("used", D),
        ("clutter_factor", D),
        ("spreads", P),
        ("looks", I),
        ("lively", I),
        ("line", P),
        ("line_length", I),
        ("streak_rules", P),
        ("streak_least_share", D),
        ("white_gray", D),
    ]


class Spline(ctypes.Structure):
    """How a spline is fitted, `fit.py`; what pulls the axis aside depends on the look of the needle."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("control_spacing_mm", D),
        ("priors", P),
        ("streak_shares", P),
        ("streak_mm", D),
        ("streak_robust", D),
        ("correlation_mm", D),
        ("robust_px", D),
        ("rounds", I),
        ("systematic_px", D),
        ("systematic_mm", D),
    ]


class Kept:
    """Arrays whose addresses are in a structure, which must live as long as it does."""

    def __init__(self) -> None:
        self._arrays: list[Array] = []

    def at(self, array: Array) -> int:
        """Where it lies."""
        self._arrays.append(array)
        return address(array)


def two_eyes(images: tuple[Image, Image], rig: StereoRig, kept: Kept) -> ctypes.Array[Eye]:
    """Both views of a pair."""
    eyes = (Eye * 2)()
    for eye, image, camera, lens in zip(eyes, images, (rig.left, rig.right), rig.lenses, strict=True):
        contiguous = np.ascontiguousarray(image)
        eye.image, eye.rows, eye.columns, eye.stride = kept.at(contiguous), *contiguous.shape, contiguous.shape[1]
        eye.own, eye.posed = kept.at(camera.lens), kept.at(lens)
    return eyes


def axis_of(needle: Needle, grid: Grid, spreads: tuple[float, ...], kept: Kept) -> Axis:
    """The axis of a needle, looked for on a grid, give or take so much at each look."""
    return Axis(
        rows_per_section=ROWS_PER_SECTION,
        offsets=kept.at(OFFSETS),
        samples=len(OFFSETS),
        unit_mm=unit_mm(needle),
        least_gray=LEAST_UNIT_GRAY,
        per_noise=UNIT_PER_NOISE,
        whitener=kept.at(reference()),
        half_widths=kept.at(HALF_WIDTHS),
        edges=EDGES,
        places=grid.reach + 1,
        fine_shifts=len(grid.fine_shifts),
        step=grid.shifts[1] - grid.shifts[0],
        fine_step=grid.fine_shifts[1] - grid.fine_shifts[0],
        refine=kept.at(grid.refine),
        never=LOG_NEVER,
        outlier=OUTLIER,
        drifts=kept.at(DRIFTS),
        drift_count=len(DRIFTS),
        motion_price=MOTION_PRICE,
        turn_price=TURN_PRICE,
        floor_log=LOG_OUTLIER,
        least_gain=LEAST_GAIN,
        least_sigma=LEAST_SIGMA,
        used=USED,
        clutter_factor=CLUTTERED,
        spreads=kept.at(np.array(spreads)),
        looks=len(spreads),
        line=kept.at(LINE),
        line_length=len(LINE),
        streak_rules=kept.at(RULES),
        streak_least_share=LEAST_SHARE,
        white_gray=CLIPPED_GRAY,
    )


def spline_of(fit: FitParameters, kept: Kept) -> Spline:
    """The spline of the fit's parameters."""
    return Spline(
        control_spacing_mm=fit.control_spacing_mm,
        priors=kept.at(priors(fit)),
        streak_shares=kept.at(np.array([fit.streak_share, fit.streak_change_share, fit.streak_bend_share])),
        streak_mm=fit.streak_mm,
        streak_robust=ROBUST_SIGMAS,
        correlation_mm=fit.correlation_mm,
        robust_px=fit.robust_px,
        rounds=ROUNDS,
        systematic_mm=fit.systematic_mm,
    )
