import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from itertools import pairwise

import psutil
import pytest
from tests.publish.network import WAIT_S, free_port

from needletrack.client import Subscriber
from needletrack.errors import PublishError
from needletrack.publish.keys import RigKeys
from needletrack.publish.session import checked_endpoint, open_session


def listening() -> set[tuple[str, int]]:
    return {
        (connection.laddr.ip, connection.laddr.port)
        for connection in psutil.Process().net_connections("inet")
        if connection.status == psutil.CONN_LISTEN or connection.type == socket.SOCK_DGRAM
    }


def test_a_session_opens_no_socket_but_those_it_was_told_to() -> None:
    before, port = listening(), free_port()
    with open_session(listen=[f"tcp/127.0.0.1:{port}"]), open_session(connect=[f"tcp/127.0.0.1:{port}"]):
        assert listening() - before == {("127.0.0.1", port)}


def test_a_taken_port_is_named_with_the_remedy() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(PublishError, match=f"{endpoint} is taken: .* choose another port"):
            open_session(listen=[endpoint])


def test_any_other_failure_is_told_in_zenohs_words() -> None:
    with pytest.raises(PublishError, match=r"no Zenoh session with listen \['tcp/host\.invalid:7447'\].*lookup"):
        open_session(listen=["tcp/host.invalid:7447"])


def test_an_address_of_another_machine_is_named() -> None:
    with pytest.raises(PublishError, match=r"tcp/192\.0\.2\.1:7447 is no address of this machine"):
        open_session(listen=["tcp/192.0.2.1:7447"])


def daemons_session(endpoint: str) -> AbstractContextManager[object]:
    return open_session(connect=[endpoint])


def clients_subscriber(endpoint: str) -> AbstractContextManager[object]:
    return Subscriber("lab", [endpoint], mode="client")


@pytest.mark.parametrize("opened", [daemons_session, clients_subscriber])
def test_who_is_not_there_is_tried_again_at_most_a_second_apart(
    opened: Callable[[str], AbstractContextManager[object]],
) -> None:
    """However long a router has been late: Zenoh's default waits twice as long each time, up to 4 s."""
    tried_s = []
    with socket.create_server(("127.0.0.1", 0)) as nobody, ThreadPoolExecutor(1) as pool:
        nobody.settimeout(WAIT_S)

        def refuse() -> None:
            # After six, Zenoh's own waits are over 1 s.
            for _ in range(7):
                link, _ = nobody.accept()
                tried_s.append(time.monotonic())
                link.close()

        refused = pool.submit(refuse)
        with opened(f"tcp/127.0.0.1:{nobody.getsockname()[1]}"):
            refused.result()
    # On a busy machine an attempt itself takes some time.
    assert max(later - earlier for earlier, later in pairwise(tried_s)) < 2.5


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "7447",
        "127.0.0.1:7447",
        "http/127.0.0.1:7447",
        "tcp/127.0.0.1",
        "tcp/:7447",
        "tcp/a:99999",
        "tcp/a:b",
    ],
)
def test_a_malformed_endpoint_is_refused(endpoint: str) -> None:
    for listen, connect in (([endpoint], []), ([], [endpoint])):
        with pytest.raises(PublishError, match="Zenoh endpoint"):
            open_session(listen, connect)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tls/tracker.local:7447",
        "tcp/127.0.0.1:1#iface=lo",
        "unixsock-stream//run/x.sock",
    ],
)
def test_a_well_formed_endpoint_is_taken(endpoint: str) -> None:
    assert checked_endpoint(endpoint) == endpoint


def test_keys_of_a_rig() -> None:
    keys = RigKeys("lab-1", prefix="hospital/theatre2")
    assert keys.track == "hospital/theatre2/lab-1/track"
    assert keys.status == "hospital/theatre2/lab-1/status"
    assert keys.alive == "hospital/theatre2/lab-1/alive"


@pytest.mark.parametrize("prefix", ["", "/a", "a/", "a//b", "a/*", "a/$x"])
def test_a_prefix_that_is_no_key_is_refused(prefix: str) -> None:
    with pytest.raises(PublishError, match="key prefix"):
        RigKeys("lab", prefix)
