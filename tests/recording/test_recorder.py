"""The recorder: what is offered is on the disk, and nothing that the disk does holds anybody up."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.recording.small_recording import SIZE_PX, image_of, small_rig

from needletrack.errors import RecordingError
from needletrack.publish.message import Instant, RunContext, Source, TrackMessage
from needletrack.recording import recorder as recorder_module
from needletrack.recording.mcap_file import About, McapRecording, PairWriter, recover
from needletrack.recording.recorder import Recorder, RecorderSettings
from needletrack.records import Clock, Frame, NeedleTrack, Reason, StampPlace, Status, StereoPair

MS = 1_000_000
ABOUT = About(rig=small_rig(), name="small", config="{}")
# Only a hang takes so long.
WAIT_S = 60.0


def pair(number: int) -> StereoPair:
    stamp = 1_000 * MS + number * 10 * MS
    frames = Frame(image_of(stamp), stamp), Frame(image_of(stamp + 1), stamp + 5_000)
    place = StampPlace.START_OF_EXPOSURE
    return StereoPair(*frames, sequence=number, clock=Clock.MONOTONIC, exposure_ns=2 * MS, stamp_at=place)


def message(of: StereoPair) -> tuple[NeedleTrack, TrackMessage]:
    track = NeedleTrack(of.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))
    run = RunContext("small", Source.LIVE, "c" * 12, "d" * 12)
    return track, TrackMessage.from_track(track, of, run, dropped={}, published=Instant.now())


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def test_pairs_and_tracks_are_in_the_file(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    messages = []
    with Recorder(RecorderSettings(tmp_path, file), ABOUT, SIZE_PX) as recorder:
        for number in range(20):
            offered = pair(number)
            assert recorder.offer(offered)
            track, told = message(offered)
            messages.append(told)
            recorder.take(offered, track, told)
    assert (recorder.offered, recorder.recorded, recorder.dropped) == (20, 20, 0)
    assert (recorder.state.pairs, recorder.state.error) == (20, None)
    recording = McapRecording(file)
    assert [told for _, told in recording.tracks()] == [told.to_json() for told in messages]
    for number in range(20):
        read, offered = recording.read(number), pair(number)
        assert np.array_equal(read.left.image, offered.left.image)
        assert np.array_equal(read.right.image, offered.right.image)
        assert (read.captured_at_ns, read.skew_us) == (offered.captured_at_ns, 5.0)
    about = recording.about
    assert (about.clock, about.exposure_ns, about.stamp_at) == (Clock.MONOTONIC, 2 * MS, StampPlace.START_OF_EXPOSURE)


def test_a_recorder_that_does_not_keep_up_costs_counted_pairs_and_no_time(tmp_path: Path) -> None:
    rig = small_rig((2000, 1500))
    picture = np.zeros((1500, 2000), np.uint8)
    big = StereoPair(Frame(picture, 1), Frame(picture, 1), 0)
    # Memory for the least number of pairs, four.
    settings = RecorderSettings(tmp_path, tmp_path / "r.mcap", buffer_mb=16)
    with Recorder(settings, replace(ABOUT, rig=rig), (2000, 1500)) as recorder:
        assert recorder.pid is not None
        os.kill(recorder.pid, signal.SIGSTOP)
        taken = [recorder.offer(big) for _ in range(10)]
        os.kill(recorder.pid, signal.SIGCONT)
        wait_for(lambda: recorder.offer(big))
    assert taken == [True] * 4 + [False] * 6
    assert recorder.offered == recorder.recorded + recorder.dropped
    assert recorder.recorded == len(McapRecording(tmp_path / "r.mcap"))


def killed(recorder: Recorder) -> None:
    """Kill the writing process, and wait until that is noticed."""
    pid = recorder.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: recorder.pid != pid)


def test_after_a_recorder_that_is_killed_another_goes_on_in_a_new_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file, numbers = tmp_path / "r.mcap", count()
    with Recorder(RecorderSettings(tmp_path, file), ABOUT, SIZE_PX) as recorder:

        def recorded() -> bool:
            offered = pair(next(numbers))
            taken = recorder.offer(offered)
            recorder.take(offered, *message(offered))
            return taken

        # These are on the disk, as nothing follows at once; those that follow are in an unfinished chunk.
        assert all(recorded() for _ in range(5))
        wait_for(lambda: file.exists() and file.stat().st_size > 6000)
        wait_for(lambda: recorded() and recorder.state.kept >= 5)
        kept = recorder.state.kept
        killed(recorder)
        assert not recorded()
        assert "the recording process was killed by SIGKILL" in str(recorder.state.error)
        assert not recorder.state.is_open
        wait_for(recorded)
        assert all(recorded() for _ in range(5))
    assert (recorder.state.error, recorder.state.file) == (None, str(tmp_path / "r-1.mcap"))
    assert "recording goes on" in caplog.text
    # Each pair is in one of the files, or is counted as dropped.
    saved, second = tmp_path / "saved.mcap", McapRecording(tmp_path / "r-1.mcap")
    assert recover(file, saved).pairs == len(McapRecording(saved)) == kept
    assert recorder.recorded == recorder.state.pairs == kept + len(second)
    assert recorder.offered == recorder.recorded + recorder.dropped == next(numbers)
    assert recorder.dropped > 0
    assert len(second.tracks()) == len(second) >= 6
    assert second.about.exposure_ns == 2 * MS


def test_a_recorder_that_is_killed_again_and_again_is_started_more_and_more_rarely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_RETRY_AFTER_S", 1000.0)
    monkeypatch.setattr(recorder_module, "_RETRY_WITHIN_S", 1000.0)
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX, begun=False) as recorder:
        killed(recorder)
        wait_for(lambda: recorder.pid is not None)
        killed(recorder)
        # Not before its time, and whoever wants to record is told.
        time.sleep(0.5)
        assert recorder.pid is None
        assert recorder.begin()
        assert not recorder.offer(pair(0))
        assert "SIGKILL" in str(recorder.state.error)
    assert (recorder.offered, recorder.recorded, recorder.dropped) == (1, 0, 1)


def test_a_recorder_that_cannot_be_started_again_is_told_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_RETRY_AFTER_S", 0.05)
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX) as recorder:

        def no_process(*unused: object) -> None:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

        with monkeypatch.context() as short_of_processes:
            short_of_processes.setattr(recorder_module, "_Writing", no_process)
            killed(recorder)
            wait_for(lambda: os.strerror(errno.EAGAIN) in str(recorder.state.error))
            assert not recorder.offer(pair(0))
        wait_for(lambda: recorder.offer(pair(1)))
    assert recorder.recorded == 1


def test_a_recorder_can_be_closed_whatever_becomes_of_its_process(tmp_path: Path) -> None:
    for wait_s in (0.0, 0.01, 0.3):
        recorder = Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX)
        recorder.offer(pair(0))
        assert recorder.pid is not None
        os.kill(recorder.pid, signal.SIGKILL)
        time.sleep(wait_s)
        recorder.close()
        assert recorder.offered == recorder.recorded + recorder.dropped == 1
        assert multiprocessing.active_children() == []


RECORD = """
import sys, time
from pathlib import Path
from tests.recording.test_recorder import ABOUT, SIZE_PX, pair
from needletrack.recording.recorder import Recorder, RecorderSettings
if __name__ == "__main__":
    recorder = Recorder(RecorderSettings(Path(sys.argv[1]), Path(sys.argv[1]) / "r.mcap"), ABOUT, SIZE_PX)
    count = int(sys.argv[2])
    for number in range(count):
        while not recorder.offer(pair(number % 50)):
            time.sleep(0.01)
    while recorder.recorded < count:
        recorder._collect(recorder._writing, 0.1)
    print(recorder.pid, flush=True)
    time.sleep(600)
