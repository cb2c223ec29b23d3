"""Lines of both views, projected exactly from curves in space: which are paired, and which of their points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tests.tracking.scenes import ARC, MIDDLE_MM, PX_PER_MM, RIG

from needletrack.errors import NeedleNotFound
from needletrack.geometry import spline
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_px, epipolar_lines
from needletrack.geometry.spline import distance_from_curve
from needletrack.records import Centerline, Float, Reason
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.tracking.match import Candidate, MatchParameters, inside, match_lines
from needletrack.tracking.needle import Needle, Range, Workspace

PARAMETERS = MatchParameters()
WORKSPACE = Workspace()
Lines = tuple[Centerline, Centerline]


def curve(motion: NeedleMotion) -> Float:
    return motion.at(0.0).points_mm


def seen(points_mm: Float) -> Lines:
    """What a perfect detector would trace of a curve in space."""
    left_px, right_px = RIG.project(points_mm)
    return Centerline(left_px, np.full(len(left_px), 5.0)), Centerline(right_px, np.full(len(right_px), 5.0))


def matched(
    *lines: Lines, workspace: Workspace = WORKSPACE, parameters: MatchParameters = PARAMETERS
) -> list[Candidate]:
    left, right = [line[0] for line in lines], [line[1] for line in lines]
    return match_lines(left, right, RIG, Needle(), workspace, parameters)


def places_px(line: Centerline, undistorted_px: Float, camera: Camera) -> Float:
    """How far along a line each undistorted point lies, px."""
    points_px = camera.undistort(line.points_px)
    nearest = np.linalg.norm(undistorted_px[:, None] - points_px[None], axis=2).argmin(axis=1)
    return np.asarray(spline.arc_length(points_px)[nearest])


def along_both(candidate: Candidate) -> tuple[Float, Float]:
    pairs = candidate.correspondences
    return (
        places_px(candidate.left, pairs.left_undistorted_px, RIG.left),
        places_px(candidate.right, pairs.right_undistorted_px, RIG.right),
    )


# Lines are matched as polylines of 4 px steps, off a needle of 40 mm radius by a sagitta of 0.01 px; in space this is
# 0.002 mm across and 3.7 times that in depth, divided by the sine at which it crosses the epipolar line.
WORST_AT_RIGHT_ANGLES_MM = 0.05


def test_a_needle_is_found_where_it_is() -> None:
    points_mm = curve(ARC)
    (found,) = matched(seen(points_mm))
    assert distance_from_curve(found.points_mm, points_mm).max() < 0.01
    assert found.length_mm == pytest.approx(spline.arc_length(points_mm)[-1], abs=2 * PARAMETERS.step_px / PX_PER_MM)
    pairs = found.correspondences
    assert len(pairs.left_undistorted_px) == len(found.points_mm) == len(found.confidence)
    assert epipolar_distance_px(
        RIG.fundamental, pairs.left_undistorted_px, pairs.right_undistorted_px
    ) == pytest.approx(0.0, abs=1e-6)
    # It crosses the epipolar lines nearly at a right angle.
    assert found.confidence.min() > 0.9


@st.composite
def needles(draw: st.DrawFn) -> NeedleMotion:
    """Needles of all directions and bends, hooks too, inside the workspace."""
    turn = draw(st.floats(0.0, 2 * np.pi))
    rise = draw(st.floats(-0.5, 0.5))
    length_mm = draw(st.floats(25.0, 80.0))
    direction = np.array([np.cos(turn), np.sin(turn), rise])
    x, y, z = np.array(MIDDLE_MM) - 0.5 * length_mm * direction / np.linalg.norm(direction)
    return NeedleMotion(
        (float(x), float(y), float(z)),
        (float(direction[0]), float(direction[1]), float(direction[2])),
        Wave(length_mm),
        bend_per_mm=Wave(draw(st.floats(-0.02, 0.02))),
        bend_change_per_mm=Wave(draw(st.floats(-0.02, 0.02))),
        bend_plane_rad=Wave(draw(st.floats(0.0, np.pi))),
    )


@settings(max_examples=40)
@given(needles(), st.booleans(), st.booleans())
def test_pairs_keep_the_order_along_both_lines_and_lie_on_the_needle(
    motion: NeedleMotion, left_turned: bool, right_turned: bool
) -> None:
    points_mm = curve(motion)
    assume(bool(inside(WORKSPACE, points_mm).all()))
    assume(
        all(camera.contains(px).all() for camera, px in zip((RIG.left, RIG.right), RIG.project(points_mm), strict=True))
    )
    left, right = seen(points_mm)
    lines = left.reversed() if left_turned else left, right.reversed() if right_turned else right
    if share_along_epipolar_lines(points_mm) > 0.9:
        return
    # What the ends say of a stretch along the epipolar lines is offered beside what crosses them, either way round.
    candidates = matched(lines)
    on_needle = [
        candidate
        for candidate in candidates
        if (distance_from_curve(candidate.points_mm, points_mm) * candidate.confidence).max() < WORST_AT_RIGHT_ANGLES_MM
    ]
    assert any((np.diff(places) >= 0).all() for candidate in on_needle for places in [np.stack(along_both(candidate))])
    if share_along_epipolar_lines(points_mm, 30.0) == 0.0:
        assert any(candidate is candidates[0] for candidate in on_needle)


@pytest.mark.parametrize("turn_deg", [12.0, 20.0, 40.0, 90.0])
def test_the_zigzag_of_a_skeleton_does_not_turn_the_order(turn_deg: float) -> None:
    # Half a pixel of noise makes an epipolar line cross a line that runs nearly along it many times, to and fro.
    turn = np.radians(turn_deg)
    points_mm = curve(NeedleMotion((-15.0, -15.0, 250.0), (float(np.cos(turn)), float(np.sin(turn)), 0.1), Wave(50.0)))
    rng = np.random.default_rng(7)
    left, right = (
        Centerline(line.points_px[::8] + rng.normal(0.0, 0.5, (len(line.points_px[::8]), 2)), line.width_px[::8])
        for line in seen(points_mm)
    )
    (found,) = matched((left, right))
    # Places are told to the nearest point of the zigzag.
    for places in along_both(found):
        assert np.diff(places).min() > -PARAMETERS.step_px
    # Across the lines, and with what half a pixel in both views does along them.
    off_mm = distance_from_curve(found.points_mm, points_mm)
    assert np.median(off_mm * found.confidence) < 0.5 * np.sqrt(2) * 250.0**2 / (68.0 * RIG.left.focal_px)


def share_along_epipolar_lines(points_mm: Float, angle_deg: float = 10.0) -> float:
    lines = epipolar_lines(RIG.fundamental, RIG.left.undistort(RIG.left.project(points_mm)))
    along = spline.tangents(RIG.right.undistort(RIG.project(points_mm)[1]))
    return float(np.mean(np.abs((lines[:, :2] * along).sum(axis=1)) < np.sin(np.radians(angle_deg))))


def test_the_direction_in_which_lines_are_traced_does_not_matter() -> None:
    points_mm = curve(ARC)
    left, right = seen(points_mm)
    (forward,) = matched((left, right))
    (backward,) = matched((left.reversed(), right))
    assert distance_from_curve(backward.points_mm, points_mm).max() < 0.01
    # What comes out runs the same way in both views, that of the left line.
    assert np.linalg.norm(backward.points_mm[0] - forward.points_mm[-1]) < 1.0
    assert np.linalg.norm(backward.right.points_px[0] - right.points_px[-1]) < 1.0


def test_a_stretch_along_the_epipolar_lines_goes_without_a_partner() -> None:
    # An L in the image: down, and then along a row.
    down, along = np.linspace(-30.0, 5.0, 200), np.linspace(0.0, 35.0, 200)
    bend = np.radians(np.linspace(0.0, 90.0, 60))
    points_mm = np.concatenate(
        [
            np.column_stack([np.full(200, -10.0), down, np.full(200, 250.0)]),
            np.column_stack([-10 + 8 * (1 - np.cos(bend)), 5 + 8 * np.sin(bend), np.full(60, 250.0)]),
            along_an_epipolar_plane(np.array([-2.0, 13.0, 250.0]), along),
        ]
    )
    (found,) = matched(seen(points_mm))
    stretch = distance_from_curve(found.points_mm, points_mm[-190:]) < 1.0
    covered = distance_from_curve(points_mm[:200], found.points_mm) < 1.0
    assert covered.all()
    # No crossing there fixes a depth: there is none, or the candidate says that it is worth nothing.
    assert found.confidence[stretch].max(initial=0.0) < 0.1
    assert found.confidence[: len(found.confidence) // 3].min() > 0.9


def along_an_epipolar_plane(start_mm: Float, at_mm: Float) -> Float:
    """A straight line (N, 3) in the plane of both cameras' centres, as deep as its start."""
    baseline = -RIG.right_from_left.rotation.T @ RIG.right_from_left.translation_mm
    normal = np.cross(start_mm, baseline)
    direction = np.cross(normal, [0.0, 0.0, 1.0])
    return start_mm + np.outer(at_mm, direction / np.linalg.norm(direction) * np.sign(direction[0]))


