"""The needle's shape in space from several sides (Fig. 9 and 10 of Nguyen et al. 2017)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from needletrack.geometry.spline import tangents, unit
from needletrack.pictures.palette import BASE, MUTED, PAGE, PANEL, RULE, TEXT, TIP
from needletrack.pictures.theme import EMPTY_PX, HEADING_PX, Page, number
from needletrack.records import Float, NeedleCurve, NeedleTrack

WIDTH_PX, HEIGHT_PX = 1570, 1570
_CELL_PX = 590
_LEFT_PX, _ACROSS_PX, _DOWN_PX = 104, 700, 690
_ROOM = 1.25
_COLORS = LinearSegmentedColormap.from_list("sigma", colormaps["plasma"](np.linspace(0.3, 1, 256)))
_BAND_FACTORS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True, slots=True)
class _Side:
    """An orthographic view: which axis runs to the right, which upwards, and whether that one is reversed."""

    name: str
    seen_from: str
    right: int
    up: int
    up_reversed: bool


# Third-angle projection: the view from above stands above the front view, that from the right to its right.
_TOP = _Side("top", "from above", right=0, up=2, up_reversed=False)
_FRONT = _Side("front", "as the left camera sees it", right=0, up=1, up_reversed=True)
_RIGHT = _Side("side", "from the right", right=2, up=1, up_reversed=True)
_AXIS = ("x", "y", "z")
_SENSE = ("right", "down", "forward")


def shape_figure(track: NeedleTrack, every: int = 1) -> Page:
    """The curve from above, from the left camera, from the right and in perspective, all at one scale.

    Axes "top", "front" and "side" have millimetres of the left camera's frame as data coordinates, with equal
    units and one cube of limits. The colour is the standard deviation across the needle; the band around it
    is two of them wide on each side, enlarged by the factor that the picture names. every: draw only each
    n-th point, as a dot (Fig. 10). Raises ValueError where it is below 1.
    """
    if every < 1:
        raise ValueError(f"every is {every}, not 1 or more")
    curve = track.curve
    page = Page(WIDTH_PX, HEIGHT_PX if curve is not None else EMPTY_PX)
    length = "" if curve is None else f", {number(curve.length_mm)} mm long"
    subtitle = "left camera's frame, mm: x right, y down, z forward"
    page.write_heading(f"Shape of the needle{length}", subtitle, track)
    if curve is None:
        page.write(WIDTH_PX / 2, page.height_px - 80, "no shape was found", 26, MUTED, "center")
        return page
    scene = _scene(track, curve, every)
    right, down = _LEFT_PX + _ACROSS_PX, HEADING_PX + 40
    for side, x, y in (
        (_TOP, _LEFT_PX, down),
        (_FRONT, _LEFT_PX, down + _DOWN_PX),
        (_RIGHT, right, down + _DOWN_PX),
    ):
        axes = page.axes_at(x, y, _CELL_PX, _CELL_PX, side.name)
        page.write(x, y - 14, side.name, 21, bold=True)
        page.write(x + 24 + 13 * len(side.name), y - 14, side.seen_from, 19, MUTED)
        _draw_side(axes, scene, side)
    page.write(right, down - 14, "perspective", 21, bold=True)
    _draw_perspective(page, right, down - 30, scene)
    _draw_scale(page, scene)
    return page


@dataclass(frozen=True, slots=True)
class _Scene:
    points_mm: Float
    sigma_mm: Float
    low_mm: Float
    high_mm: Float
    band_mm: Float
    band_factor: int
    dotted: bool
    base_mm: Float | None
    tip_mm: Float | None
    arrow_mm: Float | None
    norm: Normalize

    @property
    def segment_colors(self) -> Float:
        between = (self.sigma_mm[:-1] + self.sigma_mm[1:]) / 2
        return np.asarray(_COLORS(self.norm(between)), dtype=np.float64)


def _scene(track: NeedleTrack, curve: NeedleCurve, every: int) -> _Scene:
    # The tip stays, whichever points are left out.
    kept = np.unique(np.append(np.arange(0, len(curve.points_mm), every), len(curve.points_mm) - 1))
    points, sigma = curve.points_mm[kept], curve.sigma_mm[kept]
    low, high = curve.points_mm.min(axis=0), curve.points_mm.max(axis=0)
    span = float((high - low).max())
    middle, half = (low + high) / 2, max(_ROOM * span / 2, 1.0)
    worst = float(sigma.max())
    factor = max((f for f in _BAND_FACTORS if 2 * f * worst <= 0.035 * span), default=1)
    return _Scene(
        points_mm=points,
        sigma_mm=sigma,
        low_mm=middle - half,
        high_mm=middle + half,
        band_mm=2 * factor * sigma,
        band_factor=factor,
        dotted=every > 1,
        base_mm=None if track.base is None else track.base.position_mm,
        tip_mm=None if track.tip is None else track.tip.position_mm,
        arrow_mm=None if track.tip is None else 0.1 * span * track.tip.direction,
        norm=Normalize(0, worst if worst > 0 else 1),
    )


def _draw_side(axes: Axes, scene: _Scene, side: _Side) -> None:
    chosen = [side.right, side.up]
    points = scene.points_mm[:, chosen]
    along = np.gradient(points, axis=0)
    # No direction in the picture, thus no band, where the needle runs along the line of sight.
    length = np.maximum(np.linalg.norm(along, axis=1), np.finfo(float).tiny)
    across = along[:, ::-1] * (-1, 1) * (scene.band_mm / length)[:, None]
    outline = np.concatenate([points + across, (points - across)[::-1]])
    axes.fill(*outline.T, color=TEXT, alpha=0.22, linewidth=0)
    segments = np.stack([points[:-1], points[1:]], axis=1)
    axes.add_collection(LineCollection(list(segments), colors=scene.segment_colors, linewidths=4, capstyle="round"))
    if scene.dotted:
        x, y = points.T
        axes.scatter(x, y, s=110, c=scene.sigma_mm, cmap=_COLORS, norm=scene.norm, edgecolors=PAGE, zorder=3)
    if scene.tip_mm is not None and scene.arrow_mm is not None:
        start, end = scene.tip_mm[chosen], (scene.tip_mm + scene.arrow_mm)[chosen]
        axes.annotate(
            "",
            (end[0], end[1]),
            (start[0], start[1]),
            arrowprops={
                "arrowstyle": "-|>,head_width=0.45,head_length=0.8",
                "color": TIP,
                "linewidth": 3,
                "mutation_scale": 16,
                "shrinkA": 0,
                "shrinkB": 0,
            },
            zorder=3,
        )
        axes.plot(*start, "o", markersize=11, color=TIP, markeredgecolor=PAGE, zorder=4)
    if scene.base_mm is not None:
        axes.plot(*scene.base_mm[chosen], "s", markersize=11, color=BASE, markeredgecolor=PAGE, zorder=4)
    axes.set_xlim(scene.low_mm[side.right], scene.high_mm[side.right])
    limits = (scene.low_mm[side.up], scene.high_mm[side.up])
    axes.set_ylim(limits[::-1] if side.up_reversed else limits)
    axes.set_aspect("equal")
    axes.grid(color=RULE, linewidth=1)
    axes.set_axisbelow(True)
    axes.set_xlabel(f"{_AXIS[side.right]} ({_SENSE[side.right]}), mm", color=TEXT, fontsize=19)
    axes.set_ylabel(f"{_AXIS[side.up]} ({_SENSE[side.up]}), mm", color=TEXT, fontsize=19)


def _draw_perspective(page: Page, x: float, y: float, scene: _Scene) -> None:
    """The scene from the front, above and right, with its shadows on the floor and on both walls."""
    box = page.box(x, y, _CELL_PX + 90, _CELL_PX + 100)
    # mplot3d carries no types; it would sort whole artists by depth, where the walls have to come first.
    axes: Any = page.add_axes(box, projection="3d", label="perspective", computed_zorder=False)
    axes.patch.set_visible(False)
    axes.set_axis_off()
    axes.set_proj_type("persp", focal_length=0.9)
    axes.view_init(elev=20, azim=-58)
    (x0, y0, z0), (x1, y1, z1) = scene.low_mm, scene.high_mm
    ticks = [_ticks(low, high) for low, high in zip(scene.low_mm, scene.high_mm, strict=True)]
    faces = {
        "floor": [[x0, y1, z0], [x1, y1, z0], [x1, y1, z1], [x0, y1, z1]],
        "back": [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]],
        "left": [[x0, y0, z0], [x0, y1, z0], [x0, y1, z1], [x0, y0, z1]],
    }
    corners = [_upright(np.array(face)) for face in faces.values()]
    axes.add_collection3d(Poly3DCollection(corners, facecolors=PANEL, edgecolors=RULE, linewidths=1.5))
    lines = [[(v, y1, z0), (v, y1, z1), (v, y0, z1)] for v in ticks[0]]
    lines += [[(x0, v, z0), (x0, v, z1), (x1, v, z1)] for v in ticks[1]]
    lines += [[(x0, y0, v), (x0, y1, v), (x1, y1, v)] for v in ticks[2]]
    axes.add_collection3d(Line3DCollection([_upright(np.array(line)) for line in lines], colors=RULE, linewidths=1))
    for axis, wall in ((1, y1), (2, z1), (0, x0)):
        shadow = scene.points_mm.copy()
        shadow[:, axis] = wall
        axes.plot(*_upright(shadow).T, color=MUTED, alpha=0.45, linewidth=2.5)
    _label_edges(axes, scene, ticks)
    axes.add_collection3d(Poly3DCollection(_tube(scene), facecolors=TEXT, alpha=0.12, linewidths=0))
    points = _upright(scene.points_mm)
    segments = np.stack([points[:-1], points[1:]], axis=1)
    axes.add_collection3d(Line3DCollection(segments, colors=scene.segment_colors, linewidths=4.5, capstyle="round"))
    if scene.base_mm is not None:
        axes.plot(*_upright(scene.base_mm), marker="s", markersize=11, color=BASE, markeredgecolor=PAGE)
    if scene.tip_mm is not None and scene.arrow_mm is not None:
        axes.quiver(
            *_upright(scene.tip_mm),
            *_upright(scene.arrow_mm),
            color=TIP,
            linewidth=3,
            arrow_length_ratio=0.35,
        )
        axes.plot(*_upright(scene.tip_mm), marker="o", markersize=11, color=TIP, markeredgecolor=PAGE)
    axes.set(xlim=(x0, x1), ylim=(z0, z1), zlim=(-y1, -y0))
    axes.set_box_aspect((1, 1, 1), zoom=1.04)


def _upright(points_mm: Float) -> Float:
    """Camera axes (x right, y down, z forward) in mplot3d's, whose third axis points up."""
    return np.asarray(points_mm)[..., [0, 2, 1]] * (1.0, 1.0, -1.0)


