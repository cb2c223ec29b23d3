"""Both views with the tracked curve projected back into them (Fig. 11 of Nguyen et al. 2017)."""

from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.pictures.palette import (
    BASE,
    DETECTED,
    MUTED,
    PAGE,
    RULE,
    SEEN_COLOR,
    SEEN_MEANING,
    STATUS_COLOR,
    TEXT,
    TIP,
)
from needletrack.pictures.theme import MARGIN_PX, Page, number
from needletrack.records import (
    REASON_MEANING,
    Centerline,
    Float,
    Image,
    Int,
    NeedleCurve,
    NeedleTrack,
    StereoPair,
    TipPose,
)

WIDTH_PX = 1800
_GAP_PX = 16
_TILES_PX = 128
_REASON_PX = 32
_LEGEND_PX = 64
_MOST_REASONS = 4
# Of the raw image, around the tip; odd, so that the tip's own pixel lies in the middle.
_ZOOM_PX = 37
_INSET_SHARE = 0.31
_INSET_MARGIN = 0.018

# Left 0 or right 1, top 0 or bottom 1.
_Corner = tuple[int, int]


@dataclass(frozen=True, slots=True)
class _View:
    name: str
    camera: Camera
    camera_from_left: RigidTransform
    image: Image
    detected: Centerline | None

    def project(self, points_mm: Float) -> Float:
        return self.camera.project(self.camera_from_left.apply(points_mm))


def overlay_figure(track: NeedleTrack, pair: StereoPair, rig: StereoRig) -> Page:
    """Both raw images side by side with the reprojected curve, the tip enlarged, and the track's numbers.

    The curve's colour says how many cameras saw each point; a white halo is the centerline that was detected
    before the fit. Axes "left" and "right" have raw pixels as data coordinates. Without a curve the picture
    shows the images and the reasons.
    """
    views = (
        _View("left", rig.left, RigidTransform.identity(), pair.left.image, track.evidence.left),
        _View("right", rig.right, rig.right_from_left, pair.right.image, track.evidence.right),
    )
    width = (WIDTH_PX - 2 * MARGIN_PX - _GAP_PX) / 2
    height = max(width * view.image.shape[0] / view.image.shape[1] for view in views)
    top = _TILES_PX + _REASON_PX * min(len(track.reasons), _MOST_REASONS) + (12 if track.reasons else 0)
    page = Page(WIDTH_PX, round(top + height + _LEGEND_PX))
    _write_numbers(page, track)
    _write_reasons(page, track)
    corner = _inset_corner(track, views)
    for index, view in enumerate(views):
        x = MARGIN_PX + index * (width + _GAP_PX)
        axes = page.axes_at(x, top, width, width * view.image.shape[0] / view.image.shape[1], view.name)
        _draw_view(axes, view, track, round(width))
        _draw_name(axes, view.name, corner)
        if track.curve is not None and track.tip is not None:
            _draw_zoom(axes, view, track.curve, track.tip, corner)
    _write_legend(page, track, pair)
    return page


def _write_numbers(page: Page, track: NeedleTrack) -> None:
    curve, tip, quality = track.curve, track.tip, track.quality
    page.write(MARGIN_PX, 42, "STATUS", 18, MUTED)
    page.write_status(MARGIN_PX, 58, track.status)
    length = diameter = worst = position = sigma = reprojection = ends = coverage = ""
    if curve is not None:
        length, worst = f"{number(curve.length_mm)} mm", f"σ up to {number(float(curve.sigma_mm.max()))} mm"
    if track.diameter_mm is not None:
        diameter = f"diameter {number(track.diameter_mm)} mm"
    if tip is not None:
        x, y, z = (number(value) for value in tip.position_mm)
        position = f"x {x}   y {y}   z {z} mm"
        sigma = f"± {', '.join(number(value) for value in np.sqrt(np.diagonal(tip.covariance_mm2)))} mm (1σ)"
    if quality.reprojection_rms_px is not None:
        reprojection = f"{number(quality.reprojection_rms_px)} px rms"
    if quality.epipolar_rms_px is not None:
        ends = f"ends, epipolar {number(quality.epipolar_rms_px)} px"
    if quality.coverage is not None:
        coverage = f"{100 * quality.coverage:.0f} %"
    for left, label, value, note in (
        (310, "LENGTH", length, diameter),
        (560, "TIP  (left camera: x right, y down, z forward)", position, sigma),
        (1190, "REPROJECTION", reprojection, ends),
        (1500, "SEEN BY BOTH CAMERAS", coverage, worst),
    ):
        rule = [1 - 24 / page.height_px, 1 - 108 / page.height_px]
        page.add_artist(Line2D([(left - 22) / page.width_px] * 2, rule, color=RULE, linewidth=2))
        page.write(left, 42, label, 18, MUTED)
        page.write(left, 80, value or "–", 29, bold=True)
        page.write(left, 108, note, 19, MUTED)


