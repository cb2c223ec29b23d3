"""Tracks for Python controllers: typed, with their age, and with the truth about what is missing.

docs/wire.md shows a control loop.
"""

import atexit
import statistics
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import zenoh

from needletrack.errors import PublishError
from needletrack.publish.access import Role, common_name
from needletrack.publish.clock import ClockDifference, ClockFilter, ClockMessage, Question
from needletrack.publish.control import (
    ControlReply,
    ControlRequest,
    NeedleReply,
    NeedleRequest,
    Outcome,
    RedetectReply,
    RedetectRequest,
    SnapshotReply,
    SnapshotRequest,
    StartRecordingReply,
    StartRecordingRequest,
    StopRecordingReply,
    StopRecordingRequest,
)
from needletrack.publish.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX, RigKeys
from needletrack.publish.message import StatusMessage, TrackMessage
from needletrack.publish.session import Mode, NobodyAnswers, direct, open_session
from needletrack.publish.tls import TlsFiles
from needletrack.records import DropReason

if TYPE_CHECKING:
    from needletrack.config import SubscribingConfig

__all__ = [
    "ClockDifference",
    "ControlReply",
    "ControlRequest",
    "Freshness",
    "Health",
    "Missed",
    "NeedleReply",
    "NeedleRequest",
    "Outcome",
    "Received",
    "RedetectReply",
    "RedetectRequest",
    "SnapshotReply",
    "SnapshotRequest",
    "StartRecordingReply",
    "StartRecordingRequest",
    "StatusMessage",
    "StopRecordingReply",
    "StopRecordingRequest",
    "Subscriber",
    "TrackMessage",
    "control",
    "control_configured",
]

# A track comes for every pair, also an invalid one: this many periods without any are silence.
SILENT_PERIODS = 5
SILENT_AFTER_S = (0.05, 3.0)
SILENT_BEFORE_RATE_IS_KNOWN_S = 1.0
# Tracks come late on a busy machine, and the next one sooner after: of single periods the median wandered from 24 to
# 118 ms for five at 60 Hz (jitter of 12 ms, exponential), that of means of four from 74 to 99; two gaps do not move it.
PERIODS_REMEMBERED = 24
_PERIODS_AVERAGED = 4
HEARTBEATS_MISSED = 3
# Enough for one of them to have met a short queue; later ones go with the heartbeats.
CLOCK_QUESTIONS_AT_FIRST = 4
QUESTION_TIMEOUT_S = 1.0
# A session needs a moment to meet the daemon, and to learn what it answers.
ASK_AGAIN_S = 0.05
# A client cannot open before its router is there (zenoh 1.10): it is tried again, as often as Zenoh would.
CLIENT_TRIES_EVERY_S = 0.5

# Single frames: they never became a pair, and so never had a number that could be missing.
FRAME_DROPS = frozenset(
    {
        DropReason.UNPAIRED_LEFT,
        DropReason.UNPAIRED_RIGHT,
        DropReason.STAMP_OUT_OF_ORDER,
        DropReason.MISSING_IMAGE,
        DropReason.LOST_BY_DRIVER,
        DropReason.BUFFER_ERROR,
    }
)


class Freshness(StrEnum):
    """Whether the newest track may still be acted on; says nothing about its status."""

    FRESH = "fresh"
    STALE = "stale"
    SILENT = "silent"
    GONE = "gone"
    NEVER_SEEN = "never_seen"


@dataclass(frozen=True, slots=True)
class Health:
    """The state, one sentence why (empty when fresh), and the newest track's age."""

    state: Freshness
    reason: str
    age_ms: float | None


@dataclass(frozen=True, slots=True)
class Missed:
    """Pairs between a track and the one received before it.

    dropped: by the daemon, as its counters say; lost: on the way; overflowed: here, in the queue of a
    reader that was too slow.
    """

    dropped: int = 0
    lost: int = 0
    overflowed: int = 0

    def after(self, gone: "Missed") -> "Missed":
        """The same, where the track before was dropped here, which missed some itself."""
        return Missed(self.dropped + gone.dropped, self.lost + gone.lost, self.overflowed + gone.overflowed + 1)


