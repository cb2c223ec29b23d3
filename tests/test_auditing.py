"""Following in this process, audits in another: what is found there is gone on from here."""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.process import BaseProcess

import numpy as np
import pytest
from tests.recording.small_recording import SIZE_PX, small_rig
from tests.tracking.scenes import RIG, WORLDS, Scene, scene, seen_at

from needletrack.auditing import AuditedTracker
from needletrack.records import Frame, NeedleTrack, Status, StereoPair
from needletrack.rig import Rig
from needletrack.scoring import TrueShape, score
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import track_pair

STEP_NS = 16_666_667
WAIT_S = 20.0
P = TrackingParameters()


def the_rig() -> Rig:
    return Rig(name="drawn", left=RIG.left, right=RIG.right, right_from_left=RIG.right_from_left)


def numbered(shown: Scene, number: int) -> StereoPair:
    left, right = (Frame(frame.image, number * STEP_NS) for frame in (shown.pair.left, shown.pair.right))
    return StereoPair(left, right, number)


class Sequence:
    """Pairs one after another through one tracker, at the pace at which cameras would give them."""

    def __init__(self, tracker: AuditedTracker) -> None:
        self._tracker, self._number = tracker, 0
        self.track: NeedleTrack | None = None

    def see(self, shown: Scene) -> NeedleTrack:
        self.track = self._tracker(numbered(shown, self._number), self.track)
        self._number += 1
        time.sleep(STEP_NS * 1e-9)
        return self.track

    def see_until(self, shown: Scene, wanted: Status) -> int:
        """How many pairs it takes until a track is of that status."""
        until_s = time.monotonic() + WAIT_S
        for count in range(1, 10_000):
            if self.see(shown).status is wanted:
                return count
            assert time.monotonic() < until_s
        raise AssertionError


def test_out_of_its_context_it_is_the_plain_tracker() -> None:
    tracker = AuditedTracker(the_rig(), P)
    first = tracker(scene("dark").pair, None)
    assert first.curve is not None
    plain = track_pair(scene("dark").pair, the_rig(), P)
    assert plain.curve is not None
    np.testing.assert_array_equal(first.curve.points_mm, plain.curve.points_mm)


def test_what_is_followed_is_audited_beside_it() -> None:
    with AuditedTracker(the_rig(), P) as tracker:
        tracker.warm_up()
        pairs = Sequence(tracker)
        since: list[int] = []
        until_s = time.monotonic() + WAIT_S
        while (len(since) < 3 or since[-1] > since[-2]) and time.monotonic() < until_s:
            track = pairs.see(scene("dark"))
            assert track.status is Status.OK
            # No search of whole images here, but for the first pair.
            assert ("segment" in track.timing_ms) == (not since)
            since.append(track.since_detection)
        assert since[-1] <= since[-2], "no audit came back"
        assert tracker.failures == 0


def test_a_needle_that_is_hidden_moves_and_is_uncovered_is_found_again() -> None:
    nothing = seen_at(replace(WORLDS["dark"], needle=None))
    needle = replace(WORLDS["dark"].needle, base_mm=(-22.0, -30.0, 238.0))  # type: ignore[type-var]
    elsewhere = seen_at(replace(WORLDS["dark"], needle=needle))
    with AuditedTracker(the_rig(), P) as tracker:
        tracker.warm_up()
        pairs = Sequence(tracker)
        assert pairs.see(scene("dark")).status is Status.OK
        for _ in range(5):
            # What nobody sees is never called good.
            assert pairs.see(nothing).status is Status.INVALID
        pairs.see_until(elsewhere, Status.OK)
        assert pairs.track is not None
        assert score(pairs.track, TrueShape.drawn(elsewhere.truth)).tip_mm == pytest.approx(0.0, abs=0.15)


def test_a_needle_that_comes_back_where_it_was_needs_no_search() -> None:
    nothing = seen_at(replace(WORLDS["dark"], needle=None))
    with AuditedTracker(the_rig(), P) as tracker:
        pairs = Sequence(tracker)
        assert pairs.see(scene("dark")).status is Status.OK
        assert pairs.see(nothing).status is Status.INVALID
        assert pairs.see(scene("dark")).status is Status.OK


def test_when_the_other_process_dies_tracking_goes_on() -> None:
    with AuditedTracker(the_rig(), P) as tracker:
        tracker.warm_up()
        pairs = Sequence(tracker)
        pairs.see(scene("dark"))
        assert tracker.pid is not None
        os.kill(tracker.pid, signal.SIGKILL)
        until_s = time.monotonic() + WAIT_S
        while tracker.failures == 0 and time.monotonic() < until_s:
            assert pairs.see(scene("dark")).status is Status.OK
        assert tracker.failures == 1
        assert pairs.see(scene("dark")).status is Status.OK


def second_processes() -> set[BaseProcess]:
    return {process for process in multiprocessing.active_children() if process.name == "needletrack-audit"}


def empty(number: int = 0) -> StereoPair:
    frame = Frame(np.zeros(SIZE_PX[::-1], np.uint8), number * 10_000_000)
    return StereoPair(frame, frame, number)


def test_the_one_before_is_closed_by_who_calls_the_next_one_first() -> None:
    rig, threads = small_rig(), []

    class Told(AuditedTracker):
        def close(self) -> None:
            threads.append(threading.current_thread().name)
            super().close()

    with Told(rig, P) as first, ThreadPoolExecutor(1, "tracking") as tracking:
        assert tracking.submit(first, empty(), None).result(WAIT_S).status is Status.INVALID
        second = Told(rig, P, after=first).__enter__()
        # Nobody called the second one before there was a third.
        third = Told(rig, P, after=second).__enter__()
        assert (len(second_processes()), threads) == (3, [])
        assert tracking.submit(third, empty(1), None).result(WAIT_S).status is Status.INVALID
        assert threads == ["tracking_0"] * 2
        assert len(second_processes()) == 1
        third.close()
        assert second_processes() == set()
        third.close()


def test_one_that_was_never_called_closes_those_before() -> None:
    rig = small_rig()
    first = AuditedTracker(rig, P).__enter__()
    second = AuditedTracker(rig, P, after=first).__enter__()
    assert len(second_processes()) == 2
    second.close()
    assert second_processes() == set()


@pytest.mark.parametrize("waits", [True, False])
def test_a_second_process_that_dies_as_it_starts_ends_no_tracking(waits: bool) -> None:
    with AuditedTracker(small_rig(), P) as tracker:
        (process,) = second_processes()
        process.kill()
        process.join(WAIT_S)
        if waits:
            assert tracker.warm_up()
        track = None
        for number in range(10):
            track = tracker(empty(number), track)
        assert track is not None
        assert track.status is Status.INVALID
        assert tracker.failures == 1
    assert second_processes() == set()
