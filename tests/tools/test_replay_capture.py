"""The replay tool from outside: what it writes, what it says where, and how it ends."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.recording.small_recording import small_rig, write_recording
from tools.replay_capture import app
from typer.testing import CliRunner, Result

from needletrack.cli import app as needletrack_app
from needletrack.client import Subscriber
from needletrack.publish.message import TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.rig import Rig, read_rig, write_rig

ROOT = Path(__file__).parents[2]
STEER = ROOT / "tests" / "data" / "recordings" / "steer-b"
MS = 1_000_000
# Only a hang takes so long.
WAIT_S = 60.0
# What holds this run's times and its name.
OF_THIS_RUN = ("run_id", "published_at_ns", "timing_ms", "latency_ms")


def replay(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_bytes().splitlines()]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Five pairs of noise, in which there is no needle."""
    return write_recording(tmp_path / "small", [number * 10 * MS for number in range(5)])


def test_every_frame_gives_the_same_bytes_every_time(tmp_path: Path) -> None:
    for name in ("first", "second"):
        result = replay(STEER, "--end", 2, "--output", tmp_path / f"{name}.jsonl")
        assert result.exit_code == 0, result.stderr
    first = (tmp_path / "first.jsonl").read_bytes()
    assert first == (tmp_path / "second.jsonl").read_bytes()
    messages = lines(tmp_path / "first.jsonl")
    assert [message["sequence"] for message in messages] == [0, 1]
    recorded = [listed.left.stamp_ns for listed in AslRecording(STEER).pairs[:2]]
    assert [message["captured_at_ns"] for message in messages] == recorded
    assert {message[name] for message in messages for name in OF_THIS_RUN} == {None}
    assert {message["source"] for message in messages} == {"replay"}
    # The sequence shows a needle in every pair.
    assert all(message["centerline_mm"] for message in messages)
    for line in first.splitlines():
        TrackMessage.from_json(line)


def test_independent_pairs_are_as_if_alone(tmp_path: Path) -> None:
    together, alone = tmp_path / "together.jsonl", tmp_path / "alone.jsonl"
    assert replay(STEER, "--independent", "--end", 2, "--output", together).exit_code == 0
    assert replay(STEER, "--start", 1, "--end", 2, "--output", alone).exit_code == 0
    assert together.read_bytes().splitlines()[1] == alone.read_bytes().strip()


def test_the_reference_method_on_a_part_played_forward_and_backward(tmp_path: Path) -> None:
    output = tmp_path / "tracks.jsonl"
    result = replay(STEER, "--method", "reference", "--start", 1, "--end", 3, "--loop", 3, "--output", output)
    assert result.exit_code == 0, result.stderr
    messages = lines(output)
    assert [message["sequence"] for message in messages] == [1, 2, 3, 4]
    assert messages[0]["centerline_mm"] == messages[2]["centerline_mm"]
    assert all("reference_method" in message["reasons"] for message in messages)
    assert "reference_method 4" in result.stderr


def test_a_table_instead_of_messages(small: Path, tmp_path: Path) -> None:
    output = tmp_path / "tracks.csv"
    assert replay(small, "--output", output).exit_code == 0
    with output.open(newline="") as file:
        assert [row["sequence"] for row in csv.DictReader(file)] == ["0", "1", "2", "3", "4"]


def test_a_paced_replay_counts_what_it_could_not_track(small: Path, tmp_path: Path) -> None:
    output = tmp_path / "tracks.jsonl"
    result = replay(small, "--paced", "--loop", 20, "--output", output)
    assert result.exit_code == 0, result.stderr
    messages = lines(output)
    played = 5 + 19 * 4
    # The last pair to come is always tracked.
    assert messages[-1]["sequence"] == played - 1
    before: dict[str, Any] = {"sequence": -1, "dropped": {}}
    for message in messages:
        gap = message["sequence"] - before["sequence"] - 1
        assert gap == message["dropped"].get("overwritten", 0) - before["dropped"].get("overwritten", 0)
        before = message
    assert all(message["latency_ms"] is not None for message in messages)
    assert all(message["run_id"] == messages[0]["run_id"] for message in messages)
    assert f"{len(messages)} pairs in" in result.stderr