@dataclass(frozen=True, slots=True)
class Received:
    """One track as it arrived; received_at_ns is Unix time, received_monotonic_ns CLOCK_MONOTONIC.

    clock: what was known then of both hosts' clocks; None: not yet measured.
    """

    message: TrackMessage
    received_at_ns: int
    received_monotonic_ns: int
    missed: Missed
    clock: ClockDifference | None = None

    @property
    def transit_ms(self) -> float | None:
        """From publishing to receiving, corrected for what is known of the clocks; None in a deterministic replay."""
        published = self.message.published_at_ns
        if published is None:
            return None
        by_clocks_ms = (self.received_at_ns - published) / 1e6
        # Clocks that may be alike, as on one host, are taken as they are: a correction would only add its error.
        if self.clock is None or abs(self.clock.ours_minus_daemons_ms) <= self.clock.uncertainty_ms:
            return by_clocks_ms
        return by_clocks_ms - self.clock.ours_minus_daemons_ms

    @property
    def latency_ms(self) -> float | None:
        """From the exposure (live) or the pair's release (replay) to receiving; None where unknown."""
        transit, before = self.transit_ms, self.message.latency_ms
        return None if transit is None or before is None else before + transit

    @property
    def age_ms(self) -> float:
        """How old the track is now: since the exposure (live) or the pair's release (replay).

        A replay's recorded stamps do not count. Nor does a difference of the clocks, once it is measured. At least
        what this host alone can vouch for, so that a daemon's clock that runs ahead cannot make an old track look
        young.
        """
        here = (time.monotonic_ns() - self.received_monotonic_ns) / 1e6
        return here + max(self.message.latency_ms or 0.0, self.latency_ms or 0.0)


@dataclass(frozen=True, slots=True)
class _Sample:
    """A payload as it came in, before anybody had time to read it."""

    payload: bytes
    arrival: int
    received_at_ns: int
    received_monotonic_ns: int


class _Link(NamedTuple):
    """What is asked of an open session later."""

    info: zenoh.SessionInfo
    liveliness: zenoh.Liveliness
    status_query: zenoh.Querier
    clock_query: zenoh.Querier


