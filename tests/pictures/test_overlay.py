from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from needletrack.geometry.spline import tangents
from needletrack.pictures.overlay import overlay_figure
from needletrack.pictures.palette import SEEN_COLOR, STATUS_COLOR
from needletrack.pictures.png import rendered
from needletrack.recording.asl import AslRecording
from needletrack.records import (
    REASON_MEANING,
    Evidence,
    Float,
    Image,
    NeedleTrack,
    Reason,
    Status,
    StereoPair,
)

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]

# Antialiasing and the casing mix into a colour at the edges of a line; between two colours lie 200 and more.
SAME_COLOR = 60.0
# Up to here reach the marks of base and tip and the square around what is enlarged.
NEAR_A_MARK_PX = 30.0


def axes_named(figure: Figure, name: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_label() == name)


def in_picture(axes: Axes, points: Float) -> Float:
    """Column and row (N, 2) of data coordinates in the rendered picture, from its first pixel's centre."""
    height = axes.get_figure(root=True).bbox.height  # type: ignore[union-attr]
    return np.array([0.0, height]) + axes.transData.transform(points) * (1, -1) - 0.5


def color_distance(picture: Image, at: Float, color: str) -> Float:
    """Distance (N,) in gray levels between a colour and the picture's nearest pixel to each point."""
    columns, rows = np.round(at).astype(int).T
    wanted = 255 * np.array(to_rgb(color))
    return np.asarray(np.linalg.norm(picture[rows, columns].astype(float) - wanted, axis=1))


def of_color(picture: Image, color: str) -> npt.NDArray[np.bool_]:
    difference = picture.astype(float) - 255 * np.array(to_rgb(color))
    return np.asarray(np.linalg.norm(difference, axis=2) < SAME_COLOR)


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.texts)


@pytest.mark.parametrize("index", [0, -1])
def test_the_curve_is_drawn_where_the_truth_projects(steer: AslRecording, true_track: TrueTrack, index: int) -> None:
    track, pair = true_track(index)
    assert track.curve is not None
    figure = overlay_figure(track, pair, steer.rig)
    picture = rendered(figure)
    for name, points_px in zip(("left", "right"), steer.rig.project(track.curve.points_mm), strict=True):
        at = in_picture(axes_named(figure, name), points_px)
        across = tangents(at)[:, ::-1] * (-1, 1)
        between = np.minimum(*(np.linalg.norm(at - at[end], axis=1) for end in (0, -1))) > NEAR_A_MARK_PX
        assert between.sum() > 60
        assert (color_distance(picture, at, SEEN_COLOR[2])[between] < SAME_COLOR).all()
        for side in (-5, 5):
            beside = color_distance(picture, at + side * across, SEEN_COLOR[2])[between]
            assert (beside > SAME_COLOR).all()


