"""The daemon with cameras of the tests' own making: cameras in, messages out to an outside subscriber."""

import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.capture.fake_kernel import FakeCamera, RunningKernel, two_cameras
from tests.recording.small_recording import SIZE_PX, image_of, own_rig
from typer.testing import CliRunner

from needletrack.calibration.drift import Motion
from needletrack.cli import app
from needletrack.client import Received, Subscriber
from needletrack.config import Config
from needletrack.daemon.logs import logged
from needletrack.daemon.process import AlreadyRunning, OnlyInstance
from needletrack.daemon.run import Daemon, DaemonSummary, ExitCode, exit_code
from needletrack.errors import CaptureError, ConfigError, PublishError
from needletrack.geometry.transform import RigidTransform
from needletrack.publish.message import StatusMessage, TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.mcap_file import McapRecording, PairWriter
from needletrack.recording.registration import PointPairs, registered
from needletrack.records import Clock, DropReason, Image, Image16, StampPlace, Status
from needletrack.replay import Replay, open_recording
from needletrack.rig import CalibrationInfo, Rig, write_rig

ROOT = Path(__file__).parents[2]
STEER = ROOT / "tests" / "data" / "recordings" / "steer-b"
# Only a hang takes so long.
WAIT_S = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def config_for(rig: Rig, /, **tables: Any) -> Config:
    plain: dict[str, Any] = {
        "cameras": {"size_px": rig.left.size_px, "rate_hz": 50.0, "left": {"id": "usb-1"}, "right": {"id": "usb-2"}},
        "publishing": {"listen": [f"tcp/127.0.0.1:{free_port()}"], "heartbeat_s": 0.1},
        # Real-time threads of a test would get in the way of others.
        "daemon": {"metrics_port": 0, "realtime_priority": 0, "lock_memory": False},
    }
    for name, values in tables.items():
        plain[name] = {**plain.get(name, {}), **values}
    return Config.model_validate(plain)


def noise(number: int) -> tuple[bytes, bytes]:
    return image_of(number).tobytes(), image_of(number + 1).tobytes()


class Running:
    """A daemon in a thread of this process, a subscriber to it, and its summary once it was stopped."""

    def __init__(
        self, daemon: Daemon, subscriber: Subscriber, stop: threading.Event, done: Future[DaemonSummary]
    ) -> None:
        self.daemon, self.subscriber, self.done, self._stop = daemon, subscriber, done, stop

    def next(self) -> Received:
        received = self.subscriber.next(WAIT_S)
        assert received is not None
        return received

    def until(self, condition: Callable[[Received], bool]) -> Received:
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            received = self.next()
            if condition(received):
                return received
        raise AssertionError("it never came")

    def status(self, condition: Callable[[StatusMessage], bool]) -> StatusMessage:
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            status = self.subscriber.status
            if status is not None and condition(status):
                return status
            time.sleep(0.01)
        raise AssertionError(f"it never came: {self.subscriber.status}")

    def stop(self) -> DaemonSummary:
        self._stop.set()
        return self.done.result(WAIT_S)


@contextmanager
def running(rig: Rig, config: Config, kernel: RunningKernel) -> Iterator[Running]:
    stop, ready = threading.Event(), threading.Event()
    daemon = Daemon(rig, config, kernel=kernel)
    with (
        ThreadPoolExecutor(1) as pool,
        Subscriber(rig.name, list(config.publishing.listen), capacity=4096) as subscriber,
    ):
        done = pool.submit(daemon.run, stop, ready=ready.set)
        try:
            while not ready.wait(0.05):
                if done.done():
                    done.result()
            yield Running(daemon, subscriber, stop, done)
        finally:
            stop.set()


