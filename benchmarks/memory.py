"""Resident memory over many pairs, in a process of its own that does what the daemon does."""

import sys
from dataclasses import dataclass
from multiprocessing import active_children
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import numpy as np
import psutil
from scipy.stats import theilslopes

from benchmarks.loopback import START_S, free_endpoint, fresh_process, subscribed
from benchmarks.plan import Plan
from benchmarks.report import Delivery, Memory
from benchmarks.threads import one_thread
from benchmarks.worker import run_of
from benchmarks.worlds import Playing, Sequence
from needletrack.auditing import AuditedTracker
from needletrack.daemon.process import settle_memory
from needletrack.errors import PublishError
from needletrack.publish.message import TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.records import Frame, NeedleTrack, StereoPair
from needletrack.replay import Published
from needletrack.rig import Rig
from needletrack.service import Service
from needletrack.tracking.parameters import TrackingParameters

# A hundredth of what the daemon may have, and about 500 bytes a pair over ten thousand pairs.
FLAT_BELOW_MB = 4.0
# Until then buffers and the allocator's arenas still fill.
JUDGED_FROM_PAIRS = 1000
# Kept in memory, and told apart.
FRAMES = 16


@dataclass(frozen=True)
class Course:
    """Resident memory at each sample, before the first pair, and its peak, megabytes (10^6 bytes).

    frames_mb: the frames in it; blocks: of Python's allocator, at each sample.
    """

    at_pair: tuple[int, ...]
    resident_mb: tuple[float, ...]
    started_mb: float
    peak_mb: float
    pairs: int
    duration_s: float
    frames_mb: float
    audit_process_mb: float
    blocks: tuple[int, ...]


class MemorySink:
    """The service's sink that samples this process's memory and stops the run after so many pairs."""

    def __init__(self, pairs: int, samples: int, stop: Event) -> None:
        self.at_pair: list[int] = []
        self.resident_mb: list[float] = []
        self.blocks: list[int] = []
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
            self.blocks.append(sys.getallocatedblocks())
        if self._seen >= self._pairs:
            self._stop.set()


def measure_memory(sequence: Sequence, plan: Plan) -> Memory:
    """Track so many pairs, looped, in a fresh process, published to a subscriber in a third."""
    endpoint, rig = free_endpoint(), sequence.rig
    pairs = sequence.pairs[:FRAMES]
    with TemporaryDirectory() as folder:
        frames = Path(folder, "frames.npy")
        np.save(frames, np.stack([[pair.left.image, pair.right.image] for pair in pairs]))
        with subscribed(rig.name, endpoint) as delivery, fresh_process() as process:
            course = process.submit(
                replay, frames, rig, sequence.rate_hz, plan.memory_pairs, plan.samples, endpoint
            ).result()
            return judge(sequence.name, course, delivery.result(START_S))


def replay(frames: Path, rig: Rig, rate_hz: float, pairs: int, samples: int, endpoint: str) -> Course:
    """Run the service over a looped sequence in this process and watch its memory."""
    with one_thread():
        taken = [StereoPair(Frame(left, 0), Frame(right, 0), 0) for left, right in np.load(frames)]
        sequence = Sequence("", rig, tuple(taken), rate_hz)
        run, stop = run_of(rig), Event()
        sink = MemorySink(pairs, samples, stop)
        with AuditedTracker(rig, TrackingParameters()) as tracker:
            service = Service(Playing(sequence), tracker, rig, run, every_frame=True)
            with ZenohPublisher(run, service.status, listen=[endpoint]) as publisher:
                if not publisher.wait_for_subscriber(START_S):
                    raise PublishError(f"the subscriber's process did not connect to {endpoint} in {START_S:g} s")
                tracker.warm_up()
                settle_memory()
                started_mb = psutil.Process().memory_info().rss / 1e6
                summary = service.run([Published(publisher), sink], stop)
            (auditor,) = (child for child in active_children() if child.name == "needletrack-audit")
            audit_process_mb = psutil.Process(auditor.pid).memory_info().rss / 1e6
        return Course(
            tuple(sink.at_pair),
            tuple(sink.resident_mb),
            started_mb,
            _peak_mb(),
            summary.pairs,
            summary.duration_s,
            sequence.frames_mb,
            audit_process_mb,
            tuple(sink.blocks),
        )


def judge(name: str, course: Course, delivery: Delivery) -> Memory:
    """Peak, and growth and slope after the first tenth of the samples, in which buffers and caches fill."""
    tenth = max(len(course.at_pair) // 10, 1)
    at_pair, resident_mb = np.array(course.at_pair[tenth:]), np.array(course.resident_mb[tenth:])
    settled_mb, end_mb = float(np.median(resident_mb[:tenth])), float(np.median(resident_mb[-tenth:]))
    blocks = np.array(course.blocks[tenth:])
    slope = float(theilslopes(resident_mb, at_pair).slope)
    return Memory(
        scene=name,
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
        frames_mb=round(course.frames_mb, 2),
        audit_process_mb=round(course.audit_process_mb, 2),
        allocated_blocks_growth=round(float(np.median(blocks[-tenth:]) - np.median(blocks[:tenth]))),
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