def _ticks(low: float, high: float) -> Float:
    values = np.asarray(MaxNLocator(5).tick_values(low, high), dtype=np.float64)
    room = 0.02 * (high - low)
    return values[(values > low + room) & (values < high - room)]


def _label_edges(axes: Any, scene: _Scene, ticks: list[Float]) -> None:
    (x0, _, z0), (x1, y1, _) = scene.low_mm, scene.high_mm
    out = 0.07 * (x1 - x0)
    places = [(v, y1 + 0.5 * out, z0 - out) for v in ticks[0]]
    places += [(x0 - out, v, z0 - 0.5 * out) for v in ticks[1]]
    places += [(x1 + out, y1 + 0.5 * out, v) for v in ticks[2]]
    for value, at in zip(np.concatenate(ticks), places, strict=True):
        axes.text(*_upright(np.array(at)), number(value, 0), fontsize=16, color=MUTED, ha="center", va="center")
    middle = (scene.low_mm + scene.high_mm) / 2
    for text, at in (
        ("x, mm", (middle[0], y1 + 1.2 * out, z0 - 2.6 * out)),
        ("y, mm", (x0 - 2.6 * out, middle[1], z0 - out)),
        ("z, mm", (x1 + 2.6 * out, y1 + 1.2 * out, middle[2])),
    ):
        axes.text(*_upright(np.array(at)), text, fontsize=19, color=TEXT, ha="center", va="center")


