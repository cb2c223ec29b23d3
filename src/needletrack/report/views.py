"""The two images of a pair as a report shows them: cut out around the needle, whole, and enlarged at the tip.

Each is an SVG whose coordinates are the raw pixels of the image, with the projected curve drawn over it.
"""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from markupsafe import Markup

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Centerline, Float, Image, NeedleCurve, NeedleTrack, StereoPair, TipPose
from needletrack.report.svg import Element, band_path, digits, element, line_path, markup
from needletrack.scoring import TrueShape

# Widths on a page of 1180 px: two cut-outs beside each other, and four small pictures.
CUT_OUT_PX, SMALL_PX = 580, 280
_MARGIN_PX = 40
_LEAST_CUT_OUT_PX = 160
# Of the images' usual shape, so that small pictures beside each other have one height.
_TIP_PX = (61, 49)
_LEAST_DEPTH_MM = 1.0
# Of a file, before base64 makes it a third larger: the whole frame is to stay below 300 kB.
_CUT_OUT_BYTES, _WHOLE_BYTES, _TIP_BYTES = 48_000, 12_000, 6_000
_GREATEST_CUT_OUT_PX, _GREATEST_WHOLE_PX = 1160, 560
# WebP's own scale; above 100 it is lossless.
_QUALITIES = (90, 75, 60, 40, 20)
_LOSSLESS = 101
# A band narrower than this on the screen is not seen.
_VISIBLE_PX = 4.0
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True, slots=True)
class View:
    """One camera's image, and how points in space get into it."""

    name: str
    camera: Camera
    camera_from_left: RigidTransform
    image: Image
    detected: Centerline | None

    @classmethod
    def both(cls, track: NeedleTrack, pair: StereoPair, rig: StereoRig) -> tuple[Self, Self]:
        """The left and the right view of a pair."""
        return (
            cls("left", rig.left, RigidTransform.identity(), pair.left.image, track.evidence.left),
            cls("right", rig.right, rig.right_from_left, pair.right.image, track.evidence.right),
        )

    def project(self, points_mm: Float) -> Float:
        """Raw pixels (N, 2) of points (N, 3) in the left camera's frame; NaN behind the camera."""
        local = self.camera_from_left.apply(points_mm)
        pixels = self.camera.project(local)
        pixels[local[:, 2] < _LEAST_DEPTH_MM] = np.nan
        return pixels

    def px_per_mm(self, points_mm: Float) -> Float:
        """How many pixels a millimetre across the line of sight is, at points (N, 3)."""
        return self.camera.focal_px / np.maximum(self.camera_from_left.apply(points_mm)[:, 2], _LEAST_DEPTH_MM)


@dataclass(frozen=True, slots=True)
class Box:
    """A part of an image: its first column and row, and how many there are."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: Image) -> Image:
        """The pixels in it."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


@dataclass(frozen=True, slots=True)
class ViewPictures:
    """What is shown of one view; whole is None where the cut-out is; tip where no end is known or in the image."""

    name: str
    cut_out: Markup
    whole: Markup | None
    tip: Markup | None


def magnification(track: NeedleTrack, pair: StereoPair, rig: StereoRig, truth: TrueShape | None) -> int:
    """By how much the band of two sigmas has to be widened to be seen beside the curve."""
    if track.curve is None:
        return 1
    views = View.both(track, pair, rig)
    on_screen = CUT_OUT_PX / _cut_outs(views, track, truth)[0].width
    half_px = [2 * track.curve.sigma_mm * view.px_per_mm(track.curve.points_mm) for view in views]
    seen_px = float(np.median(half_px)) * on_screen
    return next((times for times in _MAGNIFICATIONS if times * seen_px >= _VISIBLE_PX), _MAGNIFICATIONS[-1])


def view_pictures(
    track: NeedleTrack, pair: StereoPair, rig: StereoRig, truth: TrueShape | None, times: int
) -> tuple[ViewPictures, ...]:
    """The pictures of both views; `times` magnifies the band of two sigmas across the curve."""
    views = View.both(track, pair, rig)
    cut_outs = _cut_outs(views, track, truth)
    return tuple(
        ViewPictures(
            view.name,
            _cut_out(view, box, track, truth, times),
            _whole(view, box, track, truth),
            _at_tip(view, track, truth),
        )
        for view, box in zip(views, cut_outs, strict=True)
    )


