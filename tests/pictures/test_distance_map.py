from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from needletrack.geometry.spline import arc_length, tangents
from needletrack.pictures.distance_map import distance_map, distance_map_figure
from needletrack.pictures.palette import SEEN_COLOR
from needletrack.pictures.png import rendered
from needletrack.recording.asl import AslRecording
from needletrack.records import Correspondences, Evidence, NeedleTrack, Reason, Status, StereoPair

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]


def invalid(captured_at_ns: int) -> NeedleTrack:
    return NeedleTrack(captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))


def test_each_entry_is_a_distance_in_pixels(steer: AslRecording, true_track: TrueTrack) -> None:
    """The epipolar line of a left point is drawn here through the projections of two points of its ray."""
    found = distance_map(true_track(-1)[0], steer.rig)
    assert found is not None
    i, j = np.random.default_rng(1).integers([0, 0], found.distance_px.shape, (50, 2)).T
    rays = steer.rig.left.normalize(steer.rig.left.distort(found.left_undistorted_px[i]))
    near, far = (
        steer.rig.right.undistort(steer.rig.project(depth_mm * np.column_stack([rays, np.ones(len(rays))]))[1])
        for depth_mm in (200.0, 300.0)
    )
    along, offset = far - near, found.right_undistorted_px[j] - near
    expected = np.abs(along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]) / np.linalg.norm(along, axis=1)
    assert expected.max() > 20
    np.testing.assert_allclose(found.distance_px[i, j], expected, atol=1e-5)


def test_both_centerlines_are_followed_evenly_from_base_to_tip(steer: AslRecording, true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    found = distance_map(track, steer.rig)
    assert found is not None
    assert track.curve is not None
    cameras = (steer.rig.left, steer.rig.right)
    lines = (found.left_undistorted_px, found.right_undistorted_px)
    for camera, line_px, curve_px in zip(cameras, lines, steer.rig.project(track.curve.points_mm), strict=True):
        np.testing.assert_allclose(line_px[[0, -1]], camera.undistort(curve_px[[0, -1]]), atol=1e-6)
        steps = np.diff(arc_length(line_px))
        # Chords across the curve's vertices are shorter by the square of the angle there.
        np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)


def test_true_pairs_lie_in_the_valley(steer: AslRecording, true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    found = distance_map(track, steer.rig)
    assert found is not None
    assert track.evidence.correspondences is not None
    left_px, right_px = found.place(track.evidence.correspondences)
    assert (np.diff(left_px) > 0).all()
    assert (np.diff(right_px) > 0).all()
    i = np.abs(found.left_along_px[:, None] - left_px).argmin(axis=0)
    j = np.abs(found.right_along_px[:, None] - right_px).argmin(axis=0)
    # Half a step of a pixel on either centerline, each at any angle to the epipolar line.
    assert found.distance_px[i, j].max() <= 1.1
    assert np.median(found.distance_px) > 30


def test_the_matched_pairs_are_drawn_at_their_places(steer: AslRecording, true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    figure = distance_map_figure(track, steer.rig)
    picture = rendered(figure).astype(float)
    found = distance_map(track, steer.rig)
    assert found is not None
    assert track.evidence.correspondences is not None
    places = np.column_stack(found.place(track.evidence.correspondences))
    axes = next(axes for axes in figure.axes if axes.get_label() == "map")
    assert axes.get_xlim() == pytest.approx((0, found.left_along_px[-1]))
    assert axes.get_ylim() == pytest.approx((0, found.right_along_px[-1]))
    columns, rows = (axes.transData.transform(places[5:-5]) * (1, -1) + (-0.5, picture.shape[0] - 0.5)).T
    color = 255 * np.array(to_rgb(SEEN_COLOR[2]))
    at = picture[np.round(rows).astype(int), np.round(columns).astype(int)]
    assert np.linalg.norm(at - color, axis=1).max() < 60
    assert f"{len(places)} matched pairs" in "".join(text.get_text() for text in figure.texts)


def test_offsets_are_measured_across_the_centerline(steer: AslRecording, true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    found = distance_map(track, steer.rig)
    true_pairs = track.evidence.correspondences
    assert found is not None
    assert true_pairs is not None
    beside = tangents(true_pairs.left_undistorted_px)[:, ::-1] * (-1.3, 1.3)
    moved = Correspondences(true_pairs.left_undistorted_px + beside, true_pairs.right_undistorted_px)
    left_px, right_px = found.offset(moved)
    np.testing.assert_allclose(left_px, 1.3, atol=0.05)
    np.testing.assert_allclose(right_px, 0, atol=0.05)


def test_pairs_beyond_the_ends_have_no_place(steer: AslRecording, true_track: TrueTrack) -> None:
    track, _ = true_track(-1)
    found = distance_map(track, steer.rig)
    pairs = track.evidence.correspondences
    assert found is not None
    assert pairs is not None
    ahead = pairs.left_undistorted_px[-1] + 5 * tangents(pairs.left_undistorted_px)[-1]
    right_px = pairs.right_undistorted_px
    longer = Correspondences(np.vstack([pairs.left_undistorted_px, ahead]), np.vstack([right_px, right_px[-1]]))
    for left, right in (found.place(longer), found.offset(longer)):
        assert np.isnan(left).nonzero()[0].tolist() == [len(left) - 1]
        assert np.isfinite(right).all()
    evidence = replace(track.evidence, correspondences=longer)
    figure = distance_map_figure(replace(track, evidence=evidence), steer.rig)
    assert "(1 beyond the ends)" in "".join(text.get_text() for text in figure.texts)
    assert rendered(figure).any()


def test_without_a_curve_the_detected_centerlines_serve(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    lost = replace(invalid(pair.captured_at_ns), evidence=track.evidence)
    fitted, detected = distance_map(track, steer.rig), distance_map(lost, steer.rig)
    assert fitted is not None
    assert detected is not None
    assert detected.distance_px.shape == fitted.distance_px.shape
    np.testing.assert_allclose(detected.distance_px, fitted.distance_px, atol=0.05)


def test_without_centerlines_a_sentence_stands_in_its_place(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(0)
    for evidence in (Evidence(), Evidence(left=track.evidence.left)):
        lost = replace(invalid(pair.captured_at_ns), evidence=evidence)
        assert distance_map(lost, steer.rig) is None
        figure = distance_map_figure(lost, steer.rig)
        written = "".join(text.get_text() for text in figure.texts)
        assert "no centerline in both views" in written
        assert "no_candidate" in written
        assert rendered(figure).any()
