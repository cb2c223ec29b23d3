"""What a track carries beside its shape, for those who look at it."""

import numpy as np
import pytest
from tests.tracking.scenes import tracked


@pytest.mark.parametrize("name", ["dark", "steel"])
def test_a_track_says_what_each_view_showed_beside_its_curve(name: str) -> None:
    found = tracked(name)
    assert found.curve is not None
    residual_px = found.evidence.axis_residual_px
    assert residual_px is not None
    assert residual_px.shape == (2, len(found.curve.points_mm))
    np.testing.assert_array_equal(np.isfinite(residual_px).sum(axis=0), found.curve.seen)
    # Streaks, which the fit weighs little, lie within the needle's own width.
    assert np.nanmax(np.abs(residual_px)) < 3.0
    assert np.nanmedian(residual_px) == pytest.approx(0.0, abs=0.1)
