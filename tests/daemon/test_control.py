"""The running daemon told what to do by an outsider over Zenoh; cameras of the tests' own making."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pytest
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import STEER, WAIT_S, Running, config_for, noise, running
from tests.publish.network import eventually
from tests.recording.small_recording import SIZE_PX, own_rig
from tests.test_auditing import second_processes
from typer.testing import CliRunner

from needletrack.cli import app
from needletrack.client import (
    ControlReply,
    ControlRequest,
    NeedleReply,
    NeedleRequest,
    Outcome,
    RedetectReply,
    RedetectRequest,
    SnapshotReply,
    SnapshotRequest,
    StartRecordingReply,
    StartRecordingRequest,
    StopRecordingReply,
    StopRecordingRequest,
    control,
)
from needletrack.config import Config
from needletrack.daemon import control as control_module
from needletrack.daemon.control import read_token
from needletrack.errors import ConfigError
from needletrack.publish.message import TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.mcap_file import McapRecording
from needletrack.recording.snapshot import write_snapshot
from needletrack.rig import Rig

Reply = TypeVar("Reply", bound=ControlReply)
THIN, THICK = (
    {"name": "22g", "max_diameter_mm": 0.8},
    {"name": "trocar", "min_diameter_mm": 4.0, "max_diameter_mm": 5.0},
)
SECRET = "0123456789abcdef"


def controlled(rig: Rig, /, **tables: Any) -> Config:
    return config_for(rig, **{**tables, "control": {"enabled": True, **tables.get("control", {})}})


def asked(daemon: Running, request: ControlRequest, kind: type[Reply]) -> Reply:
    listen = list(daemon.daemon.config.publishing.listen)
    reply = control(daemon.daemon.rig.name, request, listen, timeout_s=WAIT_S)
    assert isinstance(reply, kind)
    return reply


def done(daemon: Running, request: ControlRequest, kind: type[Reply]) -> Reply:
    reply = asked(daemon, request, kind)
    assert (reply.outcome, reply.detail) == (Outcome.DONE, "")
    return reply


def test_recording_is_begun_and_ended_while_tracking_goes_on(tmp_path: Path) -> None:
    rig = own_rig()
    config = controlled(rig, recording={"folder": tmp_path, "buffer_mb": 16, "at_start": False})
    with running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        daemon.next()
        assert daemon.status(lambda status: status.cameras is not None).recording is None
        assert done(daemon, StopRecordingRequest(), StopRecordingReply).changed is False
        start = StartRecordingRequest()
        begun = done(daemon, start, StartRecordingReply)
        assert begun.changed is True
        assert begun.file is not None
        assert done(daemon, start, StartRecordingReply) == begun
        assert done(daemon, StartRecordingRequest(), StartRecordingReply).changed is False
        status = daemon.status(lambda status: status.recording is not None and status.recording.pairs > 5)
        assert status.recording is not None
        assert status.recording.file == begun.file
        ended = done(daemon, StopRecordingRequest(), StopRecordingReply)
        assert (ended.changed, ended.file, ended.dropped) == (True, begun.file, 0)
        # Finished, while the daemon runs.
        recording = McapRecording(Path(begun.file))
        assert len(recording) == ended.pairs
        tracked = [TrackMessage.from_json(told).sequence for _, told in recording.tracks()]
        assert tracked == sorted(tracked)
        # The end may be told in a heartbeat before the one that counts it.
        daemon.status(lambda status: status.recording is None and status.counters["control_done"] == 4)
        second = done(daemon, StartRecordingRequest(), StartRecordingReply)
        assert second.file not in (None, begun.file)
        daemon.next()
        daemon.stop()
    assert sorted(tmp_path.glob("*.mcap")) == sorted([Path(begun.file), Path(str(second.file))])


def test_a_disk_that_takes_nothing_is_the_answer(tmp_path: Path) -> None:
    rig = own_rig()
    config = controlled(rig, recording={"folder": tmp_path, "buffer_mb": 16, "at_start": False})
    with running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        daemon.next()
        tmp_path.rename(tmp_path.with_name("gone"))
        try:
            for request, kind in ((StartRecordingRequest(), StartRecordingReply), (SnapshotRequest(), SnapshotReply)):
                if kind is SnapshotReply:
                    tmp_path.write_text("a file in the place of the folder")
                reply = asked(daemon, request, kind)
                assert (reply.outcome, reply.code) == (Outcome.FAILED, "disk"), reply
                assert str(tmp_path) in reply.detail
        finally:
            tmp_path.unlink()
            tmp_path.with_name("gone").rename(tmp_path)
        daemon.next()
        # Mended: the next recording tries at once.
        done(daemon, StopRecordingRequest(), StopRecordingReply)
        again = done(daemon, StartRecordingRequest(), StartRecordingReply)
        assert (again.changed, again.file is not None) == (True, True)


def test_a_snapshot_is_a_recording_of_the_next_pair_with_its_track(tmp_path: Path) -> None:
    rig = own_rig()
    config = controlled(rig, control={"snapshot_folder": tmp_path / "shots"})
    kernel = RunningKernel(two_cameras(SIZE_PX), noise)
    with running(rig, config, kernel) as daemon:
        before = daemon.next().message.sequence
        request = SnapshotRequest()
        reply = done(daemon, request, SnapshotReply)
        assert done(daemon, request, SnapshotReply) == reply
        assert reply.folder is not None
        assert reply.sequence is not None
        assert reply.sequence > before
        published = daemon.until(lambda received: received.message.sequence == reply.sequence).message
    (folder,) = (tmp_path / "shots").iterdir()
    assert str(folder) == reply.folder
    assert TrackMessage.from_json((folder / "track.json").read_bytes()) == published
    kept = AslRecording(folder)
    assert (len(kept), kept.rig.digest) == (1, rig.digest)
    number = kernel.stamps_us.index(published.captured_at_ns // 1000)
    for side, data in zip((kept.read(0).left, kept.read(0).right), noise(number), strict=True):
        assert side.image.tobytes() == data


def test_without_a_folder_or_a_pair_the_answer_says_so(tmp_path: Path) -> None:
    rig = own_rig()
    cameras = two_cameras(SIZE_PX)
    with running(rig, controlled(rig), RunningKernel(cameras, noise)) as daemon:
        for request, kind, told in (
            (StartRecordingRequest(), StartRecordingReply, "recording.folder is not set"),
            (StopRecordingRequest(), StopRecordingReply, "recording.folder is not set"),
            (SnapshotRequest(), SnapshotReply, "set control.snapshot_folder or recording.folder"),
        ):
            reply = asked(daemon, request, kind)
            assert (reply.outcome, reply.code) == (Outcome.REFUSED, "not_configured")
            assert told in reply.detail
    config = controlled(rig, control={"snapshot_folder": tmp_path})
    for camera in cameras:
        camera.plugged = True
    with running(rig, config, RunningKernel(cameras, lambda number: None)) as daemon:
        reply = asked(daemon, SnapshotRequest(), SnapshotReply)
        assert (reply.outcome, reply.code) == (Outcome.FAILED, "no_pair")
    assert list(tmp_path.iterdir()) == []


def test_the_needle_changes_between_two_pairs_and_the_messages_say_which(tmp_path: Path) -> None:
    recorded = AslRecording(STEER)
    rig, pair = replace(recorded.rig, name=own_rig().name), recorded.read(0)
    data = pair.left.image.tobytes(), pair.right.image.tobytes()
    config = controlled(rig, recording={"folder": tmp_path, "buffer_mb": 64}, control={"needles": [THIN, THICK]})
    kernel = RunningKernel(two_cameras(rig.left.size_px), lambda number: data)
    with running(rig, config, kernel) as daemon:
        assert daemon.until(lambda received: received.message.centerline_mm is not None).message.config_digest == (
            config.digest
        )
        assert asked(daemon, NeedleRequest(needle="30g"), NeedleReply).code == "unknown_needle"
        changed = done(daemon, NeedleRequest(needle="trocar"), NeedleReply)
        assert changed.after_sequence is not None
        assert (changed.needle, changed.config_digest) == ("trocar", config.with_needle("trocar").digest)
        after = daemon.until(lambda received: received.message.sequence > (changed.after_sequence or 0)).message
        # Of 4 mm there is none in the picture.
        assert (after.config_digest, after.centerline_mm) == (changed.config_digest, None)
        # Of a pair that came after the answer, and so is in the new file.
        delivered = kernel.delivered
        daemon.until(lambda received: received.message.sequence > delivered)
        status = daemon.status(lambda status: status.needle == "trocar")
        assert status.config_digest == changed.config_digest
        assert done(daemon, NeedleRequest(needle="trocar"), NeedleReply).changed is False
        back = done(daemon, NeedleRequest(needle="default"), NeedleReply)
        found = daemon.until(lambda received: received.message.sequence > (back.after_sequence or 0)).message
        assert found.config_digest == config.digest == back.config_digest
        assert found.centerline_mm is not None
        # Those of the other needles ended.
        assert len(second_processes()) == 1
        delivered = kernel.delivered
        daemon.until(lambda received: received.message.sequence > delivered)
        daemon.stop()
    assert second_processes() == set()
    # One file for each needle, and none of them holds another's track.
    files = sorted(tmp_path.glob("*.mcap"), key=lambda file: int(file.stem.rsplit("-", 1)[1]))
    for file, needle in zip(files, ("default", "trocar", "default"), strict=True):
        recording = McapRecording(file)
        assert Config.model_validate_json(recording.about.config).digest == config.with_needle(needle).digest
        digests = {TrackMessage.from_json(told).config_digest for _, told in recording.tracks()}
        # A pair between two of them may have been recorded before, and tracked after the change.
        assert config.with_needle(needle).digest in digests


def test_a_daemon_that_ends_while_the_needle_changes_leaves_nothing_behind() -> None:
    rig = own_rig()
    config = controlled(rig, control={"needles": [THIN]})
    with running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon, ThreadPoolExecutor(1) as pool:
        daemon.next()
        assert len(second_processes()) == 1
        asking = pool.submit(control, rig.name, NeedleRequest(needle="22g"), config.publishing.listen, timeout_s=3.0)
        assert eventually(lambda: len(second_processes()) == 2)
        daemon.stop()
        assert second_processes() == set()
        # Whether the answer still found its way is not said; that it was done would be a lie.
        if asking.exception(WAIT_S) is None:
            assert asking.result().code == "stopping"


def test_to_detect_anew_costs_the_memory_of_one_pair() -> None:
    rig = own_rig()
    with running(rig, controlled(rig), RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        daemon.next()
        reply = done(daemon, RedetectRequest(), RedetectReply)
        assert reply.after_sequence is not None
        assert daemon.daemon.service is not None
        later = daemon.until(lambda received: received.message.sequence > (reply.after_sequence or 0))
        assert later.message.config_digest == daemon.daemon.config.digest


@pytest.mark.parametrize("secret", [None, SECRET])
def test_only_who_may_is_let_in(tmp_path: Path, secret: str | None) -> None:
    rig, token_file = own_rig(), tmp_path / "token"
    settings: dict[str, Any] = {"enabled": False}
    if secret is not None:
        token_file.write_text(f"{secret}\n")
        token_file.chmod(0o600)
        settings = {"enabled": True, "token_file": token_file}
    with running(rig, config_for(rig, control=settings), RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        refused = asked(daemon, RedetectRequest(), RedetectReply)
        assert (refused.outcome, refused.code) == (Outcome.REFUSED, "disabled" if secret is None else "unauthorised")
        if secret is not None:
            assert asked(daemon, RedetectRequest(token=SECRET[::-1]), RedetectReply).code == "unauthorised"
            done(daemon, RedetectRequest(token=secret), RedetectReply)
        status = daemon.status(lambda status: status.counters["control_refused"] == (1 if secret is None else 2))
        assert SECRET not in status.model_dump_json()


@pytest.mark.parametrize(
    ("content", "mode", "told"),
    [
        (f"{SECRET}\n", 0o644, "others may read the control token (mode 644): chmod 600"),
        (f"{SECRET}\n", 0o660, "others may read the control token"),
        ("short\n", 0o600, "has 16 to 256 printable ASCII characters"),
        ("", 0o600, "has 16 to 256 printable ASCII characters"),
        (f"{SECRET}\n{SECRET}", 0o600, "on one line"),
        (None, 0o600, "cannot read the control token: No such file"),
    ],
)
def test_a_token_file_that_is_no_secret_is_refused(tmp_path: Path, content: str | None, mode: int, told: str) -> None:
    path = tmp_path / "token"
    if content is not None:
        path.write_text(content)
        path.chmod(mode)
    with pytest.raises(ConfigError) as refused:
        read_token(path)
    assert told in str(refused.value)
    assert str(path) in str(refused.value)
    assert SECRET not in str(refused.value)
    rig = own_rig()
    config = controlled(rig, control={"token_file": path})
    with (
        pytest.raises(ConfigError, match="token"),
        running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)),
    ):
        pass


def test_tracking_waits_for_no_request_however_slow_the_disk_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, began, go_on = own_rig(), threading.Event(), threading.Event()

    def slow_disk(*arguments: Any, **options: Any) -> Path:
        began.set()
        assert go_on.wait(WAIT_S)
        return write_snapshot(*arguments, **options)

    monkeypatch.setattr(control_module, "write_snapshot", slow_disk)
    config = controlled(rig, control={"snapshot_folder": tmp_path})
    kernel = RunningKernel(two_cameras(SIZE_PX), noise)
    with running(rig, config, kernel) as daemon, ThreadPoolExecutor(24) as pool:
        daemon.next()
        asking = [
            pool.submit(control, rig.name, request(), list(config.publishing.listen), timeout_s=WAIT_S)
            for request in (SnapshotRequest, RedetectRequest, StartRecordingRequest) * 8
        ]
        assert began.wait(WAIT_S)
        delivered = kernel.delivered
        daemon.until(lambda received: received.message.sequence > delivered + 10)
        assert not go_on.is_set()
        go_on.set()
        replies = [each.result(WAIT_S) for each in asking]
        assert {reply.code for reply in replies} <= {None, "busy", "not_configured"}
        done_snapshots = [reply for reply in replies if isinstance(reply, SnapshotReply) and reply.code is None]
        assert len(list(tmp_path.iterdir())) == len({reply.sequence for reply in done_snapshots}) > 0
        daemon.stop()


def test_the_command_asks_and_tells_the_answer(tmp_path: Path) -> None:
    rig, runner, token_file = own_rig(), CliRunner(), tmp_path / "token"
    token_file.write_text(SECRET)
    token_file.chmod(0o600)
    config = controlled(rig, control={"needles": [THIN], "token_file": token_file})
    with running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        (endpoint,) = config.publishing.listen
        options = ["--connect", endpoint, "--token-file", str(token_file), "--timeout", "30"]
        for words, code, outcome in (
            (["re-detect"], 0, "done"),
            (["needle", "22g", "--request-id", "n1"], 0, "done"),
            (["needle", "22g", "--request-id", "n1"], 0, "done"),
            (["needle", "23g"], 2, "unknown_needle"),
            (["snapshot"], 2, "not_configured"),
        ):
            result = runner.invoke(app, ["control", rig.name, *words, *options])
            assert result.exit_code == code, result.stderr
            reply = json.loads(result.stdout)
            assert outcome in (reply["outcome"], reply["code"])
            assert (result.stderr == "") == (code == 0)
            if words[0] == "needle" and code == 0:
                assert reply["changed"] is True
        bare = runner.invoke(app, ["control", rig.name, "re-detect", "--connect", endpoint])
        assert bare.exit_code == 2
        assert "refused (unauthorised): the token is missing" in bare.stderr
        daemon.stop()
    for words, told in (
        (["re-detect", "--connect", endpoint, "--timeout", "0.1"], "nobody answers at"),
        (["needle"], "takes a name"),
        (["re-detect", "22g"], "takes a name"),
        (["re-detect", "--request-id", "a b"], "request_id: String should match"),
    ):
        result = runner.invoke(app, ["control", rig.name, *words])
        assert result.exit_code == 2
        assert told in result.stderr
        assert len(result.stderr.splitlines()) == 1