def _write_reasons(page: Page, track: NeedleTrack) -> None:
    shown = track.reasons[:_MOST_REASONS]
    for line, reason in enumerate(shown):
        y = _TILES_PX + _REASON_PX * line + 22
        text = REASON_MEANING[reason]
        if line == _MOST_REASONS - 1 and len(track.reasons) > _MOST_REASONS:
            text += f"  (and {len(track.reasons) - _MOST_REASONS} more)"
        page.write(MARGIN_PX, y, reason.value, 21, STATUS_COLOR[track.status], bold=True)
        page.write(310, y, text, 21, TEXT)


def _write_legend(page: Page, track: NeedleTrack, pair: StereoPair) -> None:
    y = page.height_px - 24
    page.write(
        page.width_px - MARGIN_PX,
        y,
        f"pair {pair.sequence} · {pair.captured_at_ns / 1e9:.3f} s ({pair.clock.value} clock)",
        19,
        MUTED,
        "right",
    )
    handles: list[Line2D] = []
    if track.curve is not None:
        handles += [Line2D([], [], color=SEEN_COLOR[n], linewidth=5, label=SEEN_MEANING[n]) for n in (2, 1, 0)]
    if track.evidence.left is not None or track.evidence.right is not None:
        handles.append(Line2D([], [], color=DETECTED, alpha=0.6, linewidth=9, label="detected"))
    if track.base is not None:
        handles.append(_marker("s", BASE, "base"))
    if track.tip is not None:
        handles.append(_marker("o", TIP, "tip"))
    if handles:
        page.write_legend(MARGIN_PX, y + 6, handles)


def _marker(shape: str, color: str, label: str) -> Line2D:
    """A hollow marker for the legend."""
    return Line2D([], [], linestyle="none", marker=shape, markersize=13, mfc="none", mec=color, mew=3, label=label)


def _inset_corner(track: NeedleTrack, views: tuple[_View, _View]) -> _Corner:
    """The corner where the enlarged tips hide the least of the curve, the same in both views."""
    corners = [(1, 0), (0, 0), (1, 1), (0, 1)]
    curve = track.curve
    if curve is None:
        return corners[0]

    def cost(corner: _Corner) -> tuple[int, float]:
        hidden, far = 0, 0.0
        for view in views:
            size = np.array(view.image.shape[::-1])
            # Corners as a share of the image's width from that corner, so that all four look alike.
            from_corner = np.abs(view.project(curve.points_mm) - np.array(corner) * size) / size[0]
            hidden += int((from_corner < _INSET_SHARE + 3 * _INSET_MARGIN).all(axis=1).sum())
            far += float(np.linalg.norm(from_corner[-1]))
        return hidden, far

    return min(corners, key=cost)


def _draw_view(axes: Axes, view: _View, track: NeedleTrack, width_px: int) -> None:
    rows, columns = view.image.shape
    size = (width_px, round(width_px * rows / columns))
    resampling = cv2.INTER_AREA if width_px < columns else cv2.INTER_LINEAR
    shrunk = cv2.resize(view.image, size, interpolation=resampling)
    low, high = _display_range(view.image[::4, ::4])
    extent = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    axes.imshow(shrunk, "gray", vmin=low, vmax=high, extent=extent, aspect="auto", interpolation="nearest")
    axes.set(xticks=[], yticks=[], xlim=extent[:2], ylim=extent[2:])
    if view.detected is not None:
        axes.plot(*view.detected.points_px.T, color=DETECTED, alpha=0.45, linewidth=8, solid_capstyle="round")
    if track.curve is None:
        return
    _draw_curve(axes, view.project(track.curve.points_mm), track.curve.seen, 3.2)
    if track.base is not None:
        _mark(axes, view.project(track.base.position_mm)[0], "s", BASE)
    if track.tip is not None:
        _mark(axes, view.project(track.tip.position_mm)[0], "o", TIP)


def _display_range(image: Image, least_span: float = 10.0) -> tuple[float, float]:
    """Gray levels to be shown as black and as white, with headroom for the page's colours."""
    low, high = (float(level) for level in np.percentile(image, (0.2, 99.8)))
    missing = max(least_span - (high - low), 0.0)
    low, high = low - missing / 2, high + missing / 2
    return low - 0.05 * (high - low), high + 0.35 * (high - low)


def _draw_curve(axes: Axes, points_px: Float, seen: Int, width: float) -> None:
    # A dark casing keeps the colours apart from a white needle.
    axes.plot(*points_px.T, color=PAGE, alpha=0.55, linewidth=width + 2.5, solid_capstyle="round")
    segments = np.stack([points_px[:-1], points_px[1:]], axis=1)
    colors = [SEEN_COLOR[int(count)] for count in np.minimum(seen[:-1], seen[1:])]
    axes.add_collection(
        LineCollection(list(segments), colors=colors, linewidths=width, capstyle="round"), autolim=False
    )


