"""The quick pictures show what the slow ones do: the curve where it is."""

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from needletrack.geometry.transform import RigidTransform
from needletrack.pictures.palette import SEEN_COLOR, STATUS_COLOR
from needletrack.pictures.views import draw_views
from needletrack.recording.asl import AslRecording
from needletrack.records import NeedleTrack, Reason, Status, StereoPair

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]


def bgr(color: str) -> tuple[int, ...]:
    return tuple(round(255 * share) for share in reversed(to_rgb(color)))


def test_the_curve_lies_in_both_views_where_it_projects(steer: AslRecording, true_track: TrueTrack) -> None:
    track, pair = true_track(0)
    drawn = draw_views(track, pair, steer.rig)
    height, width = pair.left.image.shape
    assert drawn.shape == (height, 2 * width, 3)
    assert track.curve is not None
    views = ((0, steer.rig.left, RigidTransform.identity()), (width, steer.rig.right, steer.rig.right_from_left))
    for offset, camera, camera_from_left in views:
        points_px = camera.project(camera_from_left.apply(track.curve.points_mm))
        # The ends have circles around them; a pixel at the line's edge keeps some of the image.
        for (x, y), count in list(zip(points_px, track.curve.seen, strict=True))[12:-12:8]:
            assert drawn[round(y), round(x) + offset].tolist() == pytest.approx(bgr(SEEN_COLOR[int(count)]), abs=48)
    changed = (drawn[:, :width] != pair.left.image[..., None]).any(axis=2)
    # A thin line, two circles and the bar: the image is left alone elsewhere.
    assert changed.mean() < 0.03
    assert drawn[0, 0].tolist() == list(bgr(STATUS_COLOR[track.status]))


def test_without_a_shape_the_images_are_shown_as_they_are(steer: AslRecording, true_track: TrueTrack) -> None:
    _, pair = true_track(0)
    track = NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))
    drawn = draw_views(track, pair, steer.rig)
    bar = 32
    both = np.hstack([pair.left.image, pair.right.image])
    assert (drawn[bar:] == both[bar:, :, None]).all()
    assert drawn[0, 0].tolist() == list(bgr(STATUS_COLOR[Status.INVALID]))