def test_an_unreadable_image_costs_its_pair_and_is_named(small: Path, tmp_path: Path) -> None:
    broken = sorted((small / "cam1" / "data").glob("*.png"))[2]
    broken.write_bytes(broken.read_bytes()[:-20])
    output = tmp_path / "tracks.jsonl"
    result = replay(small, "--output", output)
    assert result.exit_code == 0
    assert [message["sequence"] for message in lines(output)] == [0, 1, 3, 4]
    assert lines(output)[-1]["dropped"] == {"unpaired_left": 1, "unreadable_image": 1}
    warning, *summary = result.stderr.splitlines()
    assert warning.startswith("warning: ")
    assert str(broken) in warning
    assert summary[0].startswith("4 pairs in")
    assert summary[2] == "  dropped: unpaired_left 1, unreadable_image 1"


def test_a_paced_replay_whose_first_pair_is_unreadable(small: Path, tmp_path: Path) -> None:
    broken = min((small / "cam0" / "data").glob("*.png"))
    broken.write_bytes(broken.read_bytes()[:-20])
    output = tmp_path / "tracks.jsonl"
    result = replay(small, "--paced", "--output", output)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("warning: pair 0 is left out") == 1
    assert lines(output)[-1]["dropped"]["unreadable_image"] == 1


def test_no_pair_at_all_is_a_failure(small: Path) -> None:
    for image in (small / "cam1" / "data").glob("*.png"):
        image.write_bytes(image.read_bytes()[:-20])
    result = replay(small)
    assert result.exit_code == 1
    assert "0 pairs in" in result.stderr
    assert "unreadable_image 5" in result.stderr


def test_the_rig_named_wins_over_the_configured_one_and_that_over_the_recordings(small: Path, tmp_path: Path) -> None:
    output = tmp_path / "tracks.jsonl"

    def rig_used(*options: object) -> str:
        result = replay(small, "--end", 1, "--output", output, *options)
        assert result.exit_code == 0, result.stderr
        return str(lines(output)[0]["rig"])

    def named(name: str) -> Rig:
        return replace(small_rig(), name=name)

    write_rig(named("configured"), tmp_path / "configured.yaml")
    write_rig(named("option"), tmp_path / "option.yaml")
    config = tmp_path / "needletrack.toml"
    config.write_text('[rig]\npath = "configured.yaml"\n')
    assert read_rig(small / "rig.yaml").name == "small"
    assert rig_used() == "small"
    assert rig_used("--config", config) == "configured"
    assert rig_used("--config", config, "--rig", tmp_path / "option.yaml") == "option"
    # A camchain serves too, and a recording's folder.
    assert replay(STEER, "--rig", STEER / "camchain.yaml", "--method", "reference", "--end", 1).exit_code == 0
    assert rig_used("--rig", small) == "small"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["nowhere"], "nowhere: there is no such recording"),
        (["small", "--rig", "nowhere.yaml"], "nowhere.yaml: cannot read the calibration"),
        (["small", "--rig", "camchain.yaml"], "camchain.yaml: cam0"),
        (["small", "--config", "nowhere.toml"], "nowhere.toml: cannot read the configuration"),
        (["small", "--config", "blind.toml"], "no part of the workspace"),
        (["small", "--start", "5"], "no pair from 5 to the last: the recording has 5"),
        (["small", "--output", "tracks.txt"], "let the name end in .jsonl or .csv"),
        (["small", "--publish", "127.0.0.1"], "write it as tcp/127.0.0.1:7447"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(
    small: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], told: str
) -> None:
    monkeypatch.chdir(small.parent)
    Path("camchain.yaml").write_text("cam0: 7\ncam1: 8\n")
    Path("blind.toml").write_text("[tracking.workspace]\nx_mm = {min = 5000.0, max = 5100.0}\n")
    result = replay(*options)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert told in result.stderr