def _mark(axes: Axes, at_px: Float, shape: str, color: str) -> None:
    for edge, width in ((PAGE, 6.0), (color, 3.0)):
        axes.plot(*at_px, marker=shape, markersize=17, mfc="none", mec=edge, mew=width)


def _draw_name(axes: Axes, name: str, corner: _Corner) -> None:
    right, bottom = 1 - corner[0], corner[1]
    axes.text(
        0.982 if right else 0.018,
        0.025 if bottom else 0.975,
        name,
        transform=axes.transAxes,
        ha="right" if right else "left",
        va="bottom" if bottom else "top",
        fontsize=21,
        fontweight="bold",
        color=TEXT,
        bbox={"boxstyle": "round,pad=0.35", "facecolor": PAGE, "edgecolor": "none", "alpha": 0.7},
    )


def _draw_zoom(axes: Axes, view: _View, curve: NeedleCurve, tip: TipPose, corner: _Corner) -> None:
    """The raw pixels around the tip with the curve, the detected points and the tip's 2-sigma ellipse."""
    tip_px = view.project(tip.position_mm)[0]
    if not view.camera.contains(tip_px):
        return
    rows, columns = view.image.shape
    size, margin = np.array([1, columns / rows]) * _INSET_SHARE, np.array([1, columns / rows]) * _INSET_MARGIN
    place = np.where([corner[0] == 1, corner[1] == 0], 1 - size - margin, margin)
    inset = axes.inset_axes((place[0], place[1], size[0], size[1]), zorder=5, label=f"{view.name} tip")
    half = _ZOOM_PX // 2
    column, row = np.round(tip_px).astype(int)
    left, top = max(column - half, 0), max(row - half, 0)
    pixels = view.image[top : row + half + 1, left : column + half + 1]
    extent = (left - 0.5, left + pixels.shape[1] - 0.5, top + pixels.shape[0] - 0.5, top - 0.5)
    # More contrast than in the whole image, but not so much that noise becomes a texture.
    darkest, brightest = _display_range(view.image[::4, ::4])
    low, high = _display_range(pixels, least_span=(brightest - darkest) / 3)
    inset.imshow(pixels, "gray", vmin=low, vmax=high, extent=extent, interpolation="nearest")
    inset.set_xlim(column - half - 0.5, column + half + 0.5)
    inset.set_ylim(row + half + 0.5, row - half - 0.5)
    inset.set(xticks=[], yticks=[], facecolor=PAGE)
    for spine in inset.spines.values():
        spine.set(color=TEXT, linewidth=2)
    _draw_curve(inset, view.project(curve.points_mm), curve.seen, 2.6)
    if view.detected is not None:
        detected = _thinned(view.detected.points_px, 1.5)
        inset.plot(*detected.T, linestyle="none", marker="o", markersize=6, color=DETECTED, mec=PAGE, mew=1)
    inset.plot(*tip_px, marker="+", markersize=20, mew=2.6, color=TIP)
    _draw_ellipse(inset, view, tip)
    # The caption goes to the corner at which the needle points: there it hides nothing of it.
    ahead = tip_px - view.project(tip.position_mm - tip.direction)[0]
    at_right, at_top = ahead[0] >= 0, ahead[1] <= 0
    inset.text(
        0.96 if at_right else 0.04,
        0.955 if at_top else 0.045,
        f"{_ZOOM_PX} × {_ZOOM_PX} px at the tip",
        transform=inset.transAxes,
        ha="right" if at_right else "left",
        va="top" if at_top else "bottom",
        fontsize=18,
        color=TEXT,
        bbox={"boxstyle": "round,pad=0.25", "facecolor": PAGE, "edgecolor": "none", "alpha": 0.6},
    )
    # indicate_inset_zoom would cross its lines where y points down.
    square = (column - half - 0.5, row - half - 0.5, float(_ZOOM_PX), float(_ZOOM_PX))
    axes.indicate_inset(square, inset, edgecolor=TEXT, alpha=0.8, linewidth=1.6)


def _thinned(points_px: Float, spacing_px: float) -> Float:
    """Those of the points (N, 2) that are, along the line, at least about this far from the one before."""
    steps = np.floor(arc_length(points_px) / spacing_px)
    return points_px[np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)]


def _draw_ellipse(axes: Axes, view: _View, tip: TipPose) -> None:
    """Two standard deviations of the tip, carried into the image to first order."""
    step_mm = 1e-3
    steps = view.project(tip.position_mm + step_mm * np.vstack([np.eye(3), -np.eye(3)]))
    jacobian = (steps[:3] - steps[3:]).T / (2 * step_mm)
    variances, directions = np.linalg.eigh(jacobian @ tip.covariance_mm2 @ jacobian.T)
    small, large = 4 * np.sqrt(variances.clip(0))
    angle_deg = float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))
    center = view.project(tip.position_mm)[0]
    axes.add_patch(
        Ellipse((center[0], center[1]), large, small, angle=angle_deg, fill=False, edgecolor=TIP, linewidth=2)
    )
