"""What docs/wire.md promises, seen by somebody who has Zenoh and JSON and nothing of ours, from the live loop."""

import json
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh
from tests.recording.small_recording import image_of, small_rig

from needletrack.client import Subscriber
from needletrack.publish.message import RunContext, Source, StatusMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.session import direct, open_session
from needletrack.records import Clock, DropReason, Frame, NeedleTrack, Reason, Status, StereoPair
from needletrack.replay import Published
from needletrack.service import Service

WAIT_S = 20.0
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Scripted:
    """A live source: numbers are pairs, reasons are losses, everything else is called."""

    def __init__(self, script: list[int | DropReason | Callable[[], object]]) -> None:
        self._script = script
        self.dropped: Mapping[DropReason, int] = {}

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        for step in self._script:
            if isinstance(step, DropReason):
                self.dropped = {**self.dropped, step: self.dropped.get(step, 0) + 1}
            elif isinstance(step, int):
                stamp = time.monotonic_ns()
                frames = Frame(image_of(step), stamp), Frame(image_of(step + 1), stamp + 3_000)
                yield StereoPair(*frames, sequence=step, clock=Clock.MONOTONIC)
            else:
                step()


def nothing(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
    return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))


def run_once(endpoint: str, script: list[int | DropReason | Callable[[], object]], run: RunContext) -> None:
    """One life of a daemon: every pair is tracked, so that only the script loses any."""
    service = Service(Scripted(script), nothing, small_rig(), run, every_frame=True, heartbeat_s=0.05)
    with ZenohPublisher(run, service.status, listen=[endpoint], heartbeat_s=0.05) as publisher:
        assert publisher.wait_for_subscriber(WAIT_S)
        service.run([Published(publisher)], threading.Event())


class Outsider:
    """Everything on a rig's keys, in the order in which it came."""

    def __init__(self, session: zenoh.Session) -> None:
        self.events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self.heartbeats = 0
        key = "needletrack/small"
        session.liveliness().declare_subscriber(f"{key}/alive", direct(self._take_token), history=True)
        for leaf in ("track", "status"):
            session.declare_subscriber(f"{key}/{leaf}", direct(self._take(leaf)))

    # All of them in the one thread that reads the link: in threads of their own they would overtake each other.
    def _take_token(self, sample: zenoh.Sample) -> None:
        self.events.put(("token", sample.kind))

    def three_heartbeats(self) -> None:
        seen = self.heartbeats
        assert eventually(lambda: self.heartbeats >= seen + 3)

    def _take(self, leaf: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            assert str(sample.encoding) == f"application/json;needletrack.{leaf}.v1"
            self.heartbeats += leaf == "status"
            self.events.put((leaf, json.loads(sample.payload.to_bytes())))

        return take

    def until_gone(self, last_sequence: int) -> list[tuple[str, Any]]:
        """What came until the token went, the last heartbeat came, and the last track: nothing orders these three."""
        seen: list[tuple[str, Any]] = []
        missing = {"token", "status", "track"}
        while missing:
            what, content = self.events.get(timeout=WAIT_S)
            seen.append((what, content))
            if (
                content == zenoh.SampleKind.DELETE
                if what == "token"
                else content.get("state") == "stopping" or content.get("sequence") == last_sequence
            ):
                missing.discard(what)
        return seen


def test_two_lives_of_a_daemon_as_the_page_tells_them(endpoint: str) -> None:
    rig = small_rig()
    first = RunContext(rig.name, Source.LIVE, "c" * 12, rig.digest)
    second = replace(first, run_id="the-next")
    with open_session(connect=[endpoint]) as session:
        outsider = Outsider(session)
        script: list[int | DropReason | Callable[[], object]] = [
            3, 4, DropReason.UNREADABLE_IMAGE, 6, DropReason.UNPAIRED_LEFT, 7, outsider.three_heartbeats, 8,
        ]  # fmt: skip
        run_once(endpoint, script, first)
        life = outsider.until_gone(8)
        run_once(endpoint, [0, 1], second)
        after = outsider.until_gone(1)
    # Start: the token, then everything else. Stop: one last heartbeat that says so, and the token goes.
    assert life[0] == ("token", zenoh.SampleKind.PUT)
    states = [content["state"] for what, content in life if what == "status"]
    assert (states.count("stopping"), states[-1]) == (1, "stopping")
    assert [kind for what, kind in life if what == "token"] == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE]
    tracks = [content for what, content in life if what == "track"]
    # Order, gaps, drops: the missing number and its count in one message; a single frame had no number.
    assert [track["sequence"] for track in tracks] == [3, 4, 6, 7, 8]
    assert [track["dropped"] for track in tracks] == [
        {}, {}, {"unreadable_image": 1}, *[{"unpaired_left": 1, "unreadable_image": 1}] * 2,
    ]  # fmt: skip
    # One sample a pair, also without a needle; times on the clocks that are named.
    assert {track["status"] for track in tracks} == {"invalid"}
    for track in tracks:
        assert (track["version"], track["clock"], track["source"]) == (1, "monotonic", "live")
        exposed_ns = track["captured_at_unix_ns"]
        assert track["latency_ms"] == pytest.approx((track["published_at_ns"] - exposed_ns) / 1e6, abs=0.001)
        assert track["latency_ms"] >= 0
    # Heartbeats go on while no pair comes.
    at = [index for index, (what, _) in enumerate(life) if what == "track"]
    assert "status" in [what for what, _ in life[at[3] : at[4]]]
    beats = [content for what, content in life if what == "status"]
    assert [beat["published_at_ns"] for beat in beats] == sorted(beat["published_at_ns"] for beat in beats)
    assert beats[-1]["last_sequence"] == 8
    assert sum(beats[-1]["counters"][f"tracks_{status.value}"] for status in Status) == 5
    # Recovery: a new run with numbers of its own.
    again = [content for what, content in after if what == "track"]
    assert [track["sequence"] for track in again] == [0, 1]
    assert {track["run_id"] for track in tracks} == {first.run_id}
    assert {track["run_id"] for track in again} == {"the-next"}