def test_cameras_in_messages_out(tmp_path: Path) -> None:
    rig, port = own_rig(), free_port()
    config = config_for(rig, recording={"folder": tmp_path, "buffer_mb": 16}, daemon={"metrics_port": port})
    kernel = RunningKernel(two_cameras(SIZE_PX), noise)
    with running(rig, config, kernel) as daemon:
        received = [daemon.next() for _ in range(20)]
        status = daemon.status(lambda status: status.recording is not None and status.recording.pairs > 0)
        metrics = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=WAIT_S).read().decode()
        # On this address of the loopback interface alone.
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(f"http://127.0.0.2:{port}/metrics", timeout=WAIT_S)
        began_s = time.monotonic()
        summary = daemon.stop()
        took_s = time.monotonic() - began_s
    assert took_s < 1
    messages = [each.message for each in received]
    stamps = {stamp_us * 1000 for stamp_us in kernel.stamps_us}
    for message in messages:
        assert message.captured_at_ns in stamps
        assert (message.source, message.clock) == ("live", Clock.MONOTONIC)
        assert (message.stamp_at, message.quality.pair_skew_us) == (StampPlace.START_OF_EXPOSURE, 40.0)
        assert message.timing_ms is not None
        assert message.latency_ms is not None
        parts = sum(message.timing_ms[part] for part in ("capture", "queue", "track"))
        # The rest is writing the message.
        assert 0 <= message.latency_ms - parts < message.latency_ms
    assert [b.sequence > a.sequence for a, b in pairwise(messages)] == [True] * 19
    assert status.cameras is not None
    assert {side: camera.state for side, camera in status.cameras.items()} == {
        "left": "streaming",
        "right": "streaming",
    }
    assert status.cameras["right"].node == "/dev/video1"
    assert 'needletrack_tracks_total{status="invalid"}' in metrics
    assert 'needletrack_camera_streaming{camera="left"} 1.0' in metrics
    assert "needletrack_latency_seconds_count" in metrics
    (file,) = tmp_path.glob(f"{rig.name}-*.mcap")
    recording = McapRecording(file)
    assert len(recording) == summary.recorded
    assert summary.recorded is not None
    assert summary.unrecorded is not None
    # The last pair may have come when the cameras were not asked any more.
    assert kernel.delivered - 1 <= summary.recorded + summary.unrecorded <= kernel.delivered
    assert recording.about.config == config.model_dump_json()
    tracked = [TrackMessage.from_json(told) for _, told in recording.tracks()]
    by_sequence = {message.sequence: message for message in tracked}
    # The subscriber may have come a few pairs later.
    assert [by_sequence[message.sequence] for message in messages] == messages
    assert summary.run.pairs + sum(summary.run.dropped.values()) == summary.recorded + summary.unrecorded


def test_a_camera_unplugged_is_told_and_back_within_two_seconds(caplog: pytest.LogCaptureFixture) -> None:
    rig = own_rig()
    cameras = two_cameras(SIZE_PX)
    with running(rig, config_for(rig), RunningKernel(cameras, noise)) as daemon:
        daemon.next()
        cameras[1].plugged = False
        status = daemon.status(lambda status: status.last_error is not None)
        assert "usb-2" in str(status.last_error)
        assert status.cameras is not None
        assert status.cameras["right"].state == "absent"
        while daemon.subscriber.next(0.3) is not None:
            pass
        cameras[1].node = "/dev/video7"
        cameras[1].plugged, back_s = True, time.monotonic()
        daemon.next()
        assert time.monotonic() - back_s < 2
        status = daemon.status(lambda status: status.cameras is not None and status.cameras["right"].restarts == 1)
        assert status.cameras is not None
        assert status.cameras["right"].node == "/dev/video7"


def without_times(message: bytes) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(message)
    of_the_run = ("run_id", "published_at_ns", "timing_ms", "latency_ms", "captured_at_unix_ns")
    for name in (*of_the_run, "source", "clock"):
        del content[name]
    return content


def registered_before_a_camera_was_turned(rig: Rig) -> Rig:
    """The rig as it was before the right camera was pitched by 0.07 degrees, registered to a robot."""
    turned = Motion(turn_deg=np.array([-0.07, 0.0, 0.0])).applied_to(rig)
    before = replace(rig, right_from_left=turned.right_from_left)
    seen_mm = np.array([[-40.0, -30, 220], [45, -25, 230], [-35, 35, 240], [40, 30, 225], [0, 0, 290]])
    robot_from_rig = RigidTransform(
        Rotation.from_euler("zyx", [80, -20, 130], degrees=True).as_matrix(), np.array([412.0, -80, 950])
    )
    pairs = PointPairs(seen_mm, robot_from_rig.apply(seen_mm), None)
    return registered(before, pairs, "robot_base", datetime.now(UTC))[0]


