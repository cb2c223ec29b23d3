"""The live loop: pairs in, tracks out, every loss counted.

A capture thread takes pairs from the source and puts each into a one-place slot in which the latest wins; the worker,
which is the thread that calls `run`, takes the newest pair, tracks it and hands track and message to the sinks. An
every-frame replay has no slot: each pair is tracked before the next is read, so that nothing depends on time.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import NamedTuple, Protocol

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from needletrack.calibration.tips import DriftParameters, DriftState, doubted
from needletrack.capture.source import FrameSource
from needletrack.publish.frames import in_published_frame
from needletrack.publish.message import (
    Instant,
    RunContext,
    ServiceState,
    StatusMessage,
    TrackMessage,
    WireCalibration,
    WireCamera,
    WireRates,
    WireRecording,
    WireSkew,
)
from needletrack.records import Clock, DropReason, NeedleTrack, Status, StereoPair
from needletrack.rig import Rig

# A daemon runs for days: its memory must not grow with them.
_TIMES_KEPT = 10_000


class Tracker(Protocol):
    """A method of tracking: the pair, and the track of the pair before, to the track of this one."""

    def __call__(self, pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        """The track of this pair; raises for nothing that the images show."""
        ...


class Sink(Protocol):
    """Whoever wants the results: a publisher, a file, a progress bar; must return at once, or tracking waits."""

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """One pair's result, in order; what it raises ends the run."""
        ...


@dataclass(frozen=True)
class RunSummary:
    """What a run did: tracks by status, losses by reason, duration, and the worker's time for the last pairs."""

    statuses: Mapping[Status, int]
    reasons: Mapping[str, int]
    dropped: Mapping[DropReason, int]
    duration_s: float
    tracking_ms: tuple[float, ...]

    @property
    def pairs(self) -> int:
        """Pairs that were tracked."""
        return sum(self.statuses.values())


class Arrival(NamedTuple):
    """A pair, and what had been lost when it came: a gap in the sequence and its count stand in one message."""

    pair: StereoPair
    dropped: Mapping[DropReason, int]


class _Orders(NamedTuple):
    """How pairs are tracked from the next one on; number: those of another number have no memory in common."""

    tracker: Tracker
    run: RunContext
    number: int


@dataclass(frozen=True)
class Surroundings:
    """What a heartbeat says of cameras, recorder, needle and control, beside what the loop itself knows."""

    cameras: Mapping[str, WireCamera] | None = None
    skew: WireSkew | None = None
    recording: WireRecording | None = None
    last_error: str | None = None
    needle: str | None = None
    counters: Mapping[str, int] = field(default_factory=dict)


