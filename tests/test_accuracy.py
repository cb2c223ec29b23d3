"""Tracks of the bundled recordings against their exact truth."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import Evidence, NeedleCurve, NeedleTrack, Status, StereoPair
from needletrack.scoring import Score, Summary, recorded_truth, score
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import audit, track_pair

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


@dataclass(frozen=True)
class Bounds:
    """What a recording's tracks must keep to, mm: 1.3 to 1.5 times what they do.

    least_ok: tracks called ok. rms_mm: median of the curves of ok tracks; worst_mm: the largest of their 95th
    percentiles; tip_mm: median of their tips; worst_tip_mm: the largest. degraded_rms_mm: median of the degraded ones.
    """

    least_ok: int
    rms_mm: float = np.inf
    worst_mm: float = np.inf
    tip_mm: float = np.inf
    worst_tip_mm: float = np.inf
    degraded_rms_mm: float = np.inf


# Each pair alone, but for the sequences. lab-a is the setting of the 2017 paper: a dark needle on white, a white one on
# dark; there every pair has to be ok.
SEQUENCES = ("steer-b",)
BOUNDS = {
    "lab-a": Bounds(5, rms_mm=0.055, worst_mm=0.28, tip_mm=0.14, worst_tip_mm=0.4),
    "steel-a": Bounds(2, rms_mm=0.047, worst_mm=0.085, tip_mm=0.14, worst_tip_mm=0.15),
    "tissue-a": Bounds(1, rms_mm=0.12, worst_mm=0.2, tip_mm=0.3, worst_tip_mm=0.3, degraded_rms_mm=0.16),
    "hard-a": Bounds(1, rms_mm=0.075, worst_mm=0.11, tip_mm=0.2, worst_tip_mm=0.2, degraded_rms_mm=0.14),
    "steer-b": Bounds(9, rms_mm=0.35, worst_mm=0.85, tip_mm=0.23, worst_tip_mm=0.55, degraded_rms_mm=0.3),
}


def summary(name: str) -> Summary:
    return Summary.of(scores(name, independent=name not in SEQUENCES))


def largest(values: Iterable[float | None]) -> float:
    return max((value for value in values if value is not None), default=0.0)


@pytest.mark.parametrize("name", BOUNDS)
def test_as_many_pairs_are_ok_as_ever(name: str) -> None:
    found = tracked(name, independent=name not in SEQUENCES)
    assert summary(name).ok >= BOUNDS[name].least_ok, [track.reasons for track, _ in found]


@pytest.mark.parametrize("name", BOUNDS)
def test_accuracy_is_kept(name: str) -> None:
    bounds, all_together = BOUNDS[name], summary(name)
    ok = [one for one in scores(name, independent=name not in SEQUENCES) if one.status is Status.OK]
    # Where there is nothing to sum up it is nan, which exceeds no bound.
    assert not all_together.rms_mm > bounds.rms_mm
    assert not all_together.tip_mm > bounds.tip_mm
    assert not all_together.degraded_rms_mm > bounds.degraded_rms_mm
    assert largest(one.worst_mm for one in ok) <= bounds.worst_mm
    assert largest(one.tip_mm for one in ok) <= bounds.worst_tip_mm


@pytest.mark.parametrize("name", BOUNDS)
def test_ok_tracks_cover_the_needle_and_know_how_good_they_are(name: str) -> None:
    all_together = summary(name)
    if all_together.ok:
        assert all_together.cover >= 0.95
        # A Gaussian of two dimensions whose larger sigma is stated is within twice that in 86 % to 95 % of all cases;
        # the errors of one needle are alike.
        assert all_together.within_two_sigma >= 0.8


def test_white_needles_of_the_lab_are_not_where_their_saturated_picture_is() -> None:
    # As wide as the picture shows them their diameters are 0.23 mm and more too large, their tips up to 0.29 mm out.
    found = tracked("lab-a")
    for pair, diameter_mm in {0: 0.708, 2: 0.953, 3: 1.098}.items():
        track, one = found[pair]
        assert track.diameter_mm == pytest.approx(diameter_mm, abs=0.08)
        assert one.tip_mm is not None
        assert one.tip_mm < 0.15
    assert np.median([found[pair][1].rms_mm for pair in (0, 2, 3)]) < 0.05


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


def test_a_needle_that_is_pushed_and_drawn_back_again_and_again_misleads_no_one() -> None:
    # Drawn back, with a glint behind its tip, it was called ok 1.8 to 2.4 mm short in 3 of 48 tracks. Now 53 of 61 are
    # ok, and the worst is 0.54 mm off.
    recording = AslRecording(RECORDINGS / "steer-b")
    truth = recorded_truth(RECORDINGS / "steer-b")
    pairs = list(ReplaySource(recording).pairs(Event()))
    assert len(pairs) == 16
    forward, backward = list(range(16)), list(range(14, -1, -1))
    found: list[tuple[NeedleTrack, Score]] = []
    previous = None
    for number, index in enumerate([*forward, *backward, *forward[1:], *backward]):
        pair, stamp_ns = pairs[index], number * 33_333_333
        left, right = (replace(frame, captured_at_ns=stamp_ns) for frame in (pair.left, pair.right))
        previous = track_pair(StereoPair(left, right, number), recording.rig, None, previous)
        found.append((previous, score(previous, truth[pair.captured_at_ns])))
    tips_mm = [one.tip_mm for track, one in found if track.status is Status.OK and one.tip_mm is not None]
    assert [one for _, one in found if one.false_ok] == []
    assert len(tips_mm) > 40
    assert max(tips_mm) < 0.8
    assert np.median(tips_mm) < 0.23


@pytest.mark.parametrize("cut_mm", [4, 9])
@pytest.mark.parametrize("name", ["steer-b", "hard-a"])
def test_an_audit_confirms_no_needle_that_was_followed_to_less_than_its_tip(name: str, cut_mm: int) -> None:
    # Within its reach it found what looks like a tip, held by where the tip was believed to be: 9 of 340 were called ok
    # 1.1 to 2.4 mm short.
    recording = AslRecording(RECORDINGS / name)
    truth = recorded_truth(RECORDINGS / name)
    for pair, (track, _) in list(zip(ReplaySource(recording).pairs(Event()), tracked(name), strict=True))[::3]:
        if track.curve is None:
            continue
        curve = track.curve
        shown = slice(len(curve.points_mm) - cut_mm)
        short = NeedleCurve(
            curve.points_mm[shown],
            curve.sigma_mm[shown],
            curve.seen[shown],
            curve.curvature_per_mm[shown],
            curve.length_mm - cut_mm,
        )
        tip = None if track.tip is None else replace(track.tip, position_mm=short.points_mm[-1])
        followed = replace(track, curve=short, tip=tip, evidence=Evidence())
        audited = audit(pair, recording.rig, TrackingParameters(), followed)
        assert not score(audited, truth[pair.captured_at_ns]).false_ok, pair.captured_at_ns


@pytest.mark.slow
def test_frames_of_a_sequence_alone_mislead_no_more() -> None:
    assert {track.captured_at_ns for track, _ in tracked("steer-b")} == stamps("steer-b")
    assert [one for one in scores("steer-b") if one.false_ok] == []