def test_a_late_joiner_has_token_and_status_at_once(endpoint: str) -> None:
    service = Service(Scripted([]), nothing, small_rig(), replace(example_run(), rig="small"))
    with (
        ZenohPublisher(replace(example_run(), rig="small"), service.status, listen=[endpoint], heartbeat_s=60.0),
        open_session(connect=[endpoint]) as session,
    ):
        what, kind = Outsider(session).events.get(timeout=WAIT_S)
        assert (what, kind) == ("token", zenoh.SampleKind.PUT)
        (reply,) = session.get("needletrack/small/status", timeout=WAIT_S)
        assert reply.ok is not None
        assert json.loads(reply.ok.payload.to_bytes())["state"] == "starting"


def test_the_daemon_s_clock_is_told_to_who_asks_for_it_by_name(endpoint: str) -> None:
    with (
        ZenohPublisher(example_run(), lambda: example_messages()[1], listen=[endpoint]),
        Subscriber("lab", [endpoint]) as waiting,
        open_session(connect=[endpoint]) as session,
    ):
        waiting.wait_for_daemon(WAIT_S)
        before_ns = time.time_ns()
        replies: list[zenoh.Reply] = []
        while not replies:
            replies = list(session.get("needletrack/lab/clock", timeout=WAIT_S))
        assert replies[0].ok is not None
        told = json.loads(replies[0].ok.payload.to_bytes())
        assert before_ns <= told["received_at_ns"] <= told["replied_at_ns"] <= time.time_ns()
        keys = {str(reply.ok.key_expr) for reply in session.get("needletrack/lab/*", timeout=WAIT_S) if reply.ok}
        assert keys == {"needletrack/lab/status"}


def with_later_fields(part: Any) -> Any:
    """The same message from a later version 1: a field more in every object, whatever its depth."""
    if isinstance(part, dict):
        free = {"dropped", "counters", "timing_ms", "tracks_per_s", "cameras"}
        return {
            **{key: value if key in free else with_later_fields(value) for key, value in part.items()},
            "of_a_later_day": {"unknown": [1, None]},
        }
    return part


def test_an_old_reader_takes_new_fields_and_never_meets_version_2(endpoint: str) -> None:
    track, status = example_messages()
    received = None
    with (
        Subscriber("lab", [], listen=[endpoint], max_age_s=60.0, silent_after_s=60.0) as subscriber,
        open_session(connect=[endpoint]) as newer,
    ):
        matched = threading.Event()
        sender = newer.declare_publisher("needletrack/lab/track")
        sender.declare_matching_listener(lambda _: matched.set())
        assert matched.wait(WAIT_S)
        later = json.dumps(with_later_fields(json.loads(track.to_json())))
        for sequence in range(3):
            # Version 2 beside version 1, on a key of its own.
            newer.put("needletrack/lab/v2/track", json.dumps({"version": 2, "pose": "of another kind"}))
            sender.put(later.replace('"sequence": 1207', f'"sequence": {1207 + sequence}'))
            received = subscriber.next(WAIT_S)
            assert received is not None
            assert received.message == track.model_copy(update={"sequence": 1207 + sequence})
        newer.put("needletrack/lab/status", json.dumps(with_later_fields(json.loads(status.to_json()))))
        assert eventually(lambda: subscriber.status == status)
        assert subscriber.undecodable == 0
        # By mistake on the key of version 1: refused by name, and what was there stays.
        sender.put(later.replace('"version": 1', '"version": 2'))
        assert eventually(lambda: subscriber.undecodable == 1)
        assert subscriber.latest() == received
        sender.put(later.replace('"sequence": 1207', '"sequence": 1210'))
        assert subscriber.next(WAIT_S) is not None


def test_a_new_reader_takes_the_status_of_an_older_daemon() -> None:
    told = json.loads(example_messages()[1].to_json())
    # Every field of the first version 1; what came later has a value for whoever lacks it.
    for later in ("needle",):
        del told[later]
    assert StatusMessage.from_json(json.dumps(told)).needle is None


def eventually(true: Callable[[], bool]) -> bool:
    deadline, tick = time.monotonic() + WAIT_S, threading.Event()
    while not true():
        if time.monotonic() > deadline:
            return False
        tick.wait(0.002)
    return True


def test_every_example_of_the_page_is_there_and_the_page_names_each() -> None:
    page = (DOCS / "wire.md").read_text(encoding="utf-8")
    for example in (DOCS / "examples").iterdir():
        if example.is_file():
            assert f"(examples/{example.name})" in page