class Subscriber:
    """Receives one rig's tracks; every method may be called from any thread.

    max_age_s: an older track is stale. silent_after_s: silence is noticed after it (None: five periods
    of the rate seen, 0.05 s at least, so within 0.1 s at 60 Hz; three heartbeats that are due). capacity:
    tracks kept for `next` and iteration; the oldest is dropped and counted. It is no error if the daemon is
    not there yet: `health` says never_seen, and it is found when it comes. mode: "client" where `connect` names
    a router, which passes nothing on between two peers. tls: our part of the link's TLS. Raises PublishError for a
    malformed endpoint or rig name, and a file of tls that cannot be used.
    """

    def __init__(
        self,
        rig: str,
        connect: Sequence[str] = (DEFAULT_ENDPOINT,),
        *,
        listen: Sequence[str] = (),
        key_prefix: str = DEFAULT_PREFIX,
        max_age_s: float = 0.1,
        silent_after_s: float | None = None,
        capacity: int = 64,
        mode: Mode = "peer",
        tls: TlsFiles | None = None,
    ) -> None:
        self.keys = RigKeys(rig, key_prefix)
        self._endpoints = (*connect, *listen)
        self._max_age_ms = max_age_s * 1000
        self._silent_after_s = silent_after_s
        # Zenoh's threads take this lock for an append only, and nothing of Zenoh is called under it.
        self._changed = threading.Condition()
        self._closed = False
        self._arrived: deque[_Sample] = deque(maxlen=capacity)
        self._arrivals = 0
        self._queue: deque[Received] = deque(maxlen=capacity)
        self._latest: Received | None = None
        self._decoded_arrivals = 0
        self._overflowed_before_next = 0
        self._last_track_ns: int | None = None
        self._periods_s: deque[float] = deque(maxlen=PERIODS_REMEMBERED)
        self._clock = ClockFilter()
        self._overflowed = 0
        self._undecodable = 0
        self._unreadable_reason = ""
        self._alive: bool | None = None
        self._status: StatusMessage | None = None
        self._status_monotonic_ns = 0
        self._tls, self._mode, self._listen, self._connect = tls, mode, tuple(listen), tuple(connect)
        self._link: _Link | None = None
        self._why_not_open = ""
        opened = ExitStack()
        # A program that ends without `close` closes the session all the same.
        self._close_session = weakref.finalize(self, opened.close)
        try:
            self._open(opened)
        except NobodyAnswers:
            opening = threading.Thread(target=self._open_when_answered, args=(opened,), daemon=True)
            # A thread inside Zenoh while the interpreter ends would abort the process.
            atexit.register(self._give_up, opening)
            opening.start()

    @classmethod
    def configured(cls, rig: str, settings: "SubscribingConfig", **options: Any) -> Self:
        """As the `[subscribing]` table of a configuration has it; options: the others of the constructor."""
        return cls(
            rig,
            settings.connect,
            key_prefix=settings.key_prefix,
            mode=settings.mode,
            tls=TlsFiles.configured(settings.tls),
            **options,
        )

    def _open(self, opened: ExitStack) -> None:
        with ExitStack() as opening:
            session = opening.enter_context(
                open_session(self._listen, self._connect, mode=self._mode, tls=self._tls, rigs=[self.keys])
            )
            with self._changed:
                if self._closed:
                    return
                # The session object itself is left alone from here on: closing it fails ("Already borrowed")
                # while another thread calls a method of it.
                link = _Link(
                    session.info,
                    session.liveliness(),
                    session.declare_querier(self.keys.status, timeout=QUESTION_TIMEOUT_S),
                    session.declare_querier(
                        self.keys.clock,
                        timeout=QUESTION_TIMEOUT_S,
                        congestion_control=zenoh.CongestionControl.DROP,
                        priority=zenoh.Priority.INTERACTIVE_HIGH,
                        express=True,
                    ),
                )
                self._link = link
            session.declare_subscriber(self.keys.track, direct(self._on_track))
            session.declare_subscriber(self.keys.status, direct(self._on_status))
            link.liveliness.declare_subscriber(self.keys.alive, direct(self._on_liveliness), history=True)
            opened.push(opening.pop_all())
        if self._closed:
            opened.close()

    def _open_when_answered(self, opened: ExitStack) -> None:
        try:
            while not self._closed:
                try:
                    self._open(opened)
                except NobodyAnswers:
                    with self._changed:
                        self._changed.wait_for(lambda: self._closed, CLIENT_TRIES_EVERY_S)
                except PublishError as error:  # told by `health`, and by who waits for the daemon
                    self._why_not_open = str(error)
                    return
                else:
                    return
        finally:
            atexit.unregister(self._give_up)

    def _give_up(self, opening: threading.Thread) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        opening.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the session and end all iterations; may be called twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._close_session()

    def __iter__(self) -> Iterator[Received]:
        """Every track from now on, in order, until `close`."""
        while (received := self.next()) is not None:
            yield received

    def next(self, timeout_s: float | None = None) -> Received | None:
        """The oldest track not yet taken; None where none came within the time, or after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._decode() or bool(self._queue), timeout_s)
            return self._queue.popleft() if self._queue else None

    def latest(self) -> Received | None:
        """The newest track, whether taken before or not; None before the first. Never waits."""
        with self._changed:
            self._decode()
            return self._latest

    @property
    def status(self) -> StatusMessage | None:
        """The daemon's newest heartbeat; None before the first."""
        with self._changed:
            return self._status

    @property
    def overflowed(self) -> int:
        """Tracks dropped here because nobody took them in time."""
        with self._changed:
            return self._overflowed

    @property
    def undecodable(self) -> int:
        """Samples on our keys that were no messages of this version; `health` gives the newest reason."""
        with self._changed:
            self._decode()
            return self._undecodable

    @property
    def clock(self) -> ClockDifference | None:
        """How far this host's clock and the daemon's differ, asked with each heartbeat; None before the first answer.

        Ages are corrected for it, so that clocks which differ make no track older or younger.
        """
        with self._changed:
            return self._clock.at(time.monotonic_ns())

    @property
    def health(self) -> Health:
        """Whether the newest track may still be acted on."""
        with self._changed:
            self._decode()
            return self._health()

    def wait_for_daemon(self, timeout_s: float) -> None:
        """Return once the rig's daemon is there; raises PublishError that says what to check."""
        with self._changed:
            if self._changed.wait_for(lambda: bool(self._alive) or self._arrivals > 0, timeout_s):
                return
        raise PublishError(self._why_no_daemon(timeout_s))

    def wait_until_gone(self, timeout_s: float | None = None) -> bool:
        """Whether the daemon, once seen, was gone within the time."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._alive is False, timeout_s)
            return self._alive is False

    def _on_track(self, sample: zenoh.Sample) -> None:
        now_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
        payload = sample.payload.to_bytes()
        with self._changed:
            if len(self._arrived) == self._arrived.maxlen:
                self._overflowed += 1
            self._arrived.append(_Sample(payload, self._arrivals, now_ns, monotonic_ns))
            self._arrivals += 1
            self._changed.notify_all()

    def _on_status(self, sample: zenoh.Sample) -> None:
        self._take_status(sample.payload.to_bytes())
        self._ask_the_time()

    def _ask_the_time(self) -> None:
        """Send one question; its answer is taken in Zenoh's thread."""
        with self._changed:
            closed, link = self._closed, self._link
        if closed or link is None:
            return
        asked = Question(time.time_ns(), time.monotonic_ns())

        def take(reply: zenoh.Reply) -> None:
            answered_ns = time.monotonic_ns()
            if reply.ok is None:
                return
            try:
                answer = ClockMessage.from_json(reply.ok.payload.to_bytes())
            except PublishError as error:
                with self._changed:
                    self._unreadable(str(error))
                return
            with self._changed:
                self._clock.add(asked, answer, answered_ns)

        with suppress(zenoh.ZError):  # closed between the check and this line
            link.clock_query.get(direct(take))

    def _on_status_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._take_status(reply.ok.payload.to_bytes())

    def _take_status(self, payload: bytes) -> None:
        monotonic_ns = time.monotonic_ns()
        try:
            status = StatusMessage.from_json(payload)
        except PublishError as error:
            with self._changed:
                self._unreadable(str(error))
            return
        with self._changed:
            if status.rig != self.keys.rig:
                self._unreadable(f"a status of rig {status.rig!r} on {self.keys.status}")
                return
            self._status, self._status_monotonic_ns = status, monotonic_ns
            self._changed.notify_all()

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        with self._changed:
            self._alive = alive
            self._periods_s.clear()
            self._last_track_ns = None
            if alive:
                # What is known of the daemon that went says nothing of the next one.
                self._status_monotonic_ns = 0
                self._clock.forget()
            self._changed.notify_all()
            closed, link = self._closed, self._link
        if alive and not closed and link is not None:
            # A late joiner has the status at once, not at the next heartbeat.
            with suppress(zenoh.ZError):  # closed between the check and this line
                link.status_query.get(direct(self._on_status_reply))
            for _ in range(CLOCK_QUESTIONS_AT_FIRST):
                self._ask_the_time()

    def _decode(self) -> bool:
        """Turn what arrived into tracks, in order; whether there were any."""
        decoded = False
        while self._arrived:
            sample = self._arrived.popleft()
            self._overflowed_before_next += sample.arrival - self._decoded_arrivals
            self._decoded_arrivals = sample.arrival + 1
            try:
                message = TrackMessage.from_json(sample.payload)
            except PublishError as error:
                self._unreadable(str(error))
                continue
            if message.rig != self.keys.rig:
                self._unreadable(f"a message of rig {message.rig!r} on {self.keys.track}")
                continue
            self._unreadable_reason = ""
            received = Received(
                message,
                sample.received_at_ns,
                sample.received_monotonic_ns,
                self._missed(message, self._overflowed_before_next),
                self._clock.at(sample.received_monotonic_ns),
            )
            self._overflowed_before_next = 0
            if self._last_track_ns is not None:
                self._periods_s.append((sample.received_monotonic_ns - self._last_track_ns) / 1e9)
            self._last_track_ns = sample.received_monotonic_ns
            self._enqueue(received)
            self._latest = received
            decoded = True
        if decoded:
            self._changed.notify_all()
        return decoded

    def _enqueue(self, received: Received) -> None:
        """Keep a track for `next`; the oldest makes room, and what follows it tells what it would have told."""
        gone = self._queue.popleft() if len(self._queue) == self._queue.maxlen else None
        self._queue.append(received)
        if gone is None:
            return
        self._overflowed += 1
        head = self._queue[0]
        if head.message.run_id == gone.message.run_id:
            self._queue[0] = replace(head, missed=head.missed.after(gone.missed))

    def _unreadable(self, reason: str) -> None:
        self._undecodable += 1
        self._unreadable_reason = reason

    def _missed(self, message: TrackMessage, overflowed: int) -> Missed:
        last = None if self._latest is None else self._latest.message
        if last is None or last.run_id != message.run_id or message.sequence <= last.sequence:
            return Missed()  # the first of a run: what came before it was not ours to miss
        gap = message.sequence - last.sequence - 1
        overflowed = min(gap, overflowed)
        dropped = min(gap - overflowed, max(0, _pairs_dropped(message) - _pairs_dropped(last)))
        return Missed(dropped=dropped, lost=gap - overflowed - dropped, overflowed=overflowed)

    def _health(self) -> Health:
        age_ms = None if self._latest is None else self._latest.age_ms
        if self._alive is False:
            return Health(Freshness.GONE, "the daemon stopped, or the link to it broke", age_ms)
        if self._latest is None or age_ms is None:
            if self._alive is None and self._undecodable == 0:
                reason = self._why_not_open or f"no daemon for rig {self.keys.rig!r} has been seen yet"
                return Health(Freshness.NEVER_SEEN, reason, None)
            return Health(Freshness.SILENT, f"no track yet; {self._daemon_says()}", None)
        silence_s = (time.monotonic_ns() - self._latest.received_monotonic_ns) / 1e9
        if silence_s > (limit_s := self._silence_limit_s()):
            reason = f"no track for {silence_s:.2f} s (limit {limit_s:.2f} s); {self._daemon_says()}"
            return Health(Freshness.SILENT, reason, age_ms)
        if (quiet_s := self._heartbeat_overdue_s()) is not None:
            reason = f"tracks come, but no heartbeat for {quiet_s:.1f} s: part of the daemon hangs, or the link is full"
            return Health(Freshness.SILENT, reason, age_ms)
        if age_ms > self._max_age_ms:
            reason = f"the newest track is {age_ms:.0f} ms old (limit {self._max_age_ms:.0f} ms)"
            on_the_way_ms = self._latest.transit_ms or 0.0
            if silence_s * 1000 < self._max_age_ms < on_the_way_ms:
                reason += f", {on_the_way_ms:.0f} ms of it on the way: is the link slow?"
                if self._latest.clock is None:
                    reason += " Or do the clocks of both hosts differ? It could not be measured."
            return Health(Freshness.STALE, reason, age_ms)
        return Health(Freshness.FRESH, "", age_ms)

    def _silence_limit_s(self) -> float:
        if self._silent_after_s is not None:
            return self._silent_after_s
        if not self._periods_s:
            return SILENT_BEFORE_RATE_IS_KNOWN_S
        shortest_s, longest_s = SILENT_AFTER_S
        return min(max(SILENT_PERIODS * usual_period_s(self._periods_s), shortest_s), longest_s)

    def _heartbeat_overdue_s(self) -> float | None:
        """How long the heart of this daemon has been quiet, where that is too long; None where it never beat."""
        if self._status is None or not self._status_monotonic_ns:
            return None
        quiet_s = (time.monotonic_ns() - self._status_monotonic_ns) / 1e9
        limit_s = max(HEARTBEATS_MISSED * self._status.heartbeat_s, self._silent_after_s or 0.0)
        return quiet_s if quiet_s > limit_s else None

    def _daemon_says(self) -> str:
        if self._unreadable_reason:
            return f"{self._undecodable} samples could not be read, the newest: {self._unreadable_reason}"
        if self._status is None:
            return "nor a heartbeat"
        if (quiet_s := self._heartbeat_overdue_s()) is not None:
            return f"nor a heartbeat for {quiet_s:.1f} s: the daemon hangs, or the link does"
        error = f", its newest error: {self._status.last_error}" if self._status.last_error else ""
        return f"the daemon's heart beats ({self._status.state.value}){error}"

    def _why_no_daemon(self, timeout_s: float) -> str:
        link = self._link
        if link is None or not link.info.transports():
            return self._why_not_open or _why_no_link(self._connect, self._listen, self._tls, timeout_s)
        where = " or ".join(self._endpoints)
        if self._mode == "peer" and link.info.routers_zid():
            return _router_and_peers(where)
        others = self._rigs_alive(link)
        alive = f"rigs alive there: {', '.join(others)}" if others else "no other rig is alive there either"
        rights = ""
        if self._tls is not None:
            may = " and ".join(repr(common_name(self.keys.rig, role)) for role in (Role.CONTROLLER, Role.OPERATOR))
            rights = (
                f"; and the rights of our certificate: {_ours(self._tls)}, and rig {self.keys.rig!r} tells {may} alone"
            )
        return (
            f"{where} answers, but no daemon of rig {self.keys.rig!r} within {timeout_s:g} s: "
            f"check the rig's name and the key prefix {self.keys.prefix!r} ({alive}){rights}"
        )

    def _rigs_alive(self, link: _Link) -> list[str]:
        replies = link.liveliness.get(f"{self.keys.prefix}/*/alive", timeout=1.0)
        return sorted({str(reply.ok.key_expr).split("/")[-2] for reply in replies if reply.ok is not None})


