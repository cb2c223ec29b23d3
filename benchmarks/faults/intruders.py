"""Faults of certificates, and what intruders try, against a daemon with mutual TLS and an honest subscriber.

The intruder keeps no rules of its own, and once more uses our client, for what its error says.
"""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import zenoh
from tests.publish.network import raw_session

from benchmarks.faults.stage import Stage, Watcher, ended, fresh, secured, until
from benchmarks.faults.table import Faults, Seen, changes, lost, require, short
from benchmarks.loopback import free_endpoint
from needletrack.authority import init_security
from needletrack.client import Subscriber, TrackMessage
from needletrack.errors import PublishError
from needletrack.publish.clock import ClockMessage
from needletrack.publish.keys import RigKeys
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.tls import TlsFiles

FAULTS = Faults()
fault = FAULTS.row

_OTHER = "another-rig"
_FORGED = "forged"
_TRIES_FOR_S = 3.0
_WAITS_S = 1.0


# --- certificates


@fault("certificates", "expired", "a subscriber whose certificate ended two days ago")
def expired(stage: Stage) -> Seen:
    """Refused by our own side before anything is opened, and by the daemon where the own side does not look."""
    pki = stage.secure()
    _issued(stage, "expired", now=datetime.now(UTC) - timedelta(days=3), days=1)
    return _refused_reader(stage, pki / "expired")


@fault("certificates", "of another rig", "a subscriber with the controller's certificate of another rig")
def of_another_rig(stage: Stage) -> Seen:
    """Of the right authority, and with no right to anything of this rig."""
    pki = stage.secure()
    init_security(pki, _OTHER)
    return _refused_reader(stage, pki / _OTHER / "controller")


@fault(
    "certificates", "for another host", "a daemon at our subscriber's second endpoint, its certificate for another name"
)
def for_another_host(stage: Stage) -> Seen:
    """Whoever got hold of a publisher's certificate can use it at its own address alone."""
    pki, endpoint = stage.secure(), secured(free_endpoint())
    shutil.copytree(pki / stage.rig / "publisher", pki / "kept")
    init_security(pki, stage.rig, hosts=["elsewhere.example"], renew=True)
    stolen = TlsFiles(*(pki / stage.rig / "publisher" / f"{name}.pem" for name in ("authority", "certificate", "key")))
    stage.daemon("--tls", str(pki / "kept"))
    watcher = stage.watcher(stage.endpoint, endpoint)
    fresh(watcher)
    at_s = time.monotonic()
    track, status = example_messages()
    run = replace(example_run(), rig=stage.rig, run_id=_FORGED)
    with ZenohPublisher(run, lambda: status, listen=[endpoint], tls=stolen) as impostor:
        while time.monotonic() < at_s + _TRIES_FOR_S:
            impostor.publish(track.model_copy(update={"rig": stage.rig, "run_id": _FORGED}))
            time.sleep(0.05)
        told = _error(stage.rig, [endpoint], stage.files("controller"))
    _require_none_forged(watcher)
    return _unharmed(watcher, at_s, f"the false daemon reached nobody; {_says(told, stage)}")


@fault("certificates", "of another authority", "a subscriber with the same names, issued by an authority of its own")
def of_another_authority(stage: Stage) -> Seen:
    """A name is worth what its authority is."""
    stage.secure()
    init_security(stage.folder / "own", stage.rig)
    return _refused_reader(stage, stage.folder / "own" / stage.rig / "controller")


@fault("certificates", "none", "a subscriber without a certificate, by TLS and by plain TCP")
def without(stage: Stage) -> Seen:
    """The endpoint is there, and not for it."""
    stage.secure()
    _, watcher = stage.running()
    at_s = time.monotonic()
    plain = stage.endpoint.replace("tls/", "tcp/")
    require(_reads(stage.endpoint, stage.files("controller").authority, None, stage.rig) is None, "a link by TLS")
    require(_reads(plain, None, None, stage.rig) is None, "a link by TCP")
    ours, by_tcp = _error(stage.rig, [stage.endpoint], None), _error(stage.rig, [plain], None)
    return _unharmed(watcher, at_s, f"the intruder: no link; {_says(ours, stage)}; by TCP {_says(by_tcp, stage)}")


