"""The drawings of a calibration's report: each one SVG, in the page's colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup
from scipy.stats import norm

from needletrack.calibration.board import Board, BoardView
from needletrack.calibration.coverage import CELLS
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.geometry.uncertainty import RigUncertainty
from needletrack.records import Float, Image, Int
from needletrack.report.svg import Element, Panel, digits, drawing, element, line_path, markup, tick_text
from needletrack.report.views import data_uri, stretched

_WIDTH_PX = 580.0
_THUMBNAIL_PX, _THUMBNAIL_BYTES = 150, 3_500
_RECTIFIED_BYTES = 42_000
# Residuals are drawn so many times longer that their median is this share of the image's width.
_ARROW_SHARE = 0.012
_BINS = 41
_MAP_COLUMNS, _MAP_ROWS = 18, 14
# Where a shade of the map begins, mm.
LEVELS_MM = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
_TURN, _LIFT = np.radians(-28.0), np.radians(22.0)


def coverage_figure(corners_px: Sequence[Float], counts: Int, size_px: tuple[int, int], side: str) -> Markup:
    """One camera's image with all boards' corners (each (N, 2)) and outlines, and the ninths that have none."""
    width, height = size_px
    scale = width / _WIDTH_PX
    svg = drawing(width, height, f"coverage of the {side} view", class_="coverage")
    element(svg, "rect", x=0, y=0, width=width, height=height, class_="panel")
    for row in range(CELLS):
        for column in range(CELLS):
            if counts[row, column]:
                continue
            x, y = column * width / CELLS, row * height / CELLS
            element(svg, "rect", x=x, y=y, width=width / CELLS, height=height / CELLS, class_="empty-ninth")
            text = element(svg, "text", "nothing here", x=x + width / CELLS / 2, y=y + height / CELLS / 2)
            text.set("class", "empty-text middle")
            text.set("font-size", digits(15 * scale))
    for line in range(1, CELLS):
        element(svg, "line", x1=line * width / CELLS, x2=line * width / CELLS, y1=0, y2=height, class_="grid")
        element(svg, "line", x1=0, x2=width, y1=line * height / CELLS, y2=line * height / CELLS, class_="grid")
    for corners in corners_px:
        known = corners[np.isfinite(corners).all(axis=1)]
        hull = cv2.convexHull(known.astype(np.float32)).reshape(-1, 2).astype(np.float64)
        element(svg, "path", d=line_path(hull, 1) + "Z", class_=f"outline-{side}")
    path = "".join(
        f"M{digits(x, 1)} {digits(y, 1)}h0" for corners in corners_px for x, y in corners[np.isfinite(corners[:, 0])]
    )
    element(svg, "path", d=path, class_=f"dots corner {side}", stroke_width=2.2 * scale)
    return markup(svg)


def residual_figure(
    corners_px: Sequence[Float], residual_px: Float, size_px: tuple[int, int], side: str
) -> tuple[Markup, float]:
    """Every corner's residual (V, N, 2) as a line from it, and how many times longer it is drawn than it is."""
    width, height = size_px
    length = np.linalg.norm(residual_px, axis=-1)
    typical = float(np.nanmedian(length))
    times = float(np.clip(_ARROW_SHARE * width / max(typical, 1e-9), 1, 1e6))
    svg = drawing(width, height, f"residuals of the {side} view", class_="coverage")
    element(svg, "rect", x=0, y=0, width=width, height=height, class_="panel")
    parts = []
    for corners, off in zip(corners_px, residual_px, strict=True):
        for (x, y), (dx, dy) in zip(corners.tolist(), (times * off).tolist(), strict=True):
            if np.isfinite(x + dx):
                parts.append(f"M{digits(x, 1)} {digits(y, 1)}l{digits(dx, 1)} {digits(dy, 1)}")
    element(svg, "path", d="".join(parts), class_=f"line {side}", stroke_width=width / _WIDTH_PX)
    return markup(svg), times


