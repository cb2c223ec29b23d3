import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from needletrack.client import (
    PERIODS_REMEMBERED,
    SILENT_PERIODS,
    Freshness,
    Missed,
    Received,
    Subscriber,
    usual_period_s,
)
from needletrack.errors import PublishError
from needletrack.publish import publisher as publisher_module
from needletrack.publish.message import Instant, RunContext, Source, StatusMessage, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run, example_track
from needletrack.publish.session import open_session
from needletrack.records import Clock, DropReason, Frame, NeedleTrack, Reason, Status, StereoPair

WAIT_S = 10.0
Floats = NDArray[np.float64]


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def status() -> StatusMessage:
    return example_messages()[1].model_copy(update={"last_error": "camera right: unplugged"})


@contextmanager
def daemon(endpoint: str, run: RunContext | None = None, **options: Any) -> Iterator[ZenohPublisher]:
    with ZenohPublisher(run or example_run(), status, listen=[endpoint], **options) as publisher:
        yield publisher


def message(
    sequence: int = 0,
    *,
    dropped: Mapping[DropReason, int] | None = None,
    run: RunContext | None = None,
    age_ns: int = 0,
    clock: Clock = Clock.REALTIME,
) -> TrackMessage:
    """A message captured age_ns before now, on its own clock; a recorded stamp is 1970's."""
    now = Instant.now()
    captured_at_ns = {Clock.REALTIME: now.unix_ns, Clock.MONOTONIC: now.monotonic_ns}.get(clock, age_ns) - age_ns
    image = np.zeros((2, 2), dtype=np.uint8)
    frame = Frame(image, captured_at_ns)
    released_at_ns = now.monotonic_ns if clock is Clock.RECORDED else None
    pair = StereoPair(frame, frame, sequence, clock, released_at_ns=released_at_ns)
    known, _ = example_track(points=8)
    track = NeedleTrack(captured_at_ns, Status.OK, (), known.curve, known.tip)
    return TrackMessage.from_track(track, pair, run or example_run(), dropped=dropped or {}, published=now)


def patient(connect: Sequence[str], rig: str = "lab", **options: Any) -> Subscriber:
    """A subscriber to which nothing seems late on a busy machine."""
    return Subscriber(rig, connect, **({"max_age_s": 60.0, "silent_after_s": 60.0} | options))


def state(subscriber: Subscriber) -> Freshness:
    return subscriber.health.state


def taken(subscriber: Subscriber) -> Received:
    received = subscriber.next(WAIT_S)
    assert received is not None
    return received


def has_latest(subscriber: Subscriber, sequence: int) -> bool:
    latest = subscriber.latest()
    return latest is not None and latest.message.sequence == sequence


def eventually(true: Callable[[], bool]) -> bool:
    """Whether it became true in time; for what nothing announces."""
    deadline, tick = time.monotonic() + WAIT_S, threading.Event()
    while not true():
        if time.monotonic() > deadline:
            return False
        tick.wait(0.002)
    return True


def test_tracks_arrive_typed_and_in_order(endpoint: str) -> None:
    with daemon(endpoint) as publisher, patient([endpoint]) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        sent = [message(sequence) for sequence in range(10)]
        for one in sent:
            publisher.publish(one)
        received = [taken(subscriber) for _ in sent]
        assert [one.message for one in received] == sent
        assert all(one.missed == Missed() for one in received)
        assert subscriber.latest() == received[-1]
        assert subscriber.next(timeout_s=0.01) is None
        assert state(subscriber) is Freshness.FRESH
        assert subscriber.health.reason == ""


def test_age_grows_from_the_exposure(endpoint: str) -> None:
    with daemon(endpoint) as publisher, Subscriber("lab", [endpoint]) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message(age_ns=3_000_000_000))
        received = taken(subscriber)
        assert received.transit_ms is not None
        assert received.transit_ms >= 0
        assert received.latency_ms == pytest.approx(3000 + received.transit_ms, abs=0.01)
        first, second = received.age_ms, received.age_ms
        assert 3000 <= first < second


