"""Daemon, subscribers and routers as the files in config/ put them together, and what happens when a part fails.

What is lost is counted, and what resumes resumes by itself.
"""

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest
from tests.publish.network import WAIT_S, eventually, free_port, raw_session
from tests.publish.relay import Relay

from needletrack.client import (
    Freshness,
    Outcome,
    Received,
    RedetectRequest,
    Subscriber,
    control,
    control_configured,
)
from needletrack.config import Config, load_config
from needletrack.errors import PublishError
from needletrack.publish.control import ControlDesk
from needletrack.publish.keys import DEFAULT_ENDPOINT, RigKeys
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run
from needletrack.publish.session import open_endpoints, open_session
from needletrack.router import serve

CONFIG = Path(__file__).parents[2] / "config"
TRACK, STATUS = example_messages()
PERIOD_S = 0.02


def local(name: str, folder: Path, ports: dict[int, int]) -> Path:
    """A file of config/ with every address made local and every port a free one."""
    text = (CONFIG / name).read_text(encoding="utf-8")
    text = re.sub(r"tcp/[\d.]+:(\d+)", lambda found: f"tcp/127.0.0.1:{ports[int(found[1])]}", text)
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def publisher_of(config: Config, rig: str = "lab", desk: ControlDesk | None = None) -> ZenohPublisher:
    settings = config.publishing
    return ZenohPublisher(
        replace(example_run(), rig=rig),
        lambda: STATUS.model_copy(update={"rig": rig}),
        listen=settings.listen,
        connect=settings.connect,
        heartbeat_s=0.1,
        control=None if desk is None else desk.receive,
    )


class Publishing:
    """Numbered tracks at a steady rate, as of a daemon."""

    def __init__(self, publisher: ZenohPublisher, rig: str = "lab") -> None:
        self._publisher, self._rig = publisher, rig
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.published = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            update = {"sequence": self.published, "rig": self._rig, "published_at_ns": time.time_ns()}
            self._publisher.publish(TRACK.model_copy(update=update))
            self.published += 1


class Receiving:
    """Every track that a subscriber gets, kept."""

    def __init__(self, subscriber: Subscriber) -> None:
        self.subscriber = subscriber
        self.received: list[Received] = []

    def more(self) -> bool:
        """Whether another one comes within the time."""
        received = self.subscriber.next(WAIT_S)
        if received is not None:
            self.received.append(received)
        return received is not None

    def drain(self) -> None:
        while (received := self.subscriber.next(0)) is not None:
            self.received.append(received)

    def loses_sight(self) -> float:
        """Seconds until the newest track is no longer called fresh, and the daemon is gone."""
        began_s = time.monotonic()
        assert eventually(lambda: self.subscriber.health.state is not Freshness.FRESH)
        assert self.subscriber.wait_until_gone(WAIT_S)
        self.drain()
        return time.monotonic() - began_s

    def accounted_for(self) -> bool:
        """Whether every number from the first to the last was received or counted as lost."""
        sequences = [one.message.sequence for one in self.received]
        lost = sum(one.missed.lost for one in self.received)
        return sequences == sorted(set(sequences)) and len(sequences) + lost == sequences[-1] - sequences[0] + 1

    @property
    def lost(self) -> int:
        return sum(one.missed.lost for one in self.received)


