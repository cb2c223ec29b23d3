"""From `security init` to tracks on a terminal: the daemon and the commands take their files from the configuration."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import config_for, free_port, noise
from tests.publish.network import WAIT_S
from tests.recording.small_recording import SIZE_PX, small_rig
from typer.testing import CliRunner

from needletrack.authority import init_security
from needletrack.cli import app
from needletrack.config import load_config
from needletrack.daemon.run import Daemon
from needletrack.doctor import Verdict, examine
from needletrack.errors import ConfigError
from needletrack.rig import Rig

RIG = "secured"


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
