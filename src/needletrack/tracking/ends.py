"""Where along its curve the needle begins and ends: its visible stretch, the sleeve's edge, the tip."""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter1d, median_filter, uniform_filter1d

from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float
from needletrack.tracking.axis import AxisObservations, Mask
from needletrack.tracking.needle import EntrySide, Positive

Observed = tuple[AxisObservations, AxisObservations]

# A cross section belongs to the needle where it lies on a line with its neighbours and most of them do, in either
# view: accidents have a density of 0.2-0.3, a needle that one view shows 0.5, one that both show 1.
_ON_LINE_PX = 1.0
_DENSITY_WINDOW_MM = 4.0
_MIN_DENSITY = 0.42
# An edge is blurred over about this much of the curve.
_EDGE_GAP_MM = 0.5
_SLEEVE_SHARE = 0.7
# A sleeve's highlight is a faint line beside the needle's own, which a vessel behind the needle does not end.
_MAX_LINE_IN_SLEEVE = 0.4
_CROSSED_MM = 2.0
# Between two pairs the base moves less than this.
_BASE_MOTION_MM = 8.0
# How much of the curve around a rough end tells where the tip is.
TIP_BEFORE_MM, TIP_BEYOND_MM = 7.0, 4.0
# Lengths of taper that are tried for the tip, mm: blunt or round ends, and cones. What is between them is blur.
_TAPERS_MM = np.array([0.2, 0.4, 1.5, 2.0, 2.5, 3.0, 3.5])
# A taper whose residual is at most so many times the best one's is a rival of it.
_RIVAL_ERROR = 1.5
# Sigma of a lens in focus and of the interpolation.
_LENS_BLUR_PX = 1.2


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


def needle_stretch(observed: Observed, spacing_mm: float, parameters: EndsParameters) -> Stretch:
    """The longest stretch that the views show, gaps bridged, cut at the sleeve's edge; empty where there is none."""
    # Where a cross section matches by accident it does so anywhere in the search range and rarely in a row.
    window = max(3, round(_DENSITY_WINDOW_MM / spacing_mm))
    firm = np.mean([_on_smooth_line(view, window) for view in observed], axis=0)
    present = (firm > 0) & (uniform_filter1d(firm, window, mode="nearest") > _MIN_DENSITY)
    found = find_sleeve_edge(observed, firm, spacing_mm, parameters)
    if found is not None:
        before, after = firm[: found.index].sum(), firm[found.index :].sum()
        present[: found.index] &= before > after
        present[found.index :] &= before <= after
    index = np.flatnonzero(present)
    if len(index) == 0:
        return Stretch(0, 0, None)
    cuts = np.flatnonzero(np.diff(index) > parameters.max_gap_mm / spacing_mm)
    starts, stops = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(index) - 1]])
    best = int(np.argmax([firm[index[a] : index[b] + 1].sum() for a, b in zip(starts, stops, strict=True)]))
    start, stop = int(index[starts[best]]), int(index[stops[best]]) + 1
    if found is not None and found.index >= stop and (found.index - stop) * spacing_mm < parameters.max_base_gap_mm:
        return Stretch(start, found.index, found)
    if found is not None and found.index <= start and (start - found.index) * spacing_mm < parameters.max_base_gap_mm:
        return Stretch(found.index, stop, found)
    return Stretch(start, stop, None)


def _on_smooth_line(view: AxisObservations, window: int) -> Mask:
    """Firm cross sections (N,) bool whose axis lies on a line with its neighbours'."""
    if not view.firm.any():
        return view.firm
    at = np.arange(len(view.firm))
    offset = np.interp(at, at[view.firm], view.offset_px[view.firm])
    return np.asarray(view.firm & (np.abs(offset - median_filter(offset, window, mode="nearest")) < _ON_LINE_PX))


