"""The commands: what they print where, and their exit codes. The replay command: tests/tools/."""

import json
import re
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path

import pytest
from rich.console import Group
from tests.recording.small_recording import small_rig
from typer.testing import CliRunner, Result

import needletrack
from needletrack.calibration.board import Checkerboard
from needletrack.cli import app
from needletrack.config import load_config
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.recording.board import BoardCalibration
from needletrack.rig import find_rig, read_rig, write_rig

RECORDINGS = Path(__file__).parent / "data" / "recordings"
STEER = RECORDINGS / "steer-b"
# Only a hang takes so long.
WAIT_S = 60.0


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def refused(*arguments: object) -> str:
    """The one line that a command says when it refuses what it was given."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("needletrack: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_the_module_is_the_program() -> None:
    done = subprocess.run([sys.executable, "-m", "needletrack", "version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == needletrack.__version__


def test_without_a_command_it_lists_the_commands() -> None:
    result = run()
    for command in (
        "run",
        "record",
        "doctor",
        "recover",
        "export",
        "import",
        "demo",
        "replay",
        "report",
        "watch",
        "rig",
        "config",
        "calibrate",
        "table1",
        "version",
    ):
        assert re.search(rf"\b{command}\b", result.output)


def test_a_rig_is_summarised_from_a_folder_a_camchain_and_a_rig_file(tmp_path: Path) -> None:
    rig = find_rig(STEER)
    write_rig(rig, tmp_path / "rig.yaml")
    outputs = [run("rig", "show", path) for path in (STEER, STEER / "camchain.yaml", tmp_path / "rig.yaml")]
    assert [result.exit_code for result in outputs] == [0, 0, 0]
    assert len({result.stdout for result in outputs}) == 1
    text = outputs[0].stdout
    assert f"steer-b, digest {rig.digest}" in text
    assert "960x768 px" in text
    assert f"baseline {rig.baseline_mm:.2f} mm" in text
    assert "by kalibr" in text


def test_a_camchain_becomes_a_rig_file(tmp_path: Path) -> None:
    output = tmp_path / "rig.yaml"
    result = run("rig", "import", STEER / "camchain.yaml", "--output", output, "--name", "bench-2")
    assert result.exit_code == 0, result.stderr
    assert read_rig(output).name == "bench-2"
    assert read_rig(output).digest == find_rig(STEER).digest
    assert f"written: {output}" in result.stdout


def test_a_rig_is_checked_against_the_workspace(tmp_path: Path) -> None:
    assert ": ok, rig steer-b, digest" in run("rig", "check", STEER).stdout
    config = tmp_path / "far.toml"
    config.write_text("[tracking.workspace]\nx_mm = {min = 5000.0, max = 5100.0}\n")
    assert "no part of the workspace" in refused("rig", "check", STEER, "--config", config)
    assert "no-such.yaml: cannot read" in refused("rig", "show", tmp_path / "no-such.yaml")


def test_what_is_configured_is_printed_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tmp_path / "needletrack.toml"
    config.write_text("[tracking.needle]\nmax_diameter_mm = 0.9\n")
    monkeypatch.setenv("NEEDLETRACK_PUBLISHING__HEARTBEAT_S", "0.25")
    result = run("config", "show", config)
    assert result.exit_code == 0, result.stderr
    shown = json.loads(result.stdout)
    assert shown == load_config(config).model_dump(mode="json")
    assert shown["tracking"]["needle"]["max_diameter_mm"] == 0.9
    assert shown["publishing"]["heartbeat_s"] == 0.25
    assert json.loads(run("config", "show").stdout)["tracking"]["needle"]["max_diameter_mm"] == 1.2


def test_a_configuration_is_checked(tmp_path: Path) -> None:
    config = tmp_path / "needletrack.toml"
    config.write_text("[tracking.needle]\nmax_diameter_mm = 0.9\n")
    assert f": ok, digest {load_config(config).digest}" in run("config", "check", config).stdout
    config.write_text("[tracking.needle]\nmax_diametre_mm = 0.9\n")
    assert "did you mean tracking.needle.max_diameter_mm?" in refused("config", "check", config)


def test_calibrate_writes_what_the_board_gave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []

    def calibrated(folder: Path, board: Checkerboard, name: str, calibrated_at: datetime) -> BoardCalibration:
        given.extend((folder, board, name, calibrated_at.tzinfo is not None))
        return BoardCalibration(small_rig(), ("1.png: the board was not found",), 0.125)

    monkeypatch.setattr("needletrack.recording.board.calibrate_from_recording", calibrated)
    output = tmp_path / "rig.yaml"
    board = RECORDINGS / "calib-b"
    result = run("calibrate", board, "--square-mm", 10, "--squares", "12x9", "--output", output)
    assert result.exit_code == 0, result.stderr
    assert given == [board, Checkerboard(12, 9, 10.0), "calib-b", True]
    assert read_rig(output).digest == small_rig().digest
    assert result.stderr == "left out: 1.png: the board was not found\n"
    assert "worst view 0.125 px rms" in result.stdout


@pytest.mark.parametrize("squares", ["11", "11x", "11x11x11", "axb", "-1x5"])
def test_a_board_needs_two_numbers_of_squares(squares: str) -> None:
    told = refused("calibrate", RECORDINGS / "calib-b", "--square-mm", 10, f"--squares={squares}")
    assert "write it as 11x11" in told


def test_a_board_too_small_to_be_found_is_refused() -> None:
    assert "at least 4 squares" in refused("calibrate", RECORDINGS / "calib-b", "--square-mm", 10, "--squares", "3x3")


def test_table1_prints_the_table_of_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []

    def measured(folder: Path, repeats: int) -> str:
        given.extend((folder, repeats))
        return "the table"

    monkeypatch.setattr("needletrack.table1.table1", measured)
    monkeypatch.setattr("needletrack.table1.render", Group)
    result = run("table1", RECORDINGS / "lab-a", "--repeats", 2)
    assert result.exit_code == 0
    assert result.stdout == "the table\n"
    assert given == [RECORDINGS / "lab-a", 2]


def test_watch_shows_so_many_tracks_and_reports_them(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    track, status = example_messages()
    with (
        ZenohPublisher(example_run(), lambda: status, listen=[endpoint]) as publisher,
        ThreadPoolExecutor(1) as pool,
    ):

        def send() -> None:
            assert publisher.wait_for_subscriber(WAIT_S)
            for number in range(3):
                publisher.publish(track.model_copy(update={"sequence": number}))

        sending = pool.submit(send)
        report = tmp_path / "received.json"
        options = ("--count", 3, "--wait", WAIT_S, "--report", report)
        result = run("watch", "lab", "--connect", endpoint, *options)
        sending.result()
    assert result.exit_code == 0, result.stderr
    assert "ok" in result.stdout
    assert result.stderr == ""
    assert json.loads(report.read_text())["statuses"] == {"ok": 3, "degraded": 0, "invalid": 0}


def test_watch_says_that_nobody_is_there() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    assert "nobody answers at" in refused("watch", "lab", "--connect", endpoint, "--wait", 0.1)
    assert "write it as tcp/127.0.0.1:7447" in refused("watch", "lab", "--connect", "localhost")
