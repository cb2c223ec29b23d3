"""Frames with known truth → two kernel cameras with our own stamps → daemon → Zenoh → a subscriber outside of it."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.hardware.loopback import LEFT, RIGHT, Feed, loopback_nodes

from needletrack.client import Subscriber
from needletrack.config import load_config
from needletrack.geometry.spline import distance_from_curve
from needletrack.recording.asl import AslRecording
from needletrack.recording.mcap_file import McapRecording
from needletrack.records import Clock, Status
from needletrack.replay import Replay, open_recording
from needletrack.scoring import recorded_truth

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


def wait_for(condition: Callable[[], bool]) -> None:
    until_s = time.monotonic() + WAIT_S
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


class Rig:
    """Two fed cameras and a subscriber; `send` feeds a pair and waits for its track."""

    def __init__(self, feeds: tuple[Feed, Feed], subscriber: Subscriber) -> None:
        self._feeds, self._subscriber = feeds, subscriber
        self._recorded = AslRecording(STEER)
        self.stamps_us: list[int] = []
        self.messages: list[Any] = []

    def ready(self, process: "subprocess.Popen[bytes]") -> None:
        """Wait until the daemon says that both cameras were started."""

        def started() -> bool:
            assert process.poll() is None, "the daemon has ended"
            return self._states() == {"starting"}

        wait_for(started)

    def send(self, number: int) -> None:
        pair = self._recorded.read(number)
        stamp_us = time.monotonic_ns() // 1000
        self.stamps_us.append(stamp_us)
        for feed, frame, late_us in zip(self._feeds, (pair.left, pair.right), (0, SKEW_US), strict=True):
            feed.put(frame.image.tobytes(), stamp_us + late_us)
        received = self._subscriber.next(WAIT_S)
        assert received is not None
        self.messages.append(received.message)

    def _states(self) -> set[str]:
        status = self._subscriber.status
        if status is None or status.cameras is None or self._subscriber.health.state == "gone":
            return set()
        return {camera.state for camera in status.cameras.values()}


def without_times(message: bytes) -> bytes:
    content = json.loads(message)
    return json.dumps({name: value for name, value in content.items() if name not in OF_THE_RUN}).encode()


@pytest.mark.skipif(len(loopback_nodes()) < 2, reason="no pair of v4l2loopback devices: run `make test-hardware`")
@pytest.mark.timeout(900)
def test_frames_to_tracks(tmp_path: Path) -> None:
    recorded = AslRecording(STEER)
    width, height = recorded.rig.left.size_px
    path = tmp_path / "needletrack.toml"
    values = {"rig": STEER, "width": width, "height": height, "left": LEFT, "right": RIGHT, "endpoint": ENDPOINT}
    path.write_text(CONFIG.format(**values, folder=tmp_path / "recordings"))
    with ExitStack() as opened:
        nodes = loopback_nodes()
        feeds = tuple(opened.enter_context(Feed(node, (width, height))) for node in nodes[:2])
        subscriber = opened.enter_context(Subscriber(recorded.rig.name, [ENDPOINT]))
        rig = Rig((feeds[0], feeds[1]), subscriber)
        with daemon(path) as process:
            rig.ready(process)
            for number in range(PAIRS):
                rig.send(number)
            process.send_signal(signal.SIGTERM)
            assert process.wait(WAIT_S) == 0
        assert subscriber.wait_until_gone(WAIT_S)

    messages = rig.messages
    truth = recorded_truth(STEER)
    for number, message in enumerate(messages):
        assert message.captured_at_ns == rig.stamps_us[number] * 1000, "stamps are unchanged"
        assert (message.sequence, message.dropped) == (number, {})
        assert (message.clock, message.quality.pair_skew_us) == (Clock.MONOTONIC, SKEW_US)
        assert message.latency_ms > message.timing_ms["track"] > 0
        true_mm = truth[recorded.pairs[number].left.stamp_ns].centerline_mm
        off_mm = distance_from_curve(np.array(message.centerline_mm), true_mm)
        # What a status of ok promises, and what these frames give.
        assert np.percentile(off_mm, 95) < 1.0
        assert np.median(off_mm) < 0.3
    assert sum(message.status is Status.OK for message in messages) > PAIRS // 2

    (file,) = (tmp_path / "recordings").glob("*.mcap")
    config = load_config(path)
    recording = McapRecording(file)
    assert len(recording) == PAIRS
    published = [message for _, message in recording.tracks()]
    assert published == [message.to_json() for message in messages]
    for number in range(PAIRS):
        for ours, true in zip(
            (recording.read(number).left, recording.read(number).right),
            (recorded.read(number).left, recorded.read(number).right),
            strict=True,
        ):
            assert np.array_equal(ours.image, true.image)
    output = tmp_path / "replayed.jsonl"
    Replay(open_recording(file, config), config, as_published=True).run(threading.Event(), output=output)
    replayed = output.read_bytes().splitlines()
    assert [without_times(message) for message in replayed] == [without_times(message) for message in published]
