"""The core measurements of one commit, in a fresh process: `benchmarks.compare` starts it with that package.

`python core.py JOB` reads the frames that the job names, and prints medians in milliseconds of the thread's processor
time as JSON. It takes nothing from the package but what every commit since 53e62b9 has, and where there is more, that.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import needletrack
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.publish.message import Instant, RunContext, Source, TrackMessage
from needletrack.records import Frame, NeedleTrack, StereoPair
from needletrack.tracking import track as tracking
from needletrack.tracking.parameters import TrackingParameters

_PAIRS_PER_AUDIT = 5


def pair_of(images: Any, number: int, rate_hz: float) -> StereoPair:
    """Two images (2, rows, columns) as the numbered pair of a sequence at a rate."""
    stamp_ns = round(number * 1e9 / rate_hz)
    return StereoPair(Frame(images[0], stamp_ns), Frame(images[1], stamp_ns), number)


def measure(sequence: dict[str, Any], pairs: int, searches: int, warmup: int) -> dict[str, float]:
    """Medians of one sequence: tracking in line, the worker where the commit has one, its message, and searches."""
    rig, images, parameters = rig_of(sequence["rig"]), np.load(sequence["frames"], mmap_mode="r"), TrackingParameters()
    order = [*range(len(images)), *range(len(images) - 2, 0, -1)]
    played = [pair_of(np.array(images[at]), number, sequence["rate_hz"]) for number, at in enumerate(order)]
    times: dict[str, list[float]] = {name: [] for name in ("track_pair", "worker", "message", "search")}

    def timed(name: str, call: Callable[..., Any], *given: Any) -> Any:
        began_ns = time.thread_time_ns()
        result = call(*given)
        times[name].append((time.thread_time_ns() - began_ns) / 1e6)
        return result

    rate_hz, previous = sequence["rate_hz"], None
    for number in range(warmup + pairs):
        pair = at(played, number, rate_hz)
        previous = timed("track_pair", tracking.track_pair, pair, rig, parameters, previous)
        timed("message", message, previous, pair)
    if hasattr(tracking, "follow"):
        _worker(tracking, played, rig, parameters, rate_hz, warmup + pairs, timed)
    else:
        times["worker"] = list(times["track_pair"])
    for number in range(warmup + searches):
        timed("search", tracking.track_pair, at(played, number, rate_hz), rig, parameters, None)
    found = {name: float(np.median(of[warmup:])) for name, of in times.items()}
    return found | {"track_pair p99": float(np.percentile(times["track_pair"][warmup:], 99))}


def message(track: NeedleTrack, pair: StereoPair) -> bytes:
    """The message of a track, to its bytes."""
    run = RunContext("compared", Source.REPLAY, "benchmark", "benchmark")
    return TrackMessage.from_track(track, pair, run, dropped={}, published=Instant.now()).to_json()


def _worker(
    module: Any,
    played: list[StereoPair],
    rig: StereoRig,
    parameters: TrackingParameters,
    rate_hz: float,
    pairs: int,
    timed: Callable[..., Any],
) -> None:
    """`follow` from pair to pair; audits and searches are made between, untimed, and adopted at the next pair."""

    def followed(pair: StereoPair, track: NeedleTrack, found: NeedleTrack | None) -> Any:
        before = track if found is None or found.curve is None else module.adopted(track, found)
        return module.follow(pair, rig, parameters, before)

    track, found = module.search(played[0], rig, parameters), None
    for number in range(1, pairs + 1):
        pair = at(played, number, rate_hz)
        if track.curve is None:
            track, found = module.search(at(played, number - 1, rate_hz), rig, parameters), None
        track, found = timed("worker", followed, pair, track, found), None
        if track.curve is not None and number % _PAIRS_PER_AUDIT == 0:
            found = module.audit(pair, rig, parameters, track)


def at(played: list[StereoPair], number: int, rate_hz: float) -> StereoPair:
    """The numbered pair of an endless play forward and backward."""
    pair = played[number % len(played)]
    return pair_of((pair.left.image, pair.right.image), number, rate_hz)


def rig_of(plain: dict[str, Any]) -> StereoRig:
    """The rig of a job."""
    cameras = [
        Camera(np.array(view["matrix"]), np.array(view["distortion"]), tuple(view["size_px"]))
        for view in (plain["left"], plain["right"])
    ]
    pose = RigidTransform(np.array(plain["rotation"]), np.array(plain["translation_mm"]))
    return StereoRig(cameras[0], cameras[1], pose)


def main() -> None:
    """Measure what the job says."""
    cv2.setNumThreads(1)
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    results = {
        sequence["name"]: measure(sequence, job["pairs"], job["searches"], job["warmup"])
        for sequence in job["sequences"]
    }
    print(json.dumps({"package": needletrack.__file__, "results": results}))


if __name__ == "__main__":
    main()
