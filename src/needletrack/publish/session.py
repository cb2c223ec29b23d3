"""Zenoh sessions that meet only whom they were told to meet."""

import json
import re
from collections.abc import Callable, Sequence
from typing import TypeVar

import zenoh
from zenoh.handlers import Callback

from needletrack.errors import PublishError

T = TypeVar("T")

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

# A hung peer is noticed after three quarters of the lease (0.75 s); Zenoh's own default is 10 s.
LEASE_MS = 1000
RECONNECT_MS = (100, 1000)
# A picture of 32 million pixels.
MOST_RECEIVED_BYTES = 32_000_000

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


def open_session(listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Session:
    """A peer that listens on and connects to the given endpoints only: no multicast, no gossip.

    It opens at once, whether or not somebody answers at `connect`, and goes on trying. Raises
    PublishError where an endpoint is malformed or cannot be listened on.
    """
    settings = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [checked_endpoint(endpoint) for endpoint in listen],
        "connect/endpoints": [checked_endpoint(endpoint) for endpoint in connect],
        "connect/retry": {
            "period_init_ms": RECONNECT_MS[0],
            "period_max_ms": RECONNECT_MS[1],
            "period_increase_factor": 2,
        },
        # Opening does not wait for an answer (Zenoh would, for half a second, where none comes).
        "open/return_conditions/connect_scouted": False,
        "transport/link/tx/lease": LEASE_MS,
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
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise PublishError(_why_not_open(str(error), listen, connect)) from error


def direct(callback: Callable[[T], None]) -> "Callback[T]":
    """The callback, run in Zenoh's own thread: for a few lines that never wait.

    Zenoh's default hands it to a Python thread behind an unbounded queue, and as that is no daemon
    thread, a program that ends without closing its session would hang (zenoh-python #434).
    """
    return Callback(callback, indirect=False)


def _why_not_open(error: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    cause = error.split(" at /", maxsplit=1)[0]
    if "Address already in use" in error:
        taken = [endpoint for endpoint in listen if endpoint in error] or list(listen)
        return (
            f"{' or '.join(taken)} is taken: another needletrack daemon or program listens there; "
            "stop it, or choose another port (publishing.listen in the configuration, or --publish)"
        )
    if "Cannot assign requested address" in error:
        return f"{' or '.join(listen)} is no address of this machine: see `ip address` ({cause})"
    return f"no Zenoh session with listen {list(listen)} and connect {list(connect)}: {cause}"