def test_colors_say_how_many_cameras_saw_a_point(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    assert track.curve is not None
    seen = np.repeat([2, 1, 0, 2], [40, 20, 20, 41])
    figure = overlay_figure(replace(track, curve=replace(track.curve, seen=seen)), pair, steer.rig)
    picture = rendered(figure)
    for name, points_px in zip(("left", "right"), steer.rig.project(track.curve.points_mm), strict=True):
        at = in_picture(axes_named(figure, name), points_px)
        for inner, count in ((slice(30, 38), 2), (slice(42, 58), 1), (slice(62, 78), 0), (slice(84, 100), 2)):
            assert (color_distance(picture, at[inner], SEEN_COLOR[count]) < SAME_COLOR).all()


@pytest.mark.parametrize("index", [0, 12, -1])
def test_the_enlarged_tips_hide_nothing_of_the_curve(steer: AslRecording, true_track: TrueTrack, index: int) -> None:
    track, pair = true_track(index)
    assert track.curve is not None
    assert track.tip is not None
    figure = overlay_figure(track, pair, steer.rig)
    rendered(figure)
    tips_px = steer.rig.project(track.tip.position_mm[None])
    for name, points_px, tip_px in zip(
        ("left", "right"), steer.rig.project(track.curve.points_mm), tips_px, strict=True
    ):
        axes = axes_named(figure, name)
        (inset,) = (child for child in axes.child_axes if child.get_label() == f"{name} tip")
        box = inset.get_window_extent()
        assert not any(box.contains(x, y) for x, y in axes.transData.transform(points_px))
        assert np.abs(np.mean(inset.get_xlim()) - tip_px[0, 0]) <= 0.5
        assert np.abs(np.mean(inset.get_ylim()) - tip_px[0, 1]) <= 0.5
        # Square pixels, each several pixels of the picture wide.
        scale = np.abs(inset.transData.transform([[1, 1]]) - inset.transData.transform([[0, 0]]))
        np.testing.assert_allclose(scale, scale[0, 0], rtol=0.01)
        assert scale[0, 0] > 6


def test_numbers_are_written_with_their_uncertainty(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    assert track.curve is not None
    assert track.tip is not None
    written = texts(overlay_figure(track, pair, steer.rig))
    x, y, z = (f"{value:.2f}".replace("-", "−") for value in track.tip.position_mm)
    assert f"x {x}   y {y}   z {z} mm" in written
    assert "± 0.03, 0.04, 0.08 mm (1σ)" in written
    assert f"{track.curve.length_mm:.2f} mm" in written
    assert "0.14 px rms" in written
    assert "OK" in written


def test_an_invalid_track_shows_both_images_and_its_reasons(steer: AslRecording, true_track: TrueTrack) -> None:
    _, pair = true_track(0)
    reasons = (Reason.NO_STEREO_MATCH, Reason.OUTSIDE_WORKSPACE)
    figure = overlay_figure(NeedleTrack(pair.captured_at_ns, Status.INVALID, reasons), pair, steer.rig)
    picture = rendered(figure)
    assert all(reason.value in texts(figure) for reason in reasons)
    assert all(REASON_MEANING[reason] in texts(figure) for reason in reasons)
    assert of_color(picture, STATUS_COLOR[Status.INVALID]).sum() > 2000
    assert not of_color(picture, SEEN_COLOR[2]).any()
    for name in ("left", "right"):
        (left, top), (right, bottom) = in_picture(axes_named(figure, name), np.array([[0, 0], [959, 767]]))
        shown = picture[round(top) : round(bottom), round(left) : round(right)]
        assert shown.shape[1] > 850
        # The image, not the page: bright and of many grays.
        assert shown.mean() > 60
        assert len(np.unique(shown)) > 100


def test_an_invalid_track_shows_what_was_detected(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    lost = NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.TOO_SHORT,))
    seen = replace(lost, evidence=Evidence(left=track.evidence.left))
    plain, marked = (rendered(overlay_figure(shown, pair, steer.rig)) for shown in (lost, seen))
    assert track.evidence.left is not None
    figure = overlay_figure(seen, pair, steer.rig)
    columns, rows = np.round(in_picture(axes_named(figure, "left"), track.evidence.left.points_px)).astype(int).T
    assert (marked[rows, columns].astype(int) > plain[rows, columns]).all()
    right = slice(picture_middle := plain.shape[1] // 2, None)
    assert picture_middle > 0
    np.testing.assert_array_equal(marked[200:800, right], plain[200:800, right])


def test_more_reasons_than_fit_are_counted(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(0)
    reasons = tuple(Reason)[:6]
    written = texts(overlay_figure(replace(track, status=Status.DEGRADED, reasons=reasons), pair, steer.rig))
    assert all(reason.value in written for reason in reasons[:4])
    assert reasons[4].value not in written
    assert "(and 2 more)" in written


def test_a_tip_outside_the_image_is_not_enlarged(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    assert track.tip is not None
    outside = replace(track, tip=replace(track.tip, position_mm=np.array([500.0, 0.0, 250.0])))
    figure = overlay_figure(outside, pair, steer.rig)
    assert not any(axes_named(figure, name).child_axes for name in ("left", "right"))
    assert rendered(figure).any()
