"""A Zenoh router: python -m benchmarks.faults.router ENDPOINT."""

import json
import signal
import sys

import zenoh

from needletrack.publish.session import LEASE_MS


def main() -> int:
    """Route until SIGTERM."""
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": sys.argv[1:],
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        print("routing", flush=True)
        signal.pause()
    return 0


if __name__ == "__main__":
    sys.exit(main())
