"""The streak of light is found where it is, to a fraction of a sample, and nowhere else."""

import numpy as np
import pytest
from tests.tracking.sections import Look

from needletrack.records import Float
from needletrack.tracking.evidence import OFFSETS
from needletrack.tracking.streak import find_streak

COUNT, HALF_WIDTH, BLUR, NOISE = 60, 2.2, 0.9, 1.0
HALF_WIDTHS, MIDDLE = np.full(COUNT, HALF_WIDTH), np.zeros(COUNT)


def cut(places: Float, look: Look, seed: int = 0, noise: float = NOISE) -> Float:
    """Sections (N, len(OFFSETS)) of a needle about the axis, whose streak lies at places (N,), units across."""
    rng = np.random.default_rng(seed)
    return np.stack(
        [
            Look(look.left, look.right, look.inside, look.streak, at / HALF_WIDTH).across(OFFSETS, HALF_WIDTH, BLUR)
            + noise * rng.normal(size=len(OFFSETS))
            for at in places
        ]
    )


SHINING = Look(90.0, 90.0, 60.0, streak=160.0)


@pytest.mark.parametrize("at", [-1.0, -0.3, 0.0, 0.6, 1.2])
def test_its_place_is_right_to_its_sigma(at: float) -> None:
    found = find_streak(cut(np.full(COUNT, at), SHINING), HALF_WIDTHS, MIDDLE)
    assert found is not None
    assert found.seen.mean() > 0.95
    off = found.offset[found.seen] - at
    # The needle's own shading about the streak moves the peak by a little more than the noise.
    assert abs(off.mean()) < 0.12
    assert off.std() < 2 * np.median(found.sigma[found.seen])


def test_it_is_followed_as_it_winds_within_the_needle() -> None:
    places = 0.9 * np.sin(np.linspace(0.0, 5.0, COUNT))
    found = find_streak(cut(places, SHINING), HALF_WIDTHS, MIDDLE)
    assert found is not None
    np.testing.assert_allclose(found.offset[found.seen], places[found.seen], atol=0.2)


def test_a_glint_elsewhere_does_not_lead_it_astray() -> None:
    values = cut(np.full(COUNT, 0.5), SHINING)
    glint = Look(0.0, 0.0, 0.0, streak=250.0, streak_at=-0.6).across(OFFSETS, HALF_WIDTH, BLUR)
    values[28:31] += glint
    found = find_streak(values, HALF_WIDTHS, MIDDLE)
    assert found is not None
    outside = np.r_[0:26, 33:COUNT]
    assert np.abs(found.offset[outside] - 0.5).max() < 0.3


def test_where_it_goes_out_it_is_not_seen() -> None:
    values = cut(np.full(COUNT, 0.3), SHINING)
    values[40:] = cut(np.full(20, 0.3), Look(90.0, 90.0, 60.0), seed=1)
    found = find_streak(values, HALF_WIDTHS, MIDDLE)
    assert found is not None
    assert found.seen[:38].all()
    assert not found.seen[42:].any()
    assert np.isinf(found.sigma[~found.seen]).all()


@pytest.mark.parametrize(
    "look",
    [Look(90.0, 90.0, 60.0), Look(200.0, 200.0, 30.0), Look(90.0, 160.0, 60.0)],
    ids=["dull", "dark", "before an edge"],
)
def test_a_needle_that_does_not_shine_has_none(look: Look) -> None:
    assert find_streak(cut(np.zeros(COUNT), look), HALF_WIDTHS, MIDDLE) is None


def test_noise_has_none() -> None:
    assert find_streak(np.random.default_rng(3).normal(size=(COUNT, len(OFFSETS))), HALF_WIDTHS, MIDDLE) is None


def test_a_line_beside_the_needle_is_none() -> None:
    beside = cut(np.zeros(COUNT), Look(90.0, 90.0, 60.0)) + 160.0 * np.exp(-0.5 * ((OFFSETS - 5.0) / BLUR) ** 2)
    assert find_streak(beside, HALF_WIDTHS, MIDDLE) is None


def test_it_is_looked_for_where_the_axis_is() -> None:
    # The needle has moved by more than its half width since its curve was drawn.
    axis = np.full(COUNT, 2.5)
    values = np.stack([np.interp(OFFSETS - 2.5, OFFSETS, row) for row in cut(np.full(COUNT, 0.6), SHINING)])
    found = find_streak(values, HALF_WIDTHS, axis)
    assert found is not None
    np.testing.assert_allclose(found.offset[found.seen], 3.1, atol=0.25)
