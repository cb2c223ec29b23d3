"""What somebody who is not meant to might try: attempted with the protection, and, as it could work, without."""

import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from ipaddress import ip_address
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID
from tests.publish.network import WAIT_S, eventually, free_port, raw_session
from typer.testing import CliRunner

from needletrack.authority import init_security
from needletrack.cli import app
from needletrack.client import Freshness, Outcome, RedetectReply, RedetectRequest, Subscriber, control
from needletrack.errors import PublishError
from needletrack.publish.access import Role
from needletrack.publish.clock import ClockMessage
from needletrack.publish.control import ControlDesk, ControlRequest
from needletrack.publish.keys import RigKeys
from needletrack.publish.message import StatusMessage
from needletrack.publish.overlay import OverlayPublisher
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.session import open_session
from needletrack.publish.tls import TlsFiles
from needletrack.router import serve

KEYS = RigKeys("lab")
TRACK, STATUS = example_messages()
# What has not come by then, while others' came within milliseconds, does not come.
NEVER_S = 0.4


def files(folder: Path) -> TlsFiles:
    return TlsFiles(folder / "authority.pem", folder / "certificate.pem", folder / "key.pem")


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A test authority with the rigs lab and other."""
    folder = tmp_path_factory.mktemp("pki")
    for rig in ("lab", "other"):
        init_security(folder, rig)
    return folder


@dataclass(frozen=True)
class Scene:
    """A daemon, and where others meet it: itself, or a router; what it was commanded."""

    publisher: ZenohPublisher
    endpoint: str
    tls: TlsFiles | None
    done: list[ControlRequest]


@contextmanager
def scene(pki: Path | None, *, routed: bool) -> Iterator[Scene]:
    """pki: None leaves everything open, as on a bench."""
    protocol = "tcp" if pki is None else "tls"
    endpoint = f"{protocol}/127.0.0.1:{free_port()}"
    with ExitStack() as opened:
        if routed and pki is not None:
            stop, ready = threading.Event(), threading.Event()
            path = pki / "router" / f"router-{free_port()}.json5"
            path.write_text(re.sub(r"tls/127.0.0.1:\d+", endpoint, (path.parent / "router.json5").read_text("utf-8")))
            thread = threading.Thread(target=serve, args=(path, stop, lambda _: ready.set()))
            thread.start()
            opened.callback(thread.join)
            opened.callback(stop.set)
            assert ready.wait(WAIT_S)
        elif routed:
            opened.enter_context(raw_session("router", listen=[endpoint]))
        tls = None if pki is None else files(pki / "lab" / "publisher")
        done: list[ControlRequest] = []

        def redetect(request: RedetectRequest) -> dict[str, object]:
            done.append(request)
            return {"after_sequence": len(done)}

        desk = opened.enter_context(ControlDesk(example_run(), KEYS, {"re-detect": redetect}, lambda request: None))
        ends: dict[str, list[str]] = {"listen": [], "connect": [endpoint]} if routed else {"listen": [endpoint]}
        publisher = opened.enter_context(
            ZenohPublisher(
                example_run(),
                lambda: STATUS,
                tls=tls,
                heartbeat_s=0.05,
                control=desk.receive,
                **ends,  # type: ignore[arg-type]
            )
        )
        yield Scene(publisher, endpoint, None if pki is None else files(pki / "lab" / "controller"), done)


def intruder(scene: Scene, pki: Path | None, identity: str = "lab/controller") -> zenoh.Session:
    """A session with a certificate of the right authority, and no rules of its own."""
    of = {} if pki is None else {"authority": pki / "authority" / "authority.pem", "identity": pki / identity}
    return raw_session("client", connect=[scene.endpoint], **of)  # type: ignore[arg-type]


EVERY_SCENE = pytest.mark.parametrize("routed", [False, True], ids=["at-the-daemon", "through-a-router"])
BOTH_WAYS = pytest.mark.parametrize("protected", [True, False], ids=["protected", "open"])


@EVERY_SCENE
@BOTH_WAYS
def test_forged_tracks_and_status_reach_nobody(pki: Path, routed: bool, protected: bool) -> None:
    shown = pki if protected else None
    forged = TRACK.model_copy(update={"sequence": 666})
    forged_status = STATUS.model_copy(update={"counters": {"forged": 1}})
    with (
        scene(shown, routed=routed) as at,
        Subscriber("lab", [at.endpoint], mode="client", tls=at.tls) as victim,
        intruder(at, shown) as session,
    ):
        victim.wait_for_daemon(WAIT_S)
        assert at.publisher.wait_for_subscriber(WAIT_S)
        sequences: set[int] = set()
        counters: list[dict[str, int]] = []

        def tried() -> bool:
            session.put(KEYS.track, forged.to_json())
            session.put(KEYS.status, forged_status.to_json())
            at.publisher.publish(TRACK)
            while (received := victim.next(0.02)) is not None:
                sequences.add(received.message.sequence)
            counters.append({} if victim.status is None else dict(victim.status.counters))
            return 666 in sequences and {"forged": 1} in counters

        assert eventually(tried, NEVER_S if protected else WAIT_S) is not protected
    assert TRACK.sequence in sequences
    assert (666 in sequences) is not protected
    assert ({"forged": 1} in counters) is not protected


@EVERY_SCENE
@BOTH_WAYS
@pytest.mark.parametrize("key", [KEYS.status, KEYS.clock], ids=["status", "clock"])
def test_nobody_else_answers_in_our_place(pki: Path, routed: bool, protected: bool, key: str) -> None:
    shown = pki if protected else None
    forged_status = STATUS.model_copy(update={"counters": {"forged": 1}}).to_json()
    forged = forged_status if key == KEYS.status else ClockMessage.now(666, 666).to_json()

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, forged)

    with scene(shown, routed=routed) as at, intruder(at, shown) as session, intruder(at, shown) as victim:
        session.declare_queryable(key, answer, complete=True)
        answers: list[bytes] = []

        def asked() -> bool:
            replies = victim.get(key, target=zenoh.QueryTarget.ALL, timeout=2.0)
            answers.extend(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)
            return forged in answers

        assert eventually(asked, NEVER_S if protected else WAIT_S) is not protected
        if protected:
            assert any(one != forged for one in answers)


@EVERY_SCENE
@BOTH_WAYS
def test_nobody_else_claims_that_the_daemon_lives(pki: Path, routed: bool, protected: bool) -> None:
    shown = pki if protected else None
    with (
        scene(shown, routed=routed) as at,
        intruder(at, shown) as session,
        Subscriber("lab", [at.endpoint], mode="client", tls=at.tls) as victim,
    ):
        token: zenoh.LivelinessToken = session.liveliness().declare_token(KEYS.alive)
        victim.wait_for_daemon(WAIT_S)
        at.publisher.close()
        # Through a router a false token keeps the daemon alive in the subscriber's eyes.
        assert victim.wait_until_gone(2.0) is (protected or not routed)
        del token


@EVERY_SCENE
def test_the_operator_commands_and_nobody_else(pki: Path, tmp_path: Path, routed: bool) -> None:
    init_security(tmp_path, "lab")

    with scene(pki, routed=routed) as at:

        def ask(folder: Path, timeout_s: float) -> RedetectReply:
            request = RedetectRequest()
            reply = control(
                "lab",
                request,
                [at.endpoint],
                mode="client" if routed else "peer",
                tls=files(folder),
                timeout_s=timeout_s,
            )
            assert isinstance(reply, RedetectReply)
            return reply

        assert ask(pki / "lab" / "operator", WAIT_S).outcome is Outcome.DONE
        for folder, told in (
            (pki / "lab" / "controller", "is 'lab.controller', and 'lab.operator' alone may command it"),
            (pki / "other" / "operator", "is 'other.operator', and 'lab.operator' alone may command it"),
            # Of an authority that says the same names.
            (tmp_path / "lab" / "operator", "is not of the authority in"),
        ):
            with pytest.raises(PublishError, match=re.escape(told)):
                ask(folder, 1.0)
        with pytest.raises(PublishError, match="TLS needs an authority"):
            control("lab", RedetectRequest(), [at.endpoint], timeout_s=1.0)
        assert len(at.done) == 1
        assert ask(pki / "lab" / "operator", WAIT_S).after_sequence == 2


@EVERY_SCENE
@BOTH_WAYS
def test_who_keeps_no_rules_commands_nothing_either(pki: Path, routed: bool, protected: bool) -> None:
    """The daemon and the router refuse: the asker's own rules are not what is relied on."""
    shown = pki if protected else None
    with scene(shown, routed=routed) as at, ExitStack() as opened:
        operator = opened.enter_context(intruder(at, shown, "lab/operator"))
        others = [opened.enter_context(intruder(at, shown, who)) for who in ("lab/controller", "other/operator")]

        def answers(session: zenoh.Session, key: str) -> list[str]:
            replies = session.get(
                key, payload=RedetectRequest().to_json(), target=zenoh.QueryTarget.ALL, timeout=NEVER_S
            )
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

        assert eventually(lambda: answers(operator, KEYS.control("re-detect")))
        done = len(at.done)
        if not protected:
            for session in others:
                assert eventually(partial(answers, session, KEYS.control("re-detect")))
            assert len(at.done) > done
            return
        for session in others:
            for key in (KEYS.control("re-detect"), KEYS.control("*"), f"{KEYS.root}/**"):
                assert KEYS.control("re-detect") not in answers(session, key)
        assert len(at.done) == done


