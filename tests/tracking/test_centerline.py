"""Lines traced in drawn images: where they run, through crossings, across gaps, and what is no line."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.tracking.scenes import PX_PER_MM, RIG, SIZE_PX, WIDTHS_PX, WORLDS, scene, seen_at

from needletrack.geometry.spline import arc_length, distance_from_curve
from needletrack.records import Centerline, Float, Image
from needletrack.synthetic.world import Rod
from needletrack.tracking.centerline import CenterlineParameters, trace_centerlines
from needletrack.tracking.segment import Ridges, SegmentParameters, find_ridges

BACKGROUND, DARK = 200.0, 40.0
LINE_PX = 5.0
# A pixel of the reduced image, in which lines are traced.
REDUCED_PX = 3.0
Levels = npt.NDArray[np.float64]
Y, X = np.indices(SIZE_PX[::-1]).astype(np.float64)


def lines_in(image: Image, parameters: CenterlineParameters | None = None) -> list[Centerline]:
    ridges = find_ridges(image, WIDTHS_PX, SegmentParameters())
    assert ridges.reduction == REDUCED_PX
    return trace_centerlines(ridges, 1.4 * WIDTHS_PX[1], PX_PER_MM, parameters or CenterlineParameters())


def plain() -> Levels:
    return np.full(SIZE_PX[::-1], BACKGROUND)


def with_line(levels: Levels, start: Float, end: Float, width_px: float = LINE_PX, level: float = DARK) -> Levels:
    """A straight line with square ends, its edges as wide as a pixel."""
    along = (end - start) / np.linalg.norm(end - start)
    at = (X - start[0]) * along[0] + (Y - start[1]) * along[1]
    across = np.abs((Y - start[1]) * along[0] - (X - start[0]) * along[1])
    outside = np.maximum.reduce([across - width_px / 2, -at, at - float(np.linalg.norm(end - start))])
    covered = np.clip(0.5 - outside, 0, 1)
    return np.asarray(levels * (1 - covered) + level * covered)


def exposed(levels: Levels) -> Image:
    blurred = cv2.GaussianBlur(levels, (0, 0), 0.8)
    noise = np.random.default_rng(1).normal(0.0, 1.0, levels.shape)
    return np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)


def follows(line: Centerline, start: Float, end: Float) -> bool:
    """Whether a line runs from one of two points to the other, and straight."""
    ends = line.points_px[[0, -1]]
    forward = np.linalg.norm(ends - [start, end], axis=1).max()
    backward = np.linalg.norm(ends - [end, start], axis=1).max()
    # A skeleton ends half a width before the line, the mask half a width after it; and it turns to a square corner.
    from_ends = np.linalg.norm(line.points_px[:, None] - [start, end], axis=2).min(axis=1)
    off = distance_from_curve(line.points_px[from_ends > 4 * LINE_PX], np.array([start, end]))
    return min(forward, backward) < 2 * LINE_PX + REDUCED_PX and float(off.max()) < REDUCED_PX


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_drawn_needle_is_the_longest_line(name: str) -> None:
    truth_mm = scene(name).truth.centerline_mm
    for image, truth_px in zip(scene(name).images, RIG.project(truth_mm), strict=True):
        line = lines_in(image)[0]
        # The skeleton is a staircase of reduced pixels, smoothed.
        assert np.sqrt(np.mean(distance_from_curve(line.points_px, truth_px) ** 2)) < REDUCED_PX / 2
        # It misses the cone's thin end and some of what lies before the sleeve, each 3 mm.
        missed = distance_from_curve(truth_px, line.points_px) > REDUCED_PX
        assert 0.5 * missed.sum() < 6.0
        # It runs on: no step is longer than the smallest gap that is bridged.
        assert np.linalg.norm(np.diff(line.points_px, axis=0), axis=1).max() < 2 * REDUCED_PX


@settings(max_examples=15)
@given(st.floats(0.0, np.pi), st.floats(6.0, 9.0), st.booleans())
def test_a_straight_line_is_one_line_whatever_its_direction(angle: float, width_px: float, is_dark: bool) -> None:
    half = 200.0 * np.array([np.cos(angle), np.sin(angle)])
    start, end = np.array([360.0, 320.0]) - half, np.array([360.0, 320.0]) + half
    levels = with_line(np.full_like(X, 120.0), start, end, width_px, 60.0 if is_dark else 180.0)
    (line,) = lines_in(exposed(levels))
    assert follows(line, start, end)
    # Half a reduced pixel to either side, and the blur of the reduction.
    assert abs(np.median(line.width_px) - width_px) < 1.5 * REDUCED_PX


@pytest.mark.parametrize("angle_deg", [35.0, 60.0, 90.0])
@pytest.mark.parametrize("levels", [(40.0, 40.0), (40.0, 245.0)], ids=["same polarity", "opposite"])
def test_crossing_lines_are_followed_straight_on(angle_deg: float, levels: tuple[float, float]) -> None:
    angle = np.radians(angle_deg)
    middle = np.array([360.0, 320.0])
    down = np.array([0.0, 250.0])
    one = middle - down, middle + down
    aside = 250.0 * np.array([np.sin(angle), np.cos(angle)])
    other = middle - aside, middle + aside
    drawn = with_line(with_line(plain() - 50, *one, level=levels[0]), *other, level=levels[1])
    found = lines_in(exposed(drawn))[:2]
    for start, end in (one, other):
        assert sum(follows(line, start, end) for line in found) == 1


@pytest.mark.parametrize(("gap_mm", "is_bridged"), [(3.0, True), (6.0, True), (12.0, False)])
def test_a_gap_is_bridged_up_to_its_greatest_length(gap_mm: float, is_bridged: bool) -> None:
    # What the filter needs of a line's end is missing from both sides: the gap is seen longer by a width or two.
    gap_px = gap_mm * PX_PER_MM
    top, bottom = np.array([340.0, 60.0]), np.array([380.0, 580.0])
    along = (bottom - top) / np.linalg.norm(bottom - top)
    middle = (top + bottom) / 2
    drawn = with_line(with_line(plain(), top, middle - gap_px / 2 * along), middle + gap_px / 2 * along, bottom)
    found = lines_in(exposed(drawn))
    assert len(found) == (1 if is_bridged else 2)
    assert follows(found[0], top, bottom) == is_bridged


def test_a_line_is_not_continued_round_a_corner() -> None:
    # A right angle whose corner is left out.
    down = np.array([200.0, 175.0]), np.array([200.0, 550.0])
    right = np.array([225.0, 150.0]), np.array([600.0, 150.0])
    found = lines_in(exposed(with_line(with_line(plain(), *down), *right)))
    assert len(found) == 2
    for start, end in (down, right):
        assert sum(follows(line, start, end) for line in found) == 1


def test_a_line_ends_at_a_corner() -> None:
    # As a needle's skeleton does where it goes over to the edge of its sleeve.
    corner = np.array([200.0, 150.0])
    down = corner, np.array([200.0, 550.0])
    right = corner, np.array([600.0, 150.0])
    found = lines_in(exposed(with_line(with_line(plain(), *down), *right)))
    assert len(found) == 2
    for line in found:
        assert min(distance_from_curve(line.points_px, np.array(arm)).max() for arm in (down, right)) < REDUCED_PX
        assert arc_length(line.points_px)[-1] > 0.9 * 400.0


def test_a_faint_needle_beside_a_wide_dark_vessel_is_a_line() -> None:
    # The vessel is told from the needle's side lobes: its response does not swallow the needle's.
    start, end = np.array([360.0, 100.0]), np.array([380.0, 500.0])
    vessel = np.array([44.0, 0.0])
    drawn = with_line(plain(), start + vessel, end + vessel, 20.0, BACKGROUND - 130.0)
    found = lines_in(exposed(with_line(drawn, start, end, level=BACKGROUND + 15.0)))
    assert any(follows(line, start, end) for line in found)


def test_a_needle_behind_a_rod_is_one_line() -> None:
    rod = Rod((-50.0, 2.0, 215.0), (80.0, -6.0, 215.0), diameter_mm=3.0)
    world = replace(WORLDS["dark"], rods=(rod,))
    hidden = seen_at(world)
    for image, truth_px in zip(hidden.images, RIG.project(hidden.truth.centerline_mm), strict=True):
        along = [np.mean(distance_from_curve(line.points_px, truth_px) < REDUCED_PX) for line in lines_in(image)]
        needle = lines_in(image)[int(np.argmax(along))]
        assert max(along) > 0.95
        missed = distance_from_curve(truth_px, needle.points_px) > 2 * REDUCED_PX
        # Cone, sleeve, and the 3.5 mm that the rod hides.
        assert 0.5 * missed.sum() < 8.5


def test_the_edge_of_something_wide_is_no_line() -> None:
    assert lines_in(exposed(np.where(X < 360 + 0.1 * Y, 40.0, 200.0))) == []
    wide = with_line(plain(), np.array([100.0, 300.0]), np.array([600.0, 340.0]), 4 * WIDTHS_PX[1])
    found = lines_in(exposed(wide))
    assert sum(arc_length(line.points_px)[-1] for line in found) < 0.1 * 500


def test_a_closed_loop_is_cut_and_traced_once() -> None:
    radius = np.hypot(X - 360, Y - 320)
    ring = np.where(np.abs(radius - 150.0) < LINE_PX / 2, DARK, BACKGROUND)
    (line,) = lines_in(exposed(ring))
    np.testing.assert_allclose(np.hypot(*(line.points_px - [360, 320]).T), 150.0, atol=REDUCED_PX)
    assert arc_length(line.points_px)[-1] == pytest.approx(2 * np.pi * 150.0, rel=0.05)


def test_faint_lines_are_left_out() -> None:
    start, end = np.array([360.0, 100.0]), np.array([380.0, 500.0])
    image = exposed(with_line(plain(), start, end, level=BACKGROUND - 10.0))
    assert len(lines_in(image)) == 1
    # Thirty grey levels of contrast are more than it has.
    assert lines_in(image, CenterlineParameters(min_contrast_gray=30.0)) == []


def test_lines_come_longest_first_and_none_from_a_plain_image() -> None:
    drawn = plain()
    for u, length in ((150.0, 200.0), (300.0, 400.0), (450.0, 120.0)):
        drawn = with_line(drawn, np.array([u, 100.0]), np.array([u + 20, 100.0 + length]))
    lengths = [float(arc_length(line.points_px)[-1]) for line in lines_in(exposed(drawn))]
    assert len(lengths) == 3
    assert all(longer > shorter for longer, shorter in pairwise(lengths))
    assert lines_in(exposed(plain())) == []


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 3.0))
def test_lines_of_any_mask_run_on_and_stay_inside_it(seed: int, blur_px: float) -> None:
    # Blobs, bands and holes of all shapes; what differs from both sides everywhere, so that nothing is left out.
    rng = np.random.default_rng(seed)
    mask = cv2.GaussianBlur(rng.normal(size=(60, 80)), (0, 0), blur_px) > 0
    mask[[0, -1]] = mask[:, [0, -1]] = False
    ridges = Ridges(mask, np.zeros_like(mask), (100.0 * mask).astype(np.float32), 1)
    parameters = CenterlineParameters(max_gap_mm=0.1, max_turn_deg=170.0, min_contrast_gray=1e-3)
    for line in trace_centerlines(ridges, 100.0, 1.0, parameters):
        columns, rows = np.rint(line.points_px).astype(int).T
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert near[rows, columns].all()
        assert np.linalg.norm(np.diff(line.points_px, axis=0), axis=1).max() < 1.5