@contextmanager
def router_process(path: Path) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "needletrack", "router", str(path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert process.stderr.readline().startswith("routing on tcp/127.0.0.1:")
            yield process
        finally:
            process.kill()


@contextmanager
def router_here(path: Path) -> Iterator[None]:
    stop, ready = threading.Event(), threading.Event()
    thread = threading.Thread(target=serve, args=(path, stop, lambda _: ready.set()))
    thread.start()
    try:
        assert ready.wait(WAIT_S)
        yield
    finally:
        stop.set()
        thread.join()


def test_by_default_nobody_but_this_machine_is_met() -> None:
    config = Config()
    listened_on = (*config.publishing.listen, *config.publishing.overlay.listen)
    assert open_endpoints(listened_on) == []
    assert all(endpoint.startswith("tcp/127.0.0.1:") for endpoint in listened_on)
    assert config.publishing.connect == ()
    assert config.publishing.listen == config.subscribing.connect == (DEFAULT_ENDPOINT,)
    assert config.publishing.overlay.rate_hz == 0
    assert not set(config.publishing.listen) & set(config.publishing.overlay.listen)


@pytest.mark.parametrize(
    ("endpoint", "is_open"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/[::1]:7447", False),
        ("tcp/localhost:7447", False),
        ("tls/0.0.0.0:7447", False),
        ("unixsock-stream//run/needletrack.sock", False),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447#iface=eth0", True),
        ("tcp/192.168.1.4:7447", True),
        ("tcp/tracker.local:7447", True),
        ("quic/192.168.1.4:7447", True),
    ],
)
def test_endpoints_that_are_open_to_others_are_known(endpoint: str, is_open: bool) -> None:
    assert open_endpoints([endpoint]) == ([endpoint] if is_open else [])


def test_peers_with_explicit_endpoints(tmp_path: Path) -> None:
    config = load_config(local("peers.toml", tmp_path, {7447: free_port()}))
    with (
        Subscriber.configured("lab", config.subscribing, max_age_s=WAIT_S) as subscriber,
        publisher_of(config) as publisher,
        Publishing(publisher),
    ):
        subscriber.wait_for_daemon(WAIT_S)
        assert subscriber.next(WAIT_S) is not None


def test_a_client_of_a_router_and_a_router_that_is_late(tmp_path: Path) -> None:
    port = free_port()
    config = load_config(local("routed.toml", tmp_path, {7447: port}))
    assert config.subscribing.mode == "client"
    with (
        Subscriber.configured("lab", config.subscribing, max_age_s=WAIT_S) as subscriber,
        publisher_of(config) as publisher,
        Publishing(publisher) as publishing,
    ):
        with pytest.raises(PublishError, match=f"nobody answers at tcp/127.0.0.1:{port} within"):
            subscriber.wait_for_daemon(0.3)
        assert subscriber.health.state is Freshness.NEVER_SEEN
        assert publishing.published > 0
        with router_here(local("router.json5", tmp_path, {7447: port})):
            subscriber.wait_for_daemon(WAIT_S)
            assert subscriber.next(WAIT_S) is not None
            assert eventually(lambda: subscriber.status is not None)


def test_a_client_that_is_closed_before_its_router_came_waits_for_nothing(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Subscriber("lab", [endpoint], mode="client") as subscriber:
        assert subscriber.latest() is None
    assert subscriber.next() is None


def test_a_peer_at_a_router_is_told_to_be_a_client(tmp_path: Path) -> None:
    port = free_port()
    with (
        router_here(local("router.json5", tmp_path, {7447: port})),
        Subscriber("lab", [f"tcp/127.0.0.1:{port}"]) as subscriber,
        pytest.raises(PublishError, match="routers pass nothing on between two peers: be a client"),
    ):
        subscriber.wait_for_daemon(0.5)


def test_a_command_waits_for_a_late_router_and_is_done_once(tmp_path: Path) -> None:
    port, done = free_port(), threading.Event()
    config = load_config(local("routed.toml", tmp_path, {7447: port}))

    def redetect(request: RedetectRequest) -> dict[str, object]:
        assert not done.is_set()
        done.set()
        return {"after_sequence": 7}

    desk = ControlDesk(example_run(), RigKeys("lab"), {"re-detect": redetect}, lambda request: None)
    with publisher_of(config, desk=desk), desk, ThreadPoolExecutor(1) as pool:
        with pytest.raises(PublishError, match=f"nobody answers at tcp/127.0.0.1:{port} within 0.2 s"):
            control_configured("lab", RedetectRequest(), config.subscribing, timeout_s=0.2)
        asking = pool.submit(control_configured, "lab", RedetectRequest(), config.subscribing, timeout_s=WAIT_S)
        assert not asking.done()
        with router_here(local("router.json5", tmp_path, {7447: port})):
            assert asking.result(WAIT_S).outcome is Outcome.DONE
            with pytest.raises(PublishError, match="routers pass nothing on between two peers: be a client"):
                control("lab", RedetectRequest(), config.subscribing.connect, timeout_s=0.3)


def test_a_client_listens_on_nothing() -> None:
    with pytest.raises(PublishError, match="a client listens on nothing"):
        open_session(["tcp/127.0.0.1:0"], mode="client")


def test_several_rigs_through_routers(tmp_path: Path) -> None:
    ends = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
    rigs = {"left-bench": ends[0], "right-bench": ends[1]}
    with ExitStack() as opened:
        opened.enter_context(raw_session("router", listen=[ends[0]]))
        opened.enter_context(raw_session("router", listen=[ends[1]], connect=[ends[0]]))
        for rig, end in rigs.items():
            config = Config.model_validate({"publishing": {"listen": [], "connect": [end]}})
            publisher = opened.enter_context(publisher_of(config, rig))
            opened.enter_context(Publishing(publisher, rig))
        for rig in rigs:
            for end in ends:
                subscriber = opened.enter_context(Subscriber(rig, [end], mode="client", max_age_s=WAIT_S))
                subscriber.wait_for_daemon(WAIT_S)
                received = [subscriber.next(WAIT_S) for _ in range(3)]
                assert [None if one is None else one.message.rig for one in received] == [rig] * 3
                assert subscriber.undecodable == 0


@contextmanager
def routed(tmp_path: Path) -> Iterator[tuple[Path, Receiving]]:
    port = free_port()
    path = local("router.json5", tmp_path, {7447: port})
    config = load_config(local("routed.toml", tmp_path, {7447: port}))
    with (
        publisher_of(config) as publisher,
        Publishing(publisher),
        Subscriber.configured("lab", config.subscribing, capacity=4096, max_age_s=WAIT_S) as subscriber,
    ):
        yield path, Receiving(subscriber)


@pytest.mark.slow
def test_a_router_that_was_killed_and_came_back(tmp_path: Path) -> None:
    with routed(tmp_path) as (path, receiving):
        with router_process(path) as router:
            assert all(receiving.more() for _ in range(20))
            router.send_signal(signal.SIGKILL)
            receiving.loses_sight()
        with router_here(path):
            assert all(receiving.more() for _ in range(20))
        assert receiving.lost > 0
        assert receiving.accounted_for()


@pytest.mark.slow
def test_a_router_that_hung_and_went_on(tmp_path: Path) -> None:
    with routed(tmp_path) as (path, receiving), router_process(path) as router:
        assert all(receiving.more() for _ in range(20))
        router.send_signal(signal.SIGSTOP)
        # The lease is 1 s. Only a link that never notices takes ten of them.
        assert receiving.loses_sight() < WAIT_S
        router.send_signal(signal.SIGCONT)
        # What the router held when it stopped may come first; then it must go on.
        assert all(receiving.more() for _ in range(20))
        assert eventually(lambda: receiving.more() and receiving.lost > 0)
        receiving.drain()
        assert receiving.accounted_for()


@contextmanager
def over_a_link() -> Iterator[tuple[Relay, Receiving, Publishing]]:
    """A daemon, and a subscriber at the other end of a relay."""
    port = free_port()
    config = Config.model_validate({"publishing": {"listen": [f"tcp/127.0.0.1:{port}"]}})
    with (
        publisher_of(config) as publisher,
        Publishing(publisher) as publishing,
        Relay(port) as link,
        Subscriber("lab", [f"tcp/127.0.0.1:{link.port}"], capacity=4096, max_age_s=WAIT_S) as subscriber,
    ):
        subscriber.wait_for_daemon(WAIT_S)
        yield link, Receiving(subscriber), publishing


def test_a_link_that_is_cut_and_heals() -> None:
    with over_a_link() as (link, receiving, publishing):
        assert all(receiving.more() for _ in range(20))
        for _ in range(2):
            link.cut()
            receiving.loses_sight()
            before, published = receiving.lost, publishing.published
            assert eventually(lambda least=published + 10: publishing.published > least)  # type: ignore[misc]
            link.heal()
            assert all(receiving.more() for _ in range(20))
            assert receiving.lost > before
        assert receiving.accounted_for()


def test_a_cable_that_is_pulled_and_put_back() -> None:
    with over_a_link() as (link, receiving, _):
        assert all(receiving.more() for _ in range(20))
        link.hold()
        assert receiving.loses_sight() < WAIT_S
        link.release()
        assert all(receiving.more() for _ in range(20))
        assert eventually(lambda: receiving.more() and receiving.lost > 0)
        receiving.drain()
        assert receiving.accounted_for()


def test_a_slow_way_shows_in_the_age_and_loses_nothing() -> None:
    with over_a_link() as (link, receiving, _):
        link.delay_s = 0.1
        # Those on the way already are not delayed.
        assert eventually(lambda: receiving.more() and (receiving.received[-1].transit_ms or 0) >= 100)
        first = len(receiving.received)
        assert all(receiving.more() for _ in range(20))
        assert all(one.age_ms >= 100 for one in receiving.received[first:])
        assert receiving.lost == 0
        assert receiving.accounted_for()


@pytest.mark.slow
def test_a_narrow_link_loses_tracks_rather_than_to_let_them_grow_old(monkeypatch: pytest.MonkeyPatch) -> None:
    points = 200
    line = tuple((1.123456 + number, 2.123456, 3.123456) for number in range(points))
    monkeypatch.setattr(
        sys.modules[__name__],
        "TRACK",
        TRACK.model_copy(
            update={
                "centerline_mm": line,
                "sigma_mm": (0.123456,) * points,
                "seen": (2,) * points,
                "curvature_per_mm": (0.012345678,) * points,
            }
        ),
    )
    with over_a_link() as (link, receiving, _):
        assert all(receiving.more() for _ in range(5))
        link.bytes_per_s = 0.5 * len(TRACK.to_json()) / PERIOD_S
        assert eventually(lambda: receiving.more() and receiving.lost > 100, timeout_s=60)
        ages_s = [one.transit_ms / 1000 for one in receiving.received if one.transit_ms is not None]
        # On the way are the send buffer (which the kernel doubles), the relay's own, and Zenoh's batches: without a
        # bound to the first, megabytes.
        assert max(ages_s) * link.bytes_per_s < 700_000
        assert receiving.accounted_for()