def data_uri(image: Image, most_bytes: int, *, lossless: bool = False) -> str:
    """The image as a WebP within a URI, as good as fits into so many bytes; smaller where nothing else helps."""
    while True:
        for quality in ((_LOSSLESS,) if lossless else ()) + _QUALITIES:
            _, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
            if data.size <= most_bytes:
                return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"
        image = np.asarray(cv2.resize(image, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def stretched(image: Image, like: Image | None = None) -> Image:
    """The image with its grey levels (or those of another) spread over the whole range."""
    low, high = np.percentile(image if like is None else like, (0.5, 99.5))
    spread = (image.astype(np.float32) - low) * (255 / max(high - low, 16.0))
    return np.asarray(np.clip(spread, 0, 255), dtype=np.uint8)


def stretches(values: list[int]) -> Iterator[tuple[int, int, int]]:
    """(value, first, one past the last) of each run of equal values."""
    first = 0
    for index in range(1, len(values) + 1):
        if index == len(values) or values[index] != values[first]:
            yield values[first], first, index
            first = index


def _cut_outs(views: tuple[View, View], track: NeedleTrack, truth: TrueShape | None) -> tuple[Box, Box]:
    """The parts of both images with the needle in them, of one size and of the images' shape; else the whole images."""
    shown = [line for line in (_curve_mm(track), _true_mm(truth)) if line is not None]
    corners: list[tuple[Float, Float]] = []
    for view in views:
        points = np.vstack([view.project(line) for line in shown]) if shown else np.zeros((0, 2))
        points = points[view.camera.contains(points)]
        if len(points) == 0:
            rows, columns = view.image.shape
            return Box(0, 0, columns, rows), Box(0, 0, columns, rows)
        corners.append((points.min(axis=0), points.max(axis=0)))
    rows, columns = views[0].image.shape
    size = np.max([high - low for low, high in corners], axis=0) + 2 * _MARGIN_PX
    width = max(float(size[0]), float(size[1]) * columns / rows, _LEAST_CUT_OUT_PX)
    width = min(round(width), columns)
    height = min(round(width * rows / columns), rows)
    boxes = []
    for low, high in corners:
        left, top = np.round((low + high - (width, height)) / 2).astype(int).tolist()
        boxes.append(Box(min(max(left, 0), columns - width), min(max(top, 0), rows - height), width, height))
    return boxes[0], boxes[1]


def _curve_mm(track: NeedleTrack) -> Float | None:
    return None if track.curve is None else track.curve.points_mm


def _true_mm(truth: TrueShape | None) -> Float | None:
    return None if truth is None or len(truth.centerline_mm) == 0 else truth.centerline_mm


def _cut_out(view: View, box: Box, track: NeedleTrack, truth: TrueShape | None, times: int) -> Markup:
    svg = _picture(view, box, "cut-out", CUT_OUT_PX, (_GREATEST_CUT_OUT_PX, _CUT_OUT_BYTES))
    mark_px = 8 * box.width / CUT_OUT_PX
    drawn = element(svg, "g", class_="drawn")
    if view.detected is not None:
        element(drawn, "path", d=line_path(view.detected.points_px), class_="detected")
    if track.curve is not None:
        _draw_band(drawn, view, track.curve, times)
        _draw_curve(drawn, view, track.curve)
    _draw_truth(svg, view, truth, mark_px)
    if track.base is not None:
        _mark_base(drawn, view.project(track.base.position_mm[None])[0], mark_px)
    if track.tip is not None:
        _mark_tip(drawn, view.project(track.tip.position_mm[None])[0], mark_px)
    element(svg, "circle", cx=-1e4, cy=-1e4, r=0.9 * mark_px, class_="cursor")
    return markup(svg)


def _whole(view: View, box: Box, track: NeedleTrack, truth: TrueShape | None) -> Markup | None:
    rows, columns = view.image.shape
    if (box.width, box.height) == (columns, rows):
        return None
    svg = _picture(view, Box(0, 0, columns, rows), "whole", SMALL_PX, (_GREATEST_WHOLE_PX, _WHOLE_BYTES))
    element(svg, "rect", x=box.left, y=box.top, width=box.width, height=box.height, class_="drawn outline")
    if track.curve is not None:
        _draw_curve(element(svg, "g", class_="drawn thin"), view, track.curve)
    elif truth is not None:
        _draw_truth(svg, view, truth, 0.0)
    return markup(svg)


def _at_tip(view: View, track: NeedleTrack, truth: TrueShape | None) -> Markup | None:
    """The raw pixels around the tip, or where the curve ends; around the true tip where there is no curve."""
    line = _curve_mm(track) if track.curve is not None else _true_mm(truth)
    if line is None:
        return None
    at_px = view.project(line[-1:])
    if not view.camera.contains(at_px)[0]:
        return None
    rows, columns = view.image.shape
    left, top = np.round(at_px[0]).astype(int).tolist()
    width, height = min(_TIP_PX[0], columns), min(_TIP_PX[1], rows)
    left, top = (min(max(left - width // 2, 0), columns - width), min(max(top - height // 2, 0), rows - height))
    svg = _picture(view, Box(left, top, width, height), "at-tip", SMALL_PX, (width, _TIP_BYTES), lossless=True)
    drawn = element(svg, "g", class_="drawn thin")
    if track.curve is not None:
        _draw_curve(drawn, view, track.curve)
    _draw_truth(svg, view, truth, 2.0)
    if track.tip is not None:
        _mark_tip(drawn, view.project(track.tip.position_mm[None])[0], 1.0)
        element(drawn, "path", d=line_path(_ellipse_px(view, track.tip)) + "Z", class_="ellipse")
    return markup(svg)


def _picture(
    view: View, box: Box, kind: str, width_px: int, most: tuple[int, int], *, lossless: bool = False
) -> Element:
    """The SVG of a part of an image, stored with at most so many pixels a side and so many bytes."""
    pixels = box.of(view.image)
    shrink = min(1.0, most[0] / box.width)
    if shrink < 1:
        size = (round(box.width * shrink), round(box.height * shrink))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # A pixel's centre has whole coordinates, as everywhere.
    left, top = box.left - 0.5, box.top - 0.5
    label = {"cut-out": "around the needle", "whole": "whole image", "at-tip": "at the tip"}[kind]
    svg = element(
        None,
        "svg",
        viewbox=f"{digits(left)} {digits(top)} {box.width} {box.height}",
        width=width_px,
        role="img",
        class_=f"view {kind} {view.name}",
    )
    svg.set("aria-label", f"{view.name} view, {label}")
    uri = data_uri(stretched(pixels), most[1], lossless=lossless)
    element(svg, "image", x=left, y=top, width=box.width, height=box.height, href=uri, preserveaspectratio="none")
    return svg


def _draw_band(group: Element, view: View, curve: NeedleCurve, times: int) -> None:
    points_px = view.project(curve.points_mm)
    along = tangents(points_px)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    half_px = (2 * times * curve.sigma_mm * view.px_per_mm(curve.points_mm))[:, None]
    # Beyond the image nothing is seen; a sigma of kilometres must not end there.
    half_px = np.minimum(half_px, 4 * max(view.camera.size_px))
    element(group, "path", d=band_path(points_px - half_px * across, points_px + half_px * across, 1), class_="sigma")


def _draw_curve(group: Element, view: View, curve: NeedleCurve) -> None:
    points_px = view.project(curve.points_mm)
    element(group, "path", d=line_path(points_px), class_="casing")
    for seen, first, last in stretches(np.minimum(curve.seen[:-1], curve.seen[1:]).tolist()):
        element(group, "path", d=line_path(points_px[first : last + 1]), class_=f"curve seen-{seen}")


def _draw_truth(svg: Element, view: View, truth: TrueShape | None, mark_px: float) -> None:
    line_mm = _true_mm(truth)
    if line_mm is None:
        return
    points_px = view.project(line_mm)
    group = element(svg, "g", class_="truth")
    element(group, "path", d=line_path(points_px), class_="true-casing")
    element(group, "path", d=line_path(points_px), class_="true-axis")
    x, y = points_px[-1].tolist()
    if mark_px and np.isfinite(points_px[-1]).all():
        arms = f"M{digits(x - mark_px)} {digits(y - mark_px)}l{digits(2 * mark_px)} {digits(2 * mark_px)}"
        arms += f"m0 {digits(-2 * mark_px)}l{digits(-2 * mark_px)} {digits(2 * mark_px)}"
        element(group, "path", d=arms, class_="true-tip")


def _mark_base(group: Element, at_px: Float, mark_px: float) -> None:
    if np.isfinite(at_px).all():
        x, y = at_px.tolist()
        place = {"x": x - mark_px, "y": y - mark_px, "width": 2 * mark_px, "height": 2 * mark_px}
        element(group, "rect", **place, class_="mark casing")
        element(group, "rect", **place, class_="mark base")


def _mark_tip(group: Element, at_px: Float, mark_px: float) -> None:
    if np.isfinite(at_px).all():
        x, y = at_px.tolist()
        element(group, "circle", cx=x, cy=y, r=mark_px, class_="mark casing")
        element(group, "circle", cx=x, cy=y, r=mark_px, class_="mark tip")


def _ellipse_px(view: View, tip: TipPose) -> Float:
    """Two standard deviations of the tip (N, 2), carried into the image to first order."""
    step_mm = 1e-3
    steps = view.project(tip.position_mm + step_mm * np.vstack([np.eye(3), -np.eye(3)]))
    jacobian = (steps[:3] - steps[3:]).T / (2 * step_mm)
    variances, axes = np.linalg.eigh(jacobian @ tip.covariance_mm2 @ jacobian.T)
    turn = np.linspace(0, 2 * np.pi, 49)[:-1]
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    center = view.project(tip.position_mm[None])[0]
    return np.asarray(center + 2 * circle * np.sqrt(variances.clip(0)) @ axes.T)