def test_ctrl_c_ends_a_published_replay_with_its_summary(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    fifo = tmp_path / "tracks.jsonl"
    os.mkfifo(fifo)
    small = write_recording(tmp_path / "small", [number * 10 * MS for number in range(5)])
    command = [sys.executable, "tools/replay_capture.py", str(small), "--paced", "--loop", "1000000"]
    command += ["--output", str(fifo), "--publish", endpoint]
    # FORCE_COLOR must not bring the progress bar into a pipe.
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, "FORCE_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process, Subscriber("small", [endpoint]) as subscriber:
        try:
            # Read without a pause: a pipe holds 64 kB, a second of such tracks, and the subscriber may need as long to
            # connect. A replay that waits for the reader publishes nothing meanwhile.
            with ThreadPoolExecutor(1) as pool, fifo.open("rb") as tracks:
                written = pool.submit(tracks.read)
                received = subscriber.next(WAIT_S)
                process.send_signal(signal.SIGINT)
                first = TrackMessage.from_json(written.result(WAIT_S).splitlines()[0])
            stdout, stderr = process.communicate(timeout=WAIT_S)
        finally:
            process.kill()
        assert subscriber.wait_until_gone(WAIT_S)
    assert process.returncode == 130
    assert stdout == ""
    assert "\x1b" not in stderr
    first_line, statuses, dropped = stderr.splitlines()
    assert " pairs in " in first_line
    assert statuses.startswith("  ok ")
    assert dropped.startswith("  dropped: ")
    assert received is not None
    assert received.message.run_id == first.run_id is not None
    assert received.message.source == "replay"


def test_one_thread_for_numpy_and_opencv() -> None:
    code = (
        "import tools.replay_capture, cv2, numpy, scipy.linalg, threadpoolctl;"
        "print([each['num_threads'] for each in threadpoolctl.threadpool_info()], cv2.getNumThreads())"
    )
    environment = {name: value for name, value in os.environ.items() if "THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    counts, _, opencv = done.stdout.strip().rpartition(" ")
    assert set(json.loads(counts)) == {1}
    assert opencv == "1"


def test_every_kind_of_recording_gives_the_same_bytes(tmp_path: Path) -> None:
    """A folder of ours, the same as MCAP, as a ROS 2 bag, and as a folder again, by the commands that make them."""
    asl = write_recording(tmp_path / "asl", [1_000_000_000 + number * 10 * MS for number in range(4)])
    rig = tmp_path / "asl" / "rig.yaml"

    def command(*arguments: object) -> None:
        result = CliRunner().invoke(needletrack_app, [str(argument) for argument in arguments])
        assert result.exit_code == 0, result.stderr
        assert "4 pairs" in result.stdout

    command("import", asl, tmp_path / "ours.mcap", "--rig", rig)
    command("export", tmp_path / "ours.mcap", tmp_path / "bag", "--to", "ros2")
    command("import", tmp_path / "bag", tmp_path / "again.mcap", "--rig", rig)
    command("export", tmp_path / "again.mcap", tmp_path / "folder")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((tmp_path / "ours.mcap").read_bytes()[:-10])
    command("recover", cut, tmp_path / "recovered.mcap")
    written = []
    for number, name in enumerate(("asl", "ours.mcap", "bag", "again.mcap", "folder", "recovered.mcap")):
        output = tmp_path / f"{number}.jsonl"
        options = ["--rig", rig] if name == "bag" else []
        result = replay(tmp_path / name, *options, "--output", output)
        assert result.exit_code == 0, result.stderr
        written.append(output.read_bytes())
    assert len(written[0].splitlines()) == 4
    assert set(written) == {written[0]}
    told = replay(cut)
    assert told.exit_code == 2
    assert "needletrack recover" in told.stderr
