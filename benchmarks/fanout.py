"""What others on the wire do to a pose: `python -m benchmarks.fanout`, on loopback and across two network namespaces.

A daemon's publisher sends tracks of 12 kB at a steady rate, one subscriber in a process of its own takes the time from
`published_at_ns` to the receipt, and beside it are, in turn: nobody; ten more subscribers; one whose callback takes
50 ms; one that was stopped (SIGSTOP); one that reads frames of 1.3 MB from the pictures' session; all of these at
once. For comparison: poses that are not express, and the frames on the poses' own session, read there by the one
subscriber, whose callback takes 20 ms for a frame. The cases run in turn,
several rounds, and each round's 99th percentile is compared with that of nobody in the same round.
"""

import argparse
import json
import os
import queue
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

RIG = "lab"
FRAME_BYTES = 1280 * 1024
WARM_UP_S = 1.0
SLOW_S = 0.05
FRAME_WORK_S = 0.02
BAR_MS = 2.0
PRIORITY = 50
_STARTED_WITHIN_S = 60.0
_SILENT_S = 1.0


def may_schedule(priority: int) -> bool:
    """Whether real-time scheduling is permitted here."""
    from needletrack.daemon.process import may_schedule as permitted

    return permitted(priority)


@dataclass(frozen=True)
class Case:
    """Who is there beside the subscriber that measures, and how the daemon publishes."""

    name: str
    beside: tuple[str, ...] = ()
    frames: str = ""
    express: bool = True
    measuring: str = "measure"
    held_to_bar: bool = True


TEN = ("idle",) * 10
CASES = (
    Case("nobody"),
    Case("ten more", TEN),
    Case("a slow one", ("slow",)),
    Case("a stopped one", ("stopped",)),
    Case("1.3 MB frames", ("frames",), frames="apart"),
    Case("all of these", (*TEN, "slow", "stopped", "frames"), frames="apart"),
    Case("not express", express=False, held_to_bar=False),
    Case("frames on the poses' session", frames="together", measuring="measure-both", held_to_bar=False),
)


@dataclass
class Outcome:
    """One case in one round."""

    p50_ms: float
    p99_ms: float
    worst_ms: float
    received: int
    lost: int
    longest_put_ms: float


@dataclass(frozen=True)
class Place:
    """Where daemon and subscribers run: a prefix for their commands, and the daemon's address."""

    name: str
    address: str
    daemon: tuple[str, ...] = ()
    subscriber: tuple[str, ...] = ()


@contextmanager
def two_namespaces() -> Iterator[Place]:
    """Two network namespaces joined by a virtual cable; PermissionError with the reason where that is not permitted."""
    one, two = (f"needletrack-{os.getpid()}-{side}" for side in "ab")
    cable = [f"nt{os.getpid() % 100000}{side}" for side in "ab"]
    with ExitStack() as opened:
        for name in (one, two):
            _ip("netns", "add", name)
            opened.callback(subprocess.run, ["ip", "netns", "del", name], check=False, capture_output=True)
        _ip("link", "add", cable[0], "netns", one, "type", "veth", "peer", "name", cable[1], "netns", two)
        for number, (name, end) in enumerate(zip((one, two), cable, strict=True), start=1):
            _ip("-n", name, "address", "add", f"10.213.71.{number}/30", "dev", end)
            for link in (end, "lo"):
                _ip("-n", name, "link", "set", link, "up")
        into = ("ip", "netns", "exec")
        yield Place("two namespaces", "10.213.71.1", (*into, one), (*into, two))


def _ip(*arguments: str) -> None:
    try:
        subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise PermissionError("there is no `ip` (iproute2)") from error
    except subprocess.CalledProcessError as error:
        raise PermissionError(f"ip {' '.join(arguments)}: {error.stderr.strip()}") from error


def run(case: Case, place: Place, rate_hz: float, seconds: float) -> Outcome:
    """One case, once."""
    ports = [_free_port(), _free_port()]
    tracks, frames = (f"tcp/{place.address}:{port}" for port in ports)
    options = ["--rate", str(rate_hz), "--seconds", str(seconds), "--frames", case.frames]
    options += [] if case.express else ["--not-express"]
    with ExitStack() as opened:

        def started(role: str, prefix: Sequence[str], *more: str) -> "subprocess.Popen[str]":
            command = [*prefix, sys.executable, "-m", "benchmarks.fanout", "--role", role, tracks, frames, *more]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            opened.callback(_end, process)
            _line(process)
            return process

        daemon = started("publish", place.daemon, *options)
        for role in case.beside:
            bystander = started("idle" if role == "stopped" else role, place.subscriber)
            if role == "stopped":
                bystander.send_signal(signal.SIGSTOP)
        measuring = started(case.measuring, place.subscriber)
        assert daemon.stdin is not None
        daemon.stdin.write("go\n")
        daemon.stdin.flush()
        sent, got = json.loads(_line(daemon)), json.loads(_line(measuring))
    return Outcome(**got, longest_put_ms=sent["longest_put_ms"])