@fault("certificates", "a key that all may read", "chmod 644 of the key, of a subscriber's and of a second daemon's")
def readable_key(stage: Stage) -> Seen:
    """Both are refused before anything is opened."""
    pki = stage.secure()
    init_security(pki, _OTHER)
    _, watcher = stage.running()
    at_s = time.monotonic()
    for role in ("controller", "publisher"):
        (pki / _OTHER / role / "key.pem").chmod(0o644)
    told = _error(_OTHER, [stage.endpoint], stage.files("controller", _OTHER))
    elsewhere = ("--name", _OTHER, "--tls", str(pki / _OTHER / "publisher"), "--listen", secured(free_endpoint()))
    second = stage.daemon(*elsewhere, listen=False)
    code = ended(second)
    said = second.stderr().strip().splitlines()[-1].removeprefix("needletrack: ")
    require(all("chmod 600" in each for each in (told, said)), f"it was not refused for its key: {told}; {said}")
    saw = f"the subscriber: {_says(told, stage)}; the daemon ends with exit code {code} and says the same of its own"
    return _unharmed(watcher, at_s, saw)


# --- intruders


@fault("intruders", "a reader publishes on our key", "tracks put with the controller's certificate, 3 s long")
def forges_tracks(stage: Stage) -> Seen:
    """It may read, and nothing else."""
    return _forger(stage, lambda session, keys: session.put(keys.track, _forged_track(stage)))


@fault("intruders", "a reader forges the status", "heartbeats put with the controller's certificate, 3 s long")
def forges_status(stage: Stage) -> Seen:
    """It may read, and nothing else."""
    return _forger(stage, lambda session, keys: session.put(keys.status, _forged_status(stage)))


