"""The subscriber that was written from docs/wire.md alone."""

import ast
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from needletrack.publish.message import Instant, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run, example_track
from needletrack.records import NeedleTrack, Reason, Status

SCRIPT = Path(__file__).parents[2] / "docs" / "examples" / "plain_subscriber.py"
WAIT_S = 20.0


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def test_it_knows_nothing_of_needletrack() -> None:
    imported = {
        alias.name.split(".")[0]
        for node in ast.walk(ast.parse(SCRIPT.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert imported - sys.stdlib_module_names == {"zenoh"}


def test_it_acts_on_good_tracks_and_holds_on_others(endpoint: str) -> None:
    known, pair = example_track()
    stamp, run = pair.captured_at_ns, example_run()
    answers = [
        NeedleTrack(stamp, Status.OK, (), known.curve, known.tip),
        NeedleTrack(stamp, Status.INVALID, (Reason.NO_CANDIDATE, Reason.JUMP)),
        NeedleTrack(stamp, Status.OK, (), known.curve, known.tip),
        NeedleTrack(stamp, Status.OK, (), known.curve, known.tip),
    ]
    with ZenohPublisher(run, lambda: example_messages()[1], listen=[endpoint]) as publisher:
        command = [sys.executable, str(SCRIPT), "--rig", "lab", "--connect", endpoint, "--count", "4"]
        with subprocess.Popen(
            [*command, "--max-age-ms", "60000"], stdout=subprocess.PIPE, text=True, encoding="utf-8"
        ) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == "daemon alive\n"
                assert publisher.wait_for_subscriber(WAIT_S)
                for sequence, answer in zip((7, 8, 11, 12), answers, strict=True):
                    message = TrackMessage.from_track(answer, pair, run, dropped={}, published=Instant.now())
                    late_ms = 70_000.0 if sequence == 12 else 8.0
                    publisher.publish(message.model_copy(update={"sequence": sequence, "latency_ms": late_ms}))
                output, _ = process.communicate(timeout=WAIT_S)
            finally:
                process.kill()
    assert process.returncode == 0
    lines = output.splitlines()
    x, y, z = example_messages()[0].tip.position_mm  # type: ignore[union-attr]
    assert lines[:3] == [
        f"tip 7 at ({x:.3f}, {y:.3f}, {z:.3f}) mm in lab_left",
        "hold: 8 is invalid: no_candidate, jump",
        f"tip 11 at ({x:.3f}, {y:.3f}, {z:.3f}) mm in lab_left (2 missing before it)",
    ]
    assert re.fullmatch(r"hold: 12 is 7\d{4} ms old", lines[3])