def test_an_old_calibration_is_said_at_the_start_and_in_every_heartbeat(caplog: pytest.LogCaptureFixture) -> None:
    info = CalibrationInfo(calibrated_at=datetime.now(UTC) - timedelta(days=45))
    rig = replace(own_rig(), calibration=info)
    for max_age_days, is_old in ((30.0, True), (60.0, False)):
        caplog.clear()
        config = config_for(rig, rig={"max_age_days": max_age_days})
        with running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
            status = daemon.status(lambda status: status.calibration.age_days is not None)
            daemon.stop()
        said = [record for record in caplog.records if "calibrated 45 days ago, more than 30" in record.getMessage()]
        assert [record.levelname for record in said] == ["WARNING"] * is_old
        assert status.calibration.warning == (said[0].getMessage() if is_old else None)


def steered() -> Rig:
    """The rig of steer-b, under a name of its own."""
    return replace(AslRecording(STEER).rig, name=own_rig().name)


def live_and_replayed(
    folder: Path,
    rig: Rig,
    count: int,
    *,
    rate_hz: float | None = None,
    pixels: Literal["GREY", "Y16"] = "GREY",
) -> list[TrackMessage]:
    """What is published of so many pairs of steer-b; asserts that their replay gives the same bytes.

    They come one after another, each when the one before is done, or so often, however long tracking takes.
    """
    recorded, cameras = AslRecording(STEER), two_cameras(rig.left.size_px, pixels=pixels)
    daemons: list[Daemon] = []

    def shown(number: int) -> tuple[bytes, bytes] | None:
        service = daemons[0].service if daemons else None
        if number == count or service is None:
            return None
        if rate_hz is None and (sum(service.statuses.values()) < number or service.busy_s):
            return None
        # Forward and backward, so that the needle never jumps.
        turns = number % (2 * len(recorded) - 2)
        pair = recorded.read(min(turns, 2 * len(recorded) - 2 - turns))
        return as_delivered(pair.left.image), as_delivered(pair.right.image)

    def as_delivered(image: Image) -> bytes:
        # Of sixteen bits the lower ones are the camera's noise.
        return image.tobytes() if pixels == "GREY" else sixteen_bits(image).tobytes()

    # Sooner than by default, which takes more pairs than are played here.
    config = config_for(rig, cameras={"format": pixels}, recording={"folder": folder}, drift={"least_pairs": 5})
    kernel = RunningKernel(cameras, shown, rate_hz or 50.0)
    with running(rig, config, kernel) as daemon:
        daemon.status(lambda status: status.cameras is not None)
        service = daemon.daemon.service
        assert service is not None
        daemons.append(daemon.daemon)
        until_s = time.monotonic() + 3 * WAIT_S
        while kernel.delivered < count or sum(service.statuses.values()) + sum(service.dropped.values()) < count:
            assert time.monotonic() < until_s, (kernel.delivered, service.statuses, service.dropped)
            time.sleep(0.05)
        summary = daemon.stop()
    (file,) = folder.glob("*.mcap")
    recording = McapRecording(file)
    published = [told for _, told in recording.tracks()]
    # On a busy machine the driver has lost frames before they were pairs.
    assert summary.run.dropped.get(DropReason.OVERWRITTEN, 0) == len(recording) - len(published)
    if rate_hz is None:
        assert (summary.run.dropped, len(published)) == ({}, count)
    for ours, again in zip(published, replayed(file, config, as_published=True), strict=True):
        live, once_more = without_times(ours), without_times(again)
        overwritten = [message.pop("dropped").get(DropReason.OVERWRITTEN, 0) for message in (live, once_more)]
        assert json.dumps(live).encode() == json.dumps(once_more).encode()
        assert overwritten[0] == overwritten[1]
    return [TrackMessage.from_json(message) for message in published]


@pytest.mark.slow
def test_what_was_tracked_of_too_many_pairs_is_replayed_as_it_was(tmp_path: Path) -> None:
    # On a busy machine the second process, which gives way while it loads, is there only after some seconds.
    live = live_and_replayed(tmp_path, steered(), 1000, rate_hz=400.0)
    # More come than are tracked, and the first is searched.
    assert len(live) < 1000
    assert live[0].searched_sequence == live[0].sequence
    gone_on_from = [message.searched_sequence for message in live[1:] if message.searched_sequence is not None]
    assert gone_on_from
    assert gone_on_from == sorted(set(gone_on_from))


def test_recorded_live_and_replayed_give_the_same_bytes_in_the_robot_s_frame(tmp_path: Path) -> None:
    live = live_and_replayed(tmp_path, registered_before_a_camera_was_turned(steered()), 2)
    assert any(message.centerline_mm for message in live)
    assert {message.frame_id for message in live} == {"robot_base"}
    in_robot_mm = np.array([message.tip.position_mm for message in live if message.tip is not None])
    assert len(in_robot_mm) > 0
    # Where the left camera stands in the robot's frame, and how far it sees.
    away_mm = np.linalg.norm(in_robot_mm - (412, -80, 950), axis=1)
    assert ((away_mm > 150) & (away_mm < 350)).all()