def _line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{' '.join(map(str, process.args))} ended with {process.wait()}")  # type: ignore[arg-type]
    return line


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def publish(tracks: str, frames: str, asked: argparse.Namespace) -> None:
    """The daemon's part: says when it is there, publishes once told to, says the longest time that a put took."""
    import zenoh

    from needletrack.publish.overlay import OverlayPublisher
    from needletrack.publish.publisher import ZenohPublisher
    from needletrack.publish.schema import example_messages, example_run

    class Variant(ZenohPublisher):
        """What is compared with."""

        pictures: zenoh.Publisher

        def _declare(self, session: zenoh.Session) -> None:
            super()._declare(session)
            if asked.not_express:
                self._tracks.undeclare()  # type: ignore[no-untyped-call]
                self._tracks = session.declare_publisher(
                    self.keys.track,
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.REAL_TIME,
                )
            self.pictures = session.declare_publisher(
                self.keys.overlay, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND
            )

    track, status = example_messages()
    points = 200
    line = tuple((1.123456 + number, 2.123456, 250.123456) for number in range(points))
    track = track.model_copy(
        update={
            "centerline_mm": line,
            "sigma_mm": (0.123456,) * points,
            "seen": (2,) * points,
            "curvature_per_mm": (0.012345678,) * points,
        }
    )
    frame, stop = bytes(FRAME_BYTES), threading.Event()
    with ExitStack() as opened:
        publisher = opened.enter_context(Variant(example_run(), lambda: status, listen=[tracks]))
        apart = opened.enter_context(OverlayPublisher(publisher.keys, listen=[frames]))

        def send_frames() -> None:
            while not stop.wait(1 / 30):
                if asked.frames == "apart":
                    apart.publish(frame, track)
                else:
                    publisher.pictures.put(frame)

        print("ready", flush=True)
        sys.stdin.readline()
        if asked.frames:
            thread = threading.Thread(target=send_frames)
            thread.start()
            opened.callback(thread.join)
        opened.callback(stop.set)
        longest_s, due_s = 0.0, time.monotonic()
        for sequence in range(round(asked.rate * (WARM_UP_S + asked.seconds))):
            due_s += 1 / asked.rate
            time.sleep(max(0.0, due_s - time.monotonic()))
            message = track.model_copy(update={"sequence": sequence, "published_at_ns": time.time_ns()})
            began_s = time.monotonic()
            publisher.publish(message)
            if sequence >= asked.rate * WARM_UP_S:
                longest_s = max(longest_s, time.monotonic() - began_s)
        time.sleep(0.3)
        print(json.dumps({"longest_put_ms": 1000 * longest_s}), flush=True)
        sys.stdin.readline()


def measure(tracks: str, rate_hz: float) -> None:
    """The subscriber that takes the times."""
    from needletrack.client import Subscriber

    transits_ms: list[float] = []
    lost = 0
    with Subscriber(RIG, [tracks], capacity=4096, max_age_s=60.0, silent_after_s=60.0) as subscriber:
        subscriber.wait_for_daemon(_STARTED_WITHIN_S)
        print("ready", flush=True)
        wait_s = _STARTED_WITHIN_S
        # The end is silence: a daemon with a stopped subscriber is some time in saying goodbye.
        while (received := subscriber.next(wait_s)) is not None:
            wait_s = _SILENT_S
            if received.message.sequence >= rate_hz * WARM_UP_S and received.transit_ms is not None:
                transits_ms.append(received.transit_ms)
                lost += received.missed.lost
    _tell(transits_ms, lost)


def measure_beside_frames(tracks: str, rate_hz: float) -> None:
    """The same on one session with the frames: what a reader of both does to itself."""
    import zenoh

    from needletrack.publish.message import TrackMessage
    from needletrack.publish.session import direct, open_session

    came: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
    with open_session(connect=[tracks]) as session:

        def take(sample: zenoh.Sample) -> None:
            came.put((time.time_ns(), sample.payload.to_bytes()))

        def take_frame(_: zenoh.Sample) -> None:
            time.sleep(FRAME_WORK_S)

        session.declare_subscriber(f"needletrack/{RIG}/overlay", direct(take_frame))
        session.declare_subscriber(f"needletrack/{RIG}/track", direct(take))
        while not session.info.transports():
            time.sleep(0.02)
        time.sleep(0.3)
        print("ready", flush=True)
        wait_s, last, lost = _STARTED_WITHIN_S, None, 0
        transits_ms: list[float] = []
        while True:
            try:
                received_at_ns, payload = came.get(timeout=wait_s)
            except queue.Empty:
                break
            wait_s, message = _SILENT_S, TrackMessage.from_json(payload)
            if message.sequence >= rate_hz * WARM_UP_S and message.published_at_ns is not None:
                transits_ms.append((received_at_ns - message.published_at_ns) / 1e6)
                lost += 0 if last is None else message.sequence - last - 1
            last = message.sequence
    _tell(transits_ms, lost)