class Service:
    """Runs one source through one tracker into sinks.

    independent: every pair starts without memory. every_frame: no pair is skipped however slow tracking is; otherwise
    the newest pair wins and the one it overwrites is counted. max_age_days: heartbeats warn of an older calibration,
    None: never. surroundings is asked once a heartbeat; in_threads is called in each of the two threads as it begins,
    with its name. The counters may be read from any thread.
    """

    def __init__(
        self,
        source: FrameSource,
        tracker: Tracker,
        rig: Rig,
        run: RunContext,
        *,
        every_frame: bool = False,
        independent: bool = False,
        heartbeat_s: float = 0.5,
        drift: DriftParameters | None = None,
        max_age_days: float | None = None,
        surroundings: Callable[[], Surroundings] = Surroundings,
        in_threads: Callable[[str], None] = lambda name: None,
    ) -> None:
        self._source, self._rig = source, rig
        self._orders, self._ordering = _Orders(tracker, run, 0), threading.Lock()
        self._taken_sequence: int | None = None
        self._every_frame, self._independent, self._heartbeat_s = every_frame, independent, heartbeat_s
        self._drift, self._max_age_days = drift or DriftParameters(), max_age_days
        self._surroundings, self._in_threads = surroundings, in_threads
        self._slot = LatestSlot()
        self._state = ServiceState.STARTING
        self._started_s = time.monotonic()
        self._statuses: Counter[Status] = Counter()
        self._reasons: Counter[str] = Counter()
        self._last_sequence: int | None = None
        self._busy_since_s: float | None = None
        self._reported = (self._started_s, 0, Counter[Status]())

    @property
    def dropped(self) -> dict[DropReason, int]:
        """Frames and pairs lost so far, by reason."""
        dropped = Counter(self._source.dropped)
        if self._slot.overwritten:
            dropped[DropReason.OVERWRITTEN] += self._slot.overwritten
        return dict(dropped)

    @property
    def statuses(self) -> dict[Status, int]:
        """Tracks so far, by status."""
        return dict(self._statuses)

    @property
    def busy_s(self) -> float:
        """For how long the worker has been at the pair in hand; 0 where it waits for one."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def forget(self) -> int | None:
        """Track without memory from the next pair on; never waits for the worker.

        The sequence of the last pair that was taken up before (None: none was): later ones are tracked so.
        """
        with self._ordering:
            self._orders = self._orders._replace(number=self._orders.number + 1)
            return self._taken_sequence

    def use(self, tracker: Tracker, config_digest: str) -> int | None:
        """Track with another tracker, without memory, from the next pair on, whose message bears the digest.

        Never waits for the worker. The sequence of the last pair that was taken up before, as of `forget`.
        """
        with self._ordering:
            run = replace(self._orders.run, config_digest=config_digest)
            self._orders = _Orders(tracker, run, self._orders.number + 1)
            return self._taken_sequence

    def _taken_up(self, sequence: int) -> _Orders:
        with self._ordering:
            self._taken_sequence = sequence
            return self._orders

    def run(self, sinks: Sequence[Sink], stop: threading.Event) -> RunSummary:
        """Track until the source ends or `stop` is set; the first exception of any thread ends the run, raised here."""
        # What two threads of BLAS sum differs in the last digits from what one does: a track must not depend on how
        # many processors there are. For matrices as small as ours two took twice the time of one.
        with threadpool_limits(1, user_api="blas"):
            return self._run(sinks, stop)

    def _run(self, sinks: Sequence[Sink], stop: threading.Event) -> RunSummary:
        self._state = ServiceState.RUNNING
        started_s = time.monotonic()
        tracking_ms: deque[float] = deque(maxlen=_TIMES_KEPT)
        previous: NeedleTrack | None = None
        followed = self._orders.number
        drift = DriftState()
        self._in_threads("tracking")
        try:
            for pair, dropped in self._every_pair(stop) if self._every_frame else self._newest_pairs(stop):
                self._busy_since_s = time.monotonic()
                began_ns = time.monotonic_ns()
                orders = self._taken_up(pair.sequence)
                if self._independent or orders.number != followed:
                    previous, followed = None, orders.number
                track = orders.tracker(pair, previous)
                tracked_ms = (time.monotonic_ns() - began_ns) / 1e6
                tracking_ms.append(tracked_ms)
                # What is published may be doubted; the next pair is tracked from the track itself.
                previous = track
                drift = drift.after(track, self._rig, self._drift)
                if drift.has_moved:
                    track = doubted(track)
                self._statuses[track.status] += 1
                self._reasons.update(track.reasons)
                self._last_sequence = pair.sequence
                message = TrackMessage.from_track(
                    in_published_frame(track, self._rig.registration),
                    pair,
                    orders.run,
                    dropped=dropped,
                    published=Instant.now(),
                    parts_ms={**_before_tracking_ms(pair, began_ns), "track": tracked_ms},
                )
                for sink in sinks:
                    sink.take(pair, track, message)
                self._busy_since_s = None
        finally:
            self._busy_since_s = None
            self._state = ServiceState.STOPPING
        duration_s = time.monotonic() - started_s
        return RunSummary(dict(self._statuses), dict(self._reasons), self.dropped, duration_s, tuple(tracking_ms))

    def status(self) -> StatusMessage:
        """The heartbeat's content; its rates are those since the last call."""
        now_s, done = time.monotonic(), self._statuses.copy()
        delivered = sum(done.values()) + self._slot.overwritten
        since_s, delivered_before, done_before = self._reported
        self._reported = (now_s, delivered, done)
        elapsed_s = max(now_s - since_s, 1e-3)
        rates = WireRates(
            pairs_per_s=round((delivered - delivered_before) / elapsed_s, 2),
            tracks_per_s={
                status.value: round((done[status] - done_before[status]) / elapsed_s, 2) for status in Status
            },
        )
        around = self._surroundings()
        return StatusMessage.from_run(
            self._orders.run,
            state=self._state,
            heartbeat_s=self._heartbeat_s,
            published_at_ns=time.time_ns(),
            uptime_s=now_s - self._started_s,
            last_sequence=self._last_sequence,
            calibration=_calibration(self._rig, self._max_age_days),
            rates=rates,
            dropped=self.dropped,
            counters={f"tracks_{status.value}": done[status] for status in Status} | dict(around.counters),
            last_error=around.last_error,
            cameras=around.cameras,
            skew=around.skew,
            recording=around.recording,
            needle=around.needle,
        )

    def _every_pair(self, stop: threading.Event) -> Iterator[Arrival]:
        for pair in self._source.pairs(stop):
            yield Arrival(pair, dict(self._source.dropped))

    def _newest_pairs(self, stop: threading.Event) -> Iterator[Arrival]:
        return newest_pairs(self._source, self._slot, stop, lambda: self._in_threads("capture"))