def replayed(file: Path, config: Config, *, as_published: bool = False) -> list[bytes]:
    """What a replay of a recording publishes."""
    output = file.with_suffix(".jsonl")
    Replay(open_recording(file, config), config, as_published=as_published).run(threading.Event(), output=output)
    return output.read_bytes().splitlines()


def sixteen_bits(image: Image) -> Image16:
    """An image whose upper eight bits are these."""
    lower = np.random.default_rng(int(image[0, 0])).integers(0, 256, image.shape, dtype=np.uint16)
    words: Image16 = np.left_shift(image, 8, dtype=np.uint16) + lower
    return words


def test_sixteen_bits_are_recorded_and_tracked_live_and_in_the_replay_as_their_upper_eight(tmp_path: Path) -> None:
    rig, count = steered(), 2
    assert live_and_replayed(tmp_path, rig, count, pixels="Y16")[0].centerline_mm
    (file,) = tmp_path.glob("*.mcap")
    recording = McapRecording(file)
    eight = PairWriter(tmp_path / "eight.mcap", recording.about)
    for number in range(count):
        read, true = recording.read(number), AslRecording(STEER).read(number)
        assert np.array_equal(read.left.pixels, sixteen_bits(true.left.image))
        assert np.array_equal(read.right.pixels, sixteen_bits(true.right.image))
        stamps_ns = read.left.captured_at_ns, read.right.captured_at_ns
        eight.add_pair(number, true.left.image, stamps_ns[0], true.right.image, stamps_ns[1])
    eight.finish()
    config = Config.model_validate_json(recording.about.config)
    of_sixteen, of_eight = (replayed(path, config) for path in (file, tmp_path / "eight.mcap"))
    assert list(map(without_times, of_sixteen)) == list(map(without_times, of_eight))


@pytest.mark.slow
def test_what_is_told_of_a_turned_camera_live_is_told_by_its_replay(tmp_path: Path) -> None:
    live = live_and_replayed(tmp_path, registered_before_a_camera_was_turned(steered()), 45)
    # When it is told depends on how many tips were seen, and so on the pace at which this machine took the pairs.
    told = ["calibration_drift" in message.reasons for message in live]
    assert not any(told[:4])
    assert told[-1]
    assert told == sorted(told)
    assert all(message.status is not Status.OK for message, is_told in zip(live, told, strict=True) if is_told)


def test_a_second_daemon_of_the_rig_is_refused(tmp_path: Path) -> None:
    rig = own_rig()
    with OnlyInstance(rig.name):
        daemon = Daemon(rig, config_for(rig), kernel=RunningKernel(two_cameras(SIZE_PX), noise))
        with pytest.raises(AlreadyRunning, match="already runs on this machine"):
            daemon.run(threading.Event())
    with OnlyInstance(rig.name):
        pass


@pytest.mark.parametrize(
    ("error", "code"),
    [(AlreadyRunning(""), 4), (CaptureError(""), 3), (ConfigError(""), 2), (PublishError(""), 2)],
)
def test_every_error_has_its_exit_code(error: Exception, code: int) -> None:
    assert exit_code(error) is ExitCode(code)


def test_a_camera_that_cannot_do_it_ends_the_start() -> None:
    rig = own_rig()
    camera = FakeCamera("/dev/video0", "usb-1", formats={"YUYV": [SIZE_PX]})
    with pytest.raises(CaptureError, match="does not do GREY"):
        Daemon(rig, config_for(rig), kernel=RunningKernel([camera], noise)).run(threading.Event())


def test_images_of_another_size_than_the_rigs_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"cameras\.size_px is 1280x1024, but rig small-\d+ was calibrated at 64x48"):
        Daemon(own_rig(), config_for(own_rig(), cameras={"size_px": (1280, 1024)}))