def _tell(transits_ms: list[float], lost: int) -> None:
    import numpy as np

    p50, p99 = np.percentile(transits_ms, [50, 99]).tolist()
    answer = {"p50_ms": p50, "p99_ms": p99, "worst_ms": max(transits_ms), "received": len(transits_ms), "lost": lost}
    print(json.dumps(answer), flush=True)


def stand_by(role: str, tracks: str, frames: str, rig: str, slow_s: float) -> None:
    """Another subscriber; slow ones hold up Zenoh's own thread."""
    import zenoh

    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [],
        # Frames on the poses' session are sent over the link of the tracks.
        "connect/endpoints": [frames if role == "frames" else tracks],
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    linked = threading.Event()
    with zenoh.open(config) as session:

        def take(sample: zenoh.Sample) -> None:
            linked.set()
            if "slow" in role:
                time.sleep(slow_s)

        key = f"needletrack/{rig}/{'overlay' if 'frames' in role else 'track'}"
        session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False))
        while not session.info.transports():
            time.sleep(0.02)
        print("ready", flush=True)
        threading.Event().wait()


@dataclass
class Table:
    """All rounds of one place."""

    place: Place
    rounds: list[dict[str, Outcome]] = field(default_factory=list)

    def added_ms(self, case: Case) -> float:
        """By how much a case moves the 99th percentile, against nobody in the same round: the median round."""
        return statistics.median(one[case.name].p99_ms - one[CASES[0].name].p99_ms for one in self.rounds)

    def __str__(self) -> str:
        lines = [f"{self.place.name}, {len(self.rounds)} rounds; ms; medians of the rounds, p99 with its range"]
        lines.append(f"{'beside':30} {'p50':>6} {'p99':>6} {'range':>14} {'added':>7} {'put, max':>9} {'lost':>12}")
        for case in CASES:
            of = [one[case.name] for one in self.rounds]
            p99 = sorted(one.p99_ms for one in of)
            span, put = f"{p99[0]:.2f} - {p99[-1]:.2f}", statistics.median(one.longest_put_ms for one in of)
            lost, all_of = sum(one.lost for one in of), sum(one.lost + one.received for one in of)
            lines.append(
                f"{case.name:30} {statistics.median(one.p50_ms for one in of):6.2f} {statistics.median(p99):6.2f} "
                f"{span:>14} {self.added_ms(case):+7.2f} {put:9.2f} {f'{lost} of {all_of}':>12}"
            )
        return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all cases in all places; 1 where one that is held to the bar misses it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("endpoints", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--role", help=argparse.SUPPRESS)
    parser.add_argument("--frames", default="", help=argparse.SUPPRESS)
    parser.add_argument("--rig", default=RIG, help=argparse.SUPPRESS)
    parser.add_argument("--slow-s", type=float, default=SLOW_S, help=argparse.SUPPRESS)
    parser.add_argument("--not-express", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--rate", type=float, default=100.0, help="tracks a second")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each case and round")
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args(arguments)
    if asked.role is not None:
        tracks, frames = asked.endpoints
        if asked.role in ("publish", "measure", "measure-both") and may_schedule(PRIORITY):
            # Zenoh's threads as well, which begin later.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        if asked.role == "publish":
            publish(tracks, frames, asked)
        elif asked.role == "measure":
            measure(tracks, asked.rate)
        elif asked.role == "measure-both":
            measure_beside_frames(tracks, asked.rate)
        else:
            stand_by(asked.role, tracks, frames, asked.rig, asked.slow_s)
        return 0
    met, fifo = True, may_schedule(PRIORITY)
    scheduled = "SCHED_FIFO, so that other jobs here count less" if fifo else "ordinary scheduling"
    print(f"daemon and measuring subscriber: {scheduled}")
    with ExitStack() as opened:
        places = [Place("loopback", "127.0.0.1")]
        try:
            places.append(opened.enter_context(two_namespaces()))
        except PermissionError as error:
            print(f"two namespaces: left out: {error}")
        for place in places:
            table = Table(place)
            for _ in range(asked.rounds):
                table.rounds.append({case.name: run(case, place, asked.rate, asked.seconds) for case in CASES})
            print(table)
            for case in CASES[1:]:
                if case.held_to_bar and table.added_ms(case) > BAR_MS:
                    print(f"MISSED {case.name}: more than {BAR_MS:g} ms added to the 99th percentile")
                    met = False
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
