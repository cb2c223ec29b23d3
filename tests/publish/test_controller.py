"""The controller's loop of docs/examples, as a program of its own, against a real publisher."""

import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from needletrack.publish.message import Instant, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run, example_track
from needletrack.records import NeedleTrack, Reason, Status

SCRIPT = Path(__file__).parents[2] / "docs" / "examples" / "controller.py"
WAIT_S = 20.0


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Sending:
    """Sends one answer over and over at 60 Hz, until another is set; None: nothing."""

    def __init__(self, publisher: ZenohPublisher) -> None:
        self._publisher, self._stop = publisher, threading.Event()
        self.answer: tuple[NeedleTrack, float] | None = None
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "Sending":
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        _, pair = example_track()
        sequence = 0
        while not self._stop.wait(1 / 60):
            if (answer := self.answer) is not None:
                made = TrackMessage.from_track(answer[0], pair, example_run(), dropped={}, published=Instant.now())
                self._publisher.publish(made.model_copy(update={"sequence": sequence, "latency_ms": answer[1]}))
                sequence += 1


def lines_of(process: "subprocess.Popen[str]") -> "queue.SimpleQueue[str]":
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line.rstrip("\n"))

    threading.Thread(target=read, daemon=True).start()
    return lines


def until(lines: "queue.SimpleQueue[str]", start: str) -> str:
    """The next line that starts so; a busy machine may have made it hold for a moment before."""
    end_s = time.monotonic() + WAIT_S
    while not (line := lines.get(timeout=max(0.0, end_s - time.monotonic()))).startswith(start):
        pass
    return line


@pytest.fixture
def process(endpoint: str) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, str(SCRIPT), "--rig", "lab", "--connect", endpoint, "--until-gone"]
    with subprocess.Popen(
        [*command, "--max-age-ms", "500"], stdout=subprocess.PIPE, text=True, encoding="utf-8"
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_it_acts_on_fresh_good_tracks_and_holds_on_everything_else(
    endpoint: str, process: "subprocess.Popen[str]"
) -> None:
    known, pair = example_track()
    stamp = pair.captured_at_ns
    good = NeedleTrack(stamp, Status.OK, (), known.curve, known.tip)
    lines = lines_of(process)
    assert until(lines, "hold: never_seen") == "hold: never_seen: no daemon for rig 'lab' has been seen yet"
    with ZenohPublisher(example_run(), lambda: example_messages()[1], listen=[endpoint]) as publisher:
        assert publisher.wait_for_subscriber(WAIT_S)
        with Sending(publisher) as sending:
            sending.answer = good, 8.0
            x, y, z = example_messages()[0].tip.position_mm  # type: ignore[union-attr]
            assert until(lines, "act") == f"act: tip at ({x:.3f}, {y:.3f}, {z:.3f}) mm in lab_left"
            sending.answer = NeedleTrack(stamp, Status.INVALID, (Reason.NO_CANDIDATE, Reason.JUMP)), 8.0
            assert until(lines, "hold: invalid") == "hold: invalid: no_candidate, jump"
            sending.answer = good, 700.0
            assert "ms old (limit 500 ms)" in until(lines, "hold: stale")
            sending.answer = None
            assert "no track for" in until(lines, "hold: silent")
            sending.answer = good, 8.0
            until(lines, "act")
    until(lines, "hold: gone")
    assert process.wait(WAIT_S) == 0
