"""Requests over a real session: read, let in, done once, answered; and everything that is no request is refused."""

import json
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from needletrack.client import Outcome, StatusMessage, control
from needletrack.errors import PublishError
from needletrack.publish import control as control_module
from needletrack.publish.control import (
    ANSWERS_KEPT,
    CONTROL_CODE_MEANING,
    MAX_REQUEST_BYTES,
    MAX_WAITING,
    REQUESTS,
    ControlDesk,
    ControlRefused,
    ControlReply,
    ControlRequest,
    NeedleReply,
    NeedleRequest,
    RedetectReply,
    RedetectRequest,
    SnapshotRequest,
    StopRecordingRequest,
    request_of,
)
from needletrack.publish.control import ControlCode as Code
from needletrack.publish.keys import RigKeys
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.session import open_session

WAIT_S = 20.0
KEYS = RigKeys("lab")
SECRET = "correct-horse-battery"


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Work:
    """A daemon's work that counts how often it is done, and can be held up."""

    def __init__(self) -> None:
        self.done: list[ControlRequest] = []
        self.began, self.go_on = threading.Event(), threading.Event()
        self.go_on.set()

    def redetect(self, request: RedetectRequest) -> Mapping[str, object]:
        self.began.set()
        assert self.go_on.wait(WAIT_S)
        self.done.append(request)
        return {"after_sequence": len(self.done)}

    def needle(self, request: NeedleRequest) -> Mapping[str, object]:
        self.done.append(request)
        if request.needle != "18g":
            raise ControlRefused(Code.UNKNOWN_NEEDLE, f"no needle {request.needle!r}: there are default, 18g")
        return {"changed": True, "needle": request.needle, "config_digest": "d"}

    def defect(self, request: ControlRequest) -> Mapping[str, object]:
        raise ZeroDivisionError("a defect of ours")

    @property
    def handlers(self) -> dict[str, Callable[[Any], Mapping[str, object]]]:
        return {"re-detect": self.redetect, "needle": self.needle, "snapshot": self.defect}


def anybody(request: ControlRequest) -> None:
    pass


def only_with_the_token(request: ControlRequest) -> None:
    if request.token != SECRET:
        raise ControlRefused(Code.UNAUTHORISED, "the token is wrong")


def status() -> StatusMessage:
    return example_messages()[1]


@contextmanager
def desk(
    endpoint: str, work: Work, authorise: Callable[[ControlRequest], None] = anybody
) -> Iterator[tuple[ControlDesk, zenoh.Session]]:
    """A desk behind a publisher, and a session of somebody else's that is connected to it."""
    taken = ControlDesk(example_run(), KEYS, work.handlers, authorise)
    with (
        ZenohPublisher(example_run(), status, listen=[endpoint], control=taken.receive),
        taken,
        open_session(connect=[endpoint]) as session,
    ):
        answers = threading.Event()
        session.liveliness().declare_subscriber(KEYS.alive, lambda _: answers.set(), history=True)
        assert answers.wait(WAIT_S)
        yield taken, session