def histogram_figure(values: Sequence[tuple[str, str, Float]], sigma_px: float, label: str) -> Markup:
    """Histograms of (name, kind, values (N,)) px over each other, with the normal curve of their common sigma."""
    limit = 5 * max(sigma_px, 1e-6)
    edges = np.linspace(-limit, limit, _BINS + 1)
    step = edges[1] - edges[0]
    curves = [(name, kind, np.histogram(v[np.isfinite(v)], edges)[0]) for name, kind, v in values]
    total = max(float(np.isfinite(v).sum()) for _, _, v in values)
    expected = total * step * norm.pdf(edges, 0, sigma_px)
    highest = 1.25 * max(float(expected.max()), *(float(counts.max()) for _, _, counts in curves))
    svg = drawing(_WIDTH_PX, 236, label, class_="trends")
    panel = Panel(svg, 92, 8, _WIDTH_PX - 104, 180, (-limit, limit), (0, highest))
    panel.frame("corners")
    for _, kind, counts in curves:
        panel.line(np.repeat(edges, 2)[1:-1], np.repeat(counts, 2), kind)
    panel.line(edges, expected, "faint dashed")
    panel.legend([(name, kind) for name, kind, _ in curves] + [("normal, common sigma", "faint dashed")])
    panel.x_axis(label, 9)
    return markup(svg)


def per_view_figure(view_rms_px: Float, numbers: Sequence[int], rms_px: float) -> Markup:
    """RMS of each used view (V, 2) in both pictures."""
    svg = drawing(1180, 210, "RMS of each view", class_="trends")
    highest = 1.3 * max(float(view_rms_px.max()), rms_px)
    panel = Panel(svg, 92, 8, 1076, 156, (-0.5, len(numbers) - 0.5), (0, highest))
    panel.frame("px rms")
    wide = 1076 / len(numbers)
    for place, (number, both) in enumerate(zip(numbers, view_rms_px.tolist(), strict=True)):
        for side, (name, rms) in enumerate(zip(("left", "right"), both, strict=True)):
            tall = rms / highest * 156
            bar = element(
                svg,
                "rect",
                x=92 + wide * (place + 0.16 + 0.35 * side),
                y=8 + 156 - tall,
                width=max(0.33 * wide, 1.0),
                height=tall,
                class_=f"bar {name}",
            )
            element(bar, "title", f"view {number}, {name}: {rms:.3f} px")
        element(svg, "text", str(number), x=92 + wide * (place + 0.5), y=182, class_="tick middle")
    panel.level(rms_px, f"all {rms_px:.3f}")
    element(svg, "text", "view", x=630, y=204, class_="label middle")
    return markup(svg)


def thumbnail(image: Image, corners_px: Float | None) -> Markup:
    """A small picture, with the corners that were found in it."""
    rows, columns = image.shape
    svg = drawing(columns, rows, "picture", class_="thumbnail")
    factor = min(1.0, 2 * _THUMBNAIL_PX / columns)
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    uri = data_uri(stretched(np.asarray(small, dtype=np.uint8)), _THUMBNAIL_BYTES)
    element(svg, "image", x=-0.5, y=-0.5, width=columns, height=rows, href=uri, preserveaspectratio="none")
    if corners_px is not None:
        path = "".join(f"M{digits(x, 1)} {digits(y, 1)}h0" for x, y in corners_px[np.isfinite(corners_px[:, 0])])
        element(svg, "path", d=path, class_="dots found", stroke_width=columns / 110)
    return markup(svg)


