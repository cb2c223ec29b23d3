"""A subscriber of needletrack that knows docs/wire.md and Zenoh, and nothing else.

pip install eclipse-zenoh
python plain_subscriber.py --rig lab --connect tcp/127.0.0.1:7447
"""
# ruff: noqa: T201

import argparse
import json
import queue
import sys
import time

import zenoh


def main() -> int:
    """Print the tip of every track that a controller could act on, and why not for every other one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", required=True, help="the rig's name, as in its rig file")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="the daemon's endpoint")
    parser.add_argument("--count", type=int, default=0, help="end after this many tracks (0: never)")
    parser.add_argument("--max-age-ms", type=float, default=200.0, help="an older track is not acted on")
    options = parser.parse_args()

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([options.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")

    # The callbacks only hand over: whatever takes time happens in this thread.
    arrived: queue.SimpleQueue[tuple[str, bytes, int]] = queue.SimpleQueue()
    key = f"needletrack/{options.rig}"
    received = 0
    last: dict = {}
    with zenoh.open(config) as session:
        session.liveliness().declare_subscriber(
            f"{key}/alive", lambda sample: arrived.put((str(sample.kind), b"", time.time_ns())), history=True
        )
        session.declare_subscriber(
            f"{key}/track", lambda sample: arrived.put(("track", bytes(sample.payload), time.time_ns()))
        )
        while True:
            what, payload, received_at_ns = arrived.get()
            if what != "track":
                gone = what.endswith("DELETE")
                print("daemon gone" if gone else "daemon alive", flush=True)
                if gone and options.count:
                    return 1
                continue
            track = json.loads(payload)
            print(judged(track, last, received_at_ns, options.max_age_ms), flush=True)
            last = track
            received += 1
            if received == options.count:
                return 0


def judged(track: dict, last: dict, received_at_ns: int, max_age_ms: float) -> str:
    """One line: the tip, or the reason to hold."""
    if track["version"] != 1:
        return f"hold: version {track['version']} is not mine"
    missing = 0
    if last and last["run_id"] == track["run_id"]:
        missing = max(0, track["sequence"] - last["sequence"] - 1)
    gap = f" ({missing} missing before it)" if missing else ""
    if track["status"] != "ok":
        return f"hold: {track['sequence']} is {track['status']}: {', '.join(track['reasons'])}{gap}"
    age_ms = track["latency_ms"] or 0.0
    if track["published_at_ns"] is not None:
        age_ms += (received_at_ns - track["published_at_ns"]) / 1e6
    if age_ms > max_age_ms:
        return f"hold: {track['sequence']} is {age_ms:.0f} ms old{gap}"
    x, y, z = track["tip"]["position_mm"]
    return f"tip {track['sequence']} at ({x:.3f}, {y:.3f}, {z:.3f}) mm in {track['frame_id']}{gap}"


if __name__ == "__main__":
    sys.exit(main())
