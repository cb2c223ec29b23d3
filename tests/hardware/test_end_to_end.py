"""Frames with known truth → two kernel cameras with our own stamps → daemon → Zenoh → a subscriber outside of it.

The daemon is killed while it records, started again at once, and asked to stop while it records: all in one run, as a
start of Python takes half a minute in the guest.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from tests.hardware.loopback import LEFT, RIGHT, Feed, loopback_nodes

from needletrack.capture.live import CameraState
from needletrack.client import Subscriber
from needletrack.config import load_config
from needletrack.daemon.cameras import both_cameras
from needletrack.daemon.run import ExitCode
from needletrack.errors import RecordingError
from needletrack.geometry.spline import distance_from_curve
from needletrack.publish.message import ServiceState, StatusMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.mcap_file import McapRecording, recover
from needletrack.records import Clock, Frame, Status, StereoPair
from needletrack.replay import Replay, open_recording
from needletrack.scoring import recorded_truth

pytestmark = [
    pytest.mark.skipif(len(loopback_nodes()) < 2, reason="no pair of v4l2loopback devices: run `make test-hardware`"),
    pytest.mark.timeout(900),
]

ROOT = Path(__file__).parents[2]
STEER = ROOT / "tests" / "data" / "recordings" / "steer-b"
ENDPOINT = "tcp/127.0.0.1:7457"
PAIRS, SKEW_US = 3, 250
# The guest's processor is emulated, and a Python process takes half a minute to start: only a hang takes so long.
WAIT_S = 200.0
OF_THE_RUN = ("run_id", "published_at_ns", "timing_ms", "latency_ms", "captured_at_unix_ns", "source", "clock")
CONFIG = """
[rig]
path = "{rig}"
[cameras]
size_px = [{width}, {height}]
rate_hz = ""
clock = "monotonic"
stall_s = 100.0
left = {{ id = "{left}" }}
right = {{ id = "{right}" }}
[publishing]
listen = ["{endpoint}"]
[recording]
folder = "{folder}"
min_free_mb = 0
buffer_mb = 32
[daemon]
metrics_port = 0
"""


def wait_for(condition: Callable[[], object], timeout_s: float = WAIT_S) -> None:
    until_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < until_s, "it never came"
        time.sleep(0.05)


@contextmanager
def daemon(config: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "needletrack", "run", "--config", str(config)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    with subprocess.Popen(command, env=environment, cwd=ROOT) as process:
        try:
            yield process
        finally:
            process.kill()


def recorded(number: int) -> StereoPair:
    """A pair of the bundled recording."""
    return AslRecording(STEER).read(number)


def grey(number: int) -> StereoPair:
    """A pair with nothing in it but a little noise: tracking the first needle takes half a minute in the guest."""
    width, height = AslRecording(STEER).rig.left.size_px
    left, right = np.random.default_rng(number).integers(100, 103, (2, height, width), dtype=np.uint8)
    return StereoPair(Frame(left, 0), Frame(right, 0), number)


def runs(process: psutil.Process) -> bool:
    """Whether it has not ended; one that nobody has waited for has."""
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


@contextmanager
def fed_cameras() -> Iterator["Rig"]:
    """The cameras, plugged in anew: a loopback device gives whoever opens it the last frames of before."""
    rig = AslRecording(STEER).rig
    with ExitStack() as opened:
        left, right = (opened.enter_context(Feed(node, rig.left.size_px)) for node in loopback_nodes()[:2])
        yield Rig((left, right), opened.enter_context(Subscriber(rig.name, [ENDPOINT])))


class Rig:
    """Two fed cameras and a subscriber; `send` feeds a pair and waits for its track."""

    def __init__(self, feeds: tuple[Feed, Feed], subscriber: Subscriber) -> None:
        self._feeds, self._subscriber = feeds, subscriber

    def ready(self, process: "subprocess.Popen[bytes]") -> None:
        """Wait until the daemon says that both cameras were started."""

        def started() -> bool:
            assert process.poll() is None, "the daemon has ended"
            return self._states() == {"starting"}

        wait_for(started)

    def feed(self, pair: StereoPair) -> int:
        """Give both cameras a pair; its left stamp in microseconds."""
        stamp_us = time.monotonic_ns() // 1000
        for feed, frame, late_us in zip(self._feeds, (pair.left, pair.right), (0, SKEW_US), strict=True):
            feed.put(frame.image.tobytes(), stamp_us + late_us)
        return stamp_us

    def send(self, number: int) -> tuple[int, Any]:
        """Feed a pair and wait for its track: the stamp in microseconds, the message."""
        stamp_us = self.feed(recorded(number))
        received = self._subscriber.next(WAIT_S)
        assert received is not None
        return stamp_us, received.message

    def last_status(self) -> StatusMessage:
        """What the daemon said last, once it says no more."""
        assert self._subscriber.wait_until_gone(WAIT_S)
        assert self._subscriber.status is not None
        return self._subscriber.status

    def _states(self) -> set[str]:
        status = self._subscriber.status
        if status is None or status.cameras is None or self._subscriber.health.state == "gone":
            return set()
        return {camera.state for camera in status.cameras.values()}


@dataclass(frozen=True)
class Killed:
    """What was left of a daemon that was killed while it recorded.

    on_disk: pairs that the recorder had given to the kernel; fed: those and the one it was at.
    """

    file: Path
    on_disk: int
    fed: int


@dataclass(frozen=True)
class Stopped:
    """What a daemon did that was asked to stop while it recorded.

    sent: each pair's stamp in microseconds and its message; status: the last one.
    """

    sent: list[tuple[int, Any]]
    code: int
    status: StatusMessage
    file: Path


@dataclass(frozen=True)
class Day:
    """A daemon that is killed, the next one, which is stopped, and a pair from the cameras, opened right after it."""

    config: Path
    killed: Killed
    stopped: Stopped
    opened_again: StereoPair


def size_of_recordings(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.mcap"))


def killed_while_it_records(process: "subprocess.Popen[bytes]", rig: Rig, folder: Path) -> Killed:
    """SIGKILL to a daemon and its recorder: nobody finishes the file. What audits its tracks must end by itself."""
    rig.ready(process)
    for number in range(PAIRS - 1):
        before = size_of_recordings(folder)
        rig.feed(grey(number))
        # Nothing else comes, so that the unfinished chunk goes to the disk.
        wait_for(partial(lambda least: size_of_recordings(folder) > least, before + 100_000))
    (file,) = folder.glob("*.mcap")
    family = psutil.Process(process.pid).children(recursive=True)
    (recorder,) = (child for child in family if any(opened.path == str(file) for opened in child.open_files()))
    assert any(child != recorder and "spawn_main" in " ".join(child.cmdline()) for child in family)
    rig.feed(grey(PAIRS - 1))
    # Stopped, it cannot finish the file when the daemon is gone.
    recorder.suspend()
    process.kill()
    recorder.kill()
    process.wait(WAIT_S)
    wait_for(lambda: not any(map(runs, family)))
    return Killed(file, on_disk=PAIRS - 1, fed=PAIRS)


def stopped_while_it_records(process: "subprocess.Popen[bytes]", rig: Rig, folder: Path, before: Path) -> Stopped:
    """SIGTERM as soon as the last track has come: its pair is still with the recorder."""
    rig.ready(process)
    sent = [rig.send(number) for number in range(PAIRS)]
    process.send_signal(signal.SIGTERM)
    code = process.wait(WAIT_S)
    status = rig.last_status()
    (file,) = (path for path in folder.glob("*.mcap") if path != before)
    return Stopped(sent, code, status, file)


def pair_of_cameras_opened_again(config: Path, rig: Rig) -> StereoPair:
    """Open the cameras, which a daemon had a moment ago, and take the first pair."""
    source = both_cameras(load_config(config))
    with ThreadPoolExecutor(1) as executor:
        first = executor.submit(next, source.pairs(threading.Event()))
        wait_for(lambda: {health.state for health in source.health.values()} == {CameraState.STARTING})
        assert source.health["left"].restarts == 0, source.last_error
        rig.feed(recorded(0))
        return first.result(WAIT_S)


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Day:
    folder = tmp_path_factory.mktemp("day")
    config, recordings = folder / "needletrack.toml", folder / "recordings"
    size_px = AslRecording(STEER).rig.left.size_px
    values = {"rig": STEER, "width": size_px[0], "height": size_px[1], "left": LEFT, "right": RIGHT}
    config.write_text(CONFIG.format(**values, endpoint=ENDPOINT, folder=recordings))
    with fed_cameras() as rig, daemon(config) as process:
        killed = killed_while_it_records(process, rig, recordings)
    with fed_cameras() as rig, daemon(config) as process:
        stopped = stopped_while_it_records(process, rig, recordings, killed.file)
    with fed_cameras() as rig:
        return Day(config, killed, stopped, pair_of_cameras_opened_again(config, rig))


def same_images(pair: StereoPair, true: StereoPair) -> bool:
    return all(
        np.array_equal(ours.image, theirs.image) for ours, theirs in ((pair.left, true.left), (pair.right, true.right))
    )


def without_times(message: bytes) -> bytes:
    content = json.loads(message)
    return json.dumps({name: value for name, value in content.items() if name not in OF_THE_RUN}).encode()


def test_what_a_killed_daemon_recorded_is_saved_but_for_the_unwritten_tail(day: Day, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="needletrack recover"):
        McapRecording(day.killed.file)
    saved = tmp_path / "saved.mcap"
    pairs = recover(day.killed.file, saved).pairs
    # The tail is a chunk: it holds the pair that the recorder was at, and no other.
    assert day.killed.on_disk <= pairs <= day.killed.fed
    recording = McapRecording(saved)
    assert len(recording) == pairs
    assert all(same_images(recording.read(number), grey(number)) for number in range(pairs))


def test_a_daemon_that_is_asked_to_stop_while_it_records_ends_in_order(day: Day) -> None:
    stopped = day.stopped
    assert stopped.code == ExitCode.STOPPED
    assert stopped.status.state is ServiceState.STOPPING
    assert stopped.status.recording is not None
    assert (stopped.status.recording.dropped, stopped.status.recording.error) == (0, None)
    recording = McapRecording(stopped.file)
    assert len(recording) == PAIRS
    assert [track for _, track in recording.tracks()] == [message.to_json() for _, message in stopped.sent]
    # The cameras were free at once.
    assert same_images(day.opened_again, recorded(0))


def test_frames_to_tracks(day: Day, tmp_path: Path) -> None:
    """By the daemon that followed the killed one."""
    truth = recorded_truth(STEER)
    for number, (stamp_us, message) in enumerate(day.stopped.sent):
        assert message.captured_at_ns == stamp_us * 1000, "stamps are unchanged"
        assert (message.sequence, message.dropped) == (number, {})
        assert (message.clock, message.quality.pair_skew_us) == (Clock.MONOTONIC, SKEW_US)
        assert message.latency_ms > message.timing_ms["track"] > 0
        true_mm = truth[recorded(number).captured_at_ns].centerline_mm
        off_mm = distance_from_curve(np.array(message.centerline_mm), true_mm)
        # What a status of ok promises, and what these frames give.
        assert np.percentile(off_mm, 95) < 1.0
        assert np.median(off_mm) < 0.3
    assert sum(message.status is Status.OK for _, message in day.stopped.sent) > PAIRS // 2

    recording, config = McapRecording(day.stopped.file), load_config(day.config)
    assert all(same_images(recording.read(number), recorded(number)) for number in range(PAIRS))
    output = tmp_path / "replayed.jsonl"
    Replay(open_recording(day.stopped.file, config), config, as_published=True).run(threading.Event(), output=output)
    published = [message for _, message in recording.tracks()]
    assert [without_times(message) for message in output.read_bytes().splitlines()] == [
        without_times(message) for message in published
    ]
