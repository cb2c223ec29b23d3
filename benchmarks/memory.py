"""Resident memory over a long replay, in a process of its own that does what the daemon does."""

from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np
import psutil
from scipy.stats import theilslopes

from benchmarks.frames import Scene, looped
from benchmarks.loopback import START_S, free_endpoint, fresh_process, subscribed
from benchmarks.plan import Plan
from benchmarks.report import Delivery, Memory
from benchmarks.threads import one_thread
from needletrack.errors import PublishError
from needletrack.publish.message import RunContext, Source, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.recording.asl import AslRecording
from needletrack.records import NeedleTrack, StereoPair
from needletrack.replay import Published
from needletrack.rig import find_rig
from needletrack.service import Service
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import track_pair

# A hundredth of what the daemon may have, and about 500 bytes a pair over ten thousand pairs.
FLAT_BELOW_MB = 4.0
# Until then buffers and the allocator's arenas still fill.
JUDGED_FROM_PAIRS = 1000


@dataclass(frozen=True)
class Course:
    """Resident memory at each sample, before the first pair, and its peak, megabytes (10^6 bytes)."""

    at_pair: tuple[int, ...]
    resident_mb: tuple[float, ...]
    started_mb: float
    peak_mb: float
    pairs: int
    duration_s: float


class MemorySink:
    """The service's sink that samples this process's memory and stops the run after so many pairs."""

    def __init__(self, pairs: int, samples: int, stop: Event) -> None:
        self.at_pair: list[int] = []
        self.resident_mb: list[float] = []
        self._pairs, self._stop = pairs, stop
        self._every = max(pairs // samples, 1)
        self._seen = 0
        self._process = psutil.Process()

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Sample where one is due."""
        self._seen += 1
        if self._seen % self._every == 0:
            self.at_pair.append(self._seen)
            self.resident_mb.append(self._process.memory_info().rss / 1e6)
        if self._seen >= self._pairs:
            self._stop.set()


def measure_memory(scene: Scene, plan: Plan) -> Memory:
    """Replay so many pairs from their files, looped, published to a subscriber in a third process."""
    endpoint = free_endpoint()
    rig = find_rig(scene.folder)
    with subscribed(rig.name, endpoint) as delivery, fresh_process() as process:
        course = process.submit(replay, scene, plan.memory_pairs, plan.samples, endpoint).result()
        return judge(scene, course, delivery.result(START_S))


def replay(scene: Scene, pairs: int, samples: int, endpoint: str) -> Course:
    """Run the service over a looped recording in this process and watch its memory."""
    with one_thread():
        recording = AslRecording(scene.folder)
        rig, parameters, stop = recording.rig, TrackingParameters(), Event()
        run = RunContext(rig.name, Source.REPLAY, config_digest="benchmark", rig_digest=rig.digest)
        service = Service(
            looped(recording, pairs),
            lambda pair, previous: track_pair(pair, rig, parameters, previous),
            rig,
            run,
            every_frame=True,
            independent=scene.independent,
        )
        sink = MemorySink(pairs, samples, stop)
        with ZenohPublisher(run, service.status, listen=[endpoint]) as publisher:
            if not publisher.wait_for_subscriber(START_S):
                raise PublishError(f"the subscriber's process did not connect to {endpoint} in {START_S:g} s")
            started_mb = psutil.Process().memory_info().rss / 1e6
            summary = service.run([Published(publisher), sink], stop)
        return Course(
            tuple(sink.at_pair),
            tuple(sink.resident_mb),
            started_mb,
            _peak_mb(),
            summary.pairs,
            summary.duration_s,
        )


def judge(scene: Scene, course: Course, delivery: Delivery) -> Memory:
    """Peak, and growth and slope after the first tenth of the samples, in which buffers and caches fill."""
    tenth = max(len(course.at_pair) // 10, 1)
    at_pair, resident_mb = np.array(course.at_pair[tenth:]), np.array(course.resident_mb[tenth:])
    settled_mb, end_mb = float(np.median(resident_mb[:tenth])), float(np.median(resident_mb[-tenth:]))
    slope = float(theilslopes(resident_mb, at_pair).slope)
    return Memory(
        scene=scene.name,
        pairs=course.pairs,
        pairs_per_s=round(course.pairs / course.duration_s, 3),
        started_mb=round(course.started_mb, 2),
        settled_mb=round(settled_mb, 2),
        end_mb=round(end_mb, 2),
        peak_mb=round(course.peak_mb, 2),
        growth_mb=round(end_mb - settled_mb, 3),
        slope_mb_per_1000=round(slope * 1000, 4),
        flat=end_mb - settled_mb < FLAT_BELOW_MB if course.pairs >= JUDGED_FROM_PAIRS else None,
        flat_below_mb=FLAT_BELOW_MB,
        at_pair=course.at_pair,
        resident_mb=[round(mb, 2) for mb in course.resident_mb],
        delivery=delivery,
    )


def _peak_mb() -> float:
    # VmHWM belongs to this program alone; getrusage's maximum is inherited from the process that started it.
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise OSError("/proc/self/status has no VmHWM: peak memory is known on Linux only")
