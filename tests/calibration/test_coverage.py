"""Guidance: what is missing is said, and what is there is not."""

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import BoardView, Checkerboard
from needletrack.calibration.coverage import WANTED_VIEWS, adds_something, coverage
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.synthetic.rig import default_rig

BOARD = Checkerboard(12, 9, 5.0)


def view(rig: StereoRig, x: float, y: float, z: float, right_nearer_deg: float, bottom_nearer_deg: float) -> BoardView:
    # A positive turn about y brings the right side nearer, a positive one about x takes the bottom away.
    turn = Rotation.from_euler("yx", [right_nearer_deg, -bottom_nearer_deg], degrees=True).as_matrix()
    pose = RigidTransform(turn, np.array([x, y, z]) - turn @ BOARD.points_mm.mean(axis=0))
    return BoardView(*rig.project(pose.apply(BOARD.points_mm)))


def test_one_view_from_the_front_lacks_all_tilts() -> None:
    rig = default_rig()
    found = coverage([view(rig, 35, 0, 250, 0, 0)], BOARD, rig.left.size_px)
    assert found.tilts == (0, 0, 0, 0)
    assert np.abs(found.tilt_deg).max() < 3
    assert sum("tilt the board" in sentence for sentence in found.missing) == 4
    assert any("near and once at the far end" in sentence for sentence in found.missing)
    assert any(f"take {WANTED_VIEWS - 1} more views" in sentence for sentence in found.missing)
    assert any(sentence.startswith("show it in the top left") for sentence in found.missing)
    assert found.share < 0.4


def test_each_tilt_is_told_from_the_others() -> None:
    rig = default_rig()
    for right, bottom, expected in ((-30, 0, 0), (30, 0, 1), (0, -30, 2), (0, 30, 3)):
        found = coverage([view(rig, 30, 0, 250, right, bottom)], BOARD, rig.left.size_px)
        assert [index for index, count in enumerate(found.tilts) if count] == [expected]


def test_nothing_is_missing_where_views_cover_all() -> None:
    rig = default_rig()
    views = [
        view(rig, x, y, z, tilt, -tilt if x > 0 else tilt)
        for z, tilt in ((200, 25), (270, -25))
        for x in (-65, 0, 35, 100)
        for y in (-60, 0, 60)
    ]
    found = coverage(views, BOARD, rig.left.size_px)
    assert found.missing == ()
    assert found.share == 1


def test_a_view_without_the_board_counts_for_nothing() -> None:
    rig = default_rig()
    found = coverage([BoardView(None, None)], BOARD, rig.left.size_px)
    assert (found.views, found.corners.sum(), found.distance_ratio) == (0, 0, 1.0)


def test_a_board_held_still_adds_nothing() -> None:
    rig = default_rig()
    first = view(rig, 30, 0, 250, 0, 0)
    assert not adds_something(view(rig, 30.05, 0, 250, 0, 0), [first], 2.0)
    assert adds_something(view(rig, 33, 0, 250, 0, 0), [first], 2.0)
    # By one whole square, which lays corners upon corners.
    assert adds_something(view(rig, 35, 0, 250, 0, 0), [first], 2.0)
