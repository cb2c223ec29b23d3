import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import psutil
import pytest
import zenoh

from needletrack.errors import PublishError
from needletrack.publish.message import ServiceState, StatusMessage, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.session import open_session

WAIT_S = 10.0
TRACK, STATUS, ALIVE = (f"needletrack/lab/{leaf}" for leaf in ("track", "status", "alive"))


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def foreign(endpoint: str) -> Iterator[zenoh.Session]:
    """A subscriber's session, opened before the daemon is there."""
    with open_session(connect=[endpoint]) as session:
        yield session


def wait_for_daemon(session: zenoh.Session) -> None:
    alive = threading.Event()
    session.liveliness().declare_subscriber("**/alive", lambda _: alive.set(), history=True)
    assert alive.wait(WAIT_S)


def steady() -> StatusMessage:
    return example_messages()[1]


def test_a_subscriber_gets_what_was_published(endpoint: str) -> None:
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    message = example_messages()[0]
    with ZenohPublisher(example_run(), steady, listen=[endpoint]) as publisher:
        assert not publisher.has_subscriber
        with open_session(connect=[endpoint]) as session:
            session.declare_subscriber(TRACK, samples.put)
            assert publisher.wait_for_subscriber(WAIT_S)
            publisher.publish(message)
            sample = samples.get(timeout=WAIT_S)
    assert TrackMessage.from_json(sample.payload.to_bytes()) == message
    assert str(sample.encoding) == "application/json;needletrack.track.v1"
    assert sample.priority == zenoh.Priority.REAL_TIME
    assert sample.congestion_control == zenoh.CongestionControl.DROP


STANDING_BY = """
import sys, json, zenoh
config = zenoh.Config()
for key, value in (("mode", "peer"), ("connect/endpoints", sys.argv[1:]), ("scouting/multicast/enabled", False)):
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
session.declare_subscriber("needletrack/lab/track", print)
sys.stdin.read()
"""


def test_a_stopped_subscriber_delays_neither_the_others_nor_the_end(endpoint: str) -> None:
    """Zenoh itself would wait for it for 10 s on closing, and then raise."""
    message = example_messages()[0]
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with (
        ZenohPublisher(example_run(), steady, listen=[endpoint]) as publisher,
        subprocess.Popen([sys.executable, "-c", STANDING_BY, endpoint], stdin=subprocess.PIPE) as process,
    ):
        try:
            assert publisher.wait_for_subscriber(WAIT_S)
            process.send_signal(signal.SIGSTOP)
            while psutil.Process(process.pid).status() != psutil.STATUS_STOPPED:
                time.sleep(0.01)
            with open_session(connect=[endpoint]) as session:
                session.declare_subscriber(TRACK, samples.put)
                # Far more than its link holds, and on until the other has one of the last: it gets them all the while,
                # but may be too busy for all of a burst.
                for sequence in range(2000):
                    publisher.publish(message.model_copy(update={"sequence": sequence}))
                received, until_s = -1, time.monotonic() + WAIT_S
                while received < 2000:
                    assert time.monotonic() < until_s
                    sequence += 1
                    publisher.publish(message.model_copy(update={"sequence": sequence}))
                    with suppress(queue.Empty):
                        received = TrackMessage.from_json(samples.get(timeout=0.01).payload.to_bytes()).sequence
            began_s = time.monotonic()
            publisher.close()
            assert time.monotonic() - began_s < 5.0
        finally:
            process.kill()


def test_publishing_without_a_subscriber_is_no_error(endpoint: str) -> None:
    with ZenohPublisher(example_run(), steady, listen=[endpoint]) as publisher:
        assert not publisher.wait_for_subscriber(0.0)
        publisher.publish(example_messages()[0])


def test_a_burst_just_before_closing_arrives(endpoint: str) -> None:
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    message = example_messages()[0]
    with (
        ZenohPublisher(example_run(), steady, listen=[endpoint]) as publisher,
        open_session(connect=[endpoint]) as session,
    ):
        session.declare_subscriber(TRACK, samples.put)
        assert publisher.wait_for_subscriber(WAIT_S)
        for sequence in range(16):
            publisher.publish(message.model_copy(update={"sequence": sequence}))
        publisher.close()
        received = [TrackMessage.from_json(samples.get(timeout=WAIT_S).payload.to_bytes()) for _ in range(16)]
    assert [one.sequence for one in received] == list(range(16))