def test_a_hook_that_crosses_an_epipolar_line_twice_is_matched_branch_by_branch() -> None:
    turn = np.linspace(0.0, np.pi, 300)
    points_mm = np.concatenate(
        [
            np.column_stack([np.full(200, -5.0), np.linspace(-35.0, 5.0, 200), np.full(200, 245.0)]),
            np.column_stack([-5 + 12 * (1 - np.cos(turn)), 5 + 12 * np.sin(turn), 245 + 3 * turn]),
            np.column_stack([np.full(100, 19.0), np.linspace(5.0, -15.0, 100), np.full(100, 245 + 3 * np.pi)]),
        ]
    )
    (found,) = matched(seen(points_mm))
    off_mm = distance_from_curve(found.points_mm, points_mm)
    assert (off_mm * found.confidence).max() < WORST_AT_RIGHT_ANGLES_MM
    # Both branches, but for the top of the arch, where it runs along the epipolar lines.
    for branch in (points_mm[:200], points_mm[-100:]):
        assert (distance_from_curve(branch, found.points_mm) < 1.0).mean() > 0.95


VESSEL = NeedleMotion((-20.0, -40.0, 345.0), (0.3, 1.0, 0.0), Wave(90.0), bend_per_mm=Wave(0.005))


def test_a_vessel_behind_the_workspace_is_not_offered() -> None:
    needle_mm, vessel_mm = curve(ARC), curve(VESSEL)
    candidates = matched(seen(vessel_mm), seen(needle_mm))
    assert distance_from_curve(candidates[0].points_mm, needle_mm).max() < 0.01
    # One view may show the needle in front of the vessel: what both could make is offered, but far behind.
    assert all(candidate.score < 0.5 * candidates[0].score for candidate in candidates[1:])
    with pytest.raises(NeedleNotFound) as refused:
        matched(seen(vessel_mm))
    assert refused.value.stage == "match"


