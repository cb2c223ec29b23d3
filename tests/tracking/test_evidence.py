"""The evidence of the axis in drawn cross sections of unit noise: where it peaks, how sure it is, where it is flat."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.tracking.sections import Look

from needletrack.records import Appearance, Float
from needletrack.tracking.evidence import (
    BLURS,
    DULL,
    HALF_WIDTHS,
    LIVELY,
    NEAR,
    OFFSETS,
    WIDE,
    Grid,
    log_evidence,
    log_evidence_of_no_needle,
    products,
)

# Three quarters of the thickest needle's width, behind a lens that is nearly in focus.
WIDTH, BLUR = 16, 1
HALF_WIDTH = float(HALF_WIDTHS[WIDTH])
# Standard deviations of noise: a dark needle on white and a bright one on black are 100 of them and more.
DARK, BRIGHT = Look(130.0, 130.0, 20.0), Look(30.0, 30.0, 150.0)
REPEATS = 24


def sections(look: Look, axis: float, blur: int = BLUR, *, seed: int = 0, repeats: int = REPEATS) -> Float:
    """Sections (repeats, len(OFFSETS)), units, with the axis at a shift and noise of one."""
    clean = look.across(OFFSETS - axis, HALF_WIDTH, BLURS[blur])
    return np.asarray(clean + np.random.default_rng(seed).normal(size=(repeats, len(OFFSETS))))


def axis_and_sigma(
    values: Float, inside: int, blur: int = BLUR, grid: Grid = WIDE, width: int = WIDTH
) -> tuple[Float, Float]:
    """Mean and standard deviation (N,) of the axis under the evidence."""
    log = log_evidence(products(values), Appearance(width, blur, inside), grid) @ grid.refine.T
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ grid.fine_shifts
    return mean, np.sqrt((weight * (grid.fine_shifts - mean[:, None]) ** 2).sum(axis=1))


# The edges of a needle of 110 noises, blurred by 0.55 to 0.84 units and sampled every 0.5, are known to
# 1 / 110 * sqrt(2 * sqrt(pi) * 0.84 * 0.5) = 0.011 units each. Between two shifts, an eighth to a quarter of a unit
# apart, evidence that is sharper than they are is interpolated: 0.03 units, a thirtieth of a pixel.
PLAIN = 0.04


@pytest.mark.parametrize("look", [DARK, BRIGHT], ids=["dark", "bright"])
@pytest.mark.parametrize("axis", [-1.3, 0.0, 0.7])
@pytest.mark.parametrize("blur", [1, 3])
@pytest.mark.parametrize("inside", [DULL, LIVELY], ids=["dull", "lively"])
def test_it_peaks_at_the_axis(look: Look, axis: float, blur: int, inside: int) -> None:
    at, sigma = axis_and_sigma(sections(look, axis, blur), inside, blur)
    assert abs(at.mean() - axis) < PLAIN
    assert sigma.mean() < 0.15
    assert np.sqrt(np.mean((at - axis) ** 2)) < 1.3 * sigma.mean()


@given(axis=st.floats(-1.4, 1.4), level=st.floats(30.0, 200.0), is_bright=st.booleans(), seed=st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_it_peaks_at_the_axis_whatever_the_levels(axis: float, level: float, is_bright: bool, seed: int) -> None:
    look = Look(40.0, 40.0, 40.0 + level) if is_bright else Look(40.0 + level, 40.0 + level, 40.0)
    at, sigma = axis_and_sigma(sections(look, axis, seed=seed, repeats=1), DULL, grid=NEAR)
    assert abs(at[0] - axis) < PLAIN + 4 * sigma[0]


@pytest.mark.parametrize("inside", [DULL, LIVELY])
def test_left_and_right_are_treated_alike(inside: int) -> None:
    values = sections(Look(130.0, 60.0, 20.0, 90.0, 0.5), 0.6)
    appearance = Appearance(WIDTH, BLUR, inside)
    shown, mirrored = products(values), products(values[:, ::-1])
    one, other = log_evidence(shown, appearance, WIDE), log_evidence(mirrored, appearance, WIDE)
    # Single precision, of misfits of thousands.
    np.testing.assert_allclose(other[:, ::-1], one, rtol=1e-3, atol=0.1)
    one, other = log_evidence_of_no_needle(shown, BLUR), log_evidence_of_no_needle(mirrored, BLUR)
    np.testing.assert_allclose(other, one, rtol=1e-3, atol=0.1)


@pytest.mark.parametrize("by", [-60.0, 90.0])
def test_the_common_level_does_not_matter(by: float) -> None:
    values = sections(DARK, 0.3)
    appearance = Appearance(WIDTH, BLUR, DULL)
    np.testing.assert_allclose(
        log_evidence(products(values + by), appearance, WIDE),
        log_evidence(products(values), appearance, WIDE),
        atol=0.05,
    )


PLACES = np.linspace(-0.9, 0.9, 13)


@pytest.mark.parametrize("streak", [110.0, 170.0])
@pytest.mark.parametrize("blur", [1, 3])
def test_a_streak_anywhere_inside_does_not_pull_the_axis(streak: float, blur: int) -> None:
    # Steel of 37 before a background of 77: the streak is brighter than both. What tracks the middle of what is bright
    # would be off by its place, up to 2 units, a whole half width.
    for place in PLACES:
        at, sigma = axis_and_sigma(sections(Look(77.0, 77.0, 37.0, streak, place), 0.3, blur), LIVELY, blur)
        assert abs(at.mean() - 0.3) < 0.25, place
        assert abs(at.mean() - 0.3) < 2 * sigma.mean(), place


@pytest.mark.parametrize("blur", [1, 3])
def test_a_streak_as_bright_as_the_background_says_that_it_hides_an_edge(blur: int) -> None:
    # At the rim it is no streak but a narrower needle: one edge has no contrast, and sigma grows by what that leaves.
    for place in PLACES:
        at, sigma = axis_and_sigma(sections(Look(77.0, 77.0, 37.0, 50.0, place), 0.3, blur), LIVELY, blur)
        assert abs(at.mean() - 0.3) < 1.3 * sigma.mean(), place


def test_an_edge_without_contrast_leaves_the_axis_to_the_other_one() -> None:
    # As dark on its right as the needle itself; the width tells where the axis is. 0.05 units: one edge of two.
    for axis in (-0.8, 0.0, 0.8):
        at, sigma = axis_and_sigma(sections(Look(130.0, 40.0, 20.0), axis), DULL)
        assert abs(at.mean() - axis) < 0.08
        assert sigma.mean() < 0.15


def test_a_saturated_needle_has_its_axis_between_its_edges() -> None:
    # Four times as bright as what the camera can tell: it looks wider, by 0.4 units on either side, which is six steps
    # of the width, and is the same for all of the needle.
    look = Look(30.0, 30.0, 600.0)
    for axis in (-0.6, 0.4):
        at, _ = axis_and_sigma(np.minimum(sections(look, axis), 170.0), DULL, width=WIDTH + 6)
        assert abs(at.mean() - axis) < PLAIN


@pytest.mark.parametrize("inside", [DULL, LIVELY])
def test_it_is_flat_where_there_is_no_contrast(inside: int) -> None:
    log = log_evidence(products(sections(Look(80.0, 80.0, 80.0), 0.0)), Appearance(WIDTH, BLUR, inside), WIDE)
    # Noise of one in some 30 samples: a log likelihood of two parameters scatters by about one.
    assert np.ptp(log.mean(axis=0)) < 2.0


def needle_over_none(values: Float, inside: int) -> float:
    """Median log Bayes factor of a needle anywhere on the grid over none."""
    log = log_evidence(products(values), Appearance(WIDTH, BLUR, inside), WIDE)
    over = (
        np.logaddexp.reduce(log, axis=1) - np.log(len(WIDE.shifts)) - log_evidence_of_no_needle(products(values), BLUR)
    )
    return float(np.median(over))


@pytest.mark.parametrize("inside", [DULL, LIVELY])
def test_nothing_is_no_needle(inside: int) -> None:
    assert needle_over_none(sections(Look(80.0, 80.0, 80.0), 0.0), inside) < 0.0


@pytest.mark.parametrize("inside", [DULL, LIVELY])
@pytest.mark.parametrize("is_brighter", [False, True])
def test_a_single_edge_is_no_needle(inside: int, is_brighter: bool) -> None:
    for edge in (-4.0, -1.5, -1.375, -1.25, 0.0, 2.75):
        # Edges are tried at every sample, half a unit apart; one that is strong and lies between two is not foreseen.
        for step in (20.0, 110.0) if edge % 0.5 == 0 else (20.0,):
            left, right = (20.0, 20.0 + step) if is_brighter else (20.0 + step, 20.0)
            # A needle as dark as what is on its right, and as bright: it has one edge.
            for axis, level in ((edge + HALF_WIDTH, right), (edge - HALF_WIDTH, left)):
                values = sections(Look(left, right, level), axis)
                assert needle_over_none(values, inside) < 0.0, (edge, step)


@pytest.mark.parametrize("look", [DARK, BRIGHT, Look(77.0, 77.0, 37.0, 110.0, 0.4), Look(100.0, 100.0, 80.0)])
def test_a_needle_is_preferred_to_none(look: Look) -> None:
    # Even one of 20 noises.
    inside = LIVELY if look.streak else DULL
    values = sections(look, 0.4)
    over = log_evidence(products(values), Appearance(WIDTH, BLUR, inside), WIDE).max(axis=1)
    assert np.median(over - log_evidence_of_no_needle(products(values), BLUR)) > 3.0


def test_of_several_widths_the_true_one_is_likeliest() -> None:
    values = sections(DARK, 0.2)
    say = {
        (width, blur): log_evidence(products(values), Appearance(width, blur, DULL), WIDE).max(axis=1).sum()
        for width in range(WIDTH - 6, WIDTH + 7, 2)
        for blur in (0, BLUR, 3)
    }
    assert max(say, key=lambda each: say[each]) == (WIDTH, BLUR)
