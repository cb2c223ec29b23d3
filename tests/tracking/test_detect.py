"""The search of whole drawn images: the needle comes first, and what is looked at together is judged as if alone."""

import numpy as np
import pytest
from tests.tracking.scenes import RIG, scene

from needletrack.geometry.spline import distance_from_curve, resample
from needletrack.tracking.detect import detect, silhouette_support
from needletrack.tracking.needle import Needle
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.stopwatch import Stopwatch


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_the_needle_is_the_first_candidate(name: str) -> None:
    stopwatch = Stopwatch()
    first, *others = detect(scene(name).images, RIG, TrackingParameters(), stopwatch)
    truth_mm = scene(name).truth.centerline_mm
    # A skeleton is a staircase of 3 px; in depth it is 3.7 times as far off.
    assert np.median(distance_from_curve(first.points_mm, truth_mm)) < 1.0
    # But for the cone's thin end and what lies before the sleeve, 3 mm each.
    assert (distance_from_curve(truth_mm, first.points_mm) < 3.0).mean() > 0.9
    assert all(other.score <= first.score for other in others)
    assert set(stopwatch.elapsed_ms) == {"segment", "centerline", "match", "judge"}


def test_curves_that_are_looked_at_together_are_judged_as_each_alone() -> None:
    images, needle = scene("steel").images, Needle()
    on_needle = resample(scene("steel").truth.centerline_mm, 20)
    curves_mm = [on_needle, on_needle + np.array([6.0, 0.0, 0.0]), on_needle[5:15]]
    together = silhouette_support(images, RIG, curves_mm, needle)
    for curve_mm, support in zip(curves_mm, together, strict=True):
        (alone,) = silhouette_support(images, RIG, [curve_mm], needle)
        # Single precision sums its products in another order.
        assert support == pytest.approx(alone, abs=0.05)
    # Six millimetres beside it there is none.
    shown, beside, _ = (float((support > 3.0).mean()) for support in together)
    assert shown > 0.8
    assert beside < 0.2
