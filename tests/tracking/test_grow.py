"""A stretch of a needle grows to what both views show of it."""

import numpy as np
import pytest
from tests.tracking.scenes import RIG, scene

from needletrack.errors import NeedleNotFound
from needletrack.geometry import spline
from needletrack.geometry.spline import arc_length, distance_from_curve
from needletrack.records import Float, Reason
from needletrack.tracking.fit import FitParameters
from needletrack.tracking.grow import Growth, grow
from needletrack.tracking.needle import Needle

NEEDLE, FIT = Needle(), FitParameters()
GROWTH = Growth(1.0, (5.0, 2.5, 11.0), 12.0, 2.0, 15, 3.0, 0.42, 5.0, 8.0)


def stretch_mm(name: str, start_mm: float, stop_mm: float) -> Float:
    true_mm = scene(name).truth.centerline_mm
    return spline.cut(true_mm, start_mm, stop_mm, round(stop_mm - start_mm) + 1)


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
@pytest.mark.parametrize(("start_mm", "stop_mm"), [(12.0, 30.0), (25.0, 45.0)])
def test_a_stretch_grows_to_both_ends(name: str, start_mm: float, stop_mm: float) -> None:
    true_mm = scene(name).truth.centerline_mm
    grown_mm, appearance = grow(scene(name).images, RIG, stretch_mm(name, start_mm, stop_mm), NEEDLE, FIT, GROWTH, None)
    # The sleeve's rim hides 6 mm and the cone before the apex is too thin to say: of the rest nothing is missing, and
    # points are within the curve's error (test_adjust.py), where it was only roughly adjusted three times that.
    shown_mm = true_mm[(arc_length(true_mm) > 8.0) & (arc_length(true_mm) < arc_length(true_mm)[-1] - 3.5)]
    assert distance_from_curve(shown_mm, grown_mm).max() < 0.4
    within = distance_from_curve(shown_mm, grown_mm)
    assert np.sqrt((within**2).mean()) < 0.2
    # Nor does it grow far beyond: a little into the cone, and along the sleeve until that is told from a needle.
    assert arc_length(grown_mm)[-1] < arc_length(true_mm)[-1] + 6.0
    assert appearance.half_width >= 0


def test_what_was_known_of_its_look_is_not_needed_but_kept() -> None:
    mine = stretch_mm("dark", 12.0, 30.0)
    first_mm, appearance = grow(scene("dark").images, RIG, mine, NEEDLE, FIT, GROWTH, None)
    again_mm, same = grow(scene("dark").images, RIG, first_mm, NEEDLE, FIT, GROWTH, appearance)
    assert same == appearance
    assert distance_from_curve(again_mm[3:-3], first_mm).max() < 0.1


def test_beside_the_needle_nothing_grows() -> None:
    aside_mm = stretch_mm("dark", 12.0, 30.0) + np.array([12.0, 0.0, 0.0])
    with pytest.raises(NeedleNotFound) as lost:
        grow(scene("dark").images, RIG, aside_mm, NEEDLE, FIT, GROWTH, None)
    assert lost.value.reason is Reason.LOW_COVERAGE
