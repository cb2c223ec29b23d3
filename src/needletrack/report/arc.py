"""What there is to see along the needle: both views straightened, and the errors, over one axis of arc length.

The images are resampled along the projected curve, evenly in millimetres along the needle, so that what is above each
other in strips and charts is one place of the needle.
"""

import json
from dataclasses import dataclass, replace

import cv2
import numpy as np
from markupsafe import Markup

from needletrack.geometry.spline import arc_length, distance_from_curve, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float, NeedleCurve, NeedleTrack, StereoPair
from needletrack.report.svg import Element, Panel, digits, drawing, element, markup, tick_text, ticks
from needletrack.report.views import View, data_uri, stretched, stretches
from needletrack.scoring import TrueShape

WIDTH_PX = 1180
_LEFT_PX, _RIGHT_PX = 116, 12
_STRIP_PX, _BAR_PX, _CHART_PX, _GAP_PX = 132, 12, 136, 14
# Shown beyond both ends, straight on: is the tip where the needle ends?
_BEYOND_MM = 4.0
_ACROSS_STEP_PX = 0.5
_HALF_PX = (8.0, 40.0)
_STRIP_BYTES = 36_000
_FARTHEST_TRUTH_PX = 80.0
_CURSOR_POINTS = 160


@dataclass(frozen=True, slots=True)
class _Strip:
    """One view along the curve: at_mm (K,) arc lengths, center_px and normal (K, 2); truth_px (K,), NaN: not there."""

    view: View
    at_mm: Float
    center_px: Float
    normal: Float
    truth_px: Float
    true_tip_mm: float | None

    @property
    def length_px(self) -> float:
        """How many pixels of the image it is long; at least one."""
        return max(float(np.nan_to_num(arc_length(self.center_px)[-1], nan=1.0)), 1.0)

    def image(self, half_px: float) -> cv2.typing.MatLike:
        """The image resampled from half_px at one side (above) of the axis to as far at the other."""
        rows = round(2 * half_px / _ACROSS_STEP_PX)
        offset = (np.arange(rows) + 0.5) * _ACROSS_STEP_PX - half_px
        at = self.center_px[None] + offset[:, None, None] * self.normal[None]
        x, y = (np.nan_to_num(at[..., k], nan=-1e6).astype(np.float32) for k in (0, 1))
        return cv2.remap(self.view.image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=[128.0])


def arc_figure(
    track: NeedleTrack, pair: StereoPair, rig: StereoRig, truth: TrueShape | None, max_sigma_mm: float
) -> Markup:
    """Strips, residuals and sigmas of a track that has a curve, from beyond its base to beyond its tip."""
    curve = track.curve
    if curve is None:
        raise ValueError("there is nothing along a needle that was not found")
    along_mm = arc_length(curve.points_mm)
    if truth is not None and len(truth.centerline_mm) == 0:
        truth = None
    x_range = (-_BEYOND_MM, float(along_mm[-1]) + _BEYOND_MM)
    strips = [_strip(view, curve, along_mm, x_range, truth) for view in View.both(track, pair, rig)]
    residual_px = track.evidence.axis_residual_px
    half_px = _half_px(track, strips, residual_px)
    height = 2 * (_STRIP_PX + _GAP_PX) + _BAR_PX + 2 * (_CHART_PX + _GAP_PX) + _GAP_PX + 48
    svg = drawing(WIDTH_PX, height, "Along the needle, from base to tip", class_="arc")
    y = 4.0
    for index, strip in enumerate(strips):
        seen_px = None if residual_px is None else residual_px[index]
        _draw_strip(svg, strip, y, x_range, half_px, (along_mm, seen_px))
        y += _STRIP_PX + _GAP_PX
    _draw_seen(svg, curve, along_mm, y, x_range)
    y += _BAR_PX + _GAP_PX
    _draw_offsets(_panel(svg, y, x_range, (-1.0, 1.0)), along_mm, residual_px, strips)
    y += _CHART_PX + _GAP_PX
    sigmas = _draw_sigmas(svg, y, x_range, along_mm, curve, truth, max_sigma_mm)
    wide = " and ".join(f"{sigmas.width / strip.length_px:.1f}" for strip in strips)
    sigmas.x_axis(
        f"arc length from the base, mm (in the strips an image's pixel is {_STRIP_PX / (2 * half_px):.1f} px high, "
        f"{wide} px wide)"
    )
    for end, name in ((0.0, "base"), (float(along_mm[-1]), "tip" if track.tip is not None else "end")):
        at = _LEFT_PX + float(sigmas.place(end, sigmas.y_range[0])[0, 0])
        element(svg, "line", x1=at, x2=at, y1=4, y2=y + _CHART_PX, class_=f"end {name}")
        place = {"x": at + (-4 if end == 0 else 4), "y": 16}
        element(svg, "text", name, **place, class_=f"on-image {'end' if end == 0 else ''}")
    _make_pointable(svg, curve, strips, sigmas, y + _CHART_PX)
    return markup(svg)