def test_vessels_do_not_lend_each_other_their_partners() -> None:
    # Rays through x = 8 of the left camera and through x = -18 of the right one, at 345 mm, meet at 250 mm: the left
    # line of one and the right line of the other are a curve inside the workspace, but steeper than each is by itself.
    one = curve(replace(VESSEL, base_mm=(8.0, -40.0, 345.0)))
    other = curve(replace(VESSEL, base_mm=(-18.0, -40.0, 345.0), direction=(0.2, 1.0, 0.0)))
    (phantom,) = matched((seen(one)[0], seen(other)[1]))
    assert inside(WORKSPACE, phantom.points_mm).all()
    assert phantom.length_mm > 40.0
    # However narrow the workspace: both vessels have their own partners outside it.
    low, high = phantom.points_mm.min(axis=0) - 1.0, phantom.points_mm.max(axis=0) + 1.0
    x, y, z = (Range(min=float(a), max=float(b)) for a, b in zip(low, high, strict=True))
    for workspace in (WORKSPACE, Workspace(x_mm=x, y_mm=y, z_mm=z)):
        with pytest.raises(NeedleNotFound):
            matched(seen(one), seen(other), workspace=workspace)


def test_each_line_is_offered_with_its_own_partner() -> None:
    places = ((8.0, -45.0, 246.0), (20.0, -12.0, 235.0), (-4.0, 22.0, 260.0))
    needles_mm = [curve(replace(ARC, base_mm=place, length_mm=Wave(26.0))) for place in places]
    candidates = matched(*(seen(points_mm) for points_mm in needles_mm))
    for points_mm in needles_mm:
        assert sum(distance_from_curve(candidate.points_mm, points_mm).max() < 0.01 for candidate in candidates) == 1
    assert [one.score for one in candidates] == sorted((one.score for one in candidates), reverse=True)


@pytest.mark.parametrize("bend_per_mm", [0.0, 0.004])
def test_a_needle_along_the_epipolar_lines_is_matched_by_its_ends(bend_per_mm: float) -> None:
    x, y, z = np.array(MIDDLE_MM) - [25.0, 0.0, 0.0]
    points_mm = curve(
        NeedleMotion((x, y, z), (1.0, 0.0, 0.1), Wave(50.0), bend_per_mm=Wave(bend_per_mm), bend_plane_rad=Wave(0.3))
    )
    assert share_along_epipolar_lines(points_mm) > 0.5
    left, right = seen(points_mm)
    for lines in ((left, right), (left, right.reversed())):
        off_mm = [distance_from_curve(points_mm, found.points_mm) for found in matched(lines)]
        assert min(np.percentile(off, 90) for off in off_mm) < 0.8


