"""The distance map: how far right points lie from left points' epipolar lines (Fig. 6 of the paper)."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.lines import Line2D
from scipy.spatial import cKDTree

from needletrack.geometry.epipolar import epipolar_distance_map_px, epipolar_distance_px
from needletrack.geometry.spline import arc_length, resample, tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.pictures.palette import MUTED, PAGE, RULE, SEEN_COLOR, TEXT
from needletrack.pictures.theme import EMPTY_PX, HEADING_PX, Page, number
from needletrack.records import Correspondences, Float, NeedleTrack, frozen_array

WIDTH_PX, HEIGHT_PX = 1200, 1370
_MAP_PX = 880
_LEFT_PX, _STRIP_PX = 128, 150
# One row a pixel of the picture at most; a longer centerline gains nothing by more.
_MOST_POINTS = 600
_LEAST_SHOWN_PX = 0.1
_BEYOND_PX = 1.0
# Dark means near, as in the paper; the cream end of the scale would outshine the page.
_COLORS = LinearSegmentedColormap.from_list("near_to_far", colormaps["magma"](np.linspace(0, 0.86, 256)))
_CHAIN = SEEN_COLOR[2]
_VIEW_COLORS = (SEEN_COLOR[2], SEEN_COLOR[1])


@dataclass(frozen=True, slots=True)
class DistanceMap:
    """distance_px (I, J), unsigned, of right point j from the epipolar line of left point i.

    left_undistorted_px (I, 2) and right_undistorted_px (J, 2) follow each view's centerline from base to tip,
    evenly along the arc, whose lengths from the base are left_along_px (I,) and right_along_px (J,).
    """

    distance_px: Float
    left_undistorted_px: Float
    right_undistorted_px: Float

    def __post_init__(self) -> None:
        left = frozen_array(self.left_undistorted_px, (None, 2), "left_undistorted_px")
        right = frozen_array(self.right_undistorted_px, (None, 2), "right_undistorted_px")
        object.__setattr__(self, "left_undistorted_px", left)
        object.__setattr__(self, "right_undistorted_px", right)
        distance = frozen_array(self.distance_px, (len(left), len(right)), "distance_px")
        object.__setattr__(self, "distance_px", distance)

    @property
    def left_along_px(self) -> Float:
        """Arc length (I,) from the base, px."""
        return arc_length(self.left_undistorted_px)

    @property
    def right_along_px(self) -> Float:
        """Arc length (J,) from the base, px."""
        return arc_length(self.right_undistorted_px)

    def place(self, pairs: Correspondences) -> tuple[Float, Float]:
        """Where matched points lie on the left and on the right centerline, (N,) px from the base each.

        NaN for points beyond a centerline's ends.
        """
        return (
            _along_and_across(self.left_undistorted_px, pairs.left_undistorted_px)[0],
            _along_and_across(self.right_undistorted_px, pairs.right_undistorted_px)[0],
        )

    def offset(self, pairs: Correspondences) -> tuple[Float, Float]:
        """How far matched points lie beside the left and the right centerline, signed, (N,) px each.

        NaN for points beyond a centerline's ends.
        """
        return (
            _along_and_across(self.left_undistorted_px, pairs.left_undistorted_px)[1],
            _along_and_across(self.right_undistorted_px, pairs.right_undistorted_px)[1],
        )


def distance_map(track: NeedleTrack, rig: StereoRig) -> DistanceMap | None:
    """The map of a track's projected centerlines, or of the detected ones, or None where it has neither."""
    if track.curve is not None:
        raw = rig.project(track.curve.points_mm)
    elif track.evidence.left is not None and track.evidence.right is not None:
        raw = (track.evidence.left.points_px, track.evidence.right.points_px)
    else:
        return None
    if min(len(points) for points in raw) < 2:
        return None
    left, right = (
        resample(points, int(np.clip(arc_length(points)[-1], 2, _MOST_POINTS)))
        for points in (rig.left.undistort(raw[0]), rig.right.undistort(raw[1]))
    )
    return DistanceMap(np.abs(epipolar_distance_map_px(rig.fundamental, left, right)), left, right)


def distance_map_figure(track: NeedleTrack, rig: StereoRig) -> Page:
    """The distance map with the matched pairs on it, and their distances from both centerlines under it.

    Axes "map" have arc lengths in px as data coordinates, left along x, right along y. The scale is
    logarithmic.
    """
    found = distance_map(track, rig)
    page = Page(WIDTH_PX, HEIGHT_PX if found is not None else EMPTY_PX)
    page.write_heading("Epipolar distance map", "every left point against every right point, undistorted px", track)
    if found is None:
        page.write(WIDTH_PX / 2, page.height_px - 80, "no centerline in both views", 26, MUTED, "center")
        return page
    _draw_map(page, found, track.evidence.correspondences, detected=track.curve is None)
    _draw_offsets(page, found, track.evidence.correspondences, rig)
    return page


