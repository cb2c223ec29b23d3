"""The commands: what they print where, and their exit codes. The replay command: tests/tools/."""

import json
import re
import shutil
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from rich.console import Group
from typer.testing import CliRunner, Result

import needletrack
from needletrack.calibration.drift import Motion
from needletrack.cli import app
from needletrack.config import load_config
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
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
        "check",
        "register",
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


def test_nothing_is_repeated_as_published_where_nothing_was_published() -> None:
    assert "no tracks were recorded with the pairs" in refused("replay", STEER, "--as-published")
    assert "leave --paced" in refused("replay", STEER, "--as-published", "--paced")


def test_calibrate_writes_the_rig_and_the_report(tmp_path: Path) -> None:
    folder = tmp_path / "bench 2"
    shutil.copytree(RECORDINGS / "calib-b", folder)
    broken = min((folder / "cam1" / "data").glob("*.png"))
    broken.write_bytes(broken.read_bytes()[:-20])
    output = tmp_path / "rig.yaml"
    result = run("calibrate", folder, "--square-mm", 10, "--squares", "12x9", "--output", output)
    assert result.exit_code == 0, result.stderr
    rig = read_rig(output)
    assert rig.name == "bench-2"
    assert rig.calibration.views == 7
    stated = rig.calibration.uncertainty
    assert stated is not None
    assert stated.after_alignment_mm is not None
    assert 0 < stated.after_alignment_mm < 0.05
    assert result.stderr.startswith("left out: ")
    assert str(broken) in result.stderr
    for expected in ("7 used, 1 left out", "held out", "mm rms to expect in the workspace", "take 5 more views"):
        assert expected in result.stdout
    page = (tmp_path / "rig-calibration.html").read_text()
    assert "Calibration of bench-2" in page
    assert "http" not in page.replace("http-equiv", "")


def test_two_folders_of_pictures_pair_by_their_numbers(tmp_path: Path) -> None:
    for camera, side in (("cam0", "left"), ("cam1", "right")):
        (tmp_path / side).mkdir()
        for index, file in enumerate(sorted((RECORDINGS / "calib-b" / camera / "data").glob("*.png"))):
            shutil.copy(file, tmp_path / side / f"{side}{index:02}.png")
    output = tmp_path / "rig.yaml"
    given = ("--square-mm", 10, "--squares", "12x9", "--output", output, "--name", "pair")
    assert run("calibrate", tmp_path / "left", tmp_path / "right", *given).exit_code == 0
    assert read_rig(output).calibration.views == 8
    (tmp_path / "empty").mkdir()
    told = refused("calibrate", tmp_path / "left", tmp_path / "empty", "--square-mm", 10)
    assert "no two pictures pair" in told


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


def test_a_fresh_pair_says_whether_the_cameras_stand(tmp_path: Path) -> None:
    given = ("--square-mm", 10, "--squares", "12x9")
    output = tmp_path / "rig.yaml"
    assert run("calibrate", RECORDINGS / "calib-b", *given, "--output", output).exit_code == 0
    fresh = tmp_path / "fresh"
    for camera in ("cam0", "cam1"):
        (fresh / camera / "data").mkdir(parents=True)
        lines = (RECORDINGS / "calib-b" / camera / "data.csv").read_text().splitlines()
        (fresh / camera / "data.csv").write_text("\n".join(lines[:2]) + "\n")
        name = lines[1].split(",")[1]
        shutil.copy(RECORDINGS / "calib-b" / camera / "data" / name, fresh / camera / "data" / name)
    still = run("check", output, fresh, *given)
    assert still.exit_code == 0, still.output
    assert "stands where it was calibrated" in still.stdout
    rig = read_rig(output)
    bumped = replace(rig, right_from_left=Motion(turn_deg=np.array([0.0, 0.1, 0.0])).applied_to(rig).right_from_left)
    write_rig(bumped, tmp_path / "bumped.yaml")
    moved = run("check", tmp_path / "bumped.yaml", fresh, *given)
    assert moved.exit_code == 1
    assert "MOVED" in moved.stdout
    assert "calibrate anew" in moved.stdout
    calibration = rig.calibration.model_copy(update={"uncertainty": None})
    write_rig(replace(rig, calibration=calibration), tmp_path / "plain.yaml")
    assert "states no uncertainty" in run("check", tmp_path / "plain.yaml", fresh, *given).stdout
    other = refused("check", output, RECORDINGS / "calib-a", "--square-mm", 2)
    assert "the rig says" in other


def test_register_writes_the_robot_s_frame_into_the_rig(tmp_path: Path) -> None:
    write_rig(find_rig(STEER), tmp_path / "rig.yaml")
    points = [(-40, -30, 220), (45, -25, 230), (-35, 35, 240), (40, 30, 225), (0, 0, 290)]
    rows = [f"{x},{y},{z},{z + 100},{-x},{-y}" for x, y, z in points]
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("rig_x_mm,rig_y_mm,rig_z_mm,robot_x_mm,robot_y_mm,robot_z_mm\n" + "\n".join(rows) + "\n")
    result = run("register", tmp_path / "rig.yaml", pairs, "--frame-id", "robot_base")
    assert result.exit_code == 0, result.output
    assert "0.000 mm rms" in result.stdout
    rig = read_rig(tmp_path / "rig.yaml")
    assert rig.frame_id == "robot_base"
    assert "registered  to robot_base, 5 points" in run("rig", "show", tmp_path / "rig.yaml").stdout
    lines = tmp_path / "tracks.jsonl"
    run("replay", STEER, "--rig", tmp_path / "rig.yaml", "--end", 1, "--output", lines)
    assert json.loads(lines.read_text())["frame_id"] == "robot_base"


def test_rigs_go_out_and_come_back_in_other_formats(tmp_path: Path) -> None:
    for kind, name in (("ros", "ros"), ("opencv", "stereo.yaml"), ("mrcal", "mrcal"), ("kalibr", "camchain.yaml")):
        result = run("rig", "export", STEER, tmp_path / name, "--format", kind)
        assert result.exit_code == 0, result.output
        files = [line.removeprefix("written: ") for line in result.stdout.splitlines()]
        back = run("rig", "import", *files, "--output", tmp_path / "back.yaml", "--name", "back")
        assert back.exit_code == 0, back.output
        assert f"by {kind}" in back.stdout
    assert "--size" in refused("rig", "import", tmp_path / "stereo.yaml", "--size", "big")


def test_an_old_calibration_is_warned_about(tmp_path: Path) -> None:
    rig = find_rig(STEER)
    old = rig.calibration.model_copy(update={"calibrated_at": datetime(2020, 1, 1, tzinfo=UTC)})
    write_rig(replace(rig, calibration=old), tmp_path / "rig.yaml")
    checked = run("rig", "check", tmp_path / "rig.yaml")
    assert checked.exit_code == 0
    assert "days ago, more than 30 (rig.max_age_days)" in checked.stderr
    played = run("replay", STEER, "--rig", tmp_path / "rig.yaml", "--end", 1)
    assert "days ago, more than 30" in played.stderr
    patient = tmp_path / "needletrack.toml"
    patient.write_text("[rig]\nmax_age_days = 100000\n")
    assert run("rig", "check", tmp_path / "rig.yaml", "--config", patient).stderr == ""
