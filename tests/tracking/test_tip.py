"""The apex of drawn needles: cones and round ends, seen from the side and turned towards or from the cameras."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr
from tests.tracking.scenes import ARC, RIG, WORLDS, Scene, seen_at

from needletrack.geometry import spline
from needletrack.records import Appearance
from needletrack.synthetic.needle import Wave
from needletrack.synthetic.tube import End
from needletrack.tracking.adjust import adjust
from needletrack.tracking.evidence import BLURS, HALF_WIDTHS
from needletrack.tracking.fit import FitParameters
from needletrack.tracking.needle import Needle
from needletrack.tracking.tip import (
    ACROSS,
    BEFORE_MM,
    BEYOND_MM,
    PICTURE_MM,
    ROW_MM,
    TRIED_MM,
    TipFit,
    TipParameters,
    find_tip,
    inside_pictures,
)

NEEDLE, PARAMETERS = Needle(), TipParameters()


@cache
def shown(name: str, tip: End, depth_slope: float) -> tuple[Scene, Appearance]:
    """A drawn needle of 40 mm whose tip comes nearer or goes away by so much per millimetre, and what it looks like."""
    motion = replace(
        ARC,
        tip=tip,
        direction=(0.12, 1.0, depth_slope),
        base_mm=(8.0, -24.0, 246.0 - 15 * depth_slope),
        length_mm=Wave(40.0),
    )
    drawn = seen_at(replace(WORLDS[name], needle=motion))
    inner_mm = drawn.truth.centerline_mm[8:-8]
    points_mm = spline.resample(inner_mm, round(spline.arc_length(inner_mm)[-1]) + 1)
    return drawn, adjust(drawn.images, RIG, points_mm, NEEDLE, FitParameters()).appearance


def tip_near(
    off_mm: float,
    name: str = "dark",
    tip: End = End.CONE,
    depth_slope: float = 0.0,
    *,
    needle: Needle = NEEDLE,
) -> tuple[TipFit, float]:
    """The tip found on the true curve from a rough end so far beyond the true one, and how far beyond it that lies."""
    drawn, appearance = shown(name, tip, depth_slope)
    truth = drawn.truth
    ahead = np.arange(1, 201)[:, None] * 0.1
    curve_mm = np.concatenate([truth.centerline_mm, truth.tip_mm + ahead * truth.tip_direction])
    arc = spline.arc_length(curve_mm)
    true_mm = float(arc[len(truth.centerline_mm) - 1])
    end_mm = true_mm + off_mm
    at_mm = np.arange(end_mm - BEFORE_MM, end_mm + BEYOND_MM, ROW_MM)
    rows = np.column_stack([np.interp(at_mm, arc, column) for column in curve_mm.T])
    left, right = drawn.images
    views = ((left, RIG.left, rows), (right, RIG.right, RIG.right_from_left.apply(rows)))
    found = find_tip(views, at_mm, end_mm, appearance, needle, PARAMETERS)
    return found, found.at_mm - true_mm


# A step of 165 grey levels over the needle's width of 5 px and the blur's 2 px, with noise of 2: an end is told to
# 2 / 165 * sqrt(2 * sqrt(pi) * 0.8 px / 5) = 0.01 px, and a cone, whose thin end shows less, to some 0.05 px, which is
# 0.01 mm; grid, interpolation and the rows of 0.2 mm add 0.01 mm. Steel's streak ends elsewhere than its outline: 0.1
# mm, which its sigma says.
PLAIN_MM, STEEL_MM = 0.03, 0.1


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
@pytest.mark.parametrize("tip", [End.CONE, End.ROUND])
@pytest.mark.parametrize("depth_slope", [-1.0, 0.0, 0.6])
def test_the_apex_is_found_from_whichever_side(name: str, tip: End, depth_slope: float) -> None:
    # Turned by 45 degrees a ball's picture reaches r (1 / cos - 1) = 0.19 mm further than its apex, which would make
    # the needle longer; a cone's thin end falls below the noise, which would make it shorter.
    for off_mm in (-1.5, 0.8):
        found, beyond_mm = tip_near(off_mm, name, tip, depth_slope)
        assert abs(beyond_mm) < (STEEL_MM if name == "steel" else PLAIN_MM)
        assert abs(beyond_mm) < 2 * max(found.sigma_mm)
        assert abs(found.each_mm[0] - found.each_mm[1]) < 0.15
        assert PARAMETERS.min_sigma_mm <= min(found.sigma_mm) <= max(found.sigma_mm) < 0.2
        assert found.taper_mm == (2.5 if tip is End.CONE else 0.0)
        assert min(found.contrast) > 15.0


@given(off_mm=st.floats(-1.8, 3.5), tip=st.sampled_from([End.CONE, End.ROUND]))
@settings(max_examples=15, deadline=None)
def test_where_the_rough_end_lies_does_not_matter(off_mm: float, tip: End) -> None:
    assert TRIED_MM[0] < -off_mm < TRIED_MM[1]
    assert abs(tip_near(off_mm, tip=tip)[1]) < PLAIN_MM


@pytest.mark.parametrize(
    ("tip", "other", "wrong_by_mm"), [(End.CONE, (0.0,), 1.5), (End.ROUND, (2.5,), 1.5)], ids=["cone", "round"]
)
def test_a_shape_of_end_that_is_not_in_use_is_not_tried(tip: End, other: tuple[float, ...], wrong_by_mm: float) -> None:
    # Without the right one the apex is off by up to half a taper: what the shapes in use are worth.
    found, beyond_mm = tip_near(0.0, tip=tip, needle=Needle(tip_tapers_mm=other))
    assert found.taper_mm == other[0]
    assert PLAIN_MM < abs(beyond_mm) < wrong_by_mm + 1.0
    right = tip_near(0.0, tip=tip)[0]
    assert min(right.contrast) > min(found.contrast)


@pytest.mark.parametrize("before_mm", [10.0, 16.0])
def test_a_needle_that_goes_on_has_no_contrast(before_mm: float) -> None:
    assert max(tip_near(-before_mm)[0].contrast) < 3.0


def test_where_no_needle_is_there_is_no_contrast() -> None:
    assert max(tip_near(10.5)[0].contrast) < 3.0


def test_an_end_in_one_view_alone_has_no_contrast_in_the_other() -> None:
    # Its right view is that of a needle which ends 5 mm further on: the same curve, and no end there.
    drawn, appearance = shown("dark", End.CONE, 0.0)
    longer = seen_at(replace(WORLDS["dark"], needle=replace(ARC, base_mm=(8.0, -24.0, 246.0), length_mm=Wave(55.0))))
    truth = drawn.truth
    along = longer.truth.centerline_mm
    arc = spline.arc_length(along)
    true_mm = float(spline.arc_length(truth.centerline_mm)[-1])
    at_mm = np.arange(true_mm - BEFORE_MM, true_mm + BEYOND_MM, ROW_MM)
    rows = np.column_stack([np.interp(at_mm, arc, column) for column in along.T])
    views = ((drawn.images[0], RIG.left, rows), (longer.images[1], RIG.right, RIG.right_from_left.apply(rows)))
    found = find_tip(views, at_mm, true_mm, appearance, NEEDLE, PARAMETERS)
    assert found.contrast[1] < 8.0 < found.contrast[0]


@pytest.mark.parametrize("taper_mm", [0.0, 2.5])
def test_pictures_of_an_end_are_those_of_scipy(taper_mm: float) -> None:
    sine, unit_mm, appearance = 0.8, 0.2, Appearance(20, 2, 0)
    pictures = inside_pictures(taper_mm, appearance, unit_mm, sine, None)
    half_width, blur = HALF_WIDTHS[20], BLURS[2]
    before = pictures.before_mm + PICTURE_MM * np.arange(len(pictures.parts))
    if taper_mm > 0:
        width = half_width * np.clip(before / taper_mm, 0.0, 1.0)
    else:
        past = np.maximum((half_width * unit_mm - before) * sine, 0.0) / (half_width * unit_mm)
        width = half_width * np.sqrt(np.clip(1 - past**2, 0.0, 1.0))
    sharp = ndtr((ACROSS + width[:, None]) / blur) - ndtr((ACROSS - width[:, None]) / blur)
    whole = gaussian_filter1d(sharp, blur * unit_mm / sine / PICTURE_MM, axis=0, mode="nearest")
    # Parts on the shaft and on the end are all of the needle, and none of it twice.
    np.testing.assert_allclose(pictures.parts.sum(axis=1), whole, atol=1e-9)
    half = pictures.parts.shape[1] // 2
    assert np.abs(pictures.parts[0, :half]).max() < 1e-9
    assert np.abs(pictures.parts[-1, half:]).max() < 1e-9
    assert pictures.parts[-1, :half].max() > 0.3