@EVERY_SCENE
@BOTH_WAYS
@pytest.mark.parametrize("role", [Role.CONTROLLER, Role.OPERATOR])
def test_clocks_are_compared_over_every_link(pki: Path, routed: bool, protected: bool, role: Role) -> None:
    with scene(pki if protected else None, routed=routed) as at:
        tls = files(pki / "lab" / role.value) if protected else None
        with Subscriber("lab", [at.endpoint], mode="client" if routed else "peer", tls=tls) as subscriber:
            assert eventually(lambda: subscriber.clock is not None)
            found = subscriber.clock
    assert found is not None
    # It is one clock.
    assert abs(found.ours_minus_daemons_ms) <= found.uncertainty_ms


@EVERY_SCENE
@pytest.mark.parametrize("identity", ["other/controller", "other/publisher", None])
def test_who_is_not_of_the_rig_reads_nothing(pki: Path, routed: bool, identity: str | None) -> None:
    authority = pki / "authority" / "authority.pem"
    with scene(pki, routed=routed) as at, intruder(at, pki) as allowed:
        theirs: list[zenoh.Sample] = []
        ours: list[zenoh.Sample] = []
        session = raw_session(
            "peer", connect=[at.endpoint], authority=authority, identity=None if identity is None else pki / identity
        )
        with session:
            for key in ("**", KEYS.track, KEYS.status):
                session.declare_subscriber(key, theirs.append)
            allowed.declare_subscriber(KEYS.status, ours.append)
            assert eventually(lambda: len(ours) >= 5)
            time.sleep(NEVER_S)
            assert theirs == []
            for key in (KEYS.status, KEYS.clock):
                assert [reply for reply in session.get(key, timeout=0.5) if reply.ok is not None] == []
            assert [reply for reply in session.liveliness().get(KEYS.alive, timeout=0.5) if reply.ok is not None] == []