def answers(session: zenoh.Session, key: str, payload: bytes | None) -> list[dict[str, Any]]:
    replies = session.get(key, payload=payload, timeout=WAIT_S)
    return [json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


def answer(session: zenoh.Session, command: str, payload: bytes | None) -> dict[str, Any]:
    (only,) = answers(session, KEYS.control(command), payload)
    return only


def redetect(**fields: object) -> bytes:
    return json.dumps({"version": 1, "request_id": "a", **fields}).encode()


def test_a_request_is_done_and_answered_with_its_results(endpoint: str) -> None:
    work = Work()
    with desk(endpoint, work) as (taken, _):
        request = RedetectRequest()
        reply = control("lab", request, [endpoint], timeout_s=WAIT_S)
        assert isinstance(reply, RedetectReply)
        assert (reply.outcome, reply.code, reply.detail) == (Outcome.DONE, None, "")
        assert (reply.after_sequence, reply.request_id, reply.command) == (1, request.request_id, "re-detect")
        assert (reply.rig, reply.run_id) == ("lab", example_run().run_id)
        other = control("lab", NeedleRequest(needle="18g"), [endpoint], timeout_s=WAIT_S)
        assert isinstance(other, NeedleReply)
        assert other.needle == "18g"
        assert taken.counts == {"done": 2, "refused": 0, "failed": 0}


def test_the_same_request_is_not_done_twice_and_answered_alike(endpoint: str) -> None:
    work = Work()
    with desk(endpoint, work) as (_, session):
        first = answer(session, "re-detect", redetect())
        assert [answer(session, "re-detect", redetect()) for _ in range(3)] == [first] * 3
        assert len(work.done) == 1
        again = answer(session, "re-detect", redetect(request_id="b"))
        assert again["after_sequence"] == 2
        # A refusal of the work itself is the outcome of its request, too.
        for _ in range(2):
            assert answer(session, "needle", redetect(request_id="n", needle="30g"))["code"] == "unknown_needle"
        assert len(work.done) == 3


def test_a_request_repeated_while_it_is_being_done_waits_for_the_same_answer(endpoint: str) -> None:
    work = Work()
    work.go_on.clear()
    with desk(endpoint, work) as (_, session), ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(answer, session, "re-detect", redetect()) for _ in range(2)]
        assert work.began.wait(WAIT_S)
        work.go_on.set()
        first, second = (each.result(WAIT_S) for each in asked)
        assert first == second
        assert len(work.done) == 1


def test_an_id_of_another_request_is_refused(endpoint: str) -> None:
    work = Work()
    with desk(endpoint, work) as (_, session):
        answer(session, "re-detect", redetect())
        other = answer(session, "needle", redetect(needle="18g"))
        assert (other["outcome"], other["code"], other["request_id"]) == ("refused", "id_reused", "a")
        assert len(work.done) == 1


def test_answers_are_kept_for_the_last_requests_only(endpoint: str) -> None:
    work = Work()
    with desk(endpoint, work) as (_, session):
        for number in range(ANSWERS_KEPT + 1):
            answer(session, "re-detect", redetect(request_id=f"r{number}"))
        answer(session, "re-detect", redetect(request_id=f"r{ANSWERS_KEPT}"))
        assert len(work.done) == ANSWERS_KEPT + 1
        answer(session, "re-detect", redetect(request_id="r0"))
        assert len(work.done) == ANSWERS_KEPT + 2


@pytest.mark.parametrize(
    ("command", "payload", "code", "told"),
    [
        ("re-detect", None, Code.MALFORMED, "the query has no payload"),
        ("re-detect", b"", Code.MALFORMED, "the query has no payload"),
        ("re-detect", b"\xff\x00", Code.MALFORMED, "request: Invalid JSON"),
        ("re-detect", b"[" * 4000, Code.MALFORMED, "request: Invalid JSON"),
        ("re-detect", b"[]", Code.MALFORMED, "request: Input should be an object"),
        ("re-detect", b"{}", Code.MALFORMED, "version: Field required"),
        ("re-detect", b'{"version": 1}', Code.MALFORMED, "request_id: Field required"),
        ("re-detect", redetect(version=2), Code.MALFORMED, "version: Input should be 1"),
        ("re-detect", redetect(request_id="a b"), Code.MALFORMED, "request_id: String should match"),
        ("re-detect", redetect(request_id=1), Code.MALFORMED, "request_id: Input should be a valid string"),
        ("re-detect", redetect(after=3), Code.MALFORMED, "after: Extra inputs are not permitted"),
        ("re-detect", b"x" * (MAX_REQUEST_BYTES + 1), Code.TOO_LARGE, f"has {MAX_REQUEST_BYTES + 1} bytes"),
        ("re-detect", b"x" * 3_000_000, Code.TOO_LARGE, "has 3000000 bytes"),
        ("needle", redetect(), Code.MALFORMED, "needle: Field required"),
        ("needle", redetect(needle="30g"), Code.UNKNOWN_NEEDLE, "there are default, 18g"),
        ("self-destruct", redetect(), Code.UNKNOWN_COMMAND, "there are start-recording"),
        ("s" * 5000, redetect(), Code.UNKNOWN_COMMAND, "no command 'sss"),
    ],
)
def test_what_is_no_request_is_refused_and_nothing_is_done(
    endpoint: str, command: str, payload: bytes | None, code: Code, told: str
) -> None:
    work = Work()
    with desk(endpoint, work) as (taken, session):
        refused = answer(session, command, payload)
        assert (refused["outcome"], refused["code"]) == ("refused", code.value)
        assert told in refused["detail"]
        assert len(json.dumps(refused)) < 1000
        assert [request for request in work.done if isinstance(request, RedetectRequest)] == []
        assert taken.counts["refused"] == 1
        # And the next one is served.
        assert answer(session, "re-detect", redetect(request_id="next"))["outcome"] == "done"


