"""From `security init` to tracks on a terminal: the daemon and the commands take their files from the configuration."""

import json
import os
import queue
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import config_for, free_port, noise
from tests.publish.network import WAIT_S, eventually
from tests.recording.small_recording import SIZE_PX, small_rig
from tests.test_auditing import second_processes
from typer.testing import CliRunner

from needletrack.authority import init_security
from needletrack.cli import app
from needletrack.client import NeedleReply, NeedleRequest, Subscriber, TrackMessage, control_configured
from needletrack.config import load_config
from needletrack.daemon.run import Daemon
from needletrack.doctor import Verdict, examine
from needletrack.errors import ConfigError
from needletrack.publish.keys import RigKeys
from needletrack.publish.session import open_session
from needletrack.publish.tls import TlsFiles
from needletrack.rig import Rig

# One daemon of a rig runs on a machine, and another checkout may be tested at the same time.
RIG = f"secured-{os.getpid()}"


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pki")
    init_security(folder, RIG, port=free_port())
    return folder


def test_a_daemon_and_a_watch_with_certificates(pki: Path, tmp_path: Path) -> None:
    rig = replace(small_rig(), name=RIG)
    publishing = load_config(pki / RIG / "publisher" / "needletrack.toml").publishing
    config = config_for(rig, publishing=publishing.model_dump(exclude={"heartbeat_s"}))
    stop, ready = threading.Event(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        daemon = Daemon(rig, config, kernel=RunningKernel(two_cameras(SIZE_PX), noise))
        done = pool.submit(daemon.run, stop, ready=ready.set)
        try:
            assert ready.wait(WAIT_S)
            for role in ("controller", "operator"):
                report = tmp_path / f"{role}.json"
                mine = ["--config", str(pki / RIG / role / "needletrack.toml"), "--count", "3", "--wait", "10"]
                watched = CliRunner().invoke(app, ["watch", RIG, *mine, "--report", str(report)])
                assert watched.exit_code == 0, watched.output
                assert '"messages": 3' in report.read_text()
            # Without: the endpoint is there, and not for us.
            endpoint = publishing.listen[0]
            told = CliRunner().invoke(app, ["watch", RIG, "--connect", endpoint, "--wait", "0.3"])
            assert told.exit_code == 2
            assert "TLS needs an authority, a certificate and its key" in told.output
        finally:
            stop.set()
        assert done.result(WAIT_S).run.pairs >= 3


def test_the_operator_changes_the_needle_with_certificates_and_pictures_beside(pki: Path, tmp_path: Path) -> None:
    """All at once: tracks, pictures on a session of their own, commands, and one auditing process throughout."""
    rig = replace(small_rig(), name=RIG)
    publishing = load_config(pki / RIG / "publisher" / "needletrack.toml").publishing
    tables = publishing.model_dump(exclude={"heartbeat_s"})
    tables["overlay"]["rate_hz"] = 20.0
    needles = [{"name": "trocar", "min_diameter_mm": 4.0, "max_diameter_mm": 5.0}]
    config = config_for(rig, publishing=tables, control={"enabled": True, "needles": needles})
    init_security(tmp_path, RIG)
    stranger = tmp_path / RIG / "operator" / "needletrack.toml"
    stranger.write_text((pki / RIG / "operator" / "needletrack.toml").read_text("utf-8"))

    def command(file: Path, timeout: str) -> tuple[int, str, str]:
        words = ["control", RIG, "needle", "trocar", "--config", str(file), "--timeout", timeout]
        result = CliRunner().invoke(app, words)
        return result.exit_code, result.stdout, result.stderr

    stop, ready = threading.Event(), threading.Event()
    pictures: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with ExitStack() as opened:
        pool = opened.enter_context(ThreadPoolExecutor(1))
        opened.callback(stop.set)
        done = pool.submit(
            Daemon(rig, config, kernel=RunningKernel(two_cameras(SIZE_PX), noise)).run, stop, ready=ready.set
        )
        assert ready.wait(WAIT_S)
        controller = load_config(pki / RIG / "controller" / "needletrack.toml").subscribing
        looking = opened.enter_context(
            open_session(
                connect=publishing.overlay.listen, tls=TlsFiles.configured(controller.tls), rigs=[RigKeys(RIG)]
            )
        )
        looking.declare_subscriber(RigKeys(RIG).overlay, pictures.put)
        beside = opened.enter_context(
            open_session(connect=publishing.listen, tls=TlsFiles.configured(controller.tls), rigs=[RigKeys(RIG)])
        )
        on_tracks: list[zenoh.Sample] = []
        for key in (RigKeys(RIG).overlay, RigKeys(RIG).track):
            beside.declare_subscriber(key, on_tracks.append)
        subscriber = opened.enter_context(Subscriber.configured(RIG, controller, capacity=4096))
        subscriber.wait_for_daemon(WAIT_S)
        assert pictures.get(timeout=WAIT_S).attachment is not None
        for file, told in (
            (pki / RIG / "controller" / "needletrack.toml", f"'{RIG}.operator' alone may command it"),
            (stranger, "is not of the authority in"),
        ):
            code, _, said = command(file, "0.5")
            assert code == 2
            assert told in said
        operator = pki / RIG / "operator" / "needletrack.toml"
        code, answer, said = command(operator, "30")
        assert code == 0, said
        reply = json.loads(answer)
        assert (reply["changed"], reply["config_digest"]) == (True, config.with_needle("trocar").digest)
        # Tracks are of the new needle, and pictures of such tracks go on.
        changed = after(subscriber, reply["after_sequence"])
        assert changed.config_digest == reply["config_digest"]
        assert eventually(
            lambda: json.loads(bytes(pictures.get(timeout=WAIT_S).attachment or b"{}"))["sequence"] > changed.sequence
        )
        assert eventually(lambda: subscriber.status is not None and subscriber.status.needle == "trocar")
        assert len(second_processes()) == 1
        settings = load_config(operator).subscribing
        back = control_configured(RIG, NeedleRequest(needle="default"), settings, timeout_s=WAIT_S)
        assert isinstance(back, NeedleReply)
        assert after(subscriber, back.after_sequence or 0).config_digest == config.digest
        assert len(second_processes()) == 1
        assert subscriber.clock is not None
        stop.set()
        # Poses go first, and no picture shares their session.
        assert {str(sample.key_expr) for sample in on_tracks} == {RigKeys(RIG).track}
        sent = {(str(each.priority), str(each.congestion_control), each.express) for each in on_tracks}
        assert sent == {(str(zenoh.Priority.REAL_TIME), str(zenoh.CongestionControl.DROP), True)}
        done.result(WAIT_S)
    assert second_processes() == set()


def after(subscriber: Subscriber, sequence: int) -> TrackMessage:
    """The first track of a later pair."""
    while (received := subscriber.next(WAIT_S)) is not None:
        if received.message.sequence > sequence:
            return received.message
    raise AssertionError("it never came")


def test_a_daemon_does_not_start_with_a_key_that_others_read(pki: Path, tmp_path: Path) -> None:
    init_security(tmp_path, RIG)
    folder = tmp_path / RIG / "publisher"
    (folder / "key.pem").chmod(0o644)
    path = folder / "needletrack.toml"
    findings = [one for one in examine(load_config(path), _no_rig, seconds=0.1) if one.subject == "zenoh"]
    assert [one.verdict for one in findings] == [Verdict.FAIL]
    assert "chmod 600" in str(findings[0])


def test_the_doctor_warns_of_what_is_open_to_the_network(tmp_path: Path) -> None:
    path = tmp_path / "open.toml"
    path.write_text(f'[publishing]\nlisten = ["tcp/0.0.0.0:{free_port()}"]\n')
    warned = [one for one in examine(load_config(path), _no_rig, seconds=0.1) if one.subject == "security"]
    assert [one.verdict for one in warned] == [Verdict.WARN]
    assert "docs/security.md" in warned[0].remedy


def _no_rig() -> Rig:
    raise ConfigError("no rig here")
