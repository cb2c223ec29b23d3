"""A rig's tracks on a terminal: the subscriber that a person reads."""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from rich.console import Console, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from needletrack.client import Freshness, Health, Received, StatusMessage, Subscriber
from needletrack.publish.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX
from needletrack.publish.session import Mode
from needletrack.publish.tls import TlsFiles
from needletrack.records import Status

DRAW_PERIOD_S = 0.1
LINE_PERIOD_S = 1.0
RATE_OVER_S = 1.0
LATENCIES_REMEMBERED = 10_000
# A person looks, and no robot moves: a slow replay need not flicker.
MAX_AGE_S = 0.2
# What was sent before the daemon went may still be on its way through this process.
LAST_TRACKS_S = 0.2

STATUS_STYLE: Mapping[str, str] = MappingProxyType(
    {Status.OK: "bold green", Status.DEGRADED: "bold yellow", Status.INVALID: "bold red"}
)
HEALTH_STYLE: Mapping[Freshness, str] = MappingProxyType(
    {
        Freshness.FRESH: "green",
        Freshness.STALE: "bold yellow",
        Freshness.SILENT: "bold red",
        Freshness.GONE: "bold red",
        Freshness.NEVER_SEEN: "yellow",
    }
)


@dataclass(frozen=True, slots=True)
class WatchSummary:
    """What was received in all; rate over the time from the first to the last track.

    statuses: tracks by status. Latencies from the exposure (live) or the pair's release (replay) to the
    receipt here, of the last 10,000 tracks; None where no track told. dropped: by the daemon, lost: on
    the way, overflowed: here. health: at the end.
    """

    messages: int
    statuses: Mapping[str, int]
    duration_s: float
    rate_hz: float | None
    latency_ms_p50: float | None
    latency_ms_p99: float | None
    dropped: int
    lost: int
    overflowed: int
    undecodable: int
    health: Health

    def __str__(self) -> str:
        """One line for a log or the end of a program."""
        statuses = ", ".join(f"{count} {status}" for status, count in self.statuses.items())
        missed = f"dropped {self.dropped}, lost {self.lost}"
        if self.overflowed:
            missed += f", overflowed {self.overflowed}"
        if self.undecodable:
            missed += f", undecodable {self.undecodable}"
        return (
            f"{self.messages} tracks{f' ({statuses})' if statuses else ''} in {self.duration_s:.1f} s, "
            f"{_number(self.rate_hz, 1)} Hz; latency p50 {_number(self.latency_ms_p50, 1)} ms, "
            f"p99 {_number(self.latency_ms_p99, 1)} ms; {missed}"
        )


def watch(
    rig: str,
    connect: Sequence[str] = (DEFAULT_ENDPOINT,),
    *,
    key_prefix: str = DEFAULT_PREFIX,
    mode: Mode = "peer",
    tls: TlsFiles | None = None,
    until_gone: bool = False,
    count: int | None = None,
    wait_s: float | None = None,
    max_age_s: float = MAX_AGE_S,
    stop: threading.Event | None = None,
    console: Console | None = None,
) -> WatchSummary:
    """Show a rig's tracks until Ctrl-C, `stop`, `count` tracks, or (until_gone) until the daemon has gone.

    mode, tls: as of `Subscriber`. On a terminal a panel, drawn ten times a second; elsewhere a line a second. Raises
    PublishError where the daemon is not there within wait_s (None: wait for ever). max_age_s: an older track is shown
    as stale.
    """
    console = console or Console()
    stop = stop or threading.Event()
    with Subscriber(rig, connect, key_prefix=key_prefix, mode=mode, tls=tls, max_age_s=max_age_s) as subscriber:
        if wait_s is not None:
            subscriber.wait_for_daemon(wait_s)
        tally = _Tally(subscriber, where=" ".join(connect))
        with suppress(KeyboardInterrupt), _display(console, tally) as (draw, period_s):
            draw_at = time.monotonic()
            while not (stop.is_set() or tally.messages == count):
                if time.monotonic() >= draw_at:
                    draw()
                    draw_at = max(draw_at + period_s, time.monotonic())
                gone = until_gone and subscriber.health.state is Freshness.GONE
                wait = LAST_TRACKS_S if gone else min(DRAW_PERIOD_S, max(0.0, draw_at - time.monotonic()))
                received = subscriber.next(wait)
                if received is not None:
                    tally.add(received)
                elif gone:
                    break
            draw()
        return tally.summary()


