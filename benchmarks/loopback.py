"""A subscriber in a process of its own."""

import multiprocessing
import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager

from benchmarks.report import Delivery, Spread
from needletrack.client import Subscriber

# Starting a process that imports everything takes seconds on a busy machine.
START_S = 60.0
# Enough for any subscriber that keeps up on average.
QUEUE = 1024


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def fresh_process() -> Iterator[ProcessPoolExecutor]:
    """One process that begins empty: not a copy of this one and its memory."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=_end_with_parent) as process:
        yield process


@contextmanager
def subscribed(rig: str, endpoint: str) -> Iterator[Future[Delivery]]:
    """A subscriber in another process that counts until its publisher is gone."""
    with fresh_process() as process:
        yield process.submit(receive, rig, endpoint)


def _end_with_parent() -> None:
    """End this process with the one that started it: a killed pool's worker would stay for ever."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def receive(rig: str, endpoint: str) -> Delivery:
    """Take every track of a rig until its publisher is gone; raises PublishError where none comes."""
    count = lost = overflowed = 0
    transits_ms: list[float] = []
    with Subscriber(rig, [endpoint], capacity=QUEUE) as subscriber:
        subscriber.wait_for_daemon(START_S)
        gone = False
        while not gone:
            gone = subscriber.wait_until_gone(0)
            while (received := subscriber.next(0.0 if gone else 0.1)) is not None:
                count += 1
                lost += received.missed.lost
                overflowed += received.missed.overflowed
                if received.transit_ms is not None:
                    transits_ms.append(received.transit_ms)
    return Delivery(
        received=count,
        lost=lost,
        overflowed=overflowed,
        transit_ms=Spread.of(transits_ms) if transits_ms else None,
    )
