"""Control at run time: what may be asked of a daemon, its answers, and the desk at which they meet.

A request is a Zenoh query on `<prefix>/<rig>/control/<command>` with a JSON payload; every one is answered once, with
the outcome or a refusal. docs/wire.md is the contract.
"""

import hashlib
import logging
import queue
import threading
import time
import uuid
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType, TracebackType
from typing import Annotated, Any, ClassVar, Literal, Self

import zenoh
from pydantic import ConfigDict, Field, ValidationError

from needletrack.errors import PublishError
from needletrack.publish.keys import RigKeys
from needletrack.publish.message import MOST_MESSAGE_BYTES, WIRE_VERSION, Count, RunContext, WirePart
from needletrack.records import Status

_log = logging.getLogger(__name__)

CONTROL_ENCODING = "application/json;needletrack.control.v1"
MAX_REQUEST_BYTES = 4096
# Requests that wait, and answers that are kept for a request that is repeated.
MAX_WAITING = 16
ANSWERS_KEPT = 256
_LONGEST_NAME = 64
_REFUSALS_TOLD_EVERY_S = 1.0
# A stop of the daemon does not wait for the disk.
_ENDS_WITHIN_S = 0.3


class Outcome(StrEnum):
    """What became of a request."""

    DONE = "done"
    REFUSED = "refused"
    FAILED = "failed"


class ControlCode(StrEnum):
    """Why a request was refused, or failed."""

    DISABLED = "disabled"
    UNAUTHORISED = "unauthorised"
    MALFORMED = "malformed"
    TOO_LARGE = "too_large"
    UNKNOWN_COMMAND = "unknown_command"
    ID_REUSED = "id_reused"
    BUSY = "busy"
    STOPPING = "stopping"
    NOT_CONFIGURED = "not_configured"
    UNKNOWN_NEEDLE = "unknown_needle"
    NO_PAIR = "no_pair"
    DISK = "disk"
    DEFECT = "defect"


CONTROL_CODE_MEANING: Mapping[ControlCode, str] = MappingProxyType(
    {
        ControlCode.DISABLED: "The daemon's configuration does not let itself be controlled (`control.enabled`).",
        ControlCode.UNAUTHORISED: "The token is missing or wrong (`control.token_file`).",
        ControlCode.MALFORMED: "The payload is no request of this command and version, or has a field unknown to it.",
        ControlCode.TOO_LARGE: f"The payload is longer than {MAX_REQUEST_BYTES} bytes; it was not read.",
        ControlCode.UNKNOWN_COMMAND: "There is no such command.",
        ControlCode.ID_REUSED: "The `request_id` was used for another request before.",
        ControlCode.BUSY: f"{MAX_WAITING} requests wait already; nothing was done, try again.",
        ControlCode.STOPPING: "The daemon is about to end; nothing was done.",
        ControlCode.NOT_CONFIGURED: "The folder for it is not configured.",
        ControlCode.UNKNOWN_NEEDLE: "No needle type of that name is configured.",
        ControlCode.NO_PAIR: "No pair was tracked in time: the cameras deliver none.",
        ControlCode.DISK: "The disk did not take it.",
        ControlCode.DEFECT: "A defect of the daemon, which is in its log.",
    }
)


class ControlRefused(PublishError):
    """A request that is refused, or failed; the message says what to change."""

    def __init__(self, code: ControlCode, detail: str, outcome: Outcome = Outcome.REFUSED) -> None:
        super().__init__(detail)
        self.code, self.outcome = code, outcome


def _new_id() -> str:
    return uuid.uuid4().hex


class ControlReply(WirePart):
    """What every answer says; its own results are null unless it was done."""

    version: Literal[1] = Field(description="as in the track message")
    rig: str = Field(description="as in the track message")
    run_id: str | None = Field(description="as in the track message; a request repeated to another run is a new one")
    command: str = Field(description="as in the key")
    request_id: str | None = Field(description="of the request; null where it could not be read")
    outcome: Outcome = Field(
        description="refused: nothing was done; failed: it was tried, and a new request may fare better"
    )
    code: str | None = Field(description="why not; null when done; the list may grow within version 1")
    detail: str = Field(description="the same in a sentence for a person, with the remedy; empty when done")

    def to_json(self) -> bytes:
        """UTF-8 JSON on one line."""
        return self.model_dump_json().encode()


