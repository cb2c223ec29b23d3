"""Zenoh sessions that meet only whom they were told to meet."""

import atexit
import ipaddress
import json
import logging
import re
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Literal, TypeVar

import zenoh
from zenoh.handlers import Callback

from needletrack.errors import PublishError
from needletrack.publish.access import access_control
from needletrack.publish.keys import RigKeys
from needletrack.publish.tls import TlsFiles

T = TypeVar("T")

_log = logging.getLogger(__name__)

# A hung peer is noticed after three quarters of the lease (0.75 s); Zenoh's own default is 10 s.
LEASE_MS = 1000
RECONNECT_MS = (100, 1000)
# For who takes a connection and says nothing, as a router that hangs: Zenoh's own 10 s held up the next attempt, and a
# client that opens. A link of 0.6 s each way needs 2.4 s, with TLS.
OPEN_WITHIN_MS = 3000
# A picture of 32 million pixels.
MOST_RECEIVED_BYTES = 32_000_000
CLOSE_WITHIN_S = 0.5
_CLOSING = "needletrack-close"

Mode = Literal["peer", "client"]

_PROTOCOLS_WITH_PORT = ("tcp", "tls", "quic", "udp", "ws")
_PROTOCOLS = (*_PROTOCOLS_WITH_PORT, "unixsock-stream", "unixpipe", "vsock", "serial")
_HOST_PORT = re.compile(r"(?:\[[^\]\s]+\]|[^:\s\[\]]+):(\d{1,5})")


def checked_endpoint(endpoint: str) -> str:
    """The endpoint, where it reads `<protocol>/<host>:<port>`; raises PublishError otherwise.

    Zenoh itself retries a malformed endpoint for ever without a word.
    """
    protocol, _, address = endpoint.partition("/")
    if protocol not in _PROTOCOLS:
        raise PublishError(f"Zenoh endpoint {endpoint!r}: write it as tcp/127.0.0.1:7447 (or tls/HOST:PORT)")
    if protocol in _PROTOCOLS_WITH_PORT:
        match = _HOST_PORT.fullmatch(re.split(r"[?#]", address, maxsplit=1)[0])
        if match is None or int(match[1]) > 65535:
            raise PublishError(
                f"Zenoh endpoint {endpoint!r}: host and port are missing or wrong, as in tcp/127.0.0.1:7447"
            )
    return endpoint


class NobodyAnswers(PublishError):
    """A client found nobody to be a client of."""


def open_session(
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    *,
    mode: Mode = "peer",
    tls: TlsFiles | None = None,
    rigs: Sequence[RigKeys] = (),
    send_buffer_bytes: int | None = None,
) -> zenoh.Session:
    """A session that listens on and connects to the given endpoints only: no multicast, no gossip.

    A peer opens at once, whether or not somebody answers at `connect`, and goes on trying. A client raises
    NobodyAnswers where none of `connect` does; once open, it goes on trying as well. tls: the link's files; the far
    end then shows a certificate, and may do with the keys of `rigs` what its role may, and nothing else.
    send_buffer_bytes: what the kernel may hold of each link; None: as it likes, megabytes. Raises PublishError
    where an endpoint is malformed or cannot be listened on, or a file of tls cannot be used.
    """
    if mode == "client" and listen:
        raise PublishError(f"a client listens on nothing: leave out {', '.join(listen)}, or be a peer")
    if tls is not None:
        tls.check()
    for endpoint in (*listen, *connect):
        _check_protection(checked_endpoint(endpoint), tls)
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": {
            "period_init_ms": RECONNECT_MS[0],
            "period_max_ms": RECONNECT_MS[1],
            "period_increase_factor": 2,
        },
        # Opening does not wait for an answer (Zenoh would, for half a second, where none comes).
        "open/return_conditions/connect_scouted": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/unicast/open_timeout": OPEN_WITHIN_MS,
        # Zenoh's default is a gigabyte, which any peer may then make us hold, and a queue of them; a larger message is
        # left out and the link goes on.
        "transport/link/rx/max_message_size": MOST_RECEIVED_BYTES,
        # Measured on 12 kB tracks: nothing gained, 30 us lost; and who is killed leaves its segments behind.
        "transport/shared_memory/enabled": False,
        # A put waits 1 ms at most for a full link (Zenoh's default, on which `publish` relies), but two
        # places (its other default) are full as soon as Zenoh's sender waits for a busy core: on a loaded
        # machine up to 28 of 30 tracks in a row were lost. 16 is the most that Zenoh allows.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 1000,
        "transport/link/tx/queue/size/real_time": 16,
    }
    if send_buffer_bytes is not None:
        settings["transport/link/tcp/so_sndbuf"] = send_buffer_bytes
    if tls is not None:
        settings["transport/link/protocols"] = ["tls"]
        settings["transport/link/tls"] = {**tls.zenoh_settings(), "so_sndbuf": send_buffer_bytes}
        settings["access_control"] = access_control(rigs)
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if mode == "client" and "Unable to connect" in str(error):
            raise NobodyAnswers(f"nobody answers at {' or '.join(connect)}") from error
        raise PublishError(_why_not_open(str(error), listen, connect)) from error