def test_plain_tcp_gets_nothing_of_a_protected_daemon(pki: Path) -> None:
    with scene(pki, routed=False) as at, pytest.raises(zenoh.ZError):
        raw_session("client", connect=[at.endpoint.replace("tls/", "tcp/")])


def test_a_rig_does_not_publish_on_anothers_keys(pki: Path) -> None:
    with scene(pki, routed=True) as at, intruder(at, pki) as reader, intruder(at, pki, "other/publisher") as other:
        payloads: list[str] = []
        reader.declare_subscriber(KEYS.status, lambda sample: payloads.append(sample.payload.to_string()))
        assert eventually(lambda: payloads)
        until_s = time.monotonic() + NEVER_S
        while time.monotonic() < until_s:
            other.put(KEYS.status, "forged")
            time.sleep(0.02)
        assert "forged" not in payloads
        # It may use its own.
        own: list[str] = []
        with intruder(at, pki, "other/controller") as of_other:
            of_other.declare_subscriber(
                "needletrack/other/track", lambda sample: own.append(sample.payload.to_string())
            )

            def arrived() -> bool:
                other.put("needletrack/other/track", "own")
                return bool(own)

            assert eventually(arrived)


def test_pictures_go_to_who_may_read(pki: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    publisher = OverlayPublisher(KEYS, listen=[endpoint], tls=files(pki / "lab" / "publisher"))
    with publisher, open_session(connect=[endpoint], tls=files(pki / "lab" / "controller"), rigs=[KEYS]) as session:
        pictures: list[zenoh.Sample] = []
        session.declare_subscriber(KEYS.overlay, pictures.append)
        assert eventually(lambda: publisher.has_subscriber)
        publisher.publish(b"jpeg", TRACK)
        assert eventually(lambda: pictures)
    assert pictures[0].payload.to_bytes() == b"jpeg"


class TestErrorsSayWhatToCheck:
    """A certificate that does not fit is no riddle: who waits is told which, and why."""

    @staticmethod
    def why(endpoint: str, tls: TlsFiles, rig: str = "lab") -> str:
        with Subscriber(rig, [endpoint], tls=tls) as subscriber:
            with pytest.raises(PublishError) as caught:
                subscriber.wait_for_daemon(0.5)
            assert subscriber.health.state is Freshness.NEVER_SEEN
        return str(caught.value)

    def test_our_authority_is_not_theirs(self, pki: Path, tmp_path: Path) -> None:
        init_security(tmp_path, "lab")
        with scene(pki, routed=False) as at:
            assert "is not of the authority in" in self.why(at.endpoint, files(tmp_path / "lab" / "controller"))

    def test_they_do_not_know_our_authority(self, pki: Path, tmp_path: Path) -> None:
        init_security(tmp_path, "lab")
        ours = files(tmp_path / "lab" / "controller")
        both = tmp_path / "both.pem"
        both.write_text(ours.authority.read_text() + (pki / "authority" / "authority.pem").read_text())
        with scene(pki, routed=False) as at:
            why = self.why(at.endpoint, replace(ours, authority=both))
        assert f"the other side refused {ours.certificate}" in why
        assert "is it of the authority that the other side trusts" in why

    def test_their_certificate_is_for_another_name(self, tmp_path: Path) -> None:
        init_security(tmp_path, "lab", hosts=["tracker.hospital.example"])
        endpoint = f"tls/127.0.0.1:{free_port()}"
        tls = files(tmp_path / "lab" / "publisher")
        with ZenohPublisher(example_run(), lambda: STATUS, listen=[endpoint], tls=tls):
            why = self.why(endpoint, files(tmp_path / "lab" / "controller"))
        assert "its certificate is not for '127.0.0.1'" in why
        assert "subject alternative names" in why

    def test_ours_expired(self, tmp_path: Path) -> None:
        init_security(tmp_path, "lab", days=1, now=datetime.now(UTC) - timedelta(days=3))
        tls = files(tmp_path / "lab" / "controller")
        with pytest.raises(PublishError, match=r"certificate\.pem expired on .* have it renewed"):
            Subscriber("lab", ["tls/127.0.0.1:1"], tls=tls)
        with pytest.raises(PublishError, match=r"certificate\.pem expired on"):
            ZenohPublisher(
                example_run(), lambda: STATUS, listen=["tls/127.0.0.1:0"], tls=files(tmp_path / "lab" / "publisher")
            )

    def test_a_certificate_from_the_future_is_a_clock_that_is_wrong(self, tmp_path: Path) -> None:
        init_security(tmp_path, "lab", now=datetime.now(UTC) + timedelta(days=3))
        with pytest.raises(PublishError, match=r"is valid from .* is the clock right\?"):
            Subscriber("lab", ["tls/127.0.0.1:1"], tls=files(tmp_path / "lab" / "controller"))

    def test_theirs_expired(self, pki: Path, tmp_path: Path) -> None:
        init_security(tmp_path, "lab", days=1, now=datetime.now(UTC) - timedelta(days=3))
        init_security(tmp_path, "other")
        endpoint = f"tls/127.0.0.1:{free_port()}"
        # Our own daemon refuses to start with it: an expired one stays up where it does not look.
        listening = raw_session(
            "peer",
            listen=[endpoint],
            authority=tmp_path / "authority" / "authority.pem",
            identity=tmp_path / "lab" / "publisher",
        )
        with listening:
            why = self.why(endpoint, files(tmp_path / "other" / "controller"), "other")
        assert "its certificate is out of date" in why

    def test_they_refuse_an_expired_one_of_ours(self, pki: Path, tmp_path: Path) -> None:
        """Also where our side does not look first."""
        init_security(tmp_path, "lab", days=1, now=datetime.now(UTC) - timedelta(days=3))
        init_security(tmp_path, "other")
        endpoint = f"tls/127.0.0.1:{free_port()}"
        publisher = files(tmp_path / "other" / "publisher")
        old = tmp_path / "lab" / "controller"
        with ZenohPublisher(replace(example_run(), rig="other"), lambda: STATUS, listen=[endpoint], tls=publisher):
            with pytest.raises(zenoh.ZError):
                raw_session("client", connect=[endpoint], authority=old / "authority.pem", identity=old)
            assert "the other side refused" in files(old).why_refused(endpoint)

    def test_a_certificate_without_the_right(self, pki: Path) -> None:
        with scene(pki, routed=False) as at:
            why = self.why(at.endpoint, files(pki / "other" / "controller"))
        assert "is 'other.controller', and rig 'lab' tells 'lab.controller' and 'lab.operator' alone" in why

    def test_no_tls_there(self, pki: Path) -> None:
        with socket.socket() as plain:
            plain.bind(("127.0.0.1", 0))
            plain.listen()

            def answer() -> None:
                link, _ = plain.accept()
                with link:
                    link.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

            thread = threading.Thread(target=answer)
            thread.start()
            endpoint = f"tls/127.0.0.1:{plain.getsockname()[1]}"
            said = files(pki / "lab" / "controller").why_refused(endpoint)
            thread.join()
        assert "no TLS is spoken there" in said

    def test_nobody_there(self, pki: Path) -> None:
        endpoint = f"tls/127.0.0.1:{free_port()}"
        assert "nothing answers on 127.0.0.1" in self.why(endpoint, files(pki / "lab" / "controller"))

    def test_tls_endpoints_need_files_and_files_tls_endpoints(self, pki: Path) -> None:
        with pytest.raises(PublishError, match="TLS needs an authority, a certificate and its key"):
            open_session(listen=["tls/127.0.0.1:0"])
        with pytest.raises(PublishError, match="is open to everybody, while TLS is configured"):
            open_session(listen=["tcp/127.0.0.1:0"], tls=files(pki / "lab" / "publisher"), rigs=[KEYS])


def test_a_link_ends_when_its_certificate_does(tmp_path: Path) -> None:
    valid_s = 3.0
    init_security(tmp_path, "other")
    init_security(tmp_path, "lab", days=1, now=datetime.now(UTC) - timedelta(days=1) + timedelta(seconds=valid_s))
    init_security(tmp_path, "lab-long")
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with (
        ZenohPublisher(example_run(), lambda: STATUS, listen=[endpoint], tls=files(tmp_path / "lab" / "publisher")),
        Subscriber("lab", [endpoint], tls=files(tmp_path / "lab" / "controller")) as subscriber,
    ):
        subscriber.wait_for_daemon(WAIT_S)
        assert subscriber.wait_until_gone(valid_s + WAIT_S)


class TestFiles:
    """The files of a link, before anything is opened."""

    @pytest.fixture
    def tls(self, tmp_path: Path) -> TlsFiles:
        init_security(tmp_path, "lab")
        return files(tmp_path / "lab" / "controller")

    def test_what_was_issued_is_usable(self, tls: TlsFiles) -> None:
        assert tls.check().not_valid_after_utc > datetime.now(UTC) + timedelta(days=89)

    @pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o601, 0o644])
    def test_a_key_that_others_may_use_is_refused_with_the_remedy(self, tls: TlsFiles, mode: int) -> None:
        tls.key.chmod(mode)
        with pytest.raises(PublishError, match=re.escape(f"(mode {mode:04o})") + f".*chmod 600 {tls.key}"):
            tls.check()
        with pytest.raises(PublishError, match="chmod 600"):
            open_session(connect=["tls/127.0.0.1:1"], tls=tls, rigs=[KEYS])

    def test_a_router_looks_at_its_key_too(self, tmp_path: Path) -> None:
        init_security(tmp_path, "lab")
        (tmp_path / "router" / "key.pem").chmod(0o644)
        with pytest.raises(PublishError, match="chmod 600"):
            serve(tmp_path / "router" / "router.json5", threading.Event())

    @pytest.mark.parametrize(
        ("broken", "message"),
        [
            (lambda tls: tls.key.unlink(), r"key\.pem: cannot read the private key: No such file"),
            (lambda tls: tls.certificate.unlink(), r"certificate\.pem: cannot read the certificate: No such file"),
            (lambda tls: tls.authority.write_text("no"), r"authority\.pem: no X\.509 certificate in PEM"),
            (lambda tls: tls.key.write_text("-----BEGIN x"), r"key\.pem: no private key in PEM"),
        ],
    )
    def test_a_broken_file_is_named(self, tls: TlsFiles, broken: Callable[[TlsFiles], object], message: str) -> None:
        broken(tls)
        with pytest.raises(PublishError, match=message):
            tls.check()

    def test_the_key_of_another_certificate_is_told(self, tls: TlsFiles) -> None:
        other = tls.key.parents[1] / "operator" / "key.pem"
        with pytest.raises(PublishError, match=r"is not the key of .*certificate\.pem"):
            replace(tls, key=other).check()

    def test_another_authority_is_told(self, tls: TlsFiles, tmp_path: Path) -> None:
        init_security(tmp_path / "second", "lab")
        with pytest.raises(PublishError, match="was not issued by an authority in"):
            replace(tls, authority=tmp_path / "second" / "authority" / "authority.pem").check()


