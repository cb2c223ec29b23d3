"""Tracks of the bundled recordings against their exact truth; and the score against tracks whose errors are known."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from needletrack.geometry.transform import orientation_along
from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import BasePose, Float, NeedleCurve, NeedleTrack, Reason, Status, TipPose
from needletrack.scoring import Score, Summary, TrueShape, recorded_truth, score
from needletrack.tracking.track import track_pair

RECORDINGS = Path(__file__).parent / "data" / "recordings"
STILLS = ("lab-a", "absent-a", "steel-a", "tissue-a", "hard-a")


def tracked(name: str, *, independent: bool = True) -> tuple[tuple[NeedleTrack, Score], ...]:
    """Every pair of a recording, tracked and scored once; independent: each without memory of the one before."""
    return _tracked(name, independent)


@cache
def _tracked(name: str, independent: bool) -> tuple[tuple[NeedleTrack, Score], ...]:
    recording = AslRecording(RECORDINGS / name)
    truth = recorded_truth(RECORDINGS / name)
    found: list[tuple[NeedleTrack, Score]] = []
    previous = None
    for pair in ReplaySource(recording).pairs(Event()):
        track = track_pair(pair, recording.rig, None, previous)
        found.append((track, score(track, truth[pair.captured_at_ns])))
        previous = None if independent else track
    return tuple(found)


def scores(name: str, *, independent: bool = True) -> list[Score]:
    return [one for _, one in tracked(name, independent=independent)]


def stamps(name: str) -> set[int]:
    return set(recorded_truth(RECORDINGS / name))


# What this project owes on the setting of the 2017 paper: a dark needle on white, a white one on dark.


def test_lab_is_ok_in_every_pair() -> None:
    assert [(track.status, track.reasons) for track, _ in tracked("lab-a")] == [(Status.OK, ())] * 5
    assert Summary.of(scores("lab-a")).false_ok == 0


def test_lab_is_accurate() -> None:
    summary = Summary.of(scores("lab-a"))
    assert summary.rms_mm <= 0.15
    assert summary.tip_mm <= 0.5
    assert summary.cover >= 0.95


def test_lab_states_its_own_accuracy() -> None:
    # A Gaussian of two dimensions whose larger sigma is stated is within twice that in 86 % to 95 % of all cases.
    assert Summary.of(scores("lab-a")).within_two_sigma >= 0.8


def test_nothing_is_found_where_no_needle_is() -> None:
    for track, _ in tracked("absent-a"):
        assert track.status is not Status.OK
    assert len(tracked("absent-a")) == 2


@pytest.mark.parametrize("name", STILLS)
def test_every_pair_has_its_track_and_no_ok_one_misleads(name: str) -> None:
    assert {track.captured_at_ns for track, _ in tracked(name)} == stamps(name)
    assert [one for one in scores(name) if one.false_ok] == []


def test_a_sequence_has_its_tracks_and_no_ok_one_misleads() -> None:
    assert {track.captured_at_ns for track, _ in tracked("steer-b", independent=False)} == stamps("steer-b")
    assert [one for one in scores("steer-b", independent=False) if one.false_ok] == []


@pytest.mark.slow
def test_frames_of_a_sequence_alone_mislead_no_more() -> None:
    assert {track.captured_at_ns for track, _ in tracked("steer-b")} == stamps("steer-b")
    assert [one for one in scores("steer-b") if one.false_ok] == []


# The score itself: a needle along the optical axis, whose every millimetre both cameras see.

LINE_MM = np.column_stack([np.zeros((121, 2)), np.linspace(220.0, 280.0, 121)])
ALONG = np.array([0.0, 0.0, 1.0])
TRUE = TrueShape(LINE_MM, ALONG, np.ones(121, np.bool_))


def answer(points_mm: Float, status: Status = Status.OK) -> NeedleTrack:
    n = len(points_mm)
    direction = points_mm[-1] - points_mm[-2]
    direction = direction / np.linalg.norm(direction)
    return NeedleTrack(
        0,
        status,
        () if status is Status.OK else (Reason.HIGH_RESIDUAL,),
        NeedleCurve(points_mm, np.full(n, 0.25), np.full(n, 2), np.zeros(n), 60.0),
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


def test_only_ok_tracks_are_summed_up() -> None:
    weak = score(answer(moved(0.9), Status.DEGRADED), TRUE)
    summary = Summary.of([score(answer(moved(0.2)), TRUE), weak])
    assert summary.ok == 1
    assert summary.rms_mm == pytest.approx(0.2)
