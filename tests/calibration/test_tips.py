"""Cameras that were bumped: what tips tell, and what they do not claim."""

from dataclasses import replace

import numpy as np
import pytest

from needletrack.calibration.tips import DriftParameters, DriftState, doubted
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Evidence, Float, NeedleCurve, NeedleTrack, Reason, Status, TipPose
from needletrack.synthetic.rig import default_rig


def track_with(offset_px: float, rig: StereoRig, at_mm: Float) -> NeedleTrack:
    points = np.linspace([0.0, -20.0, 250.0], at_mm, 12)
    curve = NeedleCurve(points, np.full(12, 0.05), np.full(12, 2), np.zeros(12), 30.0)
    pixels = rig.project(at_mm[None])
    tip_px = np.concatenate([pixels[0], pixels[1] + [[0.0, offset_px]]])
    tip = TipPose(at_mm, np.array([0.0, 1, 0]), np.array([0.0, 0, 0, 1]), 0.01 * np.eye(3), None, 2)
    return NeedleTrack(0, Status.OK, (), curve, tip, evidence=Evidence(tip_px=tip_px))


def run_through(offset_px: float, sigma_px: float, count: int, seed: int = 2) -> int | None:
    """After how many tracks drift is noticed."""
    rig, parameters, state = default_rig(), DriftParameters(), DriftState()
    random = np.random.default_rng(seed)
    for index in range(count):
        at_mm = np.array([random.uniform(-20, 40), random.uniform(-20, 20), random.uniform(230, 280)])
        state = state.after(track_with(offset_px + random.normal(0, sigma_px), rig, at_mm), rig, parameters)
        if state.has_moved:
            return index + 1
    return None


def test_tips_off_their_lines_are_noticed_soon() -> None:
    # 0.1 degrees of pitch; tips scatter by 0.1 to 0.7 px on the recordings.
    assert run_through(2.4, 0.2, 60) == DriftParameters().least_pairs
    noticed = run_through(2.4, 0.7, 60)
    assert noticed is not None
    assert noticed <= 15


@pytest.mark.parametrize("seed", range(8))
def test_tips_that_merely_scatter_are_not_a_drift(seed: int) -> None:
    assert run_through(0.0, 0.7, 300, seed) is None


def test_a_track_without_a_tip_tells_nothing() -> None:
    rig, state = default_rig(), DriftState((1.0,))
    without = replace(track_with(5.0, rig, np.array([0.0, 0, 250])), evidence=Evidence())
    assert state.after(without, rig, DriftParameters()) == state
    invalid = NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,))
    assert state.after(invalid, rig, DriftParameters()) == state


def test_what_is_noticed_is_said_and_nothing_else_changes() -> None:
    track = track_with(0.0, default_rig(), np.array([0.0, 0, 250]))
    told = doubted(track)
    assert (told.status, told.reasons) == (Status.DEGRADED, (Reason.CALIBRATION_DRIFT,))
    assert told.tip is track.tip
    invalid = NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,))
    assert doubted(invalid) is invalid


def test_what_is_noticed_stays_noticed_until_it_is_clearly_gone() -> None:
    rig, parameters, state = default_rig(), DriftParameters(window_pairs=10, least_pairs=5), DriftState()
    at_mm = np.array([0.0, 0.0, 250.0])

    def after(offsets_px: list[float]) -> DriftState:
        now = state
        for offset_px in offsets_px:
            now = now.after(track_with(offset_px, rig, at_mm), rig, parameters)
        return now

    state = after([0.5] * 10)
    assert state.has_moved
    # Tips that scatter by more than they are off would not have raised it, and do not end it.
    state = after([-1.0, 1.4] * 5)
    assert state.has_moved
    state = after([0.05] * 10)
    assert not state.has_moved
