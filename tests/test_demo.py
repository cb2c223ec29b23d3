"""The demo from outside: what it shows, what it leaves, and that it fails when its subscriber does."""

import json
import os
import pty
import re
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import cv2
import pytest
from tests.recording.small_recording import write_recording
from typer.testing import CliRunner

from needletrack.cli import app
from needletrack.demo import SubscriberFailed, run_demo
from needletrack.publish.message import TrackMessage

ROOT = Path(__file__).parents[1]
STEER = ROOT / "tests" / "data" / "recordings" / "steer-b"
MS = 1_000_000
PICTURES = ("needle-overlay.png", "needle-distance-map.png", "needle-shape.png", "timeline.png")

SUBSCRIBE = """
from needletrack.client import Subscriber
subscriber = Subscriber(sys.argv[4], [sys.argv[7]])
"""


def demo(output: Path, seconds: float) -> list[str]:
    return [sys.executable, "-m", "needletrack", "demo", str(STEER), "--output", str(output), f"--seconds={seconds}"]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Five pairs of noise, in which there is no needle."""
    return write_recording(tmp_path / "small", [number * 20 * MS for number in range(5)])


def subscriber_that(does: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the demo start another program in place of Python with `needletrack watch`."""
    program = folder / "python"
    program.write_text(f"#!{sys.executable}\nimport os, signal, sys\n{does}\n")
    program.chmod(0o755)
    monkeypatch.setattr("needletrack.demo.sys.executable", str(program))


@pytest.mark.slow
def test_into_a_pipe_it_shows_lines_and_leaves_pictures_and_tracks(tmp_path: Path) -> None:
    output = tmp_path / "new" / "demo"
    done = subprocess.run(demo(output, 2), stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert "\x1b" not in done.stdout
    received = json.loads((output / "received.json").read_text())
    tracks = [TrackMessage.from_json(line) for line in (output / "tracks.jsonl").read_bytes().splitlines()]
    assert received["messages"] + received["lost"] == len(tracks) > 0
    assert received["health"]["state"] == "gone"
    for name in PICTURES:
        picture = cv2.imread(str(output / name))
        assert picture is not None
        assert picture.std() > 5
        assert name in done.stdout
    # What the subscriber showed, and the summary.
    shown = [line for line in done.stdout.splitlines() if re.match(r" +\d+\.\d s  ", line)]
    assert len(shown) >= 2
    assert re.search(r"tip (x .* mm|-)  length .* Hz  latency .* ms  dropped \d+", shown[-1])
    assert f"pairs     {len(tracks)} tracked in" in done.stdout
    assert re.search(r"^latency   p50 \d+\.\d ms, p99 \d+\.\d ms", done.stdout, re.MULTILINE)
    last = tracks[-1]
    assert last.source == "replay"
    assert last.latency_ms is not None
    assert last.sequence + 1 == len(tracks) + last.dropped.get("overwritten", 0)


@pytest.mark.slow
def test_on_a_terminal_the_subscriber_draws_a_panel(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
    process = subprocess.Popen(demo(tmp_path, 1), stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    screen = b""
    with suppress(OSError):  # how Linux says that nobody is at the other end any more
        while part := os.read(ours, 65536):
            screen += part
    os.close(ours)
    code = process.wait()
    text = screen.decode()
    assert code == 0, text
    panel, summary = text.rsplit("╯", 1)
    assert "needletrack · steer-b" in panel
    assert panel.count("\x1b[2K") > 5  # drawn over and over
    assert "received" in summary
    assert "needle-overlay.png" in summary


def test_a_subscriber_that_never_starts_fails_the_demo(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subscriber_that("sys.exit(3)", tmp_path, monkeypatch)
    result = CliRunner().invoke(app, ["demo", str(small), "--output", str(tmp_path / "demo")])
    assert result.exit_code == 1
    assert result.stderr == "needletrack: the subscriber ended with code 3 before it had subscribed\n"


def test_a_subscriber_that_dies_ends_the_replay_and_fails_the_demo(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subscriber_that(f"{SUBSCRIBE}\nsubscriber.next()\nos._exit(4)", tmp_path, monkeypatch)
    with pytest.raises(SubscriberFailed, match="ended with code 4"):
        # Nobody would wait so long.
        run_demo(small, tmp_path / "demo", seconds=100_000, stop=threading.Event())


def test_a_subscriber_that_does_not_end_fails_the_demo_and_is_ended(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = tmp_path / "pid"
    hang = f"open({str(pid)!r}, 'w').write(str(os.getpid()))\nsignal.pause()"
    subscriber_that(f"{SUBSCRIBE}\n{hang}", tmp_path, monkeypatch)
    monkeypatch.setattr("needletrack.demo._GONE_WITHIN_S", 0.1)
    with pytest.raises(SubscriberFailed, match="has not noticed"):
        run_demo(small, tmp_path / "demo", seconds=0.1, stop=threading.Event())
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_a_subscriber_that_received_nothing_fails_the_demo(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = (
        "from pathlib import Path\nfrom needletrack.terminal import write_summary\n"
        "from needletrack.watch import WatchSummary\nsubscriber.wait_until_gone()\n"
        "write_summary(WatchSummary(0, {}, 0.0, None, None, None, 0, 0, 0, 0, subscriber.health), Path(sys.argv[11]))"
    )
    subscriber_that(f"{SUBSCRIBE}\n{nothing}", tmp_path, monkeypatch)
    with pytest.raises(SubscriberFailed, match=r"received none of \d+ tracks"):
        run_demo(small, tmp_path / "demo", seconds=0.1, stop=threading.Event())


def test_what_cannot_be_used_is_told_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for arguments, told in (
        (["nowhere"], "nowhere: there is no such recording"),
        ([str(STEER), "--output", str(tmp_path / "file" / "demo")], "no such folder can be made"),
    ):
        result = CliRunner().invoke(app, ["demo", *arguments])
        assert result.exit_code == 2
        assert told in result.stderr
        assert result.stderr.count("\n") == 1
