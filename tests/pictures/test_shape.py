from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from needletrack.pictures.png import rendered
from needletrack.pictures.shape import shape_figure
from needletrack.records import NeedleTrack, Reason, Status, StereoPair

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]

SIDES = {"top": ("x", "z"), "front": ("x", "y"), "side": ("z", "y")}
COLUMN = {"x": 0, "y": 1, "z": 2}


def axes_named(figure: Figure, name: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_label() == name)


def test_all_views_hold_the_needle_at_one_scale(true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    assert track.curve is not None
    assert track.tip is not None
    low, high = track.curve.points_mm.min(axis=0), track.curve.points_mm.max(axis=0)
    figure = shape_figure(track)
    rendered(figure)
    limits: dict[str, set[tuple[float, float]]] = {"x": set(), "y": set(), "z": set()}
    scales = []
    for name, (right, up) in SIDES.items():
        axes = axes_named(figure, name)
        limits[right].add(tuple(sorted(axes.get_xlim())))  # type: ignore[arg-type]
        limits[up].add(tuple(sorted(axes.get_ylim())))  # type: ignore[arg-type]
        scales.append(np.abs(np.diff(axes.transData.transform([[0, 0], [1, 1]]), axis=0)))
    # The same limits in every view that shows an axis, around the needle, and one length for all three.
    assert all(len(found) == 1 for found in limits.values())
    for axis, ((least, greatest),) in limits.items():
        column = COLUMN[axis]
        assert least < low[column]
        assert high[column] < greatest
        assert (least + greatest) / 2 == pytest.approx((low[column] + high[column]) / 2)
    spans = [greatest - least for ((least, greatest),) in limits.values()]
    np.testing.assert_allclose(spans, spans[0])
    assert spans[0] < 1.5 * (high - low).max()
    np.testing.assert_allclose(scales, scales[0][0, 0])


def test_pictures_match_what_a_person_sees(true_track: TrueTrack) -> None:
    """Down is down, forward is away from the viewer: upwards from above, to the right from the right."""
    figure = shape_figure(true_track(-1)[0])
    rendered(figure)
    moves = {"x": np.eye(3)[0], "y": np.eye(3)[1], "z": np.eye(3)[2]}
    wanted = {
        "top": {"x": (1, 0), "z": (0, 1)},
        "front": {"x": (1, 0), "y": (0, -1)},
        "side": {"z": (1, 0), "y": (0, -1)},
    }
    for name, (right, up) in SIDES.items():
        axes, columns = axes_named(figure, name), [COLUMN[right], COLUMN[up]]
        for axis, direction in wanted[name].items():
            start, end = axes.transData.transform([np.zeros(2), moves[axis][columns]])
            np.testing.assert_allclose((end - start) / np.linalg.norm(end - start), direction, atol=1e-9)
        assert axes.get_xlabel().startswith(right)
        assert axes.get_ylabel().startswith(up)


def test_the_band_is_two_standard_deviations_times_the_stated_factor(true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    assert track.curve is not None
    for sigma_mm, factor in ((0.05, 20), (3.0, 1)):
        wide = replace(track, curve=replace(track.curve, sigma_mm=np.full(len(track.curve.points_mm), sigma_mm)))
        figure = shape_figure(wide)
        for name, (right, up) in SIDES.items():
            points = track.curve.points_mm[:, [COLUMN[right], COLUMN[up]]]
            (band,) = (patch for patch in axes_named(figure, name).patches if isinstance(patch, Polygon))
            outline = band.get_xy()[: 2 * len(points)]
            one, other = outline[: len(points)], outline[len(points) :][::-1]
            for edge in (one, other):
                np.testing.assert_allclose(np.linalg.norm(edge - points, axis=1), 2 * factor * sigma_mm)
        (legend,) = figure.legends
        written = "".join(text.get_text() for text in legend.get_texts())
        assert ("drawn 20 × as wide" in written) == (factor == 20)


def test_every_nth_point_and_the_tip_are_dots(true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    assert track.curve is not None
    points = track.curve.points_mm
    figure = shape_figure(track, every=7)
    (dots,) = (art for art in axes_named(figure, "front").collections if isinstance(art, PathCollection))
    kept = np.vstack([points[::7], points[-1:]])[:, :2]
    np.testing.assert_allclose(np.asarray(dots.get_offsets()), kept)
    assert rendered(figure).any()


def test_every_below_one_is_refused(true_track: TrueTrack) -> None:
    with pytest.raises(ValueError, match="every is 0"):
        shape_figure(true_track(0)[0], every=0)


def test_a_needle_along_the_line_of_sight_is_drawn(true_track: TrueTrack) -> None:
    """Its direction in the front view is undefined, and so is the side on which its band lies."""
    track, _ = true_track(0)
    assert track.curve is not None
    n = len(track.curve.points_mm)
    straight = np.column_stack([np.full(n, 1.0), np.full(n, 2.0), np.linspace(220, 300, n)])
    figure = shape_figure(replace(track, curve=replace(track.curve, points_mm=straight)))
    assert rendered(figure).any()


def test_an_invalid_track_says_so(true_track: TrueTrack) -> None:
    _, pair = true_track(0)
    figure = shape_figure(NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.TOO_LONG,)))
    written = "".join(text.get_text() for text in figure.texts)
    assert "no shape was found" in written
    assert "too_long" in written
    assert rendered(figure).any()