def usual_period_s(periods_s: Sequence[float]) -> float:
    """How far apart tracks usually come, s: the median of the means of four in a row; of fewer, their median."""
    periods_s = list(periods_s)
    means_s = [
        statistics.fmean(periods_s[first : first + _PERIODS_AVERAGED])
        for first in range(len(periods_s) - _PERIODS_AVERAGED + 1)
    ]
    return statistics.median(means_s or periods_s)


def control(
    rig: str,
    request: ControlRequest,
    connect: Sequence[str] = (DEFAULT_ENDPOINT,),
    *,
    key_prefix: str = DEFAULT_PREFIX,
    mode: Mode = "peer",
    tls: TlsFiles | None = None,
    timeout_s: float = 10.0,
) -> ControlReply:
    """Ask a rig's daemon for something, and return its answer, whose class belongs to the request's.

    Asked again until an answer comes: the request's id sees to it that nothing is done twice. A refusal is an answer
    (`outcome`). mode, tls: as of `Subscriber`; over TLS the operator's certificate alone is answered. Raises
    PublishError where none comes in time, or it cannot be read.
    """
    keys = RigKeys(rig, key_prefix)
    key, until_s = keys.control(request.command), time.monotonic() + timeout_s
    reached = routed = False
    with _opened_in_time(keys, connect, mode, tls, until_s) as session:
        while session is not None and (left_s := until_s - time.monotonic()) > 0:
            for reply in session.get(key, payload=request.to_json(), timeout=left_s):
                if reply.ok is not None:
                    return request.reply_from_json(reply.ok.payload.to_bytes())
            reached = reached or bool(session.info.transports())
            routed = mode == "peer" and bool(session.info.routers_zid())
            time.sleep(min(ASK_AGAIN_S, left_s))
    if not reached:
        raise PublishError(_why_no_link(connect, (), tls, timeout_s))
    where = " or ".join(connect)
    if routed:
        raise PublishError(_router_and_peers(where))
    rights = "" if tls is None else f" {_ours(tls)}, and {common_name(rig, Role.OPERATOR)!r} alone may command it."
    raise PublishError(
        f"{where} answers, but nobody on {key} within {timeout_s:g} s: check the rig's name and the key prefix."
        f"{rights} A replay takes no requests. What was asked may have been done all the same: the same request, "
        "repeated, is answered with its outcome"
    )