JSON = st.recursive(st.none() | st.text() | st.integers() | st.floats(), st.lists).map(json.dumps)


@given(payload=st.binary(max_size=200) | JSON.map(str.encode))
def test_no_payload_whatsoever_breaks_the_reading_of_it(payload: bytes) -> None:
    for command in (*REQUESTS, "other"):
        desk = ControlDesk(example_run(), KEYS, {}, anybody)
        reply = ControlReply.model_validate_json(desk._answered(command, payload))
        assert (reply.outcome, reply.code) == (
            Outcome.REFUSED,
            Code.UNKNOWN_COMMAND if command == "other" else Code.MALFORMED,
        )


def test_who_is_not_let_in_does_nothing_learns_nothing_and_uses_up_no_id(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    work = Work()
    caplog.set_level(logging.DEBUG)
    with desk(endpoint, work, only_with_the_token) as (_, session):
        for token in (None, "", "guess", SECRET.upper()):
            assert answer(session, "re-detect", redetect(token=token))["code"] == "unauthorised"
        assert work.done == []
        first = answer(session, "re-detect", redetect(token=SECRET))
        assert first["outcome"] == "done"
        # Not even the answer to another's request.
        assert answer(session, "re-detect", redetect(token="guess"))["code"] == "unauthorised"
        assert answer(session, "re-detect", redetect(token=SECRET)) == first
        answer(session, "re-detect", redetect(token=SECRET, more=1))
        assert SECRET not in json.dumps(first)
    assert "control: re-detect done" in caplog.text
    assert SECRET not in caplog.text
    assert SECRET not in repr(RedetectRequest(token=SECRET))


def test_a_look_at_all_keys_asks_for_nothing(endpoint: str) -> None:
    work = Work()
    with desk(endpoint, work) as (taken, session):
        for key in ("needletrack/lab/control/*", "needletrack/lab/**", "**"):
            found = answers(session, key, redetect())
            assert [reply for reply in found if "outcome" in reply] == []
        assert work.done == []
        assert taken.counts == {"done": 0, "refused": 0, "failed": 0}


def test_a_flood_of_nonsense_is_counted_whole_and_logged_in_part(
    endpoint: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_module, "_REFUSALS_TOLD_EVERY_S", 3600.0)
    work = Work()
    with desk(endpoint, work) as (taken, session):
        for _ in range(40):
            answer(session, "re-detect", b"x")
        assert taken.counts["refused"] == 40
        assert len([record for record in caplog.records if "re-detect refused" in record.getMessage()]) == 1
        caplog.set_level(logging.INFO)
        answer(session, "re-detect", redetect())
        assert "re-detect done; 39 refusals before were not logged" in caplog.text


def test_a_defect_is_answered_and_the_desk_goes_on(endpoint: str, caplog: pytest.LogCaptureFixture) -> None:
    work = Work()
    with desk(endpoint, work) as (taken, session):
        failed = control("lab", SnapshotRequest(), [endpoint], timeout_s=WAIT_S)
        assert (failed.outcome, failed.code) == (Outcome.FAILED, "defect")
        assert "a defect of ours" in caplog.text
        assert answer(session, "re-detect", redetect())["outcome"] == "done"
        assert taken.counts == {"done": 1, "refused": 0, "failed": 1}


def test_too_many_at_once_are_refused_at_once(endpoint: str) -> None:
    work = Work()
    work.go_on.clear()
    with desk(endpoint, work) as (_, session), ThreadPoolExecutor(MAX_WAITING + 4) as pool:
        first = pool.submit(answer, session, "re-detect", redetect(request_id="first"))
        assert work.began.wait(WAIT_S)
        asked = [
            pool.submit(answer, session, "re-detect", redetect(request_id=f"r{n}")) for n in range(MAX_WAITING + 3)
        ]
        busy: list[Future[dict[str, Any]]] = []
        while len(busy) < 3:
            busy = [each for each in asked if each.done()]
        assert {each.result()["code"] for each in busy} == {"busy"}
        work.go_on.set()
        outcomes = [each.result(WAIT_S)["outcome"] for each in (first, *asked)]
        assert (outcomes.count("done"), outcomes.count("refused")) == (MAX_WAITING + 1, 3)
    assert len(work.done) == MAX_WAITING + 1


def test_what_waits_at_the_end_is_refused(endpoint: str) -> None:
    work = Work()
    work.go_on.clear()
    taken = ControlDesk(example_run(), KEYS, work.handlers, anybody)
    with (
        ZenohPublisher(example_run(), status, listen=[endpoint], control=taken.receive),
        ThreadPoolExecutor(2) as pool,
    ):
        with taken:
            first = pool.submit(control, "lab", RedetectRequest(), [endpoint], timeout_s=WAIT_S)
            assert work.began.wait(WAIT_S)
            second = pool.submit(control, "lab", RedetectRequest(), [endpoint], timeout_s=WAIT_S)
            while not taken._waiting.qsize():
                threading.Event().wait(0.01)
        # The daemon's end did not wait for the one in hand.
        work.go_on.set()
        assert first.result(WAIT_S).outcome is Outcome.DONE
        assert second.result(WAIT_S).code == "stopping"
        assert control("lab", RedetectRequest(), [endpoint], timeout_s=WAIT_S).code == "stopping"
    assert len(work.done) == 1


def test_nobody_there_and_nobody_who_takes_requests_are_told_apart(endpoint: str) -> None:
    with pytest.raises(PublishError, match=f"nobody answers at {endpoint} within 0.1 s"):
        control("lab", RedetectRequest(), [endpoint], timeout_s=0.1)
    with (
        ZenohPublisher(example_run(), status, listen=[endpoint]),
        pytest.raises(PublishError, match=r"nobody on needletrack/lab/control/re-detect within 1 s: check"),
    ):
        control("lab", RedetectRequest(), [endpoint], timeout_s=1.0)


def test_requests_by_name() -> None:
    assert request_of("needle", needle="18g", request_id="x") == NeedleRequest(needle="18g", request_id="x")
    assert isinstance(request_of("stop-recording"), StopRecordingRequest)
    for command, needle in (("needle", None), ("snapshot", "18g")):
        with pytest.raises(PublishError, match="the command needle, and no other, takes a name"):
            request_of(command, needle=needle)
    with pytest.raises(PublishError, match="request_id: String should match"):
        request_of("snapshot", request_id="no blanks")


def test_an_old_requester_takes_an_answer_with_new_fields() -> None:
    request = RedetectRequest()
    told = {
        "version": 1, "rig": "lab", "run_id": None, "command": "re-detect", "request_id": "a", "outcome": "done",
        "code": None, "detail": "", "after_sequence": 4, "colour": "blue",
    }  # fmt: skip
    reply = request.reply_from_json(json.dumps(told).encode())
    assert isinstance(reply, RedetectReply)
    assert reply.after_sequence == 4
    with pytest.raises(PublishError, match="version: Input should be 1"):
        request.reply_from_json(json.dumps({**told, "version": 2}).encode())


def test_the_page_explains_every_command_and_code() -> None:
    page = (Path(__file__).parents[2] / "docs" / "wire.md").read_text(encoding="utf-8")
    for command in REQUESTS:
        assert f"`{command}`" in page
    for code, meaning in CONTROL_CODE_MEANING.items():
        assert f"| `{code.value}` | {meaning} |" in page
