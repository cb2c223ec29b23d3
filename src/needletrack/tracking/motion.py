"""How a needle moves from pair to pair, and where it is to be expected by its motion.

A needle bends and turns as a whole: how far aside its points have come is a smooth function of how far they are from
the base. So what a pair shows of its motion is told by a parabola, which the noise of single points does not move, and
it is expected to go on like that. What its tip advances along itself is told apart, by the tip.
"""

from dataclasses import replace

import numpy as np

from needletrack.geometry.spline import arc_length
from needletrack.kernels import call
from needletrack.records import Float, NeedleCurve

# Motion is foreseen for no longer than this, s: needles are turned and stopped. Sequences that are seen less often than
# ten times a second are taken as they were.
MOST_FORESEEN_S = 0.1


def moved_aside_mm(now_mm: Float, before_mm: Float) -> Float:
    """How far aside (N, 3) the points of a curve (N, 3) have come since another one (M, 3), smoothly along it."""
    aside_mm = np.empty((len(now_mm), 3))
    now, before = (np.ascontiguousarray(each, dtype=np.float64) for each in (now_mm, before_mm))
    if call("motion_aside", before, len(before), now, len(now), aside_mm):
        raise MemoryError("there is no memory for the kernel that tells the needle's motion")
    return aside_mm


def foreseen_mm(curve: NeedleCurve, since_s: float) -> Float:
    """Where a curve is expected so long after it was seen, (N, 3); where it was, if its motion is not known."""
    if curve.velocity_mm_s is None or not 0 < since_s <= MOST_FORESEEN_S:
        return curve.points_mm
    return np.asarray(curve.points_mm + curve.velocity_mm_s * since_s)


def moves_mm(curve: NeedleCurve, since_s: float) -> float:
    """How far a curve comes aside in so long, at most, mm; infinite where its motion is not known."""
    if curve.velocity_mm_s is None:
        return np.inf
    return float(np.abs(curve.velocity_mm_s).max()) * since_s


def moving_like(curve: NeedleCurve, other: NeedleCurve) -> NeedleCurve:
    """A curve that moves as another fit of the same needle does, at the same distances from the base."""
    if other.velocity_mm_s is None:
        return curve
    at_mm, other_mm = arc_length(curve.points_mm), arc_length(other.points_mm)
    velocity_mm_s = np.column_stack([np.interp(at_mm, other_mm, each) for each in other.velocity_mm_s.T])
    return replace(curve, velocity_mm_s=velocity_mm_s)
