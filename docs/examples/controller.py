"""A controller's loop on needletrack's client: at its own rate, the newest track, or the reason to hold.

pip install needletrack
python controller.py --rig lab --connect tcp/127.0.0.1:7447
"""
# ruff: noqa: T201

import argparse
import sys
import time

from needletrack.client import Freshness, Subscriber


def main() -> int:
    """Act on what is fresh and ok, hold otherwise; one line each time that this changes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", required=True, help="the rig's name, as in its rig file")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="the daemon's endpoint")
    parser.add_argument("--rate-hz", type=float, default=100.0, help="of the loop")
    parser.add_argument("--max-age-ms", type=float, default=100.0, help="an older track is not acted on")
    parser.add_argument("--until-gone", action="store_true", help="end once the daemon has gone")
    options = parser.parse_args()

    said = ""
    with Subscriber(options.rig, [options.connect], max_age_s=options.max_age_ms / 1000) as tracks:
        due_s = time.monotonic()
        while True:
            # The newest one, whatever came before it: a controller wants to know where the needle is now.
            newest, health = tracks.latest(), tracks.health
            if health.state is not Freshness.FRESH:
                doing = f"hold: {health.state.value}"
                why = health.reason
            elif newest.message.status != "ok":
                doing = f"hold: {newest.message.status}"
                why = ", ".join(newest.message.reasons)
            else:
                doing = "act"
                x, y, z = newest.message.tip.position_mm
                why = f"tip at ({x:.3f}, {y:.3f}, {z:.3f}) mm in {newest.message.frame_id}"
            if doing != said:
                print(f"{doing}: {why}", flush=True)
                said = doing
            if options.until_gone and health.state is Freshness.GONE:
                return 0
            # What came too late is left out, and not caught up with.
            due_s = max(due_s + 1 / options.rate_hz, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))


if __name__ == "__main__":
    sys.exit(main())