def _panel(
    svg: Element, y: float, x_range: tuple[float, float], y_range: tuple[float, float], *, log: bool = False
) -> Panel:
    return Panel(svg, _LEFT_PX, y, WIDTH_PX - _LEFT_PX - _RIGHT_PX, _CHART_PX, x_range, y_range, log)


def _strip(
    view: View, curve: NeedleCurve, along_mm: Float, x_range: tuple[float, float], truth: TrueShape | None
) -> _Strip:
    length_px = float(np.nan_to_num(arc_length(view.project(curve.points_mm))[-1], nan=600.0))
    count = int(np.clip(length_px, 200, WIDTH_PX - _LEFT_PX - _RIGHT_PX))
    at_mm = x_range[0] + (np.arange(count) + 0.5) * (x_range[1] - x_range[0]) / count
    center_px = view.project(_straight_on(curve.points_mm, along_mm, at_mm))
    along = unit(np.gradient(center_px, axis=0))
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    if truth is None:
        return _Strip(view, at_mm, center_px, normal, np.full(count, np.nan), None)
    true_px = view.project(truth.centerline_mm)
    tip_off = np.linalg.norm(center_px - true_px[-1], axis=1)
    near_tip = np.isfinite(tip_off).any() and np.nanmin(tip_off) < _HALF_PX[1]
    true_tip_mm = float(at_mm[np.nanargmin(tip_off)]) if near_tip else None
    return _Strip(view, at_mm, center_px, normal, _crossings_px(center_px, along, normal, true_px), true_tip_mm)


def _straight_on(points_mm: Float, along_mm: Float, at_mm: Float) -> Float:
    """Points (K, 3) at arc lengths (K,) of a polyline, which goes straight on beyond its ends."""
    inside = np.column_stack([np.interp(at_mm, along_mm, column) for column in points_mm.T])
    first, last = unit(points_mm[1] - points_mm[0]), unit(points_mm[-1] - points_mm[-2])
    before, after = np.minimum(at_mm, 0.0), np.maximum(at_mm - along_mm[-1], 0.0)
    return np.asarray(inside + before[:, None] * first + after[:, None] * last)


