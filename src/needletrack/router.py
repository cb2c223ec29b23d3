"""`needletrack router`: a Zenoh router from its own configuration file, where no zenohd is at hand."""

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from needletrack.errors import PublishError
from needletrack.publish.tls import TlsFiles

_TLS = "transport/link/tls"
_TLS_PATHS = (
    "root_ca_certificate",
    "listen_certificate",
    "listen_private_key",
    "connect_certificate",
    "connect_private_key",
)


def serve(path: Path, stop: threading.Event, ready: Callable[[list[str]], None] = lambda endpoints: None) -> None:
    """Route until `stop` is set; ready is called with the endpoints. Paths of the file are relative to it.

    Raises PublishError where the file is none of a router, a key in it may be read by others, or an endpoint is taken.
    """
    config = _read(path)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise PublishError(f"{path}: no router: {str(error).split(' at /', maxsplit=1)[0]}") from error
    with session:
        ready(json.loads(config.get_json("listen/endpoints")))
        stop.wait()


def _read(path: Path) -> zenoh.Config:
    try:
        path.stat()  # Zenoh's own message does not tell a missing file from a wrong one.
        config = zenoh.Config.from_file(path)
    except OSError as error:
        raise PublishError(f"{path}: cannot read: {error.strerror or error}") from error
    except zenoh.ZError as error:
        raise PublishError(f"{path}: no Zenoh configuration: {str(error).split(' at /', maxsplit=1)[0]}") from error
    if json.loads(config.get_json("mode")) != "router":
        raise PublishError(f'{path}: not of a router: mode must be "router"')
    tls: dict[str, Any] = json.loads(config.get_json(_TLS))
    for name in _TLS_PATHS:
        if tls.get(name):
            tls[name] = str(path.resolve().parent / tls[name])
    config.insert_json5(_TLS, json.dumps(tls))
    if tls.get("listen_private_key"):
        files = (tls["root_ca_certificate"], tls["listen_certificate"], tls["listen_private_key"])
        TlsFiles(*map(Path, files)).check()
    return config