def find_sleeve_edge(
    observed: Observed, firm: Float, spacing_mm: float, parameters: EndsParameters
) -> SleeveEdge | None:
    """The strongest place where both flanks change in the same sense in both views, and stay changed.

    A vessel that crosses behind lies at another place of the curve in each view and is soon past, a rod beside it is on
    one side only. firm (N,) is the share of views that show the needle, which is on the other side of the edge.
    """
    steps = np.stack([_steps(view.flank_gray, spacing_mm, parameters) for view in observed])
    same = np.abs(np.sign(steps).sum(axis=1)) == 2
    weakest = np.where(same.all(axis=0), np.abs(steps).min(axis=(0, 1)), 0.0)
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
    gap, near = round(_EDGE_GAP_MM / spacing_mm), round(parameters.sleeve_step_mm / spacing_mm)
    far = round(parameters.min_sleeve_mm / spacing_mm)
    at = np.arange(observed[0].flank_gray.shape[1])
    inward = (outward * (index - at) > gap) & (outward * (index - at) <= gap + near)
    beyond = (outward * (at - index) > gap) & (outward * (at - index) <= far)
    if not inward.any() or beyond.sum() < near:
        return False
    lines = [view.signals_gray_px[1] for view in observed]
    if np.mean([np.median(line[beyond]) / max(np.median(line[inward]), 1e-6) for line in lines]) > _MAX_LINE_IN_SLEEVE:
        return False
    for view in observed:
        change = view.flank_gray[:, beyond] - view.flank_gray[:, inward].mean(axis=1, keepdims=True)
        # Its shading and highlights may pass through the background's own level, but do not stay there.
        if ((np.abs(change) > parameters.sleeve_step_gray / 3).mean(axis=1) < _SLEEVE_SHARE).any():
            return False
    return True


def is_crossed(observed: Observed, at_mm: float, arc_mm: Float, parameters: EndsParameters) -> bool:
    """Whether in either view something begins beside a place of the curve: an end there may be hidden, not free."""
    near = np.abs(arc_mm - at_mm) <= _CROSSED_MM
    spacing_mm = float(arc_mm[1] - arc_mm[0])
    steps = [np.abs(_steps(view.flank_gray, spacing_mm, parameters)[:, near]) for view in observed]
    return bool(max(float(step.max(initial=0.0)) for step in steps) > parameters.sleeve_step_gray)


