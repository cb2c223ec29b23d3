"""Where along its curve the needle begins and ends: its visible stretch, the sleeve's edge."""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float
from needletrack.tracking.beside import Beside
from needletrack.tracking.needle import EntrySide, Positive

Observed = tuple[Beside, Beside]

# An edge is blurred over about this much of the curve.
EDGE_GAP_MM = 0.5
_SLEEVE_SHARE = 0.7
# A sleeve's highlight is a faint line beside the needle's own, which a vessel behind the needle does not end.
_MAX_LINE_IN_SLEEVE = 0.4
CROSSED_MM = 2.0
# Between two pairs the base moves less than this.
_BASE_MOTION_MM = 8.0
# How much of the curve around a rough end tells where the tip is.
TIP_BEFORE_MM, TIP_BEYOND_MM = 7.0, 4.0


class EndsParameters(BaseModel):
    """What counts as an end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_gap_mm: Positive = Field(
        8.0, description="Longest stretch that neither view shows in the middle of the needle, mm."
    )
    max_base_gap_mm: Positive = Field(
        20.0, description="Longest stretch next to the sleeve that neither view shows, mm."
    )
    sleeve_step_gray: Positive = Field(
        8.0,
        description="The sleeve differs from what is beside the needle, on both sides in both views, by this, grey.",
    )
    min_sleeve_mm: Positive = Field(
        8.0, description="A sleeve is at least so long: what is shorter crosses the needle, mm."
    )
    sleeve_step_mm: Positive = Field(2.5, description="Length of needle and of sleeve that are compared, mm.")


@dataclass(frozen=True, slots=True)
class SleeveEdge:
    """The step at which the flanks of the curve change: its index, and by how many grey levels (the least of four)."""

    index: int
    step_gray: float


@dataclass(frozen=True, slots=True)
class Stretch:
    """The needle's part of a curve, start <= i < stop, and the sleeve's edge where one bounds it, at start or stop."""

    start: int
    stop: int
    sleeve: SleeveEdge | None


def needle_stretch(observed: Observed, start: int, stop: int, spacing_mm: float, parameters: EndsParameters) -> Stretch:
    """The needle's part of a curve that was followed from start to stop and runs on beyond: to the sleeve's edge."""
    at = np.arange(observed[0].flank_gray.shape[1])
    found = find_sleeve_edge(observed, ((at >= start) & (at < stop)).astype(np.float64), spacing_mm, parameters)
    if found is not None and found.index >= (start + stop) / 2:
        if found.index - stop < parameters.max_base_gap_mm / spacing_mm:
            return Stretch(start, found.index, found)
    elif found is not None and start - found.index < parameters.max_base_gap_mm / spacing_mm:
        return Stretch(found.index, stop, found)
    return Stretch(start, stop, None)


def find_sleeve_edge(
    observed: Observed, firm: Float, spacing_mm: float, parameters: EndsParameters
) -> SleeveEdge | None:
    """The strongest place where both flanks change in the same sense in both views, and stay changed.

    A vessel that crosses behind lies at another place of the curve in each view and is soon past, a rod beside it is on
    one side only. firm (N,) is the share of views that show the needle, which is on the other side of the edge.
    """
    weakest = _common_step(observed, spacing_mm, parameters)
    reach = round(parameters.sleeve_step_mm / spacing_mm)
    while weakest.size and weakest.max() >= parameters.sleeve_step_gray:
        index = int(np.argmax(weakest))
        outward = 1 if firm[:index].sum() > firm[index:].sum() else -1
        if _is_sleeve(observed, index, outward, spacing_mm, parameters):
            return SleeveEdge(index, float(weakest[index]))
        weakest[max(0, index - reach) : index + reach + 1] = 0.0
    return None


def _is_sleeve(observed: Observed, index: int, outward: int, spacing_mm: float, parameters: EndsParameters) -> bool:
    """Whether both flanks of both views stay changed over the least length of a sleeve, and the needle ends there."""
    gap, near = round(EDGE_GAP_MM / spacing_mm), round(parameters.sleeve_step_mm / spacing_mm)
    far = round(parameters.min_sleeve_mm / spacing_mm)
    at = np.arange(observed[0].flank_gray.shape[1])
    inward = (outward * (index - at) > gap) & (outward * (index - at) <= gap + near)
    beyond = (outward * (at - index) > gap) & (outward * (at - index) <= far)
    if not inward.any() or beyond.sum() < near:
        return False
    lines = [view.line_gray_px for view in observed]
    if np.mean([np.median(line[beyond]) / max(np.median(line[inward]), 1e-6) for line in lines]) > _MAX_LINE_IN_SLEEVE:
        return False
    for view in observed:
        change = view.flank_gray[:, beyond] - view.flank_gray[:, inward].mean(axis=1, keepdims=True)
        # Its shading and highlights may pass through the background's own level, but do not stay there.
        if ((np.abs(change) > parameters.sleeve_step_gray / 3).mean(axis=1) < _SLEEVE_SHARE).any():
            return False
    return True


def is_crossed(observed: Observed, at_mm: float, arc_mm: Float, parameters: EndsParameters) -> bool:
    """Whether something begins there on both sides of the curve in both views: an end there may be hidden, not free.

    What lies behind, such as a vessel, begins at another place of the curve in the other view.
    """
    near = np.abs(arc_mm - at_mm) <= CROSSED_MM
    weakest = _common_step(observed, float(arc_mm[1] - arc_mm[0]), parameters)
    return bool(weakest[near].max(initial=0.0) > parameters.sleeve_step_gray)


def _common_step(observed: Observed, spacing_mm: float, parameters: EndsParameters) -> Float:
    """The least of the steps (N,), grey, of both flanks in both views where all are of one sense, else 0."""
    steps = _steps(np.stack([view.flank_gray for view in observed]), spacing_mm, parameters)
    same = np.abs(np.sign(steps).sum(axis=1)) == 2
    return np.where(same.all(axis=0), np.abs(steps).min(axis=(0, 1)), 0.0)


def _steps(flanks: Float, spacing_mm: float, parameters: EndsParameters) -> Float:
    """Change (2, 2, N) of each flank's mean grey level from behind a place to ahead of it; zero near a curve's ends."""
    length = max(2, round(parameters.sleeve_step_mm / spacing_mm))
    gap = max(1, round(EDGE_GAP_MM / spacing_mm))
    n = flanks.shape[-1]
    total = np.zeros((*flanks.shape[:-1], n + 1))
    np.cumsum(flanks, axis=-1, out=total[..., 1:])
    at = np.arange(n)
    behind = (np.clip(at - gap - length, 0, n), np.clip(at - gap, 0, n))
    ahead = (np.clip(at + gap, 0, n), np.clip(at + gap + length, 0, n))
    counts = [np.maximum(stop - start, 1) for start, stop in (behind, ahead)]
    means = [(total[..., b] - total[..., a]) / count for (a, b), count in zip((behind, ahead), counts, strict=True)]
    enough = (counts[0] >= length // 2) & (counts[1] >= length // 2)
    return np.where(enough, means[1] - means[0], 0.0)


def base_end(points_mm: Float, rig: StereoRig, entry_side: EntrySide, previous_base_mm: Float | None) -> int | None:
    """Which end (0 or -1) of a curve (N, 3) without a sleeve is the base: near where it was, or to the entry side.

    None where neither is known.
    """
    ends_mm = points_mm[[0, -1]]
    if previous_base_mm is not None:
        near, far = np.sort(np.linalg.norm(ends_mm - previous_base_mm, axis=1))
        if near < _BASE_MOTION_MM < far:
            return -int(np.argmin(np.linalg.norm(ends_mm - previous_base_mm, axis=1)))
    if entry_side == "none":
        return None
    ends_px = rig.left.project(ends_mm)
    width, height = rig.left.size_px
    distance_px = {
        "left": ends_px[:, 0],
        "right": width - ends_px[:, 0],
        "top": ends_px[:, 1],
        "bottom": height - ends_px[:, 1],
    }[entry_side]
    return -int(np.argmin(distance_px))
