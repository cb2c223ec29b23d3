"""A run as the person at a terminal sees and ends it: progress, warnings, Ctrl-C, summary."""

import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from logging.handlers import MemoryHandler
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from needletrack.capture.pairing import SkewReport
from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.records import DropReason, NeedleTrack, Status, StereoPair
from needletrack.service import RunSummary

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from rich.console import Console
    from rich.progress import Progress

    from needletrack.watch import WatchSummary

_MOST_REASONS = 4


class Interruption:
    """Sets `stop` on the first Ctrl-C or SIGTERM; the next one ends the program at once."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self._signal: int | None = None

    @property
    def exit_code(self) -> int:
        """0, or 128 + the signal that came, as a shell says it: 130 for Ctrl-C."""
        return 0 if self._signal is None else 128 + self._signal

    def __enter__(self) -> Self:
        self._before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in self._before:
            signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signal = number
        self._restore()
        self.stop.set()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


class ProgressBar:
    """A sink that draws how far a replay has come; draws nothing where the console is no terminal.

    first: the first pair's sequence number; total: pairs to be played.
    """

    def __init__(self, console: "Console", first: int, total: int) -> None:
        # Not console.is_terminal, which FORCE_COLOR makes true of a pipe.
        hidden = not console.file.isatty()
        self._progress = _bar(console, disable=hidden)
        self._task = self._progress.add_task("", total=total)
        self._first = first

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """One more pair is done, and those before it are done or lost."""
        done = pair.sequence - self._first + 1
        self._progress.update(self._task, completed=done, description=f"{track.status.value:8}")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()


@contextmanager
def steps_shown(console: "Console", what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar of so many steps while it lasts; gives what to call with how many are done."""
    with _bar(console, disable=not console.file.isatty()) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


@contextmanager
def warnings_shown(console: "Console", *, at_end: bool = False) -> Iterator[None]:
    """What the package logs within it, on the console; at_end: not before it ends."""
    handler: logging.Handler = _ConsoleHandler(console)
    if at_end:
        # Never flushed by a record's level; closing it flushes.
        handler = MemoryHandler(10_000, flushLevel=logging.CRITICAL + 1, target=handler)
    logger = logging.getLogger("needletrack")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


def described(summary: RunSummary) -> str:
    """A run's summary in a few lines."""
    rate_hz = summary.pairs / summary.duration_s if summary.duration_s > 0 else 0.0
    first = f"{summary.pairs} pairs in {summary.duration_s:.1f} s, {rate_hz:.1f} a second"
    if summary.tracking_ms:
        p50, p99 = np.percentile(summary.tracking_ms, [50, 99])
        first += f"; tracking p50 {p50:.1f} ms, p99 {p99:.1f} ms"
    return "\n".join((first, f"  {statuses_text(summary)}", f"  dropped: {counted(summary.dropped) or 'none'}"))


def described_skew(skew: SkewReport) -> str:
    """`  cameras: hardware_triggered; right is 12 ± 9 us after left`, as the stamps say it."""
    if skew.offset_us is None:
        return "  cameras: too few frames to tell how they are triggered"
    spread = "" if skew.spread_us is None else f" ± {skew.spread_us:.0f}"
    drift = "" if skew.drift_ppm is None else f", drifting by {skew.drift_ppm:.1f} ± {skew.drift_sigma_ppm:.1f} us/s"
    return f"  cameras: look {skew.looks.value}; right is {skew.offset_us:.0f}{spread} us after left{drift}"


def statuses_text(summary: RunSummary) -> str:
    """`ok 20, degraded 3, invalid 1 (tip_not_seen 3, no_candidate 1)`: the most frequent reasons."""
    statuses = ", ".join(f"{status.value} {summary.statuses.get(status, 0)}" for status in Status)
    most = sorted(summary.reasons.items(), key=lambda entry: -entry[1])
    more = f", and {len(most) - _MOST_REASONS} more" if len(most) > _MOST_REASONS else ""
    return statuses + (f" ({counted(dict(most[:_MOST_REASONS]))}{more})" if most else "")


def counted(counts: Mapping[DropReason, int] | Mapping[str, int]) -> str:
    """`overwritten 12, unpaired_left 1`, the most frequent first."""
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items(), key=lambda entry: -entry[1]))


def write_summary(summary: "WatchSummary", path: Path) -> None:
    """Write what was received as JSON; raises RecordingError where the file cannot be written."""
    # pydantic knows no read-only mapping.
    plain = replace(summary, statuses=dict(summary.statuses))
    try:
        path.write_bytes(_summaries().dump_json(plain, indent=2) + b"\n")
    except OSError as error:
        raise RecordingError(f"{path}: the summary cannot be written: {error.strerror or error}") from error


def read_summary(path: Path) -> "WatchSummary":
    """What `write_summary` wrote."""
    return _summaries().validate_json(path.read_bytes())


def _summaries() -> "TypeAdapter[WatchSummary]":
    from pydantic import TypeAdapter

    from needletrack.watch import WatchSummary

    return TypeAdapter(WatchSummary)


def _bar(console: "Console", *, disable: bool) -> "Progress":
    # With the rest of rich it takes 0.05 s to load, for which a daemon that shows none does not wait.
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=disable)


class _ConsoleHandler(logging.Handler):
    def __init__(self, console: "Console") -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = f"{record.levelname.lower()}: {record.getMessage()}"
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
