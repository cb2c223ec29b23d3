"""Needles so bright that the picture saturates, against the truth of what was drawn."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.tracking.scenes import ARC, BEHIND, RIG, Scene, scene, seen_at

from needletrack.kernels.library import BASELINE, WITH_AVX2, best_library, load
from needletrack.records import Float, Image
from needletrack.synthetic.render import Material
from needletrack.synthetic.world import LIGHT_ON_DARK, World
from needletrack.tracking.clipped import Flanks, clipped_axis, outline
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import AxisOffsets

# Looks wider than it is by half a sigma of the blur on either side, and more.
SEEN_WIDER_MM = 0.2


def bright(level: float) -> Scene:
    return seen_at(World(RIG, ARC, BEHIND, replace(LIGHT_ON_DARK, needle=Material(level), sleeve=Material(90.0))))


def unseen(points_mm: Float) -> tuple[AxisOffsets, AxisOffsets]:
    n = len(points_mm)
    view = AxisOffsets(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.full(n, np.inf))
    return view, view


def shaft(shown: Scene) -> Float:
    """Points about a millimetre apart, without sleeve and tip."""
    return shown.truth.centerline_mm[6:-10:2]


Seen = tuple[Flanks, tuple[AxisOffsets, AxisOffsets]]


@cache
def white() -> Scene:
    return bright(700.0)


def looked_at(
    images: tuple[Image, Image], points_mm: Float, is_shaft: Mask | None = None, before: Flanks | None = None
) -> Seen | None:
    """What is seen of the white needle about a curve that was not seen otherwise."""
    at = [np.zeros(len(points_mm))] * 2
    everywhere = np.ones(len(points_mm), dtype=np.bool_) if is_shaft is None else is_shaft
    seen_mm = white().truth.diameter_mm + SEEN_WIDER_MM
    return clipped_axis(images, RIG, points_mm, unseen(points_mm), at, seen_mm, everywhere, before)


@pytest.mark.parametrize("level", [400.0, 700.0, 1200.0])
def test_axis_and_diameter_of_a_clipped_needle(level: float) -> None:
    shown = bright(level)
    points_mm = shaft(shown)
    at = [np.zeros(len(points_mm))] * 2
    everywhere = np.ones(len(points_mm), dtype=np.bool_)
    seen_mm = shown.truth.diameter_mm + SEEN_WIDER_MM
    found = clipped_axis(shown.images, RIG, points_mm, unseen(points_mm), at, seen_mm, everywhere)
    assert found is not None
    flanks, observed = found
    # A blur that is off by 0.01 px puts either edge off by 0.03 px, which is 0.006 mm.
    assert flanks.diameter_mm == pytest.approx(shown.truth.diameter_mm, abs=0.06)
    for view in observed:
        assert view.seen.mean() > 0.9
        assert np.abs(view.offset_px[view.seen]).max() < 0.15
        assert np.mean(np.abs(view.offset_px[view.seen]) < 2 * view.sigma_px[view.seen]) > 0.8


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_needle_that_is_not_clipped_is_left_alone(name: str) -> None:
    points_mm = shaft(scene(name))
    everywhere = np.ones(len(points_mm), dtype=np.bool_)
    at = [np.zeros(len(points_mm))] * 2
    diameter_mm = scene(name).truth.diameter_mm
    assert clipped_axis(scene(name).images, RIG, points_mm, unseen(points_mm), at, diameter_mm, everywhere) is None


def test_it_makes_no_difference_from_which_end_a_needle_is_looked_at() -> None:
    points_mm = shaft(white())
    points_mm = points_mm[: len(points_mm) // 3 * 3]
    there, back = looked_at(white().images, points_mm), looked_at(white().images, points_mm[::-1])
    assert there is not None
    assert back is not None
    assert back[0].diameter_mm == pytest.approx(there[0].diameter_mm, rel=1e-9)
    for forth, turned in zip(there[1], back[1], strict=True):
        np.testing.assert_allclose(turned.offset_px[::-1], -forth.offset_px, atol=1e-8)
        # Windows are solved from the first to the last, and what is known of each from the last to the first.
        np.testing.assert_allclose(turned.sigma_px[::-1], forth.sigma_px, rtol=1e-8)


def test_what_was_seen_before_leads_to_the_same() -> None:
    points_mm = shaft(white())
    afresh = looked_at(white().images, points_mm)
    assert afresh is not None
    again = looked_at(white().images, points_mm, before=afresh[0])
    assert again is not None
    assert again[0].diameter_mm == pytest.approx(afresh[0].diameter_mm, abs=0.005)


def test_a_view_may_clip_a_single_window() -> None:
    points_mm = shaft(white())[:14]
    is_shaft = np.isin(np.arange(14), [0, 3, 6, *range(9, 14)])
    left, right = (image.copy() for image in white().images)
    for x, y in np.rint(RIG.project(points_mm)[1][:9]).astype(int):
        right[y - 1 : y + 2, x - 1 : x + 2] = 200
    found = looked_at((left, right), points_mm, is_shaft)
    assert found is not None
    in_left, in_right = found[1]
    assert (in_left.seen == is_shaft).all()
    assert np.flatnonzero(in_right.seen).tolist() == list(range(9, 14))
    assert np.unique(in_right.offset_px[in_right.seen]).size == 1
    assert np.abs(in_right.offset_px[in_right.seen]).max() < 0.15


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_too_few_points_hold_no_diameter(count: int) -> None:
    assert looked_at(white().images, shaft(white())[:count]) is None


def test_where_the_image_ends_nothing_is_known_and_the_rest_is_as_it_was() -> None:
    points_mm = shaft(white())
    whole = looked_at(white().images, points_mm)
    assert whole is not None
    lowest = int(min(view[:, 1][round(0.8 * len(points_mm))] for view in RIG.project(points_mm)))
    left, right = white().images
    cropped = looked_at((left[:lowest], right[:lowest]), points_mm)
    assert cropped is not None
    assert cropped[0].diameter_mm == pytest.approx(whole[0].diameter_mm, abs=0.02)
    for part, all_of_it, px in zip(cropped[1], whole[1], RIG.project(points_mm), strict=True):
        assert not part.seen[px[:, 1] > lowest + 3].any()
        inside = part.seen & (px[:, 1] < lowest - 12)
        assert inside.mean() > 0.7
        np.testing.assert_allclose(part.offset_px[inside], all_of_it.offset_px[inside], atol=0.03)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 2])
def test_a_curve_that_is_nowhere_is_not_clipped(value: float, axis: int) -> None:
    points_mm = shaft(white()).copy()
    points_mm[5, axis] = value
    assert looked_at(white().images, points_mm) is None
    assert looked_at(white().images, np.full_like(points_mm, value)) is None


def test_behind_and_on_the_camera_nothing_is_clipped() -> None:
    points_mm = shaft(white()).copy()
    assert looked_at(white().images, points_mm * [1, 1, -1]) is None
    assert looked_at(white().images, points_mm * [1, 1, 0]) is None
    assert looked_at(white().images, points_mm * [1, 1, 1e-3]) is None


def test_where_all_is_white_there_is_no_needle() -> None:
    blank = np.full_like(white().images[0], 255)
    assert looked_at((blank, blank), shaft(white())) is None


def test_both_libraries_see_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    if best_library() != WITH_AVX2:
        pytest.skip("this processor has no AVX2: there is one library for it")
    points_mm = shaft(white())
    fast = looked_at(white().images, points_mm)
    monkeypatch.setattr("needletrack.kernels.library._library", load(BASELINE))
    slow = looked_at(white().images, points_mm)
    assert fast is not None
    assert slow is not None
    assert slow[0].diameter_mm == pytest.approx(fast[0].diameter_mm, rel=1e-9)
    for a, b in zip(fast[1], slow[1], strict=True):
        np.testing.assert_allclose(a.offset_px, b.offset_px, atol=1e-8)
        np.testing.assert_allclose(a.sigma_px, b.sigma_px, rtol=1e-8)


def test_an_outline_is_that_of_the_shaft_and_draws_in_at_the_apex() -> None:
    before = np.arange(-3.0, 12.0, 0.05)
    cone = 2.0 * np.clip(before / 5.0, 0.0, 1.0)
    seen = outline(cone, (0.7, 0.7 / 0.05), 2.6)
    np.testing.assert_allclose(seen[-20:], 2.6, atol=0.01)
    assert (np.diff(seen) >= -1e-9).all()
    # Nothing is seen further beyond the apex than the outline lies beside the shaft.
    assert -0.6 < before[np.argmax(seen > 0)] < 0.6
