"""The score against tracks whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from needletrack.geometry.transform import orientation_along
from needletrack.records import BasePose, Float, NeedleCurve, NeedleTrack, Reason, Status, TipPose
from needletrack.scoring import Summary, TrueShape, score

# A needle along the optical axis, whose every millimetre both cameras see.

LINE_MM = np.column_stack([np.zeros((121, 2)), np.linspace(220.0, 280.0, 121)])
ALONG = np.array([0.0, 0.0, 1.0])
TRUE = TrueShape(LINE_MM, ALONG, np.ones(121, np.bool_))


def curve(points_mm: Float) -> NeedleCurve:
    n = len(points_mm)
    return NeedleCurve(points_mm, np.full(n, 0.25), np.full(n, 2), np.zeros(n), 60.0)


def answer(points_mm: Float, status: Status = Status.OK) -> NeedleTrack:
    direction = points_mm[-1] - points_mm[-2]
    direction = direction / np.linalg.norm(direction)
    return NeedleTrack(
        0,
        status,
        () if status is Status.OK else (Reason.HIGH_RESIDUAL,),
        curve(points_mm),
        TipPose(points_mm[-1], direction, orientation_along(direction), np.eye(3), None, 2),
        BasePose(points_mm[0], direction),
    )


def moved(by_mm: float) -> Float:
    return np.asarray(LINE_MM + np.array([by_mm, 0.0, 0.0]))


def test_the_truth_scores_nought() -> None:
    exact = score(answer(LINE_MM), TRUE)
    assert (exact.rms_mm, exact.worst_mm, exact.tip_mm, exact.cover) == (0.0, 0.0, 0.0, 1.0)
    assert (exact.direction_deg, exact.turned, exact.false_ok) == (0.0, False, False)


def test_a_shift_is_scored_as_long_as_it_is() -> None:
    shifted = score(answer(moved(0.6)), TRUE)
    assert shifted.rms_mm == pytest.approx(0.6)
    assert shifted.tip_mm == pytest.approx(0.6)
    assert shifted.off_in_sigmas is not None
    np.testing.assert_allclose(shifted.off_in_sigmas, 0.6 / 0.25)
    assert not shifted.false_ok
    assert Summary.of([shifted]).within_two_sigma == 0.0
    assert Summary.of([score(answer(moved(0.4)), TRUE)]).within_two_sigma == 1.0


@pytest.mark.parametrize(
    "points_mm",
    [
        moved(1.1),
        LINE_MM[::-1],
        LINE_MM[30:],
        LINE_MM[:-3],
        LINE_MM + np.outer(np.arange(121) < 8, [0.0, 3.0, 0.0]),
    ],
    ids=["shifted", "turned", "a quarter not covered", "tip 1.5 mm short", "6 % bent away"],
)
def test_what_would_mislead_a_robot_is_a_false_ok(points_mm: Float) -> None:
    assert score(answer(points_mm), TRUE).false_ok
    assert not score(answer(points_mm, Status.DEGRADED), TRUE).false_ok


def test_a_weak_track_that_is_believed_is_judged_like_an_ok_one() -> None:
    far, near = (score(answer(moved(by_mm), Status.DEGRADED), TRUE) for by_mm in (1.1, 0.4))
    assert far.misleads
    assert far.believed().false_ok
    assert not near.believed().false_ok
    assert Summary.of([far.believed(), near.believed()]).ok == 2
    assert score(replace(answer(LINE_MM, Status.DEGRADED), tip=None), TRUE).believed().false_ok
    assert score(answer(LINE_MM, Status.DEGRADED), TrueShape.none()).believed().false_ok
    nothing = score(NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,)), TRUE)
    assert nothing.believed() is nothing


def test_anything_ok_without_a_needle_is_false() -> None:
    assert score(answer(LINE_MM), TrueShape.none()).false_ok
    assert not score(NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,)), TrueShape.none()).false_ok
    assert not score(NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,)), TRUE).false_ok


def test_a_tip_that_one_camera_does_not_see_is_not_scored_but_may_mislead() -> None:
    unseen = replace(TRUE, seen=np.arange(121) < 118)
    short = score(answer(LINE_MM[:-4]), unseen)
    assert short.tip_mm is None
    assert short.cover == 1.0
    assert short.false_ok


def test_what_is_summed_up_goes_by_status() -> None:
    weak = score(answer(moved(0.9), Status.DEGRADED), TRUE)
    weaker = score(answer(moved(3.0), Status.DEGRADED), TRUE)
    none = score(NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,)), TRUE)
    good, fair = score(answer(moved(0.2)), TRUE), score(answer(moved(0.4)), TRUE)
    summary = Summary.of([good, fair, weak, weaker, none])
    assert (summary.frames, summary.ok, summary.degraded, summary.invalid, summary.false_ok) == (5, 2, 2, 1, 0)
    assert summary.rms_mm == pytest.approx(0.3)
    assert summary.tip_mm == pytest.approx(0.3)
    assert summary.tip_p95_mm == pytest.approx(0.39)
    assert summary.worst_p95_mm == pytest.approx(0.39)
    assert (summary.direction_deg, summary.cover) == (0.0, 1.0)
    assert summary.degraded_rms_mm == pytest.approx(1.95)
    assert summary.degraded_cover == pytest.approx(0.5)


def test_sigmas_are_a_median_of_medians_and_their_points_are_pooled() -> None:
    stated = np.linspace(0.1, 0.5, 121)
    first = score(replace(answer(moved(0.4)), curve=replace(curve(moved(0.4)), sigma_mm=stated)), TRUE)
    second = score(answer(moved(0.2)), TRUE)
    assert first.sigma_mm == pytest.approx(0.3)
    summary = Summary.of([first, second])
    assert summary.sigma_mm == pytest.approx((0.3 + 0.25) / 2)
    # Of the first track those points are within twice their sigma that state 0.2 mm or more.
    assert summary.within_two_sigma == pytest.approx(((stated >= 0.2).sum() + 121) / 242)


def test_what_no_track_tells_is_no_number() -> None:
    summary = Summary.of([score(NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,)), TRUE)])
    assert np.isnan([summary.rms_mm, summary.tip_mm, summary.tip_p95_mm, summary.direction_deg]).all()
    assert np.isnan([summary.cover, summary.within_two_sigma, summary.sigma_mm, summary.degraded_rms_mm]).all()
