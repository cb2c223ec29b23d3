"""Trackers with a second process beside them: one comes in another's place, and none of the processes is left."""

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.process import BaseProcess

import numpy as np
import pytest
from tests.recording.small_recording import SIZE_PX, small_rig

from needletrack.auditing import AuditedTracker
from needletrack.config import Config
from needletrack.records import Frame, Status, StereoPair

PARAMETERS = Config().tracking
WAIT_S = 30.0


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

    with Told(rig, PARAMETERS) as first, ThreadPoolExecutor(1, "tracking") as tracking:
        assert tracking.submit(first, empty(), None).result(WAIT_S).status is Status.INVALID
        second = Told(rig, PARAMETERS, after=first).__enter__()
        # Nobody called the second one before there was a third.
        third = Told(rig, PARAMETERS, after=second).__enter__()
        assert (len(second_processes()), threads) == (3, [])
        assert tracking.submit(third, empty(1), None).result(WAIT_S).status is Status.INVALID
        assert threads == ["tracking_0"] * 2
        assert len(second_processes()) == 1
        third.close()
        assert second_processes() == set()
        third.close()


def test_one_that_was_never_called_closes_those_before() -> None:
    rig = small_rig()
    first = AuditedTracker(rig, PARAMETERS).__enter__()
    second = AuditedTracker(rig, PARAMETERS, after=first).__enter__()
    assert len(second_processes()) == 2
    second.close()
    assert second_processes() == set()


@pytest.mark.parametrize("waits", [True, False])
def test_a_second_process_that_dies_as_it_starts_ends_no_tracking(waits: bool) -> None:
    with AuditedTracker(small_rig(), PARAMETERS) as tracker:
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