class StartRecordingReply(ControlReply):
    """Recording has begun."""

    changed: bool | None = Field(None, description="false: it recorded already")
    file: str | None = Field(None, description="on the daemon's host; null until the first pair came")


class StopRecordingReply(ControlReply):
    """The file is finished."""

    changed: bool | None = Field(None, description="false: nothing was being recorded")
    file: str | None = Field(None, description="the last one, on the daemon's host")
    pairs: Count | None = Field(None, description="recorded since the daemon's start")
    dropped: Count | None = Field(None, description="not recorded since then, though recording was on")


class SnapshotReply(ControlReply):
    """One pair with its track is on the disk."""

    folder: str | None = Field(None, description="a recording of one pair, on the daemon's host, with track.json")
    sequence: Count | None = Field(None, description="of the pair")
    status: Status | None = Field(None, description="of its track")


class RedetectReply(ControlReply):
    """The next pair is tracked without memory."""

    after_sequence: Count | None = Field(
        None, description="tracks with a higher sequence are new; null: none was taken up before"
    )


class NeedleReply(ControlReply):
    """The next pair is tracked as a needle of this type."""

    changed: bool | None = Field(None, description="false: it was in use already")
    needle: str | None = Field(None, description="the type in use")
    config_digest: str | None = Field(None, description="that its tracks bear")
    after_sequence: Count | None = Field(
        None, description="tracks with a higher sequence are of it; null: all of this run are, or nothing changed"
    )


class ControlRequest(WirePart):
    """What every request says. A field that the daemon does not know is refused: it would do something else."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    command: ClassVar[str] = ""
    reply: ClassVar[type[ControlReply]] = ControlReply

    version: Literal[1] = Field(1, description="as in the track message")
    request_id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")] = Field(
        default_factory=_new_id,
        description="the requester's own, new for each request, 1 to 64 letters, digits, `_`, `.`, `-`; repeated, it "
        "is answered as before and nothing is done twice",
    )
    token: Annotated[str, Field(max_length=256)] | None = Field(
        None, repr=False, description="the shared secret, where the daemon is configured with one; null: none"
    )

    def to_json(self) -> bytes:
        """UTF-8 JSON on one line."""
        return self.model_dump_json().encode()

    def reply_from_json(self, data: bytes) -> ControlReply:
        """The answer in a reply's payload, of the class that belongs to this request; raises PublishError."""
        if len(data) > MOST_MESSAGE_BYTES:
            raise PublishError(f"not a needletrack.control.v{WIRE_VERSION} answer: it has {len(data)} bytes")
        try:
            return self.reply.model_validate_json(data, strict=True)
        except ValidationError as error:
            raise PublishError(f"not a needletrack.control.v{WIRE_VERSION} answer: {_told(error)}") from error


class StartRecordingRequest(ControlRequest):
    """Begin to record."""

    command: ClassVar[str] = "start-recording"
    reply: ClassVar[type[ControlReply]] = StartRecordingReply


class StopRecordingRequest(ControlRequest):
    """End the recording and finish its file."""

    command: ClassVar[str] = "stop-recording"
    reply: ClassVar[type[ControlReply]] = StopRecordingReply


class SnapshotRequest(ControlRequest):
    """Keep the next pair, its images and its track."""

    command: ClassVar[str] = "snapshot"
    reply: ClassVar[type[ControlReply]] = SnapshotReply


class RedetectRequest(ControlRequest):
    """Forget the track, and look for the needle anew."""

    command: ClassVar[str] = "re-detect"
    reply: ClassVar[type[ControlReply]] = RedetectReply


class NeedleRequest(ControlRequest):
    """Track a needle of another type."""

    command: ClassVar[str] = "needle"
    reply: ClassVar[type[ControlReply]] = NeedleReply

    needle: Annotated[str, Field(max_length=64)] = Field(
        description="name of `control.needles` in the daemon's configuration, or `default`: `tracking.needle`"
    )


REQUESTS: Mapping[str, type[ControlRequest]] = MappingProxyType(
    {
        request.command: request
        for request in (
            StartRecordingRequest,
            StopRecordingRequest,
            SnapshotRequest,
            RedetectRequest,
            NeedleRequest,
        )
    }
)


