import io
import re
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
from rich.console import Console

from needletrack.client import Freshness
from needletrack.errors import PublishError
from needletrack.publish.message import Instant, StatusMessage, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run, example_track
from needletrack.records import DropReason, NeedleTrack, Reason, Status
from needletrack.watch import WatchSummary, watch

WAIT_S = 10.0


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def daemon(endpoint: str, warning: str | None = None) -> Iterator[ZenohPublisher]:
    example = example_messages()[1]

    def status() -> StatusMessage:
        calibration = example.calibration.model_copy(update={"warning": warning})
        return example.model_copy(update={"calibration": calibration})

    with ZenohPublisher(example_run(), status, listen=[endpoint]) as publisher:
        yield publisher


@contextmanager
def watching(endpoint: str, console: Console, **options: Any) -> Iterator[Future[WatchSummary]]:
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(watch, "lab", [endpoint], console=console, **options)


def paper() -> Console:
    return Console(file=io.StringIO(), width=200)


def screen() -> Console:
    return Console(file=io.StringIO(), width=120, force_terminal=True, color_system="truecolor")


def shown(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def message(sequence: int, status: Status = Status.OK, dropped: int = 0) -> TrackMessage:
    known, pair = example_track(points=8)
    stamp = pair.captured_at_ns
    track = {
        Status.OK: NeedleTrack(stamp, Status.OK, (), known.curve, known.tip),
        Status.DEGRADED: NeedleTrack(stamp, Status.DEGRADED, (Reason.TIP_NOT_SEEN,), known.curve),
        Status.INVALID: NeedleTrack(stamp, Status.INVALID, (Reason.NO_CANDIDATE,)),
    }[status]
    now = Instant.now()
    counts = {DropReason.OVERWRITTEN: dropped}
    made = TrackMessage.from_track(track, pair, example_run(), dropped=counts, published=now)
    return made.model_copy(update={"sequence": sequence, "latency_ms": 12.0})


def test_a_watch_until_the_daemon_has_gone_counts_everything(endpoint: str) -> None:
    console = paper()
    with watching(endpoint, console, until_gone=True) as summary:
        with daemon(endpoint) as publisher:
            assert publisher.wait_for_subscriber(WAIT_S)
            for number in range(6):
                publisher.publish(message(number))
            publisher.publish(message(8, Status.DEGRADED, dropped=1))  # one of two missing was dropped
            publisher.publish(message(9, Status.INVALID, dropped=1))
        result = summary.result(WAIT_S)
    assert result.messages == 8
    assert dict(result.statuses) == {"ok": 6, "degraded": 1, "invalid": 1}
    assert (result.dropped, result.lost, result.overflowed, result.undecodable) == (1, 1, 0, 0)
    assert result.rate_hz == pytest.approx(7 / result.duration_s)
    assert result.latency_ms_p50 is not None
    assert result.latency_ms_p99 is not None
    assert 12.0 <= result.latency_ms_p50 <= result.latency_ms_p99
    assert result.health.state is Freshness.GONE
    assert re.fullmatch(
        r"8 tracks \(6 ok, 1 degraded, 1 invalid\) in \d+\.\d s, \d+\.\d Hz; "
        r"latency p50 \d+\.\d ms, p99 \d+\.\d ms; dropped 1, lost 1",
        str(result),
    )


def test_in_a_pipe_there_are_plain_lines(endpoint: str) -> None:
    console = paper()
    with watching(endpoint, console, count=3) as summary, daemon(endpoint) as publisher:
        assert publisher.wait_for_subscriber(WAIT_S)
        for number in range(3):
            publisher.publish(message(number))
        assert summary.result(WAIT_S).messages == 3
    lines = shown(console).splitlines()
    assert "\x1b" not in shown(console)
    x, y, z = message(0).tip.position_mm  # type: ignore[union-attr]
    assert f"ok  tip x {x:.2f} ± 0.02  y {y:.2f} ± 0.02  z {z:.2f} ± 0.05 mm  length 50.00 mm" in lines[-1]
    assert "dropped 0  lost 0  clock " in lines[-1]


def test_reasons_are_shown(endpoint: str) -> None:
    for status, words in (
        (Status.DEGRADED, "degraded (tip_not_seen)"),
        (Status.INVALID, "invalid (no_candidate)"),
    ):
        console = paper()
        with watching(endpoint, console, count=1) as summary, daemon(endpoint) as publisher:
            assert publisher.wait_for_subscriber(WAIT_S)
            publisher.publish(message(0, status))
            summary.result(WAIT_S)
        assert words in shown(console)
        assert "tip -" in shown(console)


def test_on_a_terminal_there_is_a_panel(endpoint: str) -> None:
    console = screen()
    with watching(endpoint, console, until_gone=True) as summary:
        with daemon(endpoint, "calibrated 28 days ago, more than 20") as publisher:
            assert publisher.wait_for_subscriber(WAIT_S)
            for number in (0, 2):
                publisher.publish(message(number, dropped=number // 2))
            # The clocks are compared as soon as the daemon is seen, and drawn ten times a second.
            threading.Event().wait(0.4)
        assert summary.result(WAIT_S).messages == 2
    last = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown(console)).rsplit("needletrack · lab", maxsplit=1)[-1]
    for words in (
        "track  ok",
        "length  50.00 mm",
        "2 tracks   2 ok",
        "1 dropped (daemon's count: overwritten 1)   0 lost on the way",
        "gone",
        "clock  ours is ",
        "live running   60.0 pairs/s   calibrated 28 days ago: too long",
        endpoint,
    ):
        assert words in last
    assert "\x1b[1;32mok" in shown(console)


def test_a_daemon_that_never_comes_ends_the_watch(endpoint: str) -> None:
    with pytest.raises(PublishError, match=f"nobody answers at {endpoint}"):
        watch("lab", [endpoint], wait_s=0.02, console=paper())


def test_stopping_a_watch_without_a_track(endpoint: str) -> None:
    stop = threading.Event()
    console = paper()
    with watching(endpoint, console, stop=stop) as summary:
        stop.set()
        result = summary.result(WAIT_S)
    assert (result.messages, result.rate_hz, result.latency_ms_p50) == (0, None, None)
    assert result.health.state is Freshness.NEVER_SEEN
    assert str(result) == (
        "0 tracks (0 ok, 0 degraded, 0 invalid) in 0.0 s, - Hz; latency p50 - ms, p99 - ms; dropped 0, lost 0"
    )
    assert "no daemon for rig 'lab' has been seen yet" in shown(console)
