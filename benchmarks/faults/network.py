"""Faults of routers, links and other subscribers."""

import signal
import time

import numpy as np
from tests.publish.relay import Relay

from benchmarks.faults.stage import Child, Stage, Watcher, ended, fresh, routing, until
from benchmarks.faults.table import Faults, Seen, change, changes, lost, p99_ms, require, silence
from benchmarks.loopback import free_endpoint
from needletrack.publish.session import MOST_RECEIVED_BYTES, open_session

FAULTS = Faults()
fault = FAULTS.row


@fault("network", "router killed", "SIGKILL; started anew at once")
def router_killed(stage: Stage) -> Seen:
    """Daemon and subscriber are clients of it."""
    router, watcher = _routed(stage)
    at_s = router.signal(signal.SIGKILL)
    saw = change(watcher, at_s, "gone", "silent")
    ended(router)
    again_s = routing(stage.router())
    healthy_s = watcher.fresh_after(again_s)
    return Seen(saw, healthy_s, f"{silence(watcher, at_s):.1f} s of tracks; {lost(watcher, at_s)}")


@fault("network", "router hung", "SIGSTOP for 4 s, SIGCONT")
def router_hung(stage: Stage) -> Seen:
    """Its connections stay open and carry nothing."""
    router, watcher = _routed(stage)
    at_s = router.signal(signal.SIGSTOP)
    saw = f"{change(watcher, at_s, 'silent')}, {change(watcher, at_s, 'gone')}"
    time.sleep(max(at_s + 4 - time.monotonic(), 0))
    on_s = router.signal(signal.SIGCONT)
    healthy_s = watcher.fresh_after(on_s)
    return Seen(saw, healthy_s, f"{silence(watcher, at_s):.1f} s of tracks; {lost(watcher, at_s)}")


@fault("network", "router late", "started 5 s after daemon and subscriber ran")
def router_late(stage: Stage) -> Seen:
    """Both open without it, and go on trying, at most 1 s apart."""
    watcher, aside = _client(stage), free_endpoint()
    stage.daemon("--listen", aside, "--connect", stage.endpoint, listen=False)
    # Somebody whom it needs no router for knows when it runs, which takes long on a busy machine.
    near = stage.watcher(aside)
    fresh(near)
    seen = watcher.health(0.0, "never_seen")
    time.sleep(5)
    on_s = routing(stage.router())
    return Seen(seen["health"], watcher.fresh_after(on_s), "the tracks until then, which nobody could receive")


@fault("network", "link cut", "both directions closed and refused for 2 s")
def link_cut(stage: Stage) -> Seen:
    """A cable pulled at the subscriber's end."""
    link, watcher = _linked(stage)
    at_s = time.monotonic()
    link.cut()
    saw = change(watcher, at_s, "gone", "silent")
    time.sleep(max(at_s + 2 - time.monotonic(), 0))
    link.heal()
    healthy_s = watcher.fresh_after(time.monotonic())
    return Seen(saw, healthy_s, f"{silence(watcher, at_s):.1f} s of tracks; {lost(watcher, at_s)}")


@fault("network", "link hung", "no byte passed for 3 s, connections open")
def link_hung(stage: Stage) -> Seen:
    """A switch that forgets, a laptop that sleeps."""
    link, watcher = _linked(stage)
    at_s = time.monotonic()
    link.hold()
    saw = f"{change(watcher, at_s, 'silent')}, {change(watcher, at_s, 'gone')}"
    time.sleep(max(at_s + 3 - time.monotonic(), 0))
    link.release()
    healthy_s = watcher.fresh_after(time.monotonic())
    return Seen(saw, healthy_s, f"{silence(watcher, at_s):.1f} s of tracks; {lost(watcher, at_s)}")


@fault("network", "link delayed", "0.6 s more each way for 4 s")
def link_delayed(stage: Stage) -> Seen:
    """A satellite's way: everything comes, and too late to act on."""
    link, watcher = _linked(stage)
    at_s = time.monotonic()
    link.delay_s = 0.6
    saw = change(watcher, at_s, "stale", "silent")
    time.sleep(max(at_s + 4 - time.monotonic(), 0))
    delayed = [seen["latency_ms"] for seen in watcher.since(at_s + 2, "track")]
    require(bool(delayed), "no track came over the delayed link")
    link.delay_s = 0.0
    healthy_s = watcher.fresh_after(time.monotonic())
    saw += f"; then {changes(watcher, at_s)}; latency {np.median(delayed):.0f} ms (median)"
    return Seen(saw, healthy_s, lost(watcher, at_s))


@fault("network", "link throttled", "15 kB/s, which is a fraction of the tracks, for 8 s")
def link_throttled(stage: Stage) -> Seen:
    """What does not fit is dropped at the daemon's end: the tracks that come are not ever older."""
    link, watcher = _linked(stage)
    at_s = time.monotonic()
    link.bytes_per_s = 15_000.0
    saw = change(watcher, at_s, "stale", "silent")
    time.sleep(max(at_s + 8 - time.monotonic(), 0))
    throttled = [seen["latency_ms"] for seen in watcher.since(at_s, "track")]
    link.bytes_per_s = None
    healthy_s = watcher.fresh_after(time.monotonic())
    saw += f"; the oldest track was {max(throttled) / 1000:.1f} s old as it came"
    return Seen(saw, healthy_s, lost(watcher, at_s))