def test_gaps_are_told_apart(endpoint: str) -> None:
    over, unread, lone = DropReason.OVERWRITTEN, DropReason.UNREADABLE_IMAGE, DropReason.UNPAIRED_LEFT
    with daemon(endpoint) as publisher, patient([endpoint]) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        for sequence, dropped, missed in (
            (5, {over: 9}, Missed()),  # what came before the first is not ours to miss
            (6, {over: 9}, Missed()),
            (9, {over: 11}, Missed(dropped=2)),
            (12, {over: 11}, Missed(lost=2)),
            (16, {over: 12}, Missed(dropped=1, lost=2)),
            (18, {over: 12, unread: 2}, Missed(dropped=1)),  # two bad images, one pair
            (20, {over: 12, unread: 2, lone: 4}, Missed(lost=1)),  # single frames have no number
        ):
            publisher.publish(message(sequence, dropped=dropped))
            assert taken(subscriber).missed == missed, sequence


def test_a_new_run_is_no_gap(endpoint: str) -> None:
    with patient([endpoint]) as subscriber:
        for sequence in (3, 90, 0):
            run = RunContext("lab", Source.LIVE, "c", "r")
            with daemon(endpoint, run) as publisher:
                assert publisher.wait_for_subscriber(WAIT_S)
                publisher.publish(message(sequence, run=run))
                received = taken(subscriber)
                assert received.message.run_id == run.run_id
                assert received.missed == Missed()
                assert state(subscriber) is Freshness.FRESH
            assert subscriber.wait_until_gone(WAIT_S)
            assert state(subscriber) is Freshness.GONE


def test_a_reader_that_is_too_slow_loses_the_oldest_and_knows_it(endpoint: str) -> None:
    with daemon(endpoint) as publisher, patient([endpoint], capacity=2) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message(0))
        assert taken(subscriber).message.sequence == 0
        for sequence in (1, 2, 3, 6, 7):
            publisher.publish(message(sequence, dropped={DropReason.OVERWRITTEN: 2 if sequence > 3 else 0}))
        assert eventually(lambda: subscriber.overflowed == 3)
        first, second = taken(subscriber), taken(subscriber)
        assert (first.message.sequence, second.message.sequence) == (6, 7)
        assert first.missed == Missed(dropped=2, overflowed=3)
        assert second.missed == Missed()


@pytest.mark.parametrize("capacity", [1, 3])
def test_a_reader_that_looks_but_takes_too_slowly_is_told_of_every_track_it_missed(
    endpoint: str, capacity: int
) -> None:
    """`health` and `latest` decode what came: tracks overflow behind them, too."""
    with daemon(endpoint) as publisher, patient([endpoint], capacity=capacity) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message(0))
        assert taken(subscriber).message.sequence == 0
        for sequence in (1, 2, 3, 6, 7, 8, 9):
            publisher.publish(message(sequence, dropped={DropReason.OVERWRITTEN: 2 if sequence > 3 else 0}))
            assert eventually(partial(has_latest, subscriber, sequence))
        received = [taken(subscriber) for _ in range(capacity)]
        assert [one.message.sequence for one in received] == [7, 8, 9][-capacity:]
        assert received[0].missed == Missed(dropped=2, overflowed=7 - capacity)
        assert all(one.missed == Missed() for one in received[1:])
        assert subscriber.overflowed == 7 - capacity


def test_only_looking_at_the_latest_loses_no_count(endpoint: str) -> None:
    with daemon(endpoint) as publisher, patient([endpoint], capacity=2) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        assert subscriber.latest() is None
        for sequence in range(6):
            publisher.publish(message(sequence))
            assert eventually(partial(has_latest, subscriber, sequence))
        latest = subscriber.latest()
        assert latest is not None
        assert latest.missed == Missed()


