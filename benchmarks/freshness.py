"""How soon a subscriber knows that its track is no longer fresh: `python -m benchmarks.freshness [REPEATS]`.

A publisher in its own process sends tracks of 200 points at 60 Hz and then falls silent, hangs (SIGSTOP), is killed,
or stops. Measured: from the last track's arrival until `health` says anything but fresh, asked every millisecond.
"""

import signal
import statistics
import subprocess
import sys
import time

from benchmarks.loopback import START_S, free_endpoint
from needletrack.client import Freshness, Subscriber

WAYS = ("falls silent", "hangs", "is killed", "stops")
PUBLISHING = """
import sys, threading, time
from needletrack.publish.message import Instant, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.schema import example_messages, example_run, example_track
track, pair = example_track(points=200)
told = threading.Event()
threading.Thread(target=lambda: (sys.stdin.readline(), told.set()), daemon=True).start()
with ZenohPublisher(example_run(), lambda: example_messages()[1], listen=[sys.argv[1]]) as publisher:
    publisher.wait_for_subscriber(60)
    due, number = time.monotonic(), 0
    while not told.is_set():
        made = TrackMessage.from_track(track, pair, example_run(), dropped={}, published=Instant.now())
        publisher.publish(made.model_copy(update={"sequence": number, "latency_ms": 8.0}))
        number, due = number + 1, due + 1 / 60
        told.wait(max(0.0, due - time.monotonic()))
    if sys.argv[2] == "falls silent":
        time.sleep(5)
"""


def noticed_ms(way: str) -> tuple[float, Freshness]:
    """From the last track to the first answer that is not fresh, and that answer."""
    endpoint = free_endpoint()
    process = subprocess.Popen([sys.executable, "-c", PUBLISHING, endpoint, way], stdin=subprocess.PIPE, text=True)
    # The age is not what is measured here: it would be stale 92 ms after a track that is 8 ms old.
    with process, Subscriber("lab", [endpoint], max_age_s=10.0) as subscriber:
        try:
            subscriber.wait_for_daemon(START_S)
            until_s = time.monotonic() + 1.5
            while time.monotonic() < until_s:
                subscriber.next(0.05)
            if way in ("falls silent", "stops"):
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
            else:
                process.send_signal(signal.SIGSTOP if way == "hangs" else signal.SIGKILL)
            while (health := subscriber.health).state is Freshness.FRESH:
                time.sleep(0.001)
            now_ns, latest = time.monotonic_ns(), subscriber.latest()
            assert latest is not None
            return (now_ns - latest.received_monotonic_ns) / 1e6, health.state
        finally:
            process.kill()


def main() -> None:
    """A line for each way to fall silent."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    for way in WAYS:
        times = [noticed_ms(way) for _ in range(repeats)]
        all_ms = [ms for ms, _ in times]
        states = ", ".join(sorted({state.value for _, state in times}))
        print(f"{way:14} {statistics.median(all_ms):6.1f} ms, at most {max(all_ms):6.1f} ms: {states}")


if __name__ == "__main__":
    main()
