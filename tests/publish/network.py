"""Endpoints, sessions that know no manners, and waiting: what the tests of the wire share."""

import json
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh

WAIT_S = 10.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(condition: Callable[[], Any], timeout_s: float = WAIT_S) -> bool:
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.01)
    return bool(condition())


def raw_session(
    mode: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    authority: Path | None = None,
    identity: Path | None = None,
    **settings: Any,
) -> zenoh.Session:
    """A session that keeps no rules of its own; identity: folder of a role whose certificate it shows."""
    tls: dict[str, Any] = {"verify_name_on_connect": True}
    if authority is not None:
        tls["root_ca_certificate"] = str(authority)
    if identity is not None:
        tls["enable_mtls"] = True
        for way in ("listen", "connect"):
            tls |= {f"{way}_certificate": f"{identity}/certificate.pem", f"{way}_private_key": f"{identity}/key.pem"}
    values: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "open/return_conditions/connect_scouted": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 1000,
        "transport/link/tls": tls,
        **settings,
    }
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