def test_several_threads_share_the_tracks(endpoint: str) -> None:
    seen: list[int] = []
    with daemon(endpoint) as publisher, patient([endpoint]) as subscriber:

        def read() -> None:
            seen.extend(received.message.sequence for received in subscriber)

        readers = [threading.Thread(target=read) for _ in range(3)]
        for reader in readers:
            reader.start()
        assert publisher.wait_for_subscriber(WAIT_S)
        for sequence in range(15):
            publisher.publish(message(sequence))
        assert eventually(lambda: len(seen) == 15)
        subscriber.close()
        for reader in readers:
            reader.join(WAIT_S)
            assert not reader.is_alive()
    assert sorted(seen) == list(range(15))


def test_an_old_track_is_stale(endpoint: str) -> None:
    with (
        daemon(endpoint) as publisher,
        Subscriber("lab", [endpoint], max_age_s=2.0, silent_after_s=60.0) as subscriber,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        for clock in (Clock.REALTIME, Clock.MONOTONIC):
            publisher.publish(message(age_ns=3_000_000_000, clock=clock))
            taken(subscriber)
            health = subscriber.health
            assert health.state is Freshness.STALE, clock
            assert health.age_ms is not None
            assert health.age_ms >= 3000
            assert "limit 2000 ms" in health.reason


def test_recorded_stamps_make_no_track_stale(endpoint: str) -> None:
    with (
        daemon(endpoint) as publisher,
        Subscriber("lab", [endpoint], max_age_s=30.0, silent_after_s=60.0) as subscriber,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message(clock=Clock.RECORDED))
        assert taken(subscriber).message.captured_at_ns < 1_000_000_000
        assert state(subscriber) is Freshness.FRESH


def test_a_track_without_times_ages_from_its_receipt(endpoint: str) -> None:
    run = RunContext("lab", Source.REPLAY, "c", "r", deterministic=True)
    with daemon(endpoint, run) as publisher, patient([endpoint]) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message(run=run, clock=Clock.RECORDED))
        received = taken(subscriber)
        assert (received.transit_ms, received.latency_ms) == (None, None)
        assert 0 <= received.age_ms < received.age_ms
        assert state(subscriber) is Freshness.FRESH


def published_by_a_clock_ahead(seconds: float, sequence: int = 0) -> TrackMessage:
    ours = message(sequence)
    assert ours.published_at_ns is not None
    return ours.model_copy(
        update={"published_at_ns": ours.published_at_ns + round(seconds * 1e9), "latency_ms": 8.0, "sequence": sequence}
    )


@contextmanager
def daemon_with_a_clock_ahead(
    endpoint: str, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ZenohPublisher]:
    """A daemon whose host's clock is ahead of ours; it is the subscriber's own everywhere else."""
    monkeypatch.setattr(
        publisher_module, "time", SimpleNamespace(time_ns=lambda: time.time_ns() + round(seconds * 1e9))
    )
    with daemon(endpoint, heartbeat_s=0.1) as publisher:
        yield publisher