def rectified_figure(rig: StereoRig, images: tuple[Image, Image], view: BoardView) -> Markup:
    """Both pictures of a view turned so that epipolar lines are rows: the same corner has to lie on the same row."""
    width, height = rig.left.size_px
    turns = rig.rectification
    pictures, corners = [], []
    for image, camera, turn, px in zip(
        images, (rig.left, rig.right), turns[:2], (view.left_px, view.right_px), strict=True
    ):
        assert px is not None
        map_x, map_y = cv2.initUndistortRectifyMap(
            camera.matrix, camera.distortion, turn, turns[2], (width, height), cv2.CV_32FC1
        )
        pictures.append(np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), dtype=np.uint8))
        rays = np.column_stack([camera.normalize(px), np.ones(len(px))]) @ turn.T
        corners.append(rays[:, :2] / rays[:, 2:] * turns[2][[0, 1], [0, 1]] + turns[2][:2, 2])
    svg = drawing(2 * width + 20, height, "rectified pair with epipolar lines", class_="coverage")
    for at, picture in zip((0, width + 20), pictures, strict=True):
        small = cv2.resize(picture, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
        uri = data_uri(stretched(np.asarray(small, dtype=np.uint8)), _RECTIFIED_BYTES)
        element(svg, "image", x=at, y=0, width=width, height=height, href=uri, preserveaspectratio="none")
    known = np.flatnonzero(np.isfinite(corners[0] + corners[1]).all(axis=1))
    chosen = known[np.unique(np.linspace(0, len(known) - 1, 9).astype(int))]
    for index in chosen:
        row = float(corners[0][index, 1])
        element(svg, "line", x1=0, x2=2 * width + 20, y1=row, y2=row, class_="epipolar", stroke_width=width / 700)
        for at, px in zip((0, width + 20), corners, strict=True):
            element(svg, "circle", cx=at + px[index, 0], cy=px[index, 1], r=width / 130, class_="ring")
    return markup(svg)


@dataclass(frozen=True, slots=True)
class UncertaintyMap:
    """One depth: its drawing before and after alignment."""

    depth_mm: float
    before: Markup
    after: Markup


def uncertainty_maps(rig: StereoRig, covariance: Float, points_mm: Float) -> tuple[UncertaintyMap, ...]:
    """The error to expect, rms mm, over the workspace's width and height at three depths."""
    depths = np.quantile(points_mm[:, 2], [0.02, 0.5, 0.98])
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    x, y = np.linspace(low[0], high[0], _MAP_COLUMNS), np.linspace(low[1], high[1], _MAP_ROWS)
    models = (RigUncertainty(rig, covariance), RigUncertainty(rig, covariance, points_mm))
    maps = []
    for depth in depths.tolist():
        grid = np.stack(np.meshgrid(x, y, [depth]), axis=-1).reshape(-1, 3)
        pixels = rig.project(grid)
        seen = rig.left.contains(pixels[0]) & rig.right.contains(pixels[1])
        drawn = []
        for model in models:
            rms = np.sqrt(np.trace(model.covariance_mm2(grid), axis1=1, axis2=2))
            drawn.append(_map(np.where(seen, rms, np.nan).reshape(_MAP_ROWS, _MAP_COLUMNS), x, y, depth))
        maps.append(UncertaintyMap(depth, drawn[0], drawn[1]))
    return tuple(maps)


def _map(rms_mm: Float, x: Float, y: Float, depth: float) -> Markup:
    wide, tall = 380.0, 380.0 * np.ptp(y) / np.ptp(x)
    svg = drawing(wide + 60, tall + 56, f"error to expect at {depth:.0f} mm", class_="trends map")
    cell_w, cell_h = wide / len(x), tall / len(y)
    for (row, column), value in np.ndenumerate(rms_mm):
        level = "none" if np.isnan(value) else str(int(np.searchsorted(LEVELS_MM, value)))
        cell = element(
            svg,
            "rect",
            x=50 + column * cell_w,
            y=6 + row * cell_h,
            width=cell_w + 0.4,
            height=cell_h + 0.4,
            class_=f"level-{level}",
        )
        said = "not seen by both cameras" if np.isnan(value) else f"{value:.3f} mm"
        element(cell, "title", f"x {x[column]:.0f}, y {y[row]:.0f}, z {depth:.0f} mm: {said}")
    if np.isfinite(rms_mm).any():
        for name, of in (("least", np.nanargmin(rms_mm)), ("most", np.nanargmax(rms_mm))):
            row, column = np.unravel_index(int(of), rms_mm.shape)
            element(
                svg,
                "text",
                f"{rms_mm[row, column]:.3f}",
                x=50 + float(np.clip((column + 0.5) * cell_w, 22, wide - 22)),
                y=10 + float(np.clip((row + 0.5) * cell_h, 8, tall - 12)),
                class_=f"on-map middle {name}",
            )
    for place in (0, len(x) - 1):
        element(
            svg, "text", tick_text(round(x[place])), x=50 + (place + 0.5) * cell_w, y=tall + 22, class_="tick middle"
        )
    for place in (0, len(y) - 1):
        element(svg, "text", tick_text(round(y[place])), x=44, y=10 + (place + 0.5) * cell_h, class_="tick end")
    element(svg, "text", "x, mm", x=50 + wide / 2, y=tall + 22, class_="tick middle")
    element(svg, "text", "y, mm", x=44, y=10 + tall / 2, class_="tick end")
    element(svg, "text", f"z = {depth:.0f} mm", x=50 + wide / 2, y=tall + 44, class_="label middle")
    return markup(svg)


def rig_figure(rig: StereoRig, board: Board, left_from_board: Sequence[RigidTransform], points_mm: Float) -> Markup:
    """Both cameras, all boards and the workspace, from behind, above and to the side of the cameras."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    outlines = [pose.apply(_outline_mm(board)) for pose in left_from_board]
    cameras = [_frustum(rig, side) for side in (0, 1)]
    every = np.concatenate([box, *outlines, *cameras])
    flat = _seen_from_aside(every)
    least, most = flat.min(axis=0), flat.max(axis=0)
    scale = min(1100 / (most[0] - least[0]), 480 / (most[1] - least[1]))
    width, height = 1180.0, float((most[1] - least[1]) * scale + 60)

    def place(points: Float) -> Float:
        flat_px = (_seen_from_aside(points) - least) * scale
        return np.asarray(flat_px + np.array([(width - (most[0] - least[0]) * scale) / 2, 30]))

    svg = drawing(width, height, "the rig in space", class_="scene")
    for i, j in [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]:
        element(svg, "path", d=line_path(place(box[[i, j]]), 1), class_="box")
    for outline in outlines:
        element(svg, "path", d=line_path(place(outline), 1) + "Z", class_="board")
    for side, frustum in zip(("left", "right"), cameras, strict=True):
        apex, corners = place(frustum[:1]), place(frustum[1:])
        rays = "".join(line_path(np.vstack([apex, corner[None]]), 1) for corner in corners)
        element(svg, "path", d=rays + line_path(corners, 1) + "Z", class_=f"frustum {side}")
        x, y = apex[0].tolist()
        element(svg, "circle", cx=x, cy=y, r=5, class_=f"apex {side}")
        element(svg, "text", f"{side} camera", x=x, y=y - 12, class_="label middle")
    _label_box(svg, place(box), low, high)
    return markup(svg)


def _label_box(svg: Element, corners: Float, low: Float, high: Float) -> None:
    x, y = corners[corners[:, 1].argmax()].tolist()
    size = " × ".join(f"{extent:.0f}" for extent in high - low)
    element(svg, "text", f"workspace {size} mm, z {low[2]:.0f} to {high[2]:.0f}", x=x, y=y + 20, class_="label middle")


def _seen_from_aside(points: Float) -> Float:
    """Parallel projection (N, 2) of points (N, 3): depth runs to the right, up is up."""
    x, y, z = points.T
    across = z * np.cos(_TURN) - x * np.sin(_TURN)
    deep = z * np.sin(_TURN) + x * np.cos(_TURN)
    return np.column_stack([across, y * np.cos(_LIFT) + deep * np.sin(_LIFT)])


def _outline_mm(board: Board) -> Float:
    low, high = board.points_mm.min(axis=0), board.points_mm.max(axis=0)
    side = board.square_mm
    return np.array(
        [
            [low[0] - side, low[1] - side, 0],
            [high[0] + side, low[1] - side, 0],
            [high[0] + side, high[1] + side, 0],
            [low[0] - side, high[1] + side, 0],
        ]
    )


def _frustum(rig: StereoRig, side: int) -> Float:
    """A camera's centre and the corners of its image 60 mm in front of it, in the left camera's frame (5, 3)."""
    camera = (rig.left, rig.right)[side]
    pose = RigidTransform.identity() if side == 0 else rig.right_from_left.inverse()
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    rays = np.column_stack([camera.normalize(corners), np.ones(4)]) * 60
    return np.asarray(pose.apply(np.vstack([np.zeros(3), rays])))