def _tube(scene: _Scene, sides: int = 10) -> Float:
    """Quadrilaterals (M, 4, 3) around the curve at the band's distance."""
    points = _upright(scene.points_mm)
    along = tangents(points)
    # Any direction that is nowhere along the needle serves to begin with.
    start = np.eye(3)[np.abs(along).max(axis=0).argmin()]
    first = unit(np.cross(along, start))
    second = np.cross(along, first)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.cos(angle)[None, :, None] * first[:, None] + np.sin(angle)[None, :, None] * second[:, None]
    skin = points[:, None] + scene.band_mm[:, None, None] * ring
    quads = np.stack([skin[:-1, :-1], skin[1:, :-1], skin[1:, 1:], skin[:-1, 1:]], axis=2)
    return np.asarray(quads.reshape(-1, 4, 3), dtype=np.float64)


def _draw_scale(page: Page, scene: _Scene) -> None:
    x, y = WIDTH_PX - 142, HEADING_PX + 40 + _DOWN_PX
    axes = page.axes_at(x, y, 26, _CELL_PX, "scale")
    bar = page.colorbar(ScalarMappable(scene.norm, _COLORS), cax=axes)
    bar.set_label("standard deviation across the needle, mm", color=TEXT, fontsize=19, labelpad=10)
    times = "" if scene.band_factor == 1 else f", drawn {scene.band_factor} × as wide"
    handles = [Patch(color=TEXT, alpha=0.22, linewidth=0, label=f"2σ on each side{times}")]
    page.write_legend(_LEFT_PX, page.height_px - 24, [*_ends(scene), *handles])


def _ends(scene: _Scene) -> list[Line2D]:
    shown = ((scene.base_mm, "s", BASE, "base"), (scene.tip_mm, "o", TIP, "tip"))
    return [
        Line2D([], [], linestyle="none", marker=marker, markersize=11, color=color, label=name)
        for at, marker, color, name in shown
        if at is not None
    ]