class LatestSlot:
    """One place between two threads in which the latest pair wins; what it overwrites is counted."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._arrival: Arrival | None = None
        self._closed = False
        self.overwritten = 0
        self.failure: BaseException | None = None

    def put(self, arrival: Arrival) -> None:
        """Leave a pair for the worker, in place of one that it has not taken."""
        with self._changed:
            self.overwritten += self._arrival is not None
            self._arrival = arrival
            self._changed.notify()

    def take(self) -> Arrival | None:
        """The newest pair, waiting for one; None once the slot is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrival is not None or self._closed)
            arrival, self._arrival = self._arrival, None
            if arrival is None or not self.overwritten:
                return arrival
            return Arrival(arrival.pair, {**arrival.dropped, DropReason.OVERWRITTEN: self.overwritten})

    def close(self, failure: BaseException | None = None) -> None:
        """No pair follows; `failure` says why where it is not the source's end."""
        with self._changed:
            self._closed, self.failure = True, failure
            self._changed.notify()


def newest_pairs(
    source: FrameSource, slot: LatestSlot, stop: threading.Event, in_thread: Callable[[], None] = lambda: None
) -> Iterator[Arrival]:
    """The newest pair each time one is asked for; a thread of its own, which calls in_thread first, keeps taking them.

    Sets `stop` on every way out, and waits for the thread; raises what the source raised.
    """

    def capture() -> None:
        failure: BaseException | None = None
        try:
            in_thread()
            for pair in source.pairs(stop):
                slot.put(Arrival(pair, dict(source.dropped)))
        except BaseException as error:  # raised again by whoever takes
            failure = error
        finally:
            slot.close(failure)

    thread = threading.Thread(target=capture, name="needletrack-capture")
    thread.start()
    try:
        while (arrival := slot.take()) is not None:
            yield arrival
    finally:
        # Also where the taker raised: the thread must not outlive the run.
        stop.set()
        thread.join()
    if slot.failure is not None:
        raise slot.failure


def _before_tracking_ms(pair: StereoPair, began_ns: int) -> dict[str, float]:
    """The parts of the latency before tracking: from the stamp to the complete pair here, and its wait for the worker.

    Only what this process's monotonic clock can tell: a camera's stamp on another clock gives no `capture`.
    """
    arrived_ns = pair.released_at_ns if pair.arrived_at_ns is None else pair.arrived_at_ns
    if arrived_ns is None:
        return {}
    parts_ms = {"queue": (began_ns - arrived_ns) / 1e6}
    if pair.arrived_at_ns is not None and pair.clock is not Clock.RECORDED:
        behind_ns = 0 if pair.clock is Clock.MONOTONIC else time.time_ns() - time.monotonic_ns()
        parts_ms["capture"] = (arrived_ns + behind_ns - pair.captured_at_ns) / 1e6
    return parts_ms


def _calibration(rig: Rig, max_age_days: float | None) -> WireCalibration:
    calibrated_at, now = rig.calibration.calibrated_at, datetime.now(UTC)
    age_days = rig.age_days(now)
    return WireCalibration(
        calibrated_at=None if calibrated_at is None else calibrated_at.isoformat(),
        age_days=None if age_days is None else round(age_days, 2),
        reprojection_rms_px=rig.calibration.reprojection_rms_px,
        warning=None if max_age_days is None else rig.age_warning(max_age_days, now),
    )