def open_endpoints(listen: Sequence[str]) -> list[str]:
    """Those of the endpoints which others than this machine reach, without having to show a certificate."""
    return [endpoint for endpoint in listen if not endpoint.startswith("tls/") and not _is_local(endpoint)]


def _is_local(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    if protocol not in _PROTOCOLS_WITH_PORT:
        return protocol not in ("vsock", "serial")
    host = re.split(r"[?#]", address, maxsplit=1)[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_protection(endpoint: str, tls: TlsFiles | None) -> None:
    protected = endpoint.startswith("tls/")
    if tls is None and protected:
        raise PublishError(
            f"{endpoint}: TLS needs an authority, a certificate and its key: set authority, certificate and key of the "
            "configuration's tls table (`needletrack security init` makes them for a test)"
        )
    if tls is not None and not protected:
        raise PublishError(f"{endpoint} is open to everybody, while TLS is configured: write it as tls/HOST:PORT")


def close_soon(opened: ExitStack) -> None:
    """Close what was opened with a session, and wait for it 0.5 s at most; the rest goes on in a thread.

    For a subscriber that was stopped (SIGSTOP, a debugger) Zenoh waits as long as that one's lease is, 10 s by
    default, and raises then; cutting the link shortens nothing (zenoh 1.10). The end of the process waits for the
    thread, unless `os._exit` ends it.
    """

    def close() -> None:
        try:
            opened.close()
        except zenoh.ZError as error:
            _log.warning("the Zenoh session was not closed properly: %s", _cause(error))

    closing = threading.Thread(target=close, name=_CLOSING, daemon=True)
    try:
        closing.start()
    except RuntimeError:  # the interpreter is about to end, and starts no thread any more
        close()
        return
    closing.join(CLOSE_WITHIN_S)
    if closing.is_alive():
        _log.warning("a subscriber takes no farewell: it is not waited for any more")
        # A thread inside Zenoh while the interpreter ends would abort the process.
        atexit.register(closing.join)


def is_still_closing() -> bool:
    """Whether `close_soon` left something behind that the end of the process would wait for."""
    return any(thread.name == _CLOSING for thread in threading.enumerate())


def _cause(error: object) -> str:
    """Zenoh's own words, without the place in its source."""
    return str(error).split(" at /", maxsplit=1)[0]


def direct(callback: Callable[[T], None]) -> "Callback[T]":
    """The callback, run in Zenoh's own thread: for a few lines that never wait.

    Zenoh's default hands it to a Python thread behind an unbounded queue, and as that is no daemon
    thread, a program that ends without closing its session would hang (zenoh-python #434).
    """
    return Callback(callback, indirect=False)


def _why_not_open(error: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    cause = _cause(error)
    if "Address already in use" in error:
        taken = [endpoint for endpoint in listen if endpoint in error] or list(listen)
        return (
            f"{' or '.join(taken)} is taken: another needletrack daemon or program listens there; "
            "stop it, or choose another port (publishing.listen in the configuration, or --publish)"
        )
    if "Cannot assign requested address" in error:
        return f"{' or '.join(listen)} is no address of this machine: see `ip address` ({cause})"
    return f"no Zenoh session with listen {list(listen)} and connect {list(connect)}: {cause}"