@fault("network", "a slow subscriber", "a second one takes 0.3 s for each track and lets 8 wait")
def other_slow(stage: Stage) -> Seen:
    """It is told of what it missed, and the first one is not held up."""
    _, watcher = stage.running()
    before_s = time.monotonic()
    watcher.tracks(before_s, 60)
    at_s = time.monotonic()
    other = stage.watcher(options=["--work-s", "0.3", "--capacity", "8"])
    until(lambda: other.since(at_s, "track"), "a track at the slow subscriber")
    beside_s = time.monotonic()
    watcher.tracks(beside_s, 60)
    until(lambda: other.missed(at_s)[2] > 20, "an overflow in the slow subscriber")
    saw = f"the first: {changes(watcher, beside_s)}, {_p99s(watcher, before_s, at_s, beside_s)}"
    return Seen(saw, 0.0, f"the first: {lost(watcher, at_s)}; the second: {lost(other, at_s)}")


@fault("network", "a slow callback", "a second subscriber holds up Zenoh's own thread for 0.3 s with each track")
def other_blocks(stage: Stage) -> Seen:
    """Its link fills, and no other."""
    return _beside(stage, "slow", 1, "--slow-s", "0.3")


@fault("network", "ten subscribers", "ten more of the tracks")
def ten_more(stage: Stage) -> Seen:
    """Each has a link of its own."""
    return _beside(stage, "idle", 10)


@fault("network", "another subscriber hangs", "SIGSTOP to a second subscriber for 4 s")
def other_hangs(stage: Stage) -> Seen:
    """It must not hold the first one up."""
    _, watcher = stage.running()
    other = stage.watcher()
    fresh(other)
    before_s = time.monotonic()
    watcher.tracks(before_s, 90)
    at_s = other.signal(signal.SIGSTOP)
    time.sleep(4)
    on_s = other.signal(signal.SIGCONT)
    before, during = (p99_ms(watcher, *span) for span in ((before_s, at_s), (at_s, on_s)))
    healthy_s = other.fresh_after(on_s)
    saw = f"the first: {changes(watcher, at_s)}, p99 {during:.1f} ms after {before:.1f} ms before"
    return Seen(saw, healthy_s, f"the first: {lost(watcher, at_s)}; the second: {lost(other, at_s)}")


@fault("network", "another subscriber killed", "SIGKILL to a second subscriber")
def other_killed(stage: Stage) -> Seen:
    """Its connection breaks."""
    _, watcher = stage.running()
    other = stage.watcher()
    fresh(other)
    at_s = other.signal(signal.SIGKILL)
    watcher.tracks(at_s, 60)
    return Seen(f"the first: {changes(watcher, at_s)}", 0.0, lost(watcher, at_s))


@fault(
    "network",
    "nonsense on our keys",
    "100 random payloads and one of 64 MB, put by a neighbour",
)
def nonsense(stage: Stage) -> Seen:
    """Who may put at all is decided by certificates; what is put is checked."""
    rogue = free_endpoint()
    stage.daemon()
    random = np.random.default_rng(7)
    with open_session(listen=[rogue]) as session:
        # The daemon passes on nothing that another peer puts: it must be a neighbour of the subscriber itself.
        watcher = stage.watcher(stage.endpoint, rogue)
        fresh(watcher)
        at_s = time.monotonic()
        for number in range(100):
            session.put(f"needletrack/{stage.rig}/track", random.bytes(number * 10))
        session.put(f"needletrack/{stage.rig}/track", bytes(2 * MOST_RECEIVED_BYTES))
        watcher.tracks(time.monotonic(), 30)
    counts = [seen["undecodable"] for seen in watcher.since(at_s, "undecodable")]
    require(bool(counts), "no payload reached the subscriber")
    saw = f"{counts[-1]} counted as undecodable; {changes(watcher, at_s)}"
    return Seen(saw, watcher.fresh_after(time.monotonic()), lost(watcher, at_s))


def _client(stage: Stage) -> Watcher:
    """A subscriber that is a router's client: a router passes nothing on between peers that know of each other."""
    return stage.watcher(mode="client")


def _routed(stage: Stage) -> tuple[Child, Watcher]:
    watcher = _client(stage)
    router = stage.router()
    stage.daemon("--connect", stage.endpoint, listen=False)
    fresh(watcher)
    return router, watcher


def _linked(stage: Stage) -> tuple[Relay, Watcher]:
    stage.daemon()
    link = stage.link()
    watcher = stage.watcher(f"tcp/127.0.0.1:{link.port}")
    fresh(watcher)
    return link, watcher


def _beside(stage: Stage, role: str, count: int, *options: str) -> Seen:
    """What others do to the first subscriber."""
    _, watcher = stage.running()
    before_s = time.monotonic()
    watcher.tracks(before_s, 60)
    # Their start costs this machine's cores more than their tracks do.
    starting_s = time.monotonic()
    stage.bystanders(role, count, *options)
    at_s = time.monotonic()
    watcher.tracks(at_s, 60)
    latencies = _p99s(watcher, before_s, starting_s, at_s)
    return Seen(f"the first: {changes(watcher, at_s)}, {latencies}", 0.0, f"the first: {lost(watcher, at_s)}")


def _p99s(watcher: Watcher, before_s: float, until_s: float, since_s: float) -> str:
    before, beside = p99_ms(watcher, before_s, until_s), p99_ms(watcher, since_s, time.monotonic())
    return f"p99 {beside:.1f} ms after {before:.1f} ms before"