"""


@contextmanager
def recorded_by_another(tmp_path: Path, count: int) -> Iterator[int]:
    """A process that has recorded so many pairs and goes on; gives the id of its writing process; killed at the end."""
    script = tmp_path / "record.py"
    script.write_text(RECORD)
    with subprocess.Popen(
        [sys.executable, script, tmp_path, str(count)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    ) as process:
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline())
        finally:
            process.kill()


def test_after_a_sigkill_of_both_nothing_but_the_unwritten_tail_is_lost(tmp_path: Path) -> None:
    with recorded_by_another(tmp_path, 2000) as writing:
        os.kill(writing, signal.SIGKILL)
    # A chunk of 8 MB holds 1300 of these small pairs.
    assert recover(tmp_path / "r.mcap", tmp_path / "saved.mcap").pairs >= 2000 - 1366


def test_after_a_sigkill_of_the_daemon_alone_the_file_is_finished(tmp_path: Path) -> None:
    def is_whole() -> bool:
        try:
            return len(McapRecording(tmp_path / "r.mcap")) == 100
        except RecordingError:
            return False

    with recorded_by_another(tmp_path, 100):
        assert not is_whole()
    # The writing process notices.
    wait_for(is_whole)


def test_a_disk_with_too_little_space_pauses_before_the_first_pair(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording\.min_free_mb is 1000000000: free some space"):
        Recorder(RecorderSettings(tmp_path, min_free_mb=10**9), ABOUT, SIZE_PX)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_an_error_of_the_disk_pauses_and_a_new_file_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    files = recorder_module._Files(RecorderSettings(tmp_path, min_free_mb=0), ABOUT)
    faults: list[OSError] = []
    usual = PairWriter.add_pair

    def add_pair(self: Any, *arguments: Any) -> None:
        if faults:
            raise faults[0]
        usual(self, *arguments)

    monkeypatch.setattr(PairWriter, "add_pair", add_pair)
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def add(n: int) -> bool:
        command = recorder_module._Pair(0, n, n * MS, n * MS, None)
        return files.add_pair(command, image_of(n), image_of(n))

    assert add(0)
    faults.append(OSError(number, os.strerror(number)))
    assert not add(1)
    assert os.strerror(number) in str(files.state.error)
    faults.clear()
    assert not add(2), "it is tried again after a while, not with every pair"
    now[0] += 6
    assert add(3)
    assert files.state.error is None
    files.finish()
    first, second = sorted(tmp_path.glob("small-*.mcap"))
    assert len(McapRecording(second)) == 1
    with pytest.raises(RecordingError, match="recover"):
        McapRecording(first)


def test_a_new_file_after_so_many_megabytes(tmp_path: Path) -> None:
    settings = RecorderSettings(tmp_path, tmp_path / "r.mcap", min_free_mb=0, max_file_mb=16)
    picture = np.random.default_rng(0).integers(0, 256, (1024, 1280), dtype=np.uint8)
    big = StereoPair(Frame(picture, 1), Frame(picture, 1), 0)
    with Recorder(settings, replace(ABOUT, rig=small_rig((1280, 1024))), (1280, 1024)) as recorder:
        for _ in range(20):
            wait_for(lambda: recorder.offer(big))
    files = [McapRecording(tmp_path / name) for name in ("r.mcap", "r-1.mcap", "r-2.mcap")]
    assert sum(map(len, files)) == 20 == recorder.state.pairs
    assert max(file.folder.stat().st_size for file in files) < 28e6


def test_what_cannot_be_written_is_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "there.mcap").touch()
    with pytest.raises(RecordingError, match="nothing is overwritten"):
        Recorder(RecorderSettings(tmp_path, tmp_path / "there.mcap"), ABOUT, SIZE_PX)
    with pytest.raises(RecordingError, match="make it first"):
        Recorder(RecorderSettings(tmp_path, tmp_path / "no" / "r.mcap"), ABOUT, SIZE_PX)
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"recording\.folder"):
        Recorder(RecorderSettings(tmp_path / "file"), ABOUT, SIZE_PX)


def test_an_idle_recorder_has_everything_on_the_disk(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    with Recorder(RecorderSettings(tmp_path, file), ABOUT, SIZE_PX) as recorder:
        recorder.offer(pair(0))
        wait_for(lambda: file.exists() and file.stat().st_size > 6000)
        assert recover(file, tmp_path / "saved.mcap").pairs == 1


def tracked(recorder: Recorder, number: int) -> TrackMessage:
    offered = pair(number)
    recorder.offer(offered)
    track, told = message(offered)
    recorder.take(offered, track, told)
    return told


def test_begun_and_ended_at_will_each_recording_is_a_file_of_its_own(tmp_path: Path) -> None:
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX, begun=False) as recorder:
        assert not recorder.begun
        tracked(recorder, 0)
        assert list(tmp_path.glob("*.mcap")) == []
        assert not recorder.end(WAIT_S)
        kept = []
        for first in (1, 11):
            assert recorder.begin()
            assert not recorder.begin()
            kept.append([tracked(recorder, number) for number in range(first, first + 5)])
            assert recorder.end(WAIT_S)
            # Finished: readable by its index while the daemon goes on.
            assert len(McapRecording(Path(recorder.state.file))) == 5
            assert (recorder.begun, recorder.state.is_open) == (False, False)
            tracked(recorder, first + 5)
        assert (recorder.offered, recorder.recorded, recorder.dropped) == (10, 10, 0)
    files = sorted(tmp_path.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    assert len(files) == 2
    for file, messages in zip(files, kept, strict=True):
        recording = McapRecording(file)
        assert [told for _, told in recording.tracks()] == [told.to_json() for told in messages]
        assert recording.about.exposure_ns == 2 * MS


def test_an_end_waits_for_the_tracks_of_its_last_pairs(tmp_path: Path) -> None:
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX) as recorder:
        offered = pair(0)
        recorder.offer(offered)
        track, told = message(offered)
        late = threading.Timer(0.05, recorder.take, (offered, track, told))
        late.start()
        assert recorder.end(WAIT_S)
        late.join()
        assert [line for _, line in McapRecording(Path(recorder.state.file)).tracks()] == [told.to_json()]


def test_what_a_file_says_of_itself_can_change_on_the_way(tmp_path: Path) -> None:
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX) as recorder:
        tracked(recorder, 0)
        recorder.renew(replace(ABOUT, config='{"another": 1}'))
        tracked(recorder, 1)
    files = sorted(tmp_path.glob("*.mcap"), key=lambda file: file.name.rsplit("-", 1)[1])
    assert [McapRecording(file).about.config for file in files] == ["{}", '{"another": 1}']
    assert [len(McapRecording(file)) for file in files] == [1, 1]


def test_an_end_of_a_recorder_that_is_gone_is_told(tmp_path: Path) -> None:
    with Recorder(RecorderSettings(tmp_path), ABOUT, SIZE_PX) as recorder:
        tracked(recorder, 0)
        assert recorder.pid is not None
        os.kill(recorder.pid, signal.SIGKILL)
        with pytest.raises(RecordingError, match="the recording process has ended"):
            recorder.end(WAIT_S)
