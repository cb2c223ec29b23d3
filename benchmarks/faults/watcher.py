"""The independent subscriber: python -m benchmarks.faults.watcher MODE RIG ENDPOINT... writes what it sees.

Times are CLOCK_MONOTONIC, which all processes of a machine share.
"""

import json
import sys
import time
from typing import Any

from needletrack.client import Freshness, StatusMessage, Subscriber

_LOOK_EVERY_S = 0.004
# At ten pairs a second a track is a tenth of a second old before the next one is there.
_MAX_AGE_S = 0.5


def main() -> int:
    """Watch until the end of the process."""
    mode, rig, *endpoints = sys.argv[1:]
    options: dict[str, Any] = {"mode": mode}
    state: Freshness | None = None
    status: StatusMessage | None = None
    undecodable = 0
    with Subscriber(rig, endpoints, capacity=1024, max_age_s=_MAX_AGE_S, **options) as subscriber:
        while True:
            received = subscriber.next(_LOOK_EVERY_S)
            if received is not None:
                missed, message = received.missed, received.message
                _tell(
                    received.received_monotonic_ns / 1e9,
                    track=message.sequence,
                    run=message.run_id,
                    status=message.status.value,
                    latency_ms=received.latency_ms,
                    missed=[missed.dropped, missed.lost, missed.overflowed],
                    dropped=dict(message.dropped),
                )
            health = subscriber.health
            if health.state is not state:
                state = health.state
                _tell(time.monotonic(), health=state.value, reason=health.reason)
            if subscriber.status is not status:
                status = subscriber.status
                assert status is not None
                _tell(time.monotonic(), heartbeat=json.loads(status.to_json()))
            if subscriber.undecodable != undecodable:
                undecodable = subscriber.undecodable
                _tell(time.monotonic(), undecodable=undecodable)


def _tell(at_s: float, **what: object) -> None:
    sys.stdout.write(json.dumps({"at_s": at_s, **what}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