def test_the_heart_beats_and_says_when_it_stops(endpoint: str, foreign: zenoh.Session) -> None:
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    foreign.declare_subscriber(STATUS, samples.put)
    state = ServiceState.RUNNING
    calls = 0

    def status() -> StatusMessage:
        nonlocal calls
        calls += 1
        return steady().model_copy(update={"state": state, "counters": {"calls": calls}})

    with ZenohPublisher(example_run(), status, listen=[endpoint], heartbeat_s=0.02):
        beats = [StatusMessage.from_json(samples.get(timeout=WAIT_S).payload.to_bytes()) for _ in range(3)]
        state = ServiceState.STOPPING
    numbers = [beat.counters["calls"] for beat in beats]
    assert numbers == sorted(set(numbers))
    last = beats[-1]
    while last.counters["calls"] < calls:
        last = StatusMessage.from_json(samples.get(timeout=WAIT_S).payload.to_bytes())
    assert last.state is ServiceState.STOPPING


def test_a_query_is_answered_with_the_status(endpoint: str) -> None:
    with (
        ZenohPublisher(example_run(), steady, listen=[endpoint], heartbeat_s=60),
        open_session(connect=[endpoint]) as session,
    ):
        wait_for_daemon(session)
        replies = [reply.ok for reply in session.get(STATUS, timeout=WAIT_S)]
    assert len(replies) == 1
    assert replies[0] is not None
    assert str(replies[0].encoding) == "application/json;needletrack.status.v1"
    assert StatusMessage.from_json(replies[0].payload.to_bytes()) == steady()


def test_the_liveliness_token_lives_as_long_as_the_publisher(endpoint: str, foreign: zenoh.Session) -> None:
    tokens: queue.SimpleQueue[zenoh.SampleKind] = queue.SimpleQueue()
    foreign.liveliness().declare_subscriber(ALIVE, lambda sample: tokens.put(sample.kind), history=True)
    with ZenohPublisher(example_run(), steady, listen=[endpoint]):
        assert tokens.get(timeout=WAIT_S) == zenoh.SampleKind.PUT
        assert tokens.empty()
    assert tokens.get(timeout=WAIT_S) == zenoh.SampleKind.DELETE


def test_a_second_daemon_on_the_port_is_refused_and_the_first_lives_on(endpoint: str) -> None:
    with ZenohPublisher(example_run(), steady, listen=[endpoint]) as publisher:
        with pytest.raises(PublishError, match=f"{endpoint} is taken"):
            ZenohPublisher(example_run(), steady, listen=[endpoint])
        publisher.publish(example_messages()[0])
    with ZenohPublisher(example_run(), steady, listen=[endpoint]):
        pass


def test_another_prefix_moves_all_keys(endpoint: str) -> None:
    with (
        ZenohPublisher(example_run(), steady, listen=[endpoint], key_prefix="ward/3") as publisher,
        open_session(connect=[endpoint]) as session,
    ):
        assert publisher.keys.track == "ward/3/lab/track"
        wait_for_daemon(session)
        replies = [reply.ok for reply in session.get("ward/3/**", timeout=WAIT_S)]
    assert [str(reply.key_expr) for reply in replies if reply is not None] == ["ward/3/lab/status"]


def test_an_error_of_the_status_is_not_swallowed(endpoint: str) -> None:
    failed = threading.Event()

    def status() -> StatusMessage:
        if threading.current_thread() is threading.main_thread():
            return steady()
        failed.set()
        raise RuntimeError("the counters are gone")

    publisher = ZenohPublisher(example_run(), status, listen=[endpoint], heartbeat_s=0.01)
    assert failed.wait(WAIT_S)
    with pytest.raises(RuntimeError, match="the counters are gone"):
        publisher.close()
    with pytest.raises(RuntimeError, match="the counters are gone"):
        publisher.publish(example_messages()[0])


def test_closing_twice_is_allowed_and_publishing_afterwards_is_not(endpoint: str) -> None:
    publisher = ZenohPublisher(example_run(), steady, listen=[endpoint])
    publisher.close()
    publisher.close()
    with pytest.raises(PublishError, match="needletrack/lab/track: not published"):
        publisher.publish(example_messages()[0])