def _draw_map(page: Page, found: DistanceMap, pairs: Correspondences | None, detected: bool) -> None:
    left, right = found.left_along_px, found.right_along_px
    axes = page.axes_at(_LEFT_PX, HEADING_PX, _MAP_PX, _MAP_PX, "map")
    low, high = _LEAST_SHOWN_PX, max(10.0, float(found.distance_px.max()))
    shown = np.clip(found.distance_px.T, low, None)
    # An image's cells reach half a step beyond their centres.
    half_left, half_right = left[1] / 2, right[1] / 2
    image = axes.imshow(
        shown,
        _COLORS,
        norm=LogNorm(low, high),
        origin="lower",
        aspect="auto",
        interpolation="bilinear",
        extent=(-half_left, left[-1] + half_left, -half_right, right[-1] + half_right),
    )
    if found.distance_px.min() < 1 < found.distance_px.max():
        axes.contour(left, right, found.distance_px.T, levels=[1.0], colors=[TEXT], linewidths=1.3, alpha=0.8)
    of = "detected" if detected else "projected"
    axes.set_xlabel(f"along the {of} centerline, left view, px from the base", color=TEXT, fontsize=20)
    axes.set_ylabel(f"along the {of} centerline, right view, px from the base", color=TEXT, fontsize=20)
    handles = [Line2D([], [], color=TEXT, linewidth=2, label="1 px")]
    if pairs is not None and len(pairs.left_undistorted_px):
        axes.plot(*found.place(pairs), linestyle="none", marker="o", markersize=3.6, color=_CHAIN, markeredgewidth=0)
        handles.append(Line2D([], [], linestyle="none", marker="o", markersize=9, color=_CHAIN, label="matched pairs"))
    axes.set(xlim=(0, left[-1]), ylim=(0, right[-1]))
    axes.legend(
        handles=handles,
        loc="upper left",
        fontsize=19,
        labelcolor=TEXT,
        facecolor=PAGE,
        edgecolor=RULE,
        framealpha=0.75,
    )
    bar_axes = page.axes_at(_LEFT_PX + _MAP_PX + 24, HEADING_PX, 28, _MAP_PX, "scale")
    bar = page.colorbar(image, cax=bar_axes, extend="min", extendfrac=0.02)
    bar.set_label("distance from the epipolar line, px", color=TEXT, fontsize=20)
    ticks = [tick for tick in (0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000) if tick <= high]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar_axes.minorticks_off()
    bar_axes.axhline(1.0, color=TEXT, linewidth=2)


def _draw_offsets(page: Page, found: DistanceMap, pairs: Correspondences | None, rig: StereoRig) -> None:
    top = HEADING_PX + _MAP_PX + 130
    if pairs is None or not len(pairs.left_undistorted_px):
        page.write(_LEFT_PX, top + 30, "this track states no matched pairs", 20, MUTED)
        return
    axes = page.axes_at(_LEFT_PX, top, _MAP_PX, _STRIP_PX, "offsets")
    axes.axhline(0, color=RULE, linewidth=2)
    along, offsets = found.place(pairs)[0], found.offset(pairs)
    for view, offset, color in zip(("left", "right"), offsets, _VIEW_COLORS, strict=True):
        axes.plot(along, offset, linestyle="none", marker="o", markersize=5, color=color, label=view)
    found_offsets = np.concatenate(offsets)
    found_offsets = found_offsets[np.isfinite(found_offsets)]
    limit = max(0.5, 1.15 * float(np.abs(found_offsets).max(initial=0)))
    axes.set(xlim=(0, found.left_along_px[-1]), ylim=(-limit, limit))
    axes.set_xlabel("along the left centerline, px from the base", color=TEXT, fontsize=20)
    axes.set_ylabel("offset, px", color=TEXT, fontsize=20)
    axes.legend(
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        fontsize=19,
        labelcolor=TEXT,
        frameon=False,
        handletextpad=0.1,
    )
    from_lines = epipolar_distance_px(rig.fundamental, pairs.left_undistorted_px, pairs.right_undistorted_px)
    beyond = int(np.isnan(np.add(*offsets)).sum())
    beside = f" ({beyond} beyond the ends)" if beyond else ""
    told = (
        f"rms {number(_rms(from_lines))} px off the epipolar lines, "
        f"{number(_rms(found_offsets))} px off the centerlines"
    )
    page.write(_LEFT_PX, top - 18, f"{len(from_lines)} matched pairs{beside}, {told}", 19)


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _along_and_across(line_px: Float, points_px: Float) -> tuple[Float, Float]:
    """Where points (N, 2) lie along a polyline (M, 2) and how far off, (N,) px each; NaN beyond the ends."""
    length = arc_length(line_px)[-1]
    dense = resample(line_px, max(2, int(4 * length)))
    index = np.asarray(cKDTree(dense).query(points_px)[1], dtype=np.int64)
    (x, y), (along_x, along_y) = (points_px - dense[index]).T, tangents(dense)[index].T
    along = np.asarray(index * (length / (len(dense) - 1)), dtype=np.float64)
    across = np.asarray(along_x * y - along_y * x, dtype=np.float64)
    # Between the ends, the way to the nearest point is at right angles to the line.
    beyond = np.abs(along_x * x + along_y * y) > _BEYOND_PX
    return np.where(beyond, np.nan, along), np.where(beyond, np.nan, across)