def _steps(flanks: Float, spacing_mm: float, parameters: EndsParameters) -> Float:
    """Change (2, N) of each flank's mean grey level from behind a place to ahead of it; zero near the curve's ends."""
    length = max(2, round(parameters.sleeve_step_mm / spacing_mm))
    gap = max(1, round(_EDGE_GAP_MM / spacing_mm))
    total = np.cumsum(np.pad(flanks, ((0, 0), (1, 0))), axis=1)
    n = flanks.shape[1]
    at = np.arange(n)
    behind = (np.clip(at - gap - length, 0, n), np.clip(at - gap, 0, n))
    ahead = (np.clip(at + gap, 0, n), np.clip(at + gap + length, 0, n))
    counts = [np.maximum(stop - start, 1) for start, stop in (behind, ahead)]
    means = [(total[:, b] - total[:, a]) / count for (a, b), count in zip((behind, ahead), counts, strict=True)]
    enough = (counts[0] >= length // 2) & (counts[1] >= length // 2)
    return np.where(enough, means[1] - means[0], 0.0)


@dataclass(frozen=True, slots=True)
class TipFit:
    """The apex along the curve, mm from its first point: of each view alone and of both; sigma_mm; taper_mm; contrast.

    `contrast` is the height of the needle's signal over what lies beyond the tip, in units of their scatter; is_free is
    false where something crosses there, behind which the needle may go on.
    """

    at_mm: float
    each_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    taper_mm: float
    contrast: tuple[float, float]
    is_free: bool


def find_tip(
    observed: Observed, arc_mm: Float, end_mm: float, smoothed_mm: float, parameters: EndsParameters
) -> TipFit:
    """Where the needle's signal ends beyond a rough end, the curve running on past it.

    The signal across the needle falls linearly over the taper of a cone and within the radius of a round tip; the
    apex is where it reaches zero, not where half of it is left, so a taper does not shorten the needle. smoothed_mm
    is the sigma by which the observations were averaged along the curve; the lens adds its blur, which a needle turned
    towards the camera spreads over more of its length.
    """
    near = (arc_mm >= end_mm - TIP_BEFORE_MM) & (arc_mm <= end_mm + TIP_BEYOND_MM)
    s = arc_mm[near]
    tips = np.arange(end_mm - 2.0, end_mm + 3.5, 0.05)
    # Shape of the signal: 1 on the shaft, falling to 0 at the apex; (tapers, tips, stations).
    ramp = np.clip((tips[None, :, None] - s) / _TAPERS_MM[:, None, None], 0.0, 1.0)
    # Clutter beside the needle spoils one measure, a streak that ends early the other: the steadier one is believed.
    fits = []
    for view in observed:
        px_per_mm = float(np.linalg.norm(np.diff(view.center_px[near], axis=0), axis=1).mean()) / (s[1] - s[0])
        blur = np.hypot(smoothed_mm, _LENS_BLUR_PX / px_per_mm) / (s[1] - s[0])
        blurred = gaussian_filter1d(ramp, blur, axis=2, mode="nearest")
        candidates = [_ramp_fit(blurred, signal[near], tips, s) for signal in view.signals_gray_px]
        fits.append(max(candidates, key=lambda fit: fit[1]))
    costs, contrast = [fit[0] for fit in fits], [fit[1] for fit in fits]
    # Each view weighs by its own scatter: log of the error is its profile likelihood.
    joint = np.log(costs[0]) + np.log(costs[1])
    taper, tip = np.unravel_index(int(np.argmin(joint)), joint.shape)
    each = [tips[int(np.argmin(cost[taper]))] for cost in costs]
    # Tapers that explain the signal nearly as well place the apex elsewhere: that spread is the larger uncertainty.
    best_of_taper = joint.min(axis=1)
    rivals = tips[joint.argmin(axis=1)[best_of_taper < joint.min() + 2 * np.log(_RIVAL_ERROR) * len(costs)]]
    spread = float(np.ptp(rivals)) / 2
    # The slope of the signal over the taper turns its scatter into a distance.
    sigma = [float(np.hypot(max(0.05, _TAPERS_MM[taper] / max(c, 1.0)), spread)) for c in contrast]
    return TipFit(
        float(tips[tip]),
        (float(each[0]), float(each[1])),
        (sigma[0], sigma[1]),
        float(_TAPERS_MM[taper]),
        (contrast[0], contrast[1]),
        not is_crossed(observed, float(tips[tip]), arc_mm, parameters),
    )


def _ramp_fit(ramp: Float, signal: Float, tips_mm: Float, at_mm: Float) -> tuple[Float, float]:
    """Mean squared error (tapers, tips) of each ramp, scaled and shifted to the signal, and the best one's contrast.

    The contrast is the signal's height over its scatter, or over what is left of it just beyond the tip: a faint rest
    there may be the needle's own end.
    """
    mean_ramp, mean_signal = ramp.mean(axis=2, keepdims=True), signal.mean()
    covariance = ((ramp - mean_ramp) * (signal - mean_signal)).mean(axis=2)
    height = covariance / np.maximum(((ramp - mean_ramp) ** 2).mean(axis=2), 1e-9)
    spread = ((signal - mean_signal) ** 2).mean() + 1e-9
    error = np.where(height > 0, np.maximum(spread - covariance * height, 1e-9), spread)
    best = np.unravel_index(int(np.argmin(error)), error.shape)
    tip_mm = tips_mm[best[1]]
    beyond = (at_mm > tip_mm + 0.4) & (at_mm < tip_mm + 1.6)
    rest = float(signal[beyond].mean() - signal.min()) if beyond.any() else 0.0
    return error, float(height[best] / max(np.sqrt(error[best]), rest))


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