class _Tally:
    """What has been received so far, and how it reads."""

    def __init__(self, subscriber: Subscriber, where: str) -> None:
        self._subscriber = subscriber
        self._where = where
        self._began_ns = time.monotonic_ns()
        self._first_ns: int | None = None
        self._newest: Received | None = None
        self._recent_ns: deque[int] = deque()
        self._latencies_ms: deque[float] = deque(maxlen=LATENCIES_REMEMBERED)
        self._statuses: Counter[str] = Counter()
        self._dropped = self._lost = self._overflowed = 0

    @property
    def messages(self) -> int:
        return self._statuses.total()

    def add(self, received: Received) -> None:
        self._newest = received
        if self._first_ns is None:
            self._first_ns = received.received_monotonic_ns
        self._recent_ns.append(received.received_monotonic_ns)
        self._statuses[received.message.status.value] += 1
        if received.latency_ms is not None:
            self._latencies_ms.append(received.latency_ms)
        self._dropped += received.missed.dropped
        self._lost += received.missed.lost
        self._overflowed += received.missed.overflowed

    def summary(self) -> WatchSummary:
        duration_s = 0.0
        if self._newest is not None and self._first_ns is not None:
            duration_s = (self._newest.received_monotonic_ns - self._first_ns) / 1e9
        return WatchSummary(
            messages=self.messages,
            statuses=MappingProxyType({status.value: self._statuses[status.value] for status in Status}),
            duration_s=duration_s,
            rate_hz=(self.messages - 1) / duration_s if duration_s > 0 else None,
            latency_ms_p50=self._latency_ms(50),
            latency_ms_p99=self._latency_ms(99),
            dropped=self._dropped,
            lost=self._lost,
            overflowed=self._overflowed,
            undecodable=self._subscriber.undecodable,
            health=self._subscriber.health,
        )

    def line(self) -> str:
        """One line without control codes."""
        health = self._subscriber.health
        state = health.state.value + (f": {health.reason}" if health.reason else "")
        seconds = (time.monotonic_ns() - self._began_ns) / 1e9
        if self._newest is None:
            return _plain(f"{seconds:7.1f} s  {state}")
        parts = (
            f"{seconds:7.1f} s",
            _status(self._newest),
            f"tip {_tip(self._newest)}",
            f"length {_number(self._newest.message.length_mm, 2)} mm",
            f"{_number(self._rate_hz(), 1)} Hz",
            f"latency {_number(self._newest.latency_ms, 1)} ms",
            f"dropped {self._dropped}",
            f"lost {self._lost}",
            f"clock {self._clock()}",
            state,
        )
        return _plain("  ".join(parts))

    def panel(self) -> RenderableType:
        """The picture for a terminal."""
        health = self._subscriber.health
        rows = Table.grid(padding=(0, 2))
        rows.add_column(style="dim", justify="right", no_wrap=True)
        rows.add_column()
        if self._newest is not None:
            message = self._newest.message
            rows.add_row("track", Text(_plain(_status(self._newest)), style=STATUS_STYLE[message.status]))
            rows.add_row("tip", _tip(self._newest))
            rows.add_row("length", f"{_number(message.length_mm, 2)} mm")
            rows.add_row(
                "latency",
                f"{_number(self._newest.latency_ms, 1)} ms   p50 {_number(self._latency_ms(50), 1)}"
                f"   p99 {_number(self._latency_ms(99), 1)}",
            )
            rows.add_row("rate", f"{_number(self._rate_hz(), 1)} Hz   {self.messages} tracks   {self._shares()}")
            rows.add_row("missed", Text(_plain(self._missed())))
        age = "" if health.age_ms is None else f"   {health.age_ms:.0f} ms old"
        reason = f"   {health.reason}" if health.reason else ""
        rows.add_row("link", Text(_plain(f"{health.state.value}{age}{reason}"), style=HEALTH_STYLE[health.state]))
        rows.add_row("clock", Text(_plain(self._clock())))
        if (status := self._subscriber.status) is not None:
            rows.add_row("daemon", Text(_plain(_daemon(status))))
        return Panel(rows, title=f"needletrack · {self._subscriber.keys.rig}", subtitle=self._where, title_align="left")

    def _rate_hz(self) -> float | None:
        since_ns = time.monotonic_ns() - int(RATE_OVER_S * 1e9)
        while self._recent_ns and self._recent_ns[0] < since_ns:
            self._recent_ns.popleft()
        if len(self._recent_ns) < 2:
            return None
        return (len(self._recent_ns) - 1) / ((self._recent_ns[-1] - self._recent_ns[0]) / 1e9)

    def _latency_ms(self, percent: float) -> float | None:
        return float(np.percentile(self._latencies_ms, percent)) if self._latencies_ms else None

    def _shares(self) -> str:
        return "   ".join(f"{count} {status}" for status, count in sorted(self._statuses.items()))

    def _clock(self) -> str:
        clock = self._subscriber.clock
        return "not compared" if clock is None else str(clock)

    def _missed(self) -> str:
        reasons = ""
        if self._newest is not None and self._newest.message.dropped:
            counts = self._newest.message.dropped.items()
            reasons = f" (daemon's count: {', '.join(f'{reason} {count}' for reason, count in counts)})"
        here = f"   {self._overflowed} overflowed here" if self._overflowed else ""
        return f"{self._dropped} dropped{reasons}   {self._lost} lost on the way{here}"


@contextmanager
def _display(console: Console, tally: _Tally) -> Iterator[tuple[Callable[[], None], float]]:
    """What draws the tally, and how often to call it."""
    if not console.is_terminal:
        yield (
            lambda: console.print(tally.line(), markup=False, highlight=False, soft_wrap=True),
            LINE_PERIOD_S,
        )
        return
    with Live(tally.panel(), console=console, auto_refresh=False) as live:
        yield lambda: live.update(tally.panel(), refresh=True), DRAW_PERIOD_S


def _plain(text: str) -> str:
    """What came over the wire, as it may stand on a terminal: nothing in it moves the cursor or rings the bell."""
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)


def _status(received: Received) -> str:
    message = received.message
    return message.status.value + (f" ({', '.join(message.reasons)})" if message.reasons else "")


def _tip(received: Received) -> str:
    tip = received.message.tip
    if tip is None:
        return "-"
    axes = zip("xyz", tip.position_mm, range(3), strict=True)
    return "  ".join(f"{axis} {mm:.2f} ± {math.sqrt(tip.covariance_mm2[i][i]):.2f}" for axis, mm, i in axes) + " mm"


def _daemon(status: StatusMessage) -> str:
    age = status.calibration.age_days
    calibration = "" if age is None else f"   calibrated {age:.0f} days ago"
    calibration += "" if status.calibration.warning is None else ": too long"
    error = "" if status.last_error is None else f"   {status.last_error}"
    rate = f"{status.rates.pairs_per_s:.1f} pairs/s"
    return f"{status.source.value} {status.state.value}   {rate}{calibration}{error}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