@fault(
    "intruders", "a reader answers for us", "queryables of status and clock, declared with the controller's certificate"
)
def answers(stage: Stage) -> Seen:
    """A late joiner asks for the status, and every subscriber asks for the time."""
    stage.secure()
    stage.daemon()
    watcher = stage.watcher(mode="client")
    fresh(watcher)
    at_s, keys, asked = time.monotonic(), RigKeys(stage.rig), []

    def answer(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            clock = str(query.key_expr) == keys.clock
            query.reply(str(query.key_expr), ClockMessage.now(666, 666).to_json() if clock else _forged_status(stage))

    with _reader(stage) as session:
        read = _counted(session, keys)
        for key in (keys.status, keys.clock):
            session.declare_queryable(key, answer, complete=True)
        until(lambda: read, "a track at the intruder")
        late = stage.watcher(mode="client")
        fresh(late)
        until(lambda: time.monotonic() > at_s + _TRIES_FOR_S, "the end")
    require(not asked, f"the intruder was asked: {asked[:3]}")
    for each in (watcher, late):
        _require_none_forged(each)
        clocks = [seen["clock_ms"] for seen in each.since(at_s, "heartbeat") if seen["clock_ms"] is not None]
        require(bool(clocks) and max(map(abs, clocks)) < 1000, f"its clock was believed: {clocks[:3]}")
    saw = f"none of its answers; the intruder read {len(read)} tracks, which it may, and was asked nothing"
    return _unharmed(watcher, at_s, saw)


@fault(
    "intruders", "a false neighbour", "another rig's publisher, at our subscriber's second endpoint, puts on our keys"
)
def false_neighbour(stage: Stage) -> Seen:
    """Here nobody stands between: the subscriber's own rules refuse."""
    pki, endpoint = stage.secure(), secured(free_endpoint())
    init_security(pki, _OTHER)
    stage.daemon()
    watcher, keys = stage.watcher(stage.endpoint, endpoint), RigKeys(stage.rig)
    fresh(watcher)
    at_s, tried = time.monotonic(), 0
    authority = pki / "authority" / "authority.pem"
    identity = pki / _OTHER / "publisher"
    with raw_session("peer", listen=[endpoint], authority=authority, identity=identity) as session:
        until(session.info.transports, "a link from the subscriber")
        while time.monotonic() < at_s + _TRIES_FOR_S:
            session.put(keys.track, _forged_track(stage))
            session.put(keys.status, _forged_status(stage))
            tried += 2
            time.sleep(0.02)
    _require_none_forged(watcher)
    return _unharmed(watcher, at_s, f"none of {tried} messages, though the link stood")


def _refused_reader(stage: Stage, identity: Path) -> Seen:
    """What a reader sees with the certificate in a folder."""
    _, watcher = stage.running()
    at_s = time.monotonic()
    tls = TlsFiles(*(identity / f"{name}.pem" for name in ("authority", "certificate", "key")))
    seen = _reads(stage.endpoint, tls.authority, identity, stage.rig)
    require(not seen, f"the intruder read {seen} samples")
    told = _error(stage.rig, [stage.endpoint], tls)
    link = "no link" if seen is None else "a link, and nothing on it"
    return _unharmed(watcher, at_s, f"the intruder: {link}; {_says(told, stage)}")


def _forger(stage: Stage, forge: Callable[[zenoh.Session, RigKeys], None]) -> Seen:
    stage.secure()
    stage.daemon()
    # A daemon passes on between its clients alone: as a peer, the subscriber would be safe for another reason.
    watcher, keys = stage.watcher(mode="client"), RigKeys(stage.rig)
    fresh(watcher)
    at_s, tried = time.monotonic(), 0
    with _reader(stage) as session:
        read = _counted(session, keys)
        until(lambda: read, "a track at the intruder")
        until_s = time.monotonic() + _TRIES_FOR_S
        while time.monotonic() < until_s:
            forge(session, keys)
            tried += 1
            time.sleep(0.02)
    _require_none_forged(watcher)
    undecodable = [seen["undecodable"] for seen in watcher.since(at_s, "undecodable")]
    require(not undecodable, f"{undecodable} undecodable messages reached the subscriber")
    saw = f"none of {tried} forged messages; the intruder read {len(read)} of our tracks meanwhile, which it may"
    return _unharmed(watcher, at_s, saw)


def _reader(stage: Stage) -> zenoh.Session:
    """A session with the certificate of the rig's controller, and no rules of its own."""
    tls = stage.files("controller")
    return raw_session("client", connect=[stage.endpoint], authority=tls.authority, identity=tls.key.parent)


def _counted(session: zenoh.Session, keys: RigKeys) -> list[str]:
    """The tracks that a session gets from now on, but for those that it put itself."""
    read: list[str] = []

    def take(sample: zenoh.Sample) -> None:
        if (run := str(TrackMessage.from_json(sample.payload.to_bytes()).run_id)) != _FORGED:
            read.append(run)

    session.declare_subscriber(keys.track, take)
    return read


def _reads(endpoint: str, authority: Path | None, identity: Path | None, rig: str) -> int | None:
    """How many of a rig's samples and answers a session without rules gets; None: it gets no link."""
    keys, got = RigKeys(rig), []
    try:
        session = raw_session("client", connect=[endpoint], authority=authority, identity=identity)
    except zenoh.ZError:
        return None
    with session:
        for key in ("**", keys.track, keys.status):
            session.declare_subscriber(key, lambda sample: got.append(str(sample.key_expr)))
        time.sleep(_WAITS_S)
        for key in (keys.status, keys.clock):
            got += [key for reply in session.get(key, timeout=_WAITS_S) if reply.ok is not None]
    return len(got)


def _error(rig: str, endpoints: list[str], tls: TlsFiles | None) -> str:
    """What our own client says, which must not get there."""
    try:
        with Subscriber(rig, endpoints, tls=tls) as subscriber:
            subscriber.wait_for_daemon(_WAITS_S)
    except PublishError as error:
        return str(error)
    return ""


def _says(told: str, stage: Stage) -> str:
    require(bool(told), "our own client was let in")
    return f"its error: “{short(told, stage)}”"


def _issued(stage: Stage, name: str, *, now: datetime, days: int) -> None:
    """A controller's certificate of another validity in the folder `name`; the rig's own are made anew."""
    assert stage.pki is not None
    init_security(stage.pki, stage.rig, now=now, days=days, renew=True)
    shutil.copytree(stage.pki / stage.rig / "controller", stage.pki / name)
    init_security(stage.pki, stage.rig, renew=True)


def _forged_track(stage: Stage) -> bytes:
    track, _ = example_messages()
    return track.model_copy(update={"rig": stage.rig, "run_id": _FORGED}).to_json()


def _forged_status(stage: Stage) -> bytes:
    _, status = example_messages()
    return status.model_copy(update={"rig": stage.rig, "run_id": _FORGED}).to_json()


def _require_none_forged(watcher: Watcher) -> None:
    runs = {seen["run"] for seen in watcher.since(0.0, "track")}
    runs |= {seen["heartbeat"]["run_id"] for seen in watcher.since(0.0, "heartbeat")}
    require(_FORGED not in runs, "a forged message was believed")


def _unharmed(watcher: Watcher, at_s: float, saw: str) -> Seen:
    """What the honest subscriber saw of it."""
    watcher.tracks(time.monotonic())
    return Seen(f"{saw}; the honest subscriber: {changes(watcher, at_s)}", 0.0, lost(watcher, at_s))