def _crossings_px(center_px: Float, along: Float, normal: Float, line_px: Float) -> Float:
    """How far beside each centre (K,) a line (M, 2) crosses its normal, px; the nearest crossing, NaN for none."""
    apart = line_px[None] - center_px[:, None]
    ahead, beside = (apart * along[:, None]).sum(-1), (apart * normal[:, None]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = ahead[:, :-1] / (ahead[:, :-1] - ahead[:, 1:])
        at_px = beside[:, :-1] + share * np.diff(beside, axis=1)
        crosses = (ahead[:, :-1] * ahead[:, 1:] <= 0) & (np.abs(at_px) < _FARTHEST_TRUTH_PX)
    nearest = np.argmin(np.where(crosses, np.abs(at_px), np.inf), axis=1)
    each = np.arange(len(center_px))
    return np.where(crosses[each, nearest], at_px[each, nearest], np.nan)


def _half_px(track: NeedleTrack, strips: list[_Strip], residual_px: Float | None) -> float:
    """How much is shown beside the axis: the needle with its surroundings, and what lies beside the curve."""
    wanted = [_HALF_PX[0]]
    if track.diameter_mm is not None and track.curve is not None:
        scale = max(float(np.median(strip.view.px_per_mm(track.curve.points_mm))) for strip in strips)
        wanted.append(2.5 * track.diameter_mm * scale)
    beside = [strip.truth_px for strip in strips] + ([] if residual_px is None else [residual_px.ravel()])
    seen = np.concatenate(beside)
    if np.isfinite(seen).any():
        wanted.append(1.4 * float(np.nanpercentile(np.abs(seen), 95)))
    return float(np.ceil(min(max(wanted), _HALF_PX[1])))


def _draw_strip(
    svg: Element,
    strip: _Strip,
    y: float,
    x_range: tuple[float, float],
    half_px: float,
    seen: tuple[Float, Float | None],
) -> None:
    width = WIDTH_PX - _LEFT_PX - _RIGHT_PX
    panel = Panel(svg, _LEFT_PX, y, width, _STRIP_PX, x_range, (half_px, -half_px))
    pixels = np.asarray(strip.image(half_px), dtype=np.uint8)
    place = {"x": panel.x, "y": y, "width": width, "height": _STRIP_PX}
    uri = data_uri(stretched(pixels), _STRIP_BYTES, lossless=True)
    # As a class, so that a reader (and a test) finds the strip of a view.
    element(svg, "image", **place, href=uri, preserveaspectratio="none", class_=f"strip {strip.view.name}")
    panel.label(f"{strip.view.name} view,\nstraightened", "px across")
    step = ticks(0, half_px, 2)[1]
    for value in (-step, 0.0, step):
        at = y + float(panel.place(0.0, value)[0, 1])
        element(svg, "text", tick_text(value), x=_LEFT_PX - 6, y=at + 4, class_="tick end")
    if np.isfinite(strip.truth_px).any():
        truth = panel.layer("truth")
        truth.line(strip.at_mm, strip.truth_px, "true-casing")
        truth.line(strip.at_mm, strip.truth_px, "true-axis")
        if strip.true_tip_mm is not None:
            at = panel.x + float(panel.place(strip.true_tip_mm, 0.0)[0, 0])
            element(truth.svg, "line", x1=at, x2=at, y1=y, y2=y + _STRIP_PX, class_="true-end")
    drawn = panel.layer("drawn")
    drawn.line([0.0, seen[0][-1]], [0.0, 0.0], "axis")
    if seen[1] is not None:
        drawn.dots(seen[0], seen[1], "observed")


def _draw_seen(svg: Element, curve: NeedleCurve, along_mm: Float, y: float, x_range: tuple[float, float]) -> None:
    width = WIDTH_PX - _LEFT_PX - _RIGHT_PX
    bar = Panel(svg, _LEFT_PX, y, width, _BAR_PX, x_range, (0.0, 1.0))
    element(svg, "rect", x=_LEFT_PX, y=y, width=width, height=_BAR_PX, class_="panel")
    middles = (along_mm[:-1] + along_mm[1:]) / 2
    edges = _LEFT_PX + bar.place(np.concatenate([[0.0], middles, along_mm[-1:]]), 0)[:, 0]
    for cameras, first, last in stretches(curve.seen.tolist()):
        left, right = float(edges[first]), float(edges[last])
        element(svg, "rect", x=left, y=y, width=right - left, height=_BAR_PX, class_=f"cameras seen-{cameras}")
    bar.label("seen by")


def _draw_offsets(panel: Panel, along_mm: Float, residual_px: Float | None, strips: list[_Strip]) -> None:
    """What each view showed beside the projected curve, and where the true axis lies."""
    seen_px = 0.0 if residual_px is None else _most(residual_px)
    true_px = _most(np.concatenate([strip.truth_px for strip in strips]))
    # A true axis that is far off runs out of the chart; otherwise what was seen would become one flat line.
    most = 1.25 * max(0.4, seen_px, min(true_px, max(3.0, 6 * seen_px)))
    panel = replace(panel, y_range=(-most, most))
    panel.frame("axis beside\nthe curve", "px")
    panel.line(panel.x_range, (0.0, 0.0), "zero")
    legend: list[tuple[str, str]] = []
    for index, (strip, side) in enumerate(zip(strips, ("left", "right"), strict=True)):
        if residual_px is not None:
            panel.dots(along_mm, residual_px[index], side)
            panel.line(along_mm, residual_px[index], f"{side} faint")
            legend.append((f"seen, {side}", side))
        if np.isfinite(strip.truth_px).any():
            panel.layer("truth").line(strip.at_mm, strip.truth_px, f"{side} dashed")
            legend.append((f"true, {side}", f"{side} dashed"))
    panel.legend(legend)


def _most(values: Float) -> float:
    """The size of nearly all that are known; 0 where none is."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.percentile(known, 98)) if len(known) else 0.0


def _draw_sigmas(
    svg: Element,
    y: float,
    x_range: tuple[float, float],
    along_mm: Float,
    curve: NeedleCurve,
    truth: TrueShape | None,
    max_sigma_mm: float,
) -> Panel:
    off_mm = None if truth is None else distance_from_curve(curve.points_mm, truth.centerline_mm)
    values = np.concatenate([2 * curve.sigma_mm, [max_sigma_mm], [] if off_mm is None else off_mm])
    # Linear as long as that shows the usual; a sigma that runs away at an end must not flatten the rest.
    log = bool(values.max() > 12 * np.median(curve.sigma_mm))
    low = 0.0 if not log else 0.7 * float(max(1e-3, np.concatenate([curve.sigma_mm, values]).min()))
    panel = _panel(
        svg, y, x_range, (low, 1.35 * float(values.max()) if not log else 2.5 * float(values.max())), log=log
    )
    panel.frame("stated sigma,\nlogarithmic" if log else "stated sigma", "mm")
    panel.band(along_mm, np.full(len(along_mm), max(low, 1e-9)), 2 * curve.sigma_mm, "sigma")
    panel.line(along_mm, curve.sigma_mm, "sigma")
    panel.level(max_sigma_mm, f"gate {max_sigma_mm:g}")
    legend = [("sigma; shaded up to twice", "sigma")]
    if off_mm is not None:
        panel.layer("truth").line(along_mm, np.maximum(off_mm, 1e-6), "true")
        legend.append(("true error", "true"))
    panel.legend(legend)
    return panel


def _make_pointable(svg: Element, curve: NeedleCurve, strips: list[_Strip], panel: Panel, bottom: float) -> None:
    """What the page's script needs to mark, in both views, the place along the needle that is pointed at."""
    along_mm = arc_length(curve.points_mm)
    at_mm = np.linspace(0.0, along_mm[-1], _CURSOR_POINTS)
    points_mm = _straight_on(curve.points_mm, along_mm, at_mm)
    both = np.hstack([np.nan_to_num(strip.view.project(points_mm), nan=-1e4) for strip in strips])
    svg.set("data-points", json.dumps(np.round(both, 1).tolist(), separators=(",", ":")))
    start, end = (panel.x + panel.place([0.0, along_mm[-1]], panel.y_range[0])[:, 0]).tolist()
    svg.set("data-start", digits(start))
    svg.set("data-end", digits(end))
    svg.set("data-length", digits(float(along_mm[-1])))
    element(svg, "line", x1=-9, x2=-9, y1=4, y2=bottom, class_="cursor")
    element(svg, "text", "", x=-9, y=bottom - 6, class_="cursor tick")