def test_systemd_is_told_when_it_is_ready_that_it_lives_and_that_it_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.settimeout(WAIT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        monkeypatch.setenv("WATCHDOG_USEC", "200000")
        monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
        rig = own_rig()
        with running(rig, config_for(rig), RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
            assert systemd.recv(4096).startswith(b"READY=1\n")
            daemon.next()
            alive = systemd.recv(4096)
            while b"left streaming" not in alive:
                alive = systemd.recv(4096)
            assert alive.startswith(b"WATCHDOG=1\n")
            daemon.stop()
            while (told := systemd.recv(4096)).startswith(b"WATCHDOG=1"):
                pass
            assert told == b"STOPPING=1"


def test_the_command_says_what_is_wrong_in_one_line_with_its_code(tmp_path: Path) -> None:
    write_rig(own_rig(), tmp_path / "rig.yaml")
    (tmp_path / "small.toml").write_text("[cameras]\nsize_px = [64, 48]\n")
    runner, rig = CliRunner(), str(tmp_path / "rig.yaml")
    for options, code, told in (
        ([], 2, "no rig: name one with --rig"),
        (["--rig", rig], 2, "cameras.size_px is 1280x1024"),
        (["--rig", rig, "--config", str(tmp_path / "small.toml")], 3, "cameras.left.id is not configured"),
    ):
        result = runner.invoke(app, ["run", *options])
        assert result.exit_code == code, result.stderr
        assert told in result.stderr.splitlines()[-1]
        assert result.stdout == ""


def test_logs_are_json_lines_with_rig_and_run() -> None:
    code = (
        "import logging, sys\n"
        "from needletrack.daemon.logs import logged\n"
        "with logged({'rig': 'r1', 'run_id': 'x'}):\n"
        "    logging.getLogger('needletrack.capture.live').warning('left %s', 'gone', extra={'node': '/dev/video0'})\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    line = json.loads(done.stderr)
    assert done.stdout == ""
    assert (line["event"], line["level"], line["rig"], line["run_id"]) == ("left gone", "warning", "r1", "x")
    assert (line["node"], line["logger"]) == ("/dev/video0", "needletrack.capture.live")


def test_a_defect_is_logged_frame_by_frame() -> None:
    stream = StringIO()
    with logged({}, stream):
        try:
            raise RuntimeError("bad")
        except RuntimeError:
            logging.getLogger("needletrack.capture").exception("stuck")
    line = json.loads(stream.getvalue())
    assert (line["event"], line["level"]) == ("stuck", "error")
    (told,) = line["exception"]
    assert (told["exc_type"], told["exc_value"]) == ("RuntimeError", "bad")
    assert told["frames"][-1]["name"] == "test_a_defect_is_logged_frame_by_frame"


# Each of these takes a twentieth of a second or more to load, before the first track or in the midst of following.
NOT_FOR_A_START = {
    *("cryptography", "jinja2", "matplotlib", "mcap", "pydantic_settings", "rich", "rosbags", "skimage", "structlog"),
    *("scipy.interpolate", "scipy.io", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.stats"),
    *("needletrack.calibration.bundle", "needletrack.recording.bag", "needletrack.recording.recorder"),
}


def test_the_daemon_loads_what_its_first_track_needs_and_no_more() -> None:
    code = (
        "import json, sys\n"
        "import needletrack.cli, needletrack.terminal\n"
        "from pathlib import Path\n"
        "from needletrack.auditing import AuditedTracker\n"
        "from needletrack.config import load_config\n"
        "from needletrack.daemon.logs import logged\n"
        "from needletrack.daemon.run import Daemon\n"
        "from needletrack.recording.asl import AslRecording\n"
        "from needletrack.rig import find_rig\n"
        "rig, config = find_rig(sys.argv[1]), load_config()\n"
        "with logged({}):\n"
        "    tracker = AuditedTracker(rig, config.tracking)\n"
        "    tracker.warm_up()\n"
        "    assert tracker(AslRecording(Path(sys.argv[1]), rig).read(0), None).curve is not None\n"
        "json.dump(sorted(sys.modules), sys.stdout)\n"
    )
    recording = Path(__file__).parents[1] / "data" / "recordings" / "lab-a"
    done = subprocess.run([sys.executable, "-c", code, recording], capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout)) & NOT_FOR_A_START == set()


def test_logs_go_where_they_went_once_the_daemon_is_gone(caplog: pytest.LogCaptureFixture) -> None:
    stream = StringIO()
    with logged({"rig": "r1"}, stream):
        logging.getLogger("needletrack.capture").warning("during")
    logging.getLogger("needletrack.capture").warning("after")
    assert "during" in stream.getvalue()
    assert "after" not in stream.getvalue()
    assert [record.message for record in caplog.records] == ["after"]