def request_of(
    command: str, *, needle: str | None = None, token: str | None = None, request_id: str | None = None
) -> ControlRequest:
    """The request of a command by its name; needle: a type's name, of `needle` alone. Raises PublishError."""
    model = REQUESTS[command]
    if (needle is None) == (model is NeedleRequest):
        raise PublishError("the command needle, and no other, takes a name: one of control.needles, or default")
    given = {"needle": needle, "token": token, "request_id": request_id}
    try:
        return model.model_validate({name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        raise PublishError(f"{command}: {_told(error)}") from error


# A command's own work: the request, to the results of its reply; raises ControlRefused.
Handler = Callable[[Any], Mapping[str, object]]


@dataclass(frozen=True, slots=True)
class _Waiting:
    query: zenoh.Query
    command: str
    payload: bytes


class ControlDesk:
    """Takes requests in Zenoh's thread, and does one after another in a thread of its own, never in tracking's.

    handlers: a command's name to its work; authorise: raises ControlRefused for whom it does not let in, and is asked
    before anything else is done. It begins to work when it is entered; what waits when it is left is refused.
    """

    def __init__(
        self,
        run: RunContext,
        keys: RigKeys,
        handlers: Mapping[str, Handler],
        authorise: Callable[[ControlRequest], None],
    ) -> None:
        self._run, self._handlers, self._authorise = run, handlers, authorise
        self._prefix = keys.control("")
        self._waiting: queue.SimpleQueue[_Waiting | None] = queue.SimpleQueue()
        self._answers: OrderedDict[str, tuple[bytes, bytes]] = OrderedDict()
        # Requests are refused in Zenoh's threads, too.
        self._telling = threading.Lock()
        self._counts: Counter[Outcome] = Counter()
        self._quiet_until_s, self._untold = 0.0, 0
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="needletrack-control", daemon=True)

    @property
    def counts(self) -> dict[str, int]:
        """Answers so far: outcome to number."""
        return {outcome.value: self._counts[outcome] for outcome in Outcome}

    def receive(self, query: zenoh.Query) -> None:
        """A query below `control/`; returns at once."""
        command = str(query.key_expr).removeprefix(self._prefix)
        if not str(query.key_expr).startswith(self._prefix) or "*" in command or "$" in command:
            # Somebody who looks at all keys asks for nothing to be done.
            with query:
                return
        payload = query.payload
        if payload is not None and len(payload) > MAX_REQUEST_BYTES:
            detail = f"the request has {len(payload)} bytes, at most {MAX_REQUEST_BYTES} are read"
            self._refuse(query, command, ControlCode.TOO_LARGE, detail)
        elif self._stopping:
            self._refuse(query, command, ControlCode.STOPPING, "the daemon is about to end")
        elif self._waiting.qsize() >= MAX_WAITING:
            self._refuse(query, command, ControlCode.BUSY, f"{MAX_WAITING} requests wait already: try again")
        else:
            self._waiting.put(_Waiting(query, command, b"" if payload is None else payload.to_bytes()))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping = True
        self._waiting.put(None)
        self._thread.join(_ENDS_WITHIN_S)

    def _work(self) -> None:
        while (waiting := self._waiting.get()) is not None:
            if self._stopping:
                self._refuse(waiting.query, waiting.command, ControlCode.STOPPING, "the daemon is about to end")
                continue
            self._send(waiting.query, waiting.command, self._answered(waiting.command, waiting.payload))

    def _refuse(self, query: zenoh.Query, command: str, code: ControlCode, detail: str) -> None:
        reply = self._reply(ControlReply, command, None, ControlRefused(code, detail))
        self._told(reply)
        self._send(query, command, reply.to_json())

    def _send(self, query: zenoh.Query, command: str, answer: bytes) -> None:
        with suppress(zenoh.ZError), query:  # the asker, or our own session, may be gone meanwhile
            query.reply(self._prefix + command, answer, encoding=CONTROL_ENCODING)

    def _answered(self, command: str, payload: bytes) -> bytes:
        """The answer to a request; the work is done, unless it was done before."""
        model, request = REQUESTS.get(command), None
        try:
            if model is None:
                known = ", ".join(REQUESTS)
                name = command[:_LONGEST_NAME]
                raise ControlRefused(ControlCode.UNKNOWN_COMMAND, f"no command {name!r}: there are {known}")
            request = _read(model, payload)
            self._authorise(request)
        except ControlRefused as refusal:
            # Not remembered: whoever is not let in uses up nobody's request ids.
            request_id = None if request is None else request.request_id
            reply = self._reply(ControlReply if model is None else model.reply, command, request_id, refusal)
            self._told(reply)
            return reply.to_json()
        content = hashlib.sha256(f"{command} {request.model_dump_json(exclude={'token'})}".encode()).digest()
        if (before := self._answers.get(request.request_id)) is not None:
            if before[0] == content:
                return before[1]
            reused = ControlRefused(
                ControlCode.ID_REUSED, f"request_id {request.request_id!r} was another request's: choose a new one"
            )
            reply = self._reply(request.reply, command, request.request_id, reused)
            self._told(reply)
            return reply.to_json()
        reply = self._done(request)
        self._told(reply)
        answer = reply.to_json()
        self._answers[request.request_id] = (content, answer)
        if len(self._answers) > ANSWERS_KEPT:
            self._answers.popitem(last=False)
        return answer

    def _done(self, request: ControlRequest) -> ControlReply:
        try:
            results = self._handlers[request.command](request)
        except ControlRefused as refusal:
            return self._reply(request.reply, request.command, request.request_id, refusal)
        except Exception:
            # Tracking goes on: a defect here is no reason to lose the needle.
            _log.exception("control: %s failed", request.command)
            defect = ControlRefused(ControlCode.DEFECT, "a defect: see the daemon's log", Outcome.FAILED)
            return self._reply(request.reply, request.command, request.request_id, defect)
        return self._reply(request.reply, request.command, request.request_id, None, results)

    def _reply(
        self,
        model: type[ControlReply],
        command: str,
        request_id: str | None,
        refusal: ControlRefused | None,
        results: Mapping[str, object] = MappingProxyType({}),
    ) -> ControlReply:
        return model.model_validate(
            {
                **results,
                "version": WIRE_VERSION,
                "rig": self._run.rig,
                "run_id": self._run.run_id,
                "command": command[:_LONGEST_NAME],
                "request_id": request_id,
                "outcome": Outcome.DONE if refusal is None else refusal.outcome,
                "code": None if refusal is None else refusal.code.value,
                "detail": "" if refusal is None else str(refusal),
            }
        )

    def _told(self, reply: ControlReply) -> None:
        with self._telling:
            self._counts[reply.outcome] += 1
            if reply.outcome is Outcome.REFUSED:
                # Whoever floods us with nonsense shall not fill the disk with it.
                now_s = time.monotonic()
                if now_s < self._quiet_until_s:
                    self._untold += 1
                    return
                self._quiet_until_s = now_s + _REFUSALS_TOLD_EVERY_S
            untold, self._untold = self._untold, 0
        told = f" ({reply.code}: {reply.detail})" if reply.code else ""
        more = f"; {untold} refusals before were not logged" if untold else ""
        level = logging.INFO if reply.outcome is Outcome.DONE else logging.WARNING
        _log.log(level, "control: %s %s%s%s", reply.command, reply.outcome.value, told, more)


def _read(model: type[ControlRequest], payload: bytes) -> ControlRequest:
    if not payload:
        raise ControlRefused(ControlCode.MALFORMED, "the query has no payload: send the request as JSON (docs/wire.md)")
    try:
        request = model.model_validate_json(payload, strict=True)
    except ValidationError as error:
        raise ControlRefused(ControlCode.MALFORMED, _told(error)) from error
    # Defaults are for those who write requests in Python.
    if missing := [name for name in ("version", "request_id") if name not in request.model_fields_set]:
        raise ControlRefused(ControlCode.MALFORMED, f"{missing[0]}: Field required")
    return request


def _told(error: ValidationError) -> str:
    """What is wrong, without what was sent: it may hold the token."""
    problems = error.errors(include_url=False, include_input=False, include_context=False)
    told = "; ".join(f"{'.'.join(map(str, p['loc']))[:_LONGEST_NAME] or 'request'}: {p['msg']}" for p in problems[:3])
    return told + (f" (and {len(problems) - 3} more)" if len(problems) > 3 else "")
