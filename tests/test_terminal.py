"""What a person at a terminal sees of a run, and how it is ended."""

import io
import logging
import signal
from pathlib import Path
from types import MappingProxyType

import pytest
from rich.console import Console

from needletrack.client import Freshness, Health
from needletrack.errors import RecordingError
from needletrack.publish.message import Instant, TrackMessage
from needletrack.publish.schema import example_run, example_track
from needletrack.records import DropReason, Status
from needletrack.service import RunSummary
from needletrack.terminal import (
    Interruption,
    ProgressBar,
    described,
    read_summary,
    warnings_shown,
    write_summary,
)
from needletrack.watch import WatchSummary


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_first_ctrl_c_stops_and_the_second_ends() -> None:
    inherited = signal.getsignal(signal.SIGINT)
    # A job in the background inherits an ignored SIGINT; this is about one in the foreground.
    before = signal.default_int_handler
    signal.signal(signal.SIGINT, before)
    with Interruption() as interruption:
        assert interruption.exit_code == 0
        assert not interruption.stop.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interruption.stop.is_set()
        assert interruption.exit_code == 130
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, inherited)


def test_a_service_manager_stops_it_too() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Interruption() as interruption:
        signal.raise_signal(signal.SIGTERM)
        assert interruption.stop.is_set()
        assert interruption.exit_code == 143
    assert signal.getsignal(signal.SIGTERM) is before


def test_nothing_is_caught_where_nothing_came() -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interruption() as interruption:
        assert signal.getsignal(signal.SIGINT) is not before
    assert interruption.exit_code == 0
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("file", [Terminal(), io.StringIO()], ids=["terminal", "pipe"])
def test_the_bar_is_drawn_on_a_terminal_alone(file: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    # A dumb terminal, as CI has, can draw no bar.
    monkeypatch.setenv("TERM", "xterm")
    track, pair = example_track()
    message = TrackMessage.from_track(track, pair, example_run(), dropped={}, published=Instant.now())
    # What FORCE_COLOR does to a console in a pipe.
    console = Console(file=file, force_terminal=True, width=100)
    with ProgressBar(console, first=pair.sequence - 6, total=20) as progress:
        progress.take(pair, track, message)
    if isinstance(file, Terminal):
        assert "7/20" in file.getvalue()
        assert "ok" in file.getvalue()
    else:
        assert file.getvalue() == ""


@pytest.mark.parametrize("at_end", [False, True])
def test_warnings_reach_the_console(at_end: bool) -> None:
    console = Console(file=io.StringIO(), width=20)
    assert isinstance(console.file, io.StringIO)
    logger = logging.getLogger("needletrack.recording.replay")
    with warnings_shown(console, at_end=at_end):
        logger.warning("pair %d is left out: [a/b.png] is truncated", 7)
        seen_within = console.file.getvalue()
    expected = "warning: pair 7 is left out: [a/b.png] is truncated\n"
    assert console.file.getvalue() == expected
    assert seen_within == ("" if at_end else expected)
    logger.warning("nobody listens any more")
    assert console.file.getvalue() == expected


def test_a_summary_counts_and_names_the_most_frequent_reasons() -> None:
    reasons = {"tip_not_seen": 1, "jump": 5, "too_short": 4, "too_long": 3, "high_residual": 2}
    summary = RunSummary(
        {Status.DEGRADED: 3, Status.OK: 20},
        reasons,
        {DropReason.UNPAIRED_LEFT: 1, DropReason.OVERWRITTEN: 12},
        duration_s=11.5,
        tracking_ms=(10.0, 20.0, 30.0),
    )
    assert described(summary).splitlines() == [
        "23 pairs in 11.5 s, 2.0 a second; tracking p50 20.0 ms, p99 29.8 ms",
        "  ok 20, degraded 3, invalid 0 (jump 5, too_short 4, too_long 3, high_residual 2, and 1 more)",
        "  dropped: overwritten 12, unpaired_left 1",
    ]


def test_the_summary_of_a_run_that_tracked_nothing() -> None:
    assert described(RunSummary({}, {}, {}, duration_s=0.0, tracking_ms=())).splitlines() == [
        "0 pairs in 0.0 s, 0.0 a second",
        "  ok 0, degraded 0, invalid 0",
        "  dropped: none",
    ]


def test_what_a_subscriber_counted_survives_the_way_through_a_file(tmp_path: Path) -> None:
    health = Health(Freshness.GONE, "the daemon stopped", 12.5)
    statuses = MappingProxyType({"ok": 7, "degraded": 0, "invalid": 1})
    summary = WatchSummary(8, statuses, 1.5, 4.7, None, 80.25, 3, 1, 0, 0, health)
    write_summary(summary, tmp_path / "received.json")
    assert read_summary(tmp_path / "received.json") == summary
    with pytest.raises(RecordingError, match=r"nowhere.received\.json"):
        write_summary(summary, tmp_path / "nowhere" / "received.json")