@pytest.mark.parametrize("ahead_s", [0.0, 3600.0, -3600.0])
def test_a_difference_of_clocks_is_measured_and_makes_no_track_older_or_younger(
    endpoint: str, ahead_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        daemon_with_a_clock_ahead(endpoint, ahead_s, monkeypatch) as publisher,
        Subscriber("lab", [endpoint], max_age_s=30.0, silent_after_s=60.0) as subscriber,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        assert eventually(lambda: subscriber.clock is not None)
        clock = subscriber.clock
        assert clock is not None
        # The stated uncertainty is a bound, and both clocks are one.
        assert abs(clock.ours_minus_daemons_ms + ahead_s * 1000) <= clock.uncertainty_ms + 1e-3
        publisher.publish(published_by_a_clock_ahead(ahead_s))
        received = taken(subscriber)
        assert received.transit_ms is not None
        assert -clock.uncertainty_ms - 1e-3 <= received.transit_ms < WAIT_S * 1000
        assert 8.0 <= received.age_ms < WAIT_S * 1000
        assert state(subscriber) is Freshness.FRESH
        # Held up on the way for a minute: seen, whatever the clocks say.
        publisher.publish(published_by_a_clock_ahead(ahead_s - 60.0, sequence=1))
        assert taken(subscriber).age_ms > 60_000
        health = subscriber.health
        assert health.state is Freshness.STALE
        assert "of it on the way: is the link slow?" in health.reason
        assert "could not be measured" not in health.reason


def test_where_the_clocks_could_not_be_compared_that_is_said(endpoint: str) -> None:
    matched = threading.Event()
    with (
        Subscriber("lab", [], listen=[endpoint], max_age_s=30.0, silent_after_s=60.0) as subscriber,
        open_session(connect=[endpoint]) as foreign,
    ):
        sender = foreign.declare_publisher(subscriber.keys.track)
        sender.declare_matching_listener(lambda _: matched.set())
        assert matched.wait(WAIT_S)
        sender.put(published_by_a_clock_ahead(-3600.0).to_json())
        taken(subscriber)
        assert subscriber.clock is None
        assert subscriber.health.state is Freshness.STALE
        assert "Or do the clocks of both hosts differ? It could not be measured." in subscriber.health.reason


def test_at_60_hz_silence_is_noticed_within_100_ms(endpoint: str) -> None:
    with (
        daemon(endpoint) as publisher,
        Subscriber("lab", [endpoint], max_age_s=60.0) as subscriber,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        stop = threading.Event()
        sent: list[Received] = []
        due_s = time.monotonic()
        while len(sent) < 40:
            due_s += 1 / 60
            stop.wait(max(0.0, due_s - time.monotonic()))
            publisher.publish(message(len(sent)))
            sent.append(taken(subscriber))
        # Only time passes now. A busy machine may have made the tracks come at another rate.
        gaps_s = [(b.received_monotonic_ns - a.received_monotonic_ns) / 1e9 for a, b in pairwise(sent)]
        limit_s = 0.1 * max(1.0, statistics.median(gaps_s[-16:]) * 60)
        stop.wait(max(0.0, sent[-1].received_monotonic_ns / 1e9 + limit_s - time.monotonic()))
        health = subscriber.health
        assert health.state is Freshness.SILENT
        assert "no track for" in health.reason


def test_a_heart_that_stops_while_tracks_come_is_no_fresh_daemon(endpoint: str) -> None:
    beating = status().model_copy(update={"heartbeat_s": 0.02})
    with (
        ZenohPublisher(example_run(), lambda: beating, listen=[endpoint], heartbeat_s=60.0) as publisher,
        Subscriber("lab", [endpoint], max_age_s=60.0, silent_after_s=0.2) as subscriber,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        assert eventually(lambda: subscriber.status is not None)
        assert eventually(partial(heart_is_missed, publisher, subscriber))


def heart_is_missed(publisher: ZenohPublisher, subscriber: Subscriber) -> bool:
    publisher.publish(message())
    taken(subscriber)
    health = subscriber.health
    return health.state is Freshness.SILENT and health.reason.startswith("tracks come, but no heartbeat for")


def test_silence_of_a_living_daemon_is_told_with_its_own_words(endpoint: str) -> None:
    with (
        daemon(endpoint, heartbeat_s=0.01) as publisher,
        Subscriber("lab", [endpoint], max_age_s=60.0, silent_after_s=0.05) as subscriber,
    ):
        subscriber.wait_for_daemon(WAIT_S)
        assert state(subscriber) is Freshness.SILENT
        assert subscriber.health.reason.startswith("no track yet")
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(message())
        taken(subscriber)
        assert eventually(lambda: subscriber.status is not None)
        assert subscriber.next(timeout_s=0.06) is None
        health = subscriber.health
        assert health.state is Freshness.SILENT
        assert "camera right: unplugged" in health.reason


def test_silence_is_measured_against_the_rate_seen(endpoint: str) -> None:
    with daemon(endpoint) as publisher, Subscriber("lab", [endpoint], max_age_s=60.0) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        for sequence in range(20):
            publisher.publish(message(sequence))
            taken(subscriber)
        # They came within milliseconds of each other, so the shortest limit of 50 ms holds.
        assert subscriber.next(timeout_s=0.06) is None
        assert state(subscriber) is Freshness.SILENT
        assert "limit 0.05 s" in subscriber.health.reason
        publisher.publish(message(20))
        taken(subscriber)
        assert state(subscriber) is Freshness.FRESH


def test_a_late_joiner_has_the_status_at_once(endpoint: str) -> None:
    with daemon(endpoint, heartbeat_s=60.0), Subscriber("lab", [endpoint]) as subscriber:
        assert eventually(lambda: subscriber.status is not None)
        assert subscriber.status == status()


def test_a_daemon_that_comes_later_is_found(endpoint: str) -> None:
    with patient([endpoint]) as subscriber:
        assert state(subscriber) is Freshness.NEVER_SEEN
        with pytest.raises(PublishError, match=f"nobody answers at {endpoint} within 0.05 s: is the daemon running"):
            subscriber.wait_for_daemon(0.05)
        with daemon(endpoint) as publisher:
            subscriber.wait_for_daemon(WAIT_S)
            assert publisher.wait_for_subscriber(WAIT_S)
            publisher.publish(message())
            assert taken(subscriber).message.rig == "lab"


def test_a_wrong_rig_name_is_told_with_the_right_ones(endpoint: str) -> None:
    with daemon(endpoint), Subscriber("lab", [endpoint]) as right, Subscriber("lob", [endpoint]) as wrong:
        right.wait_for_daemon(WAIT_S)
        assert eventually(lambda: "rigs alive there: lab" in why_no_daemon(wrong))
        assert wrong.health.state is Freshness.NEVER_SEEN


def why_no_daemon(subscriber: Subscriber) -> str:
    with pytest.raises(PublishError) as refused:
        subscriber.wait_for_daemon(0.0)
    return str(refused.value)


PUBLISHING = """
import sys, threading
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
track, status = example_messages()
with ZenohPublisher(example_run(), lambda: status, listen=[sys.argv[1]]) as publisher:
    publisher.wait_for_subscriber(60)
    publisher.publish(track)
    sys.stdin.read()
"""


def test_a_killed_daemon_is_gone(endpoint: str) -> None:
    with (
        subprocess.Popen([sys.executable, "-c", PUBLISHING, endpoint], stdin=subprocess.PIPE) as process,
        patient([endpoint]) as subscriber,
    ):
        try:
            subscriber.wait_for_daemon(WAIT_S)
            taken(subscriber)
            assert state(subscriber) is not Freshness.GONE
        finally:
            process.send_signal(signal.SIGKILL)
        assert subscriber.wait_until_gone(WAIT_S)
        assert state(subscriber) is Freshness.GONE
        assert "stopped, or the link to it broke" in subscriber.health.reason


def test_a_hung_daemon_is_gone_after_the_lease(endpoint: str) -> None:
    with (
        subprocess.Popen([sys.executable, "-c", PUBLISHING, endpoint], stdin=subprocess.PIPE) as process,
        patient([endpoint]) as subscriber,
    ):
        try:
            subscriber.wait_for_daemon(WAIT_S)
            process.send_signal(signal.SIGSTOP)
            assert subscriber.wait_until_gone(WAIT_S)
        finally:
            process.send_signal(signal.SIGKILL)


@pytest.mark.parametrize("payload", [b"", b"{}", message().model_copy(update={"rig": "other"}).to_json()])
def test_what_cannot_be_read_is_counted_and_told(endpoint: str, payload: bytes) -> None:
    matched = threading.Event()
    with (
        patient([], listen=[endpoint]) as subscriber,
        open_session(connect=[endpoint]) as foreign,
    ):
        forger = foreign.declare_publisher(subscriber.keys.track)
        forger.declare_matching_listener(lambda _: matched.set())
        assert matched.wait(WAIT_S)
        forger.put(payload)
        assert eventually(lambda: subscriber.undecodable == 1)
        assert subscriber.latest() is None
        assert state(subscriber) is Freshness.SILENT
        assert "1 samples could not be read" in subscriber.health.reason
        forger.put(message().to_json())
        assert taken(subscriber).missed == Missed()
        assert state(subscriber) is Freshness.FRESH


def test_an_invalid_track_is_as_fresh_as_any(endpoint: str) -> None:
    now = Instant.now()
    frame = Frame(np.zeros((2, 2), dtype=np.uint8), now.unix_ns)
    track = NeedleTrack(now.unix_ns, Status.INVALID, (Reason.NO_CANDIDATE,))
    pair = StereoPair(frame, frame, 0, Clock.REALTIME)
    with daemon(endpoint) as publisher, patient([endpoint]) as subscriber:
        assert publisher.wait_for_subscriber(WAIT_S)
        publisher.publish(TrackMessage.from_track(track, pair, example_run(), dropped={}, published=now))
        assert taken(subscriber).message.status is Status.INVALID
        assert state(subscriber) is Freshness.FRESH


def test_closing_ends_the_iteration_and_may_happen_twice(endpoint: str) -> None:
    subscriber = Subscriber("lab", [endpoint])
    with subscriber:
        subscriber.close()
        assert list(subscriber) == []
    assert subscriber.next() is None


@pytest.mark.parametrize(
    "left_open",
    ["Subscriber('lab', [e])", "ZenohPublisher(example_run(), lambda: example_messages()[1], listen=[e])"],
)
def test_a_program_that_closes_nothing_ends_all_the_same(endpoint: str, left_open: str) -> None:
    program = (
        "import sys; from needletrack.client import Subscriber\n"
        "from needletrack.publish.publisher import ZenohPublisher\n"
        "from needletrack.publish.schema import example_messages, example_run\n"
        f"e = sys.argv[1]; left_open = {left_open}"
    )
    assert subprocess.run([sys.executable, "-c", program, endpoint], timeout=30, check=False).returncode == 0


def late_by_chance(due_s: Floats, random: np.random.Generator) -> Floats:
    """As on a busy machine: in order, some later than they should, those behind them sooner after."""
    return np.maximum.accumulate(due_s + random.exponential(0.010, len(due_s)))


def two_at_a_time(due_s: Floats, random: np.random.Generator) -> Floats:
    held = np.arange(len(due_s)) // 2 * 2 + 1
    return due_s[np.minimum(held, len(due_s) - 1)]


def after_two_gaps(due_s: Floats, random: np.random.Generator) -> Floats:
    gaps = np.zeros(len(due_s))
    gaps[random.choice(np.arange(1, len(due_s)), 2, replace=False)] = 0.05
    return due_s + np.cumsum(gaps)


@pytest.mark.parametrize("arrive", [late_by_chance, two_at_a_time, after_two_gaps])
def test_silence_is_noticed_in_time_whatever_the_pace_of_this_machine(
    arrive: Callable[[Floats, np.random.Generator], Floats],
) -> None:
    """At 60 Hz within 100 ms, and not as soon as one track is late."""
    random = np.random.default_rng(5)
    for _ in range(200):
        came_s = arrive(np.arange(PERIODS_REMEMBERED + 1) / 60, random)
        assert 0.06 < SILENT_PERIODS * usual_period_s(np.diff(came_s).tolist()) < 0.1


def test_of_few_tracks_the_usual_period_is_the_median() -> None:
    assert usual_period_s([0.5]) == 0.5
    assert usual_period_s([0.5, 0.02, 0.02]) == 0.02


@pytest.mark.parametrize("closing", ["", "subscriber.close()"])
def test_a_program_ends_in_order_while_its_router_hangs(closing: str) -> None:
    """A router that takes the connection and says nothing: Zenoh waits in a thread as the interpreter ends."""
    code = f"""
import sys, time
from needletrack.client import Freshness, Subscriber
from needletrack.publish import session
session.OPEN_WITHIN_MS = 500

class EndsSlowly:
    def __del__(self, sleep=time.sleep):
        sleep(1.0)

something = EndsSlowly()
subscriber = Subscriber("lab", [sys.argv[1]], mode="client")
assert subscriber.health.state is Freshness.NEVER_SEEN
{closing}
"""
    with socket.create_server(("127.0.0.1", 0)) as hung:
        endpoint = f"tcp/127.0.0.1:{hung.getsockname()[1]}"
        done = subprocess.run([sys.executable, "-c", code, endpoint], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
