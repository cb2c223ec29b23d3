"""The independent subscriber: python -m benchmarks.faults.watcher RIG ENDPOINT... writes what it sees.

Times are CLOCK_MONOTONIC, which all processes of a machine share.
"""

import argparse
import json
import sys
import time
from pathlib import Path

from needletrack.client import Freshness, StatusMessage, Subscriber
from needletrack.publish.tls import TlsFiles

_LOOK_EVERY_S = 0.004
# At ten pairs a second a track is a tenth of a second old before the next one is there.
_MAX_AGE_S = 0.5


def main() -> int:
    """Watch until the end of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rig")
    parser.add_argument("endpoints", nargs="+")
    parser.add_argument("--mode", choices=("peer", "client"), default="peer")
    parser.add_argument("--tls", type=Path, help="folder of authority, certificate and key")
    parser.add_argument("--capacity", type=int, default=1024, help="tracks that wait")
    parser.add_argument("--work-s", type=float, default=0.0, help="what a track costs this reader")
    asked = parser.parse_args()
    tls = None
    if asked.tls is not None:
        tls = TlsFiles(*(asked.tls / f"{name}.pem" for name in ("authority", "certificate", "key")))
    state: Freshness | None = None
    status: StatusMessage | None = None
    undecodable = 0
    with Subscriber(
        asked.rig, asked.endpoints, capacity=asked.capacity, max_age_s=_MAX_AGE_S, mode=asked.mode, tls=tls
    ) as subscriber:
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
                time.sleep(asked.work_s)
            health = subscriber.health
            if health.state is not state:
                state = health.state
                _tell(time.monotonic(), health=state.value, reason=health.reason)
            if subscriber.status is not status:
                status = subscriber.status
                assert status is not None
                clock = subscriber.clock
                _tell(
                    time.monotonic(),
                    heartbeat=json.loads(status.to_json()),
                    clock_ms=None if clock is None else clock.ours_minus_daemons_ms,
                )
            if subscriber.undecodable != undecodable:
                undecodable = subscriber.undecodable
                _tell(time.monotonic(), undecodable=undecodable)


def _tell(at_s: float, **what: object) -> None:
    sys.stdout.write(json.dumps({"at_s": at_s, **what}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
