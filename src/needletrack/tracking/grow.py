"""A rough curve followed to the needle's ends: adjusted, cut to what the views show, lengthened, and adjusted again.

What was found of a needle is a stretch of it. It grows at both ends as a parabola foresees it, round by round, until
the views show no more of it; where it seems to end it may bend more than that, or go on behind a gap. All rounds are
one call into the compiled kernel `grow.c`, of which each is what `adjust` does.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import address, call
from needletrack.records import Appearance, Float, Reason
from needletrack.tracking.adjust import BANK_WANTED, GROWING, ROUGH, Images, adjusting, make_missing
from needletrack.tracking.axis import FOUND, NOT_HELD, NOT_SEEN, D, I, Kept, P, two_eyes
from needletrack.tracking.fit import FitParameters
from needletrack.tracking.needle import Needle
from needletrack.tracking.silhouette import as_look

# Less than so much that looks like more of a needle beyond an end is none, mm.
_GOES_ON_MM = 1.5
# A curve that grew to this share of the longest needle is none.
_TOO_LONG_SHARE, _TOO_SHORT_SHARE = 1.5, 0.5
_TOO_LONG, _TOO_SHORT = BANK_WANTED + 1, BANK_WANTED + 2
_LOST = {
    NOT_SEEN: ("refine", Reason.LOW_COVERAGE),
    NOT_HELD: ("fit", Reason.HIGH_UNCERTAINTY),
    _TOO_LONG: ("refine", Reason.TOO_LONG),
    _TOO_SHORT: ("refine", Reason.TOO_SHORT),
}


@dataclass(frozen=True, slots=True)
class Growth:
    """How a curve grows.

    spacing_mm of its points. reaches_mm: by how much it is lengthened in one round, first while it grows, then once
    each where it does not. settled_mm: what is less than this is no growth. parabola_mm: it goes on with the bend of so
    much of it. A place is shown where the log odds of a needle there exceed shown_log_odds, and the curve goes on where
    shown_share of both views' places over shown_over_mm are; max_gap_mm is bridged.
    """

    spacing_mm: float
    reaches_mm: tuple[float, ...]
    parabola_mm: float
    settled_mm: float
    max_rounds: int
    shown_log_odds: float
    shown_share: float
    shown_over_mm: float
    max_gap_mm: float


def grow(
    images: Images,
    rig: StereoRig,
    points_mm: Float,
    needle: Needle,
    fit: FitParameters,
    growth: Growth,
    appearance: Appearance | None,
) -> tuple[Float, Appearance]:
    """The curve (N, 3) in space as far as both views show it, from a rough one (M, 3); and what the needle looks like.

    appearance: what it looked like before, or None. Raises NeedleNotFound where the views show none, or nothing as
    short and as long as a needle.
    """
    template, kept = _template(needle, fit, growth)
    now = _Grow.from_buffer_copy(template)
    mine = Kept()
    now.points_mm, now.n = mine.at(np.ascontiguousarray(points_mm, dtype=np.float64)), len(points_mm)
    now.near[:] = as_look(appearance).tolist()
    eyes = two_eyes(images, rig, mine)
    grown_mm = np.empty((round((_TOO_LONG_SHARE * needle.max_length_mm + 100.0) / growth.spacing_mm), 3))
    found = _Grown(room=len(grown_mm), points_mm=address(grown_mm))
    answer = BANK_WANTED
    while answer == BANK_WANTED:
        answer = call("grow", now, eyes, found)
        if answer == BANK_WANTED and not make_missing(needle, fit, ROUGH, GROWING):
            break
    del kept
    if answer in _LOST:
        raise NeedleNotFound(*_LOST[answer])
    if answer != FOUND:
        raise MemoryError("there is no memory for the kernel that follows a curve to its ends")
    return grown_mm[: found.count].copy(), Appearance(*found.look)


class _Grow(ctypes.Structure):
    """What is known and wanted, as `grow.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("rough", P),
        ("growing", P),
        ("points_mm", P),
        ("n", I),
        ("near", I * 3),
        ("reaches_mm", P),
        ("reaches", I),
        ("farthest_mm", D),
        ("spacing_mm", D),
        ("parabola_mm", D),
        ("settled_mm", D),
        ("shown_log_odds", D),
        ("shown_share", D),
        ("shown_over_mm", D),
        ("max_gap_mm", D),
        ("goes_on_mm", D),
        ("rounds", I),
        ("longest_mm", D),
        ("shortest_mm", D),
    ]


class _Grown(ctypes.Structure):
    """What was found, as `grow.c` lays it out."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = [
        ("room", I),
        ("count", I),
        ("look", I * 3),
        ("points_mm", P),
    ]


@lru_cache(maxsize=32)
def _template(needle: Needle, fit: FitParameters, growth: Growth) -> tuple[_Grow, Kept]:
    """What does not change from curve to curve; and the arrays that it points to."""
    kept = Kept()
    rough, growing = adjusting(needle, fit, ROUGH), adjusting(needle, fit, GROWING)
    return _Grow(
        rough=ctypes.addressof(rough),
        growing=ctypes.addressof(growing),
        reaches_mm=kept.at(np.array(growth.reaches_mm)),
        reaches=len(growth.reaches_mm),
        farthest_mm=max(growth.reaches_mm),
        spacing_mm=growth.spacing_mm,
        parabola_mm=growth.parabola_mm,
        settled_mm=growth.settled_mm,
        shown_log_odds=growth.shown_log_odds,
        shown_share=growth.shown_share,
        shown_over_mm=growth.shown_over_mm,
        max_gap_mm=growth.max_gap_mm,
        goes_on_mm=_GOES_ON_MM,
        rounds=growth.max_rounds,
        longest_mm=_TOO_LONG_SHARE * needle.max_length_mm,
        shortest_mm=_TOO_SHORT_SHARE * needle.min_length_mm,
    ), kept