def test_a_pki_with_an_authority_in_between(tmp_path: Path) -> None:
    """As of a hospital's: the root is trusted, the certificate in between stands behind ours."""
    now, days = datetime.now(UTC), timedelta(days=1)
    keys = {
        name: ec.generate_private_key(ec.SECP256R1()) for name in ("root", "between", "lab.publisher", "lab.controller")
    }

    def issued(name: str, by: str) -> str:
        subject, issuer = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, one)]) for one in (name, by))
        begun = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).serial_number(len(name))
        begun = begun.public_key(keys[name].public_key()).not_valid_before(now - days).not_valid_after(now + days)
        begun = begun.add_extension(x509.BasicConstraints(ca="." not in name, path_length=None), critical=True)
        begun = begun.add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))]), critical=False
        )
        return begun.sign(keys[by], hashes.SHA256()).public_bytes(Encoding.PEM).decode()

    between, ends = issued("between", "root"), {}
    (tmp_path / "root.pem").write_text(issued("root", "root"))
    for name in ("lab.publisher", "lab.controller"):
        key, certificate = tmp_path / f"{name}.key", tmp_path / f"{name}.pem"
        key.touch(mode=0o600)
        key.write_bytes(keys[name].private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
        certificate.write_text(issued(name, "between") + between)
        ends[name] = TlsFiles(tmp_path / "root.pem", certificate, key)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with (
        ZenohPublisher(example_run(), lambda: STATUS, listen=[endpoint], tls=ends["lab.publisher"]),
        Subscriber("lab", [endpoint], tls=ends["lab.controller"]) as subscriber,
    ):
        subscriber.wait_for_daemon(WAIT_S)
    alone = tmp_path / "alone.pem"
    alone.write_text(issued("lab.controller", "between"))
    with pytest.raises(PublishError, match="put certificates in between behind ours"):
        replace(ends["lab.controller"], certificate=alone).check()


@pytest.mark.slow
def test_secrets_are_in_no_output(pki: Path, tmp_path: Path) -> None:
    """Neither in errors nor in logs, at the most talkative, of a daemon's and a subscriber's program."""
    role = pki / "lab" / "controller"
    body = [line for line in (role / "key.pem").read_text().splitlines() if not line.startswith("-")]
    config = tmp_path / "watch.toml"
    config.write_text((role / "needletrack.toml").read_text().replace('= "', f'= "{role}/').replace("7447", "1"))
    config.write_text(config.read_text().replace(f'"{role}/needletrack"', '"needletrack"'))
    mixed = tmp_path / "mixed.pem"
    mixed.write_text((role / "key.pem").read_text().replace("BEGIN PRIVATE", "BEGIN EC PRIVATE"))
    mixed.chmod(0o600)
    said = "".join(CliRunner().invoke(app, ["config", "show", str(config)]).output)
    said += CliRunner().invoke(app, ["router", str(role / "key.pem")]).output
    for key in (role / "key.pem", mixed):
        done = subprocess.run(
            [sys.executable, "-m", "needletrack", "watch", "lab", "--config", str(config), "--wait", "0.3"],
            env={**os.environ, "RUST_LOG": "trace", "NEEDLETRACK_SUBSCRIBING__TLS__KEY": str(key)},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        said += done.stdout + done.stderr
    assert "key.pem" in said
    assert "no private key in PEM" in said
    assert not any(line in said for line in body)


def test_status_messages_are_not_checked_for_nothing() -> None:
    """The forged ones above would be believed: they are whole."""
    assert StatusMessage.from_json(STATUS.model_copy(update={"counters": {"forged": 1}}).to_json()).counters