def test_a_needle_in_front_of_a_vessel_keeps_its_partner() -> None:
    # In the right view the tracing goes from the needle over to the vessel, whose line is the longer part.
    needle_mm, vessel_mm = curve(replace(ARC, length_mm=Wave(30.0))), curve(VESSEL)
    (needle_left, needle_right), (vessel_left, vessel_right) = seen(needle_mm), seen(vessel_mm)
    below = vessel_right.points_px[vessel_right.points_px[:, 1] > needle_right.points_px[:, 1].max() + 10.0]
    joined_px = np.concatenate([needle_right.points_px, below])
    candidates = matched(
        (needle_left, Centerline(joined_px, np.full(len(joined_px), 5.0))), (vessel_left, vessel_right)
    )
    assert distance_from_curve(needle_mm, candidates[0].points_mm).max() < 1.5


def test_the_longer_of_two_needles_comes_first() -> None:
    short, long = curve(replace(ARC, base_mm=(-14.0, -34.0, 246.0), length_mm=Wave(25.0))), curve(ARC)
    candidates = matched(seen(short), seen(long))
    assert distance_from_curve(candidates[0].points_mm, long).max() < 0.01
    assert candidates[0].length_mm > candidates[1].length_mm


def test_a_candidate_is_worth_what_fixes_its_depth() -> None:
    across = curve(NeedleMotion((0.0, -20.0, 250.0), (0.0, 1.0, 0.0), Wave(40.0)))
    slanted = curve(NeedleMotion((-15.0, -5.0, 250.0), (1.0, 0.2, 0.0), Wave(40.0)))
    (firm,), (loose,) = matched(seen(across)), matched(seen(slanted))
    assert loose.confidence.max() < 0.3
    assert loose.score < 0.5 * firm.score


def test_without_lines_there_is_no_candidate() -> None:
    left, right = seen(curve(ARC))
    nothing: list[Centerline] = []
    for lefts, rights in ((nothing, [right]), ([left], nothing), (nothing, nothing)):
        with pytest.raises(NeedleNotFound) as refused:
            match_lines(lefts, rights, RIG, Needle(), WORKSPACE, PARAMETERS)
        assert refused.value.reason == Reason.NO_CANDIDATE


def test_lines_on_other_epipolar_lines_do_not_match() -> None:
    high = curve(NeedleMotion((0.0, -45.0, 250.0), (0.2, 1.0, 0.0), Wave(30.0)))
    low = curve(NeedleMotion((0.0, 10.0, 250.0), (0.2, 1.0, 0.0), Wave(30.0)))
    with pytest.raises(NeedleNotFound) as refused:
        matched((seen(high)[0], seen(low)[1]))
    assert refused.value.reason == Reason.NO_STEREO_MATCH


def test_what_is_too_short_to_be_a_needle_is_not_offered() -> None:
    short = seen(curve(replace(ARC, length_mm=Wave(3.0))))
    with pytest.raises(NeedleNotFound) as refused:
        matched(short)
    assert refused.value.reason == Reason.NO_STEREO_MATCH


def test_the_workspace_decides() -> None:
    points_mm = curve(ARC)
    assert matched(seen(points_mm), workspace=Workspace(z_mm=Range(min=240.0, max=270.0)))
    # Of a needle that is partly outside, only what is inside is matched.
    part = Workspace(z_mm=Range(min=240.0, max=float(np.percentile(points_mm[:, 2], 70))))
    (found,) = matched(seen(points_mm), workspace=part)
    assert inside(part, found.points_mm).all()
    assert found.length_mm == pytest.approx(0.7 * 68.0, abs=3.0)
    for elsewhere in (
        Workspace(z_mm=Range(min=290.0, max=310.0)),
        Workspace(x_mm=Range(min=60.0, max=90.0)),
        Workspace(y_mm=Range(min=60.0, max=90.0)),
    ):
        with pytest.raises(NeedleNotFound):
            matched(seen(points_mm), workspace=elsewhere)


def test_inside_is_closed_and_nowhere_is_not_inside() -> None:
    box = Workspace(x_mm=Range(min=-1.0, max=1.0), y_mm=Range(min=-2.0, max=2.0), z_mm=Range(min=200.0, max=300.0))
    corners = np.array([[-1.0, -2.0, 200.0], [1.0, 2.0, 300.0]])
    assert inside(box, corners).all()
    assert not inside(box, corners * [1.001, 1, 1]).any()
    assert not inside(box, corners * [1, 1.001, 1]).any()
    assert not inside(box, np.array([[0.0, 0.0, 199.9], [0.0, 0.0, 300.1], [np.nan, 0.0, 250.0]])).any()
