"""The interpreter that `benchmarks.start` starts: as `needletrack run`, to the first track, cameras apart.

`python -m benchmarks.starting FRAMES RIG` prints moments of CLOCK_MONOTONIC in nanoseconds, as JSON. Nothing heavy is
loaded where this module is only imported: the second process imports it, in place of the daemon's command.
"""

import json
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from needletrack.publish.message import TrackMessage
    from needletrack.publish.publisher import ZenohPublisher
    from needletrack.records import DropReason, Image, NeedleTrack, StereoPair


class _OnePair:
    """A source of one pair, stamped now."""

    @property
    def dropped(self) -> "Mapping[DropReason, int]":
        """Nothing is lost here."""
        return {}

    def __init__(self, images: "tuple[Image, Image]") -> None:
        self._images = images

    def pairs(self, stop: threading.Event) -> "Iterator[StereoPair]":
        """The pair."""
        from needletrack.records import Clock, Frame, StereoPair

        now_ns = time.monotonic_ns()
        left, right = (Frame(image, now_ns) for image in self._images)
        yield StereoPair(left, right, 0, clock=Clock.MONOTONIC, arrived_at_ns=now_ns)


class _First:
    """A sink that notes when the first track was published, and whether it has a shape."""

    def __init__(self, publisher: "ZenohPublisher") -> None:
        self.at_ns, self.found = 0, False
        self._publisher = publisher

    def take(self, pair: "StereoPair", track: "NeedleTrack", message: "TrackMessage") -> None:
        """Publish, as the daemon does, and note the moment."""
        self._publisher.publish(message)
        self.at_ns, self.found = time.monotonic_ns(), track.curve is not None


def start(frames: Path, rig_file: Path) -> dict[str, int]:
    """What `Daemon.run` sets up, without cameras, recorder and control; moments in ns, CLOCK_MONOTONIC."""
    import numpy as np

    from needletrack.auditing import AuditedTracker
    from needletrack.config import load_config
    from needletrack.daemon.metrics import Metrics
    from needletrack.daemon.process import settle_memory
    from needletrack.publish.message import RunContext, Source
    from needletrack.publish.publisher import ZenohPublisher
    from needletrack.rig import read_rig
    from needletrack.service import Service, Surroundings

    left, right = np.load(frames)
    rig, config = read_rig(rig_file), load_config()
    run = RunContext(rig.name, Source.LIVE, config.digest, rig.digest)
    moments = {"configured": time.monotonic_ns()}
    with ExitStack() as opened:
        tracker = opened.enter_context(AuditedTracker(rig, config.tracking))
        service = Service(_OnePair((left, right)), tracker, rig, run, drift=config.drift)
        publisher = opened.enter_context(ZenohPublisher(run, service.status, listen=["tcp/127.0.0.1:0"]))
        opened.enter_context(Metrics(service, Surroundings, 0))
        moments["built"] = time.monotonic_ns()
        tracker.warm_up(within_s=0.0)
        settle_memory()
        moments["warm"] = time.monotonic_ns()
        first = _First(publisher)
        service.run([first], threading.Event())
        moments["tracked"] = first.at_ns
    if not first.found:
        raise SystemExit("the first pair gave no track")
    return moments


def main() -> None:
    """Load what the command loads, in its order, start, and print when what was done."""
    began_ns = time.monotonic_ns()
    import needletrack.cli
    from needletrack.daemon.process import load_without_collecting

    load_without_collecting()
    import needletrack.daemon.logs
    import needletrack.daemon.run
    import needletrack.terminal  # noqa: F401

    imported_ns = time.monotonic_ns()
    print(json.dumps({"interpreter": began_ns, "imported": imported_ns} | start(Path(sys.argv[1]), Path(sys.argv[2]))))


if __name__ == "__main__":
    main()
