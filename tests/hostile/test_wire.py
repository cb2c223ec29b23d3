"""A peer that sends anything costs a count: the subscriber goes on, and what it says harms no terminal."""

import json
import threading
import time
from collections.abc import Iterator
from io import StringIO

import pytest
import zenoh
from rich.console import Console
from tests.daemon.test_run import free_port
from tests.hostile.edges import BY_NAME

from needletrack.client import Subscriber
from needletrack.errors import PublishError
from needletrack.publish.message import MOST_MESSAGE_BYTES, StatusMessage, TrackMessage
from needletrack.publish.session import MOST_RECEIVED_BYTES, open_session
from needletrack.watch import watch

RIG = json.loads(BY_NAME["track"].valid()[0])["rig"]
_WAIT_S = 20.0


@pytest.fixture
def peer() -> Iterator[tuple[zenoh.Session, str]]:
    """A session that may put anything, and where it listens."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session([endpoint]) as session:
        yield session, endpoint


def track(sequence: int, **changes: object) -> bytes:
    return json.dumps({**json.loads(BY_NAME["track"].valid()[0]), "sequence": sequence, **changes}).encode()


def test_a_subscriber_outlives_whatever_is_sent(peer: tuple[zenoh.Session, str]) -> None:
    session, endpoint = peer
    nonsense = [
        b"",
        b"\x00\xff",
        b"[" * 100_000,
        b"a" * (MOST_MESSAGE_BYTES + 1),
        track(2, captured_at_ns=10**400),
        track(2, published_at_ns=-(10**400)),
        track(2**64),
        track(2, rig="another"),
        track(2, version=2),
        *(cut_and_flipped(number) for number in range(30)),
    ]
    refused = [payload for payload in nonsense if not _is_message(payload)]
    asked: list[bytes] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            asked.append(nonsense[len(asked) % len(nonsense)])
            query.reply(str(query.key_expr), asked[-1])

    session.declare_queryable(f"needletrack/{RIG}/clock", answer)
    session.declare_queryable(f"needletrack/{RIG}/status", answer)
    with Subscriber(RIG, [endpoint], capacity=1024) as subscriber:
        put_until_received(session, subscriber, track(1))
        for payload in refused:
            session.put(subscriber.keys.track, payload, congestion_control=zenoh.CongestionControl.BLOCK)
            session.put(subscriber.keys.status, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        # More than is received at all: it is left out, and the link stays.
        session.put(
            subscriber.keys.track, bytes(2 * MOST_RECEIVED_BYTES), congestion_control=zenoh.CongestionControl.BLOCK
        )
        session.put(subscriber.keys.track, track(1000), congestion_control=zenoh.CongestionControl.BLOCK)
        newest = 0
        until_s = time.monotonic() + _WAIT_S
        while newest != 1000 and time.monotonic() < until_s:
            received = subscriber.next(1.0)
            newest = newest if received is None else received.message.sequence
        assert newest == 1000
        assert asked
        assert subscriber.undecodable >= len(refused)
        assert subscriber.health.age_ms is not None
        assert subscriber.clock is None


def cut_and_flipped(number: int) -> bytes:
    """A damaged track, the same in every run."""
    whole = BY_NAME["track"].valid()[0]
    at = (number * 7919) % len(whole)
    return whole[:at] + bytes([number * 37 % 256]) + whole[at + number :]


def _is_message(payload: bytes) -> bool:
    try:
        return TrackMessage.from_json(payload).rig == str(RIG)
    except PublishError:
        return False


def put_until_received(session: zenoh.Session, subscriber: Subscriber, payload: bytes) -> None:
    """The link may not be there at once."""
    until_s = time.monotonic() + _WAIT_S
    while subscriber.latest() is None:
        session.put(subscriber.keys.track, payload)
        time.sleep(0.05)
        assert time.monotonic() < until_s


@pytest.mark.parametrize("is_terminal", [True, False])
def test_what_a_daemon_says_is_shown_and_not_obeyed(peer: tuple[zenoh.Session, str], is_terminal: bool) -> None:
    session, endpoint = peer
    status = json.loads(BY_NAME["status"].valid()[0])
    said = "[/dev/video0] \x1b[2Jis gone\x07"
    hostile = StatusMessage.from_json(json.dumps({**status, "rig": RIG, "last_error": said})).to_json()
    out, stop = StringIO(), threading.Event()

    def put() -> None:
        number = 0
        while not stop.wait(0.05):
            number += 1
            session.put(f"needletrack/{RIG}/status", hostile)
            session.put(f"needletrack/{RIG}/track", track(number, dropped={"[/]\x1b[31m": 1}))

    sender = threading.Thread(target=put)
    sender.start()
    try:
        watch(RIG, [endpoint], count=20, console=Console(file=out, force_terminal=is_terminal, width=200))
    finally:
        stop.set()
        sender.join()
    shown = out.getvalue()
    assert "\x1b[2J" not in shown
    assert "\x07" not in shown
    if is_terminal:
        assert "[/dev/video0]" in shown
