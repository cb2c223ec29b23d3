"""Faults of control: requests that must not be done, or not twice, or cannot be done."""

import json
import os
import signal
import time
from pathlib import Path

from benchmarks.faults.stage import Stage, Watcher, until
from benchmarks.faults.table import Faults, Seen, changes, lost, require, short
from needletrack.client import (
    ControlReply,
    ControlRequest,
    NeedleRequest,
    Outcome,
    RedetectRequest,
    SnapshotRequest,
    StartRecordingReply,
    StartRecordingRequest,
    StopRecordingRequest,
    control,
)
from needletrack.errors import PublishError
from needletrack.publish.control import MAX_REQUEST_BYTES
from needletrack.publish.keys import RigKeys
from needletrack.publish.session import open_session

FAULTS = Faults()
fault = FAULTS.row

_SECRET = "a-secret-of-twenty-letters"
_ANSWERED_WITHIN_S = 20.0


@fault(
    "control",
    "unauthorised",
    "re-detect without a token, with a wrong one, with the controller's certificate, over mutual TLS",
)
def unauthorised(stage: Stage) -> Seen:
    """The certificate decides who is heard at all, the token who is obeyed."""
    stage.secure()
    _, watcher = stage.running("--control", "--token", str(_token(stage)))
    at_s, operator = time.monotonic(), stage.files("operator")
    codes = []
    for token in (None, _SECRET[::-1]):
        reply = control(stage.rig, RedetectRequest(token=token), [stage.endpoint], tls=operator)
        require(reply.outcome is Outcome.REFUSED, f"it was {reply.outcome}")
        codes.append(reply.code)
    try:
        control(
            stage.rig, RedetectRequest(token=_SECRET), [stage.endpoint], tls=stage.files("controller"), timeout_s=1.0
        )
        told = ""
    except PublishError as error:
        told = str(error)
    require(bool(told), "a controller's certificate was answered")
    counts, seen = _counts(watcher, at_s, refused=2), changes(watcher, at_s)
    allowed = control(stage.rig, RedetectRequest(token=_SECRET), [stage.endpoint], tls=operator)
    require(allowed.outcome is Outcome.DONE, "the operator with the token was refused, too")
    saw = f"answers: {' and '.join(map(str, codes))}, {counts}; no answer to the controller: “{short(told, stage)}”"
    saw += f"; tracks: {seen}; then the operator with the token: done"
    # It was, and so the next pair is searched from nothing, which takes longer than a pair has.
    return Seen(saw, watcher.fresh_after(time.monotonic()), f"tracks: {lost(watcher, at_s)}")


@fault(
    "control",
    "invalid",
    f"nonsense, no request id, more than {MAX_REQUEST_BYTES} bytes, an unknown command, an unknown needle",
)
def invalid(stage: Stage) -> Seen:
    """Nothing is done, each is answered."""
    _, watcher = stage.running("--control")
    at_s, keys = time.monotonic(), RigKeys(stage.rig)
    redetect = RedetectRequest()
    tried = (
        (redetect.command, b"\x00\xff{"),
        (redetect.command, b'{"version": 1}'),
        (redetect.command, bytes(MAX_REQUEST_BYTES + 1)),
        ("self-destruct", redetect.to_json()),
        (NeedleRequest.command, NeedleRequest(needle="knitting").to_json()),
    )
    with open_session(connect=[stage.endpoint]) as session:
        until(session.info.transports, "a link")

        def ask(command: str, payload: bytes) -> str:
            def answer() -> str | None:
                replies = session.get(keys.control(command), payload=payload, timeout=_ANSWERED_WITHIN_S)
                told = [json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
                return f"{told[0]['outcome']}: {told[0]['code']}" if told else None

            return str(until(answer, "an answer"))

        told = [ask(*each) for each in tried]
    require(all(each.startswith("refused") for each in told), f"not every one was refused: {told}")
    codes = ", ".join(each.removeprefix("refused: ") for each in told)
    return _unharmed(watcher, at_s, f"refused as {codes}; {_counts(watcher, at_s, refused=len(tried))}")


@fault("control", "the same request twice", "start-recording sent again with its id, then its id for another command")
def twice(stage: Stage) -> Seen:
    """A link that broke after the request was done must not have it done again."""
    _, watcher = stage.running("--control", "--record", str(stage.folder), "--idle")
    at_s, request = time.monotonic(), StartRecordingRequest()
    first, again = _asked(stage, request), _asked(stage, request)
    require(isinstance(first, StartRecordingReply) and first.outcome is Outcome.DONE, f"it was not done: {first}")
    reused = _asked(stage, SnapshotRequest(request_id=request.request_id))
    files = list(stage.folder.glob("*.mcap"))
    require(first == again and len(files) == 1, f"it was done twice: {files}")
    saw = (
        f"the same answer twice, {len(files)} file; the id for another command: {reused.outcome.value} ({reused.code})"
    )
    return _unharmed(watcher, at_s, saw)


@fault(
    "control",
    "while the recorder is gone",
    "SIGKILL to the recording process; at once stop-recording, start-recording, snapshot",
)
def recorder_gone(stage: Stage) -> Seen:
    """Each is answered with what became of it."""
    daemon, watcher = stage.running("--control", "--record", str(stage.folder))
    watcher.heartbeat(0.0, lambda beat: beat["recording"]["pairs"] > 30, "a recording")
    at_s, recorder = time.monotonic(), daemon.recorder()
    os.kill(recorder, signal.SIGKILL)
    until(lambda: all(process.pid != recorder for process in daemon.family()), "the end of the recording process")
    told = []
    for request in (StopRecordingRequest(), StartRecordingRequest(), SnapshotRequest()):
        asked_s = time.monotonic()
        reply = _asked(stage, request)
        code = f" ({reply.code}: “{short(reply.detail, stage)}”)" if reply.code else ""
        told.append(f"{request.command} {reply.outcome.value} after {time.monotonic() - asked_s:.1f} s{code}")
    before = _recorded(watcher)
    watcher.tracks(time.monotonic(), 30)
    told.append(f"of the next 30 pairs {_recorded(watcher) - before} were recorded")
    return _unharmed(watcher, at_s, "; ".join(told))


def _asked(stage: Stage, request: ControlRequest) -> ControlReply:
    return control(stage.rig, request, [stage.endpoint], timeout_s=_ANSWERED_WITHIN_S)


def _token(stage: Stage) -> Path:
    path = stage.folder / "token"
    path.touch(mode=0o600)
    path.write_text(_SECRET, encoding="utf-8")
    return path


def _recorded(watcher: Watcher) -> int:
    said = watcher.since(0.0, "heartbeat")[-1]["heartbeat"]["recording"]
    return 0 if said is None else int(said["pairs"])


def _counts(watcher: Watcher, at_s: float, *, refused: int) -> str:
    """`control_refused 2 in the status`."""
    beat = watcher.heartbeat(at_s, lambda said: said["counters"]["control_refused"] >= refused, "the refusals' count")
    return f"control_refused {beat['heartbeat']['counters']['control_refused']} in the status"


def _unharmed(watcher: Watcher, at_s: float, saw: str) -> Seen:
    """What tracking, and who watches it, saw of it."""
    watcher.tracks(time.monotonic())
    return Seen(f"{saw}; tracks: {changes(watcher, at_s)}", 0.0, f"tracks: {lost(watcher, at_s)}")