def control_configured(
    rig: str, request: ControlRequest, settings: "SubscribingConfig", *, timeout_s: float = 10.0
) -> ControlReply:
    """`control`, as the `[subscribing]` table of a configuration has it."""
    return control(
        rig,
        request,
        settings.connect,
        key_prefix=settings.key_prefix,
        mode=settings.mode,
        tls=TlsFiles.configured(settings.tls),
        timeout_s=timeout_s,
    )


@contextmanager
def _opened_in_time(
    keys: RigKeys, connect: Sequence[str], mode: Mode, tls: TlsFiles | None, until_s: float
) -> Iterator[zenoh.Session | None]:
    """A session; None where nobody answered a client in time."""
    with ExitStack() as opened:
        session = None
        while session is None and time.monotonic() < until_s:
            try:
                session = opened.enter_context(open_session(connect=connect, mode=mode, tls=tls, rigs=[keys]))
            except NobodyAnswers:
                time.sleep(min(CLIENT_TRIES_EVERY_S, max(until_s - time.monotonic(), 0)))
        yield session


def _why_no_link(connect: Sequence[str], listen: Sequence[str], tls: TlsFiles | None, timeout_s: float) -> str:
    if tls is not None:
        whys = (f"{endpoint}: {why}" for endpoint in connect if (why := tls.why_refused(endpoint)))
        if why := "; ".join(whys):
            return f"no link within {timeout_s:g} s: {why}"
    return (
        f"nobody answers at {' or '.join((*connect, *listen))} within {timeout_s:g} s: is the daemon running, does it "
        "listen on this endpoint (publishing.listen in its configuration), does a firewall stand between?"
    )


def _router_and_peers(where: str) -> str:
    return (
        f"a router answers at {where}, and routers pass nothing on between two peers: be a client of it "
        '(subscribing.mode = "client" in the configuration, or --client)'
    )


def _ours(tls: TlsFiles) -> str:
    from needletrack.publish.certificates import name_of  # with cryptography, which only TLS needs

    return f"{tls.certificate} is {name_of(tls.check())!r}"


def _pairs_dropped(message: TrackMessage) -> int:
    return sum(count for reason, count in message.dropped.items() if reason not in FRAME_DROPS)
