"""The live loop under load: `python -m benchmarks.live RECORDING --minutes 10 --rate 60`.

Pairs are held in memory, so that decoding does not count, and released at a steady rate, stamped as a camera would;
they are tracked, recorded, and published to a subscriber in another process. Printed: the share tracked, every loss
with its reason, latency and its parts from the messages, latency as the subscriber saw it, and memory over time.
"""

import argparse
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import psutil

from benchmarks.threads import one_thread
from needletrack.auditing import AuditedTracker
from needletrack.config import load_config
from needletrack.daemon.process import settle_memory
from needletrack.daemon.run import RecordedSource
from needletrack.publish.message import RunContext, Source, TrackMessage, WireRecording
from needletrack.publish.publisher import ZenohPublisher
from needletrack.recording.mcap_file import About
from needletrack.recording.recorder import Recorder, RecorderSettings
from needletrack.records import Clock, DropReason, NeedleTrack, StereoPair
from needletrack.replay import open_recording
from needletrack.service import RunSummary, Service, Sink, Surroundings
from needletrack.terminal import read_summary
from needletrack.watch import WatchSummary

PARTS = ("capture", "queue", "track")
_FILE_MB = 1000
_SUBSCRIBED_WITHIN_S = 60.0
# What is loaded and cached in the first tenth is no growth.
_SETTLED_AFTER = 0.1


class MemorySource:
    """Pairs out of memory, forward and backward in turn, so many a second; what cannot be released in time is late."""

    def __init__(self, pairs: list[StereoPair], rate_hz: float, seconds: float) -> None:
        self._pairs, self._rate_hz, self._count = pairs, rate_hz, round(rate_hz * seconds)
        self.released = 0

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Nothing is lost here."""
        return {}

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        """Release the pairs, stamped with this moment."""
        there_and_back = [*range(len(self._pairs)), *range(len(self._pairs) - 2, 0, -1)]
        began_s = time.monotonic()
        for number in range(self._count):
            if stop.wait(max(began_s + number / self._rate_hz - time.monotonic(), 0.0)):
                return
            pair = self._pairs[there_and_back[number % len(there_and_back)]]
            now_ns = time.monotonic_ns()
            self.released += 1
            yield replace(
                pair,
                left=replace(pair.left, captured_at_ns=now_ns),
                right=replace(pair.right, captured_at_ns=now_ns),
                sequence=number,
                clock=Clock.MONOTONIC,
                arrived_at_ns=now_ns,
            )


@dataclass
class Figures:
    """A sink that keeps what the messages say of their latency."""

    latency_ms: list[float] = field(default_factory=list)
    parts_ms: dict[str, list[float]] = field(default_factory=lambda: {part: [] for part in PARTS})

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Note one message's times."""
        assert message.latency_ms is not None
        assert message.timing_ms is not None
        self.latency_ms.append(message.latency_ms)
        for part in PARTS:
            self.parts_ms[part].append(message.timing_ms[part])


@dataclass(frozen=True)
class Load:
    """What a run under load gave; resident_mb: (seconds, daemon, recorder) once a second."""

    released: int
    run: RunSummary
    figures: Figures
    received: WatchSummary
    recorded: int | None
    unrecorded: int | None
    resident_mb: list[tuple[float, float, float]]
    cpu_s: float
    recorder_cpu_s: float

    @property
    def share_tracked(self) -> float:
        """Of the pairs released."""
        return self.run.pairs / self.released

    @property
    def unaccounted(self) -> int:
        """Pairs that are neither tracked nor counted with a reason: none, or there is a defect."""
        return self.released - self.run.pairs - sum(self.run.dropped.values())

    def growth(self, which: int) -> float:
        """How much the memory of the daemon (1) or the recorder (2) moved from its median, as a share, once settled."""
        settled = [row[which] for row in self.resident_mb[int(len(self.resident_mb) * _SETTLED_AFTER) :]]
        middle = float(np.median(settled))
        return max(abs(max(settled) - middle), abs(min(settled) - middle)) / middle if middle else 0.0

    def __str__(self) -> str:
        """The figures, a line each."""
        lost = ", ".join(f"{reason.value} {count}" for reason, count in self.run.dropped.items()) or "none"
        spent_s, received = self.run.duration_s, self.received
        share = f"{100 * self.share_tracked:.1f} %; lost: {lost}; unaccounted {self.unaccounted}"
        seen = f"p50 / p99 {received.latency_ms_p50} / {received.latency_ms_p99} ms, stamp to receipt"
        lines = [
            f"released   {self.released} pairs, {self.released / spent_s:.1f} pairs/s for {spent_s:.0f} s",
            f"tracked    {self.run.pairs}, {share}",
            f"latency    p50 / p99 {_two(self.figures.latency_ms)} ms, stamp to publishing, in the message",
            *(f"  {part:8} p50 / p99 {_two(self.figures.parts_ms[part])} ms" for part in PARTS),
            f"subscriber {received.messages} received, {received.lost} lost on the way, {seen}",
        ]
        if self.recorded is not None:
            lines.append(f"recorded   {self.recorded}, not recorded {self.unrecorded}")
        lines.append(
            f"memory     daemon {self.resident_mb[-1][1]:.0f} MB ± {100 * self.growth(1):.1f} %, recorder "
            f"{self.resident_mb[-1][2]:.0f} MB ± {100 * self.growth(2):.1f} %, after the first tenth"
        )
        lines.append(f"cores      daemon {self.cpu_s / spent_s:.2f}, recorder {self.recorder_cpu_s / spent_s:.2f}")
        return "\n".join(lines)


def under_load(recording: Path, rate_hz: float, seconds: float, *, record: Path | None, track: bool = True) -> Load:
    """Run the live loop over a recording's pairs at a rate; record: folder for the files, which are not kept.

    track: False finds nothing at once, so that the recorder can be measured alone.
    """
    config = load_config()
    stored = open_recording(recording, config)
    pairs = [stored.read(index) for index in range(len(stored))]
    rig = stored.rig
    context = RunContext(rig.name, Source.LIVE, config.digest, rig.digest)
    audited = AuditedTracker(rig, config.tracking) if track else None
    source = MemorySource(pairs, rate_hz, seconds)
    figures, stop = Figures(), threading.Event()
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(dir=record)))
        recorder = None
        if record is not None:
            settings = RecorderSettings(folder, max_file_mb=_FILE_MB)
            recorder = opened.enter_context(Recorder(settings, About(rig, rig.name), rig.left.size_px))
        recorded_source = source if recorder is None else RecordedSource(source, recorder)
        if audited is not None:
            opened.enter_context(audited)
        service = Service(
            recorded_source, audited or _nothing, rig, context, surroundings=lambda: _surroundings(recorder)
        )
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        publisher = opened.enter_context(ZenohPublisher(context, service.status, listen=[endpoint]))
        report = folder / "received.json"
        watching = _subscriber(rig.name, endpoint, report)
        if audited is not None:
            audited.warm_up()
            audited(pairs[0], None)
        settle_memory()
        assert publisher.wait_for_subscriber(_SUBSCRIBED_WITHIN_S)
        cpu = _cpu_s(psutil.Process())
        sinks: list[Sink] = [_Publish(publisher), figures, *([] if recorder is None else [recorder])]
        # Until the run ends: a recorder that is closed gives its memory back.
        with _MemoryProbe(recorder, folder) as memory:
            run = service.run(sinks, stop)
        cpu_s = _cpu_s(psutil.Process()) - cpu
        recorder_cpu_s = 0.0 if recorder is None else _cpu_s(psutil.Process(recorder.pid))
        publisher.close()
        watching.wait(_SUBSCRIBED_WITHIN_S)
        if recorder is not None:
            recorder.close(30.0)
        return Load(
            source.released,
            run,
            figures,
            read_summary(report),
            None if recorder is None else recorder.recorded,
            None if recorder is None else recorder.dropped,
            memory.rows,
            cpu_s,
            recorder_cpu_s,
        )


class _Publish:
    def __init__(self, publisher: ZenohPublisher) -> None:
        self._publisher = publisher

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self._publisher.publish(message)


class _MemoryProbe:
    """Resident memory of both processes once a second; older files of the recording are removed meanwhile."""

    def __init__(self, recorder: Recorder | None, folder: Path) -> None:
        self.rows: list[tuple[float, float, float]] = []
        self._processes = [psutil.Process(), *([] if recorder is None else [psutil.Process(recorder.pid)])]
        self._folder, self._stop = folder, threading.Event()
        self._thread = threading.Thread(target=self._probe, daemon=True)

    def __enter__(self) -> "_MemoryProbe":
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        self._thread.join()

    def _probe(self) -> None:
        began_s = time.monotonic()
        while True:
            resident = [process.memory_info().rss / 1e6 for process in self._processes]
            self.rows.append((time.monotonic() - began_s, resident[0], resident[1] if len(resident) > 1 else 0.0))
            for done in sorted(self._folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)[:-1]:
                done.unlink()
            if self._stop.wait(1.0):
                return


def _nothing(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
    from needletrack.records import Reason, Status

    return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))


def _surroundings(recorder: Recorder | None) -> Surroundings:
    if recorder is None:
        return Surroundings()
    state = recorder.state
    return Surroundings(
        recording=WireRecording(
            file=state.file,
            pairs=recorder.recorded,
            dropped=recorder.dropped,
            megabytes=state.megabytes,
            error=state.error,
        )
    )


def _subscriber(rig: str, endpoint: str, report: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "needletrack", "watch", rig, "--connect", endpoint, "--until-gone"]
    return subprocess.Popen([*command, "--report", str(report)], stdout=subprocess.DEVNULL)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _two(values: list[float]) -> str:
    p50, p99 = np.percentile(values, [50, 99]) if values else (0.0, 0.0)
    return f"{p50:.1f} / {p99:.1f}"


def main(arguments: list[str] | None = None) -> int:
    """Run what the command line asks for; 1 where the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?", default=Path("tests/data/recordings/steer-b"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=60.0, help="pairs a second")
    parser.add_argument("--record", type=Path, default=Path("build"), help="folder on the disk to record to")
    parser.add_argument("--no-record", action="store_true")
    parser.add_argument("--no-track", action="store_true", help="the recorder alone")
    asked = parser.parse_args(arguments)
    asked.record.mkdir(parents=True, exist_ok=True)
    # As in the daemon: a second thread of BLAS makes products of this size slower, and takes the recorder's core.
    with one_thread():
        load = under_load(
            asked.recording,
            asked.rate,
            60 * asked.minutes,
            record=None if asked.no_record else asked.record,
            track=not asked.no_track,
        )
    print(load)
    met = {
        "95 % tracked": load.share_tracked >= 0.95,
        "every pair accounted for": load.unaccounted == 0,
        "memory flat within 5 %": max(load.growth(1), load.growth(2)) <= 0.05,
        "every pair recorded": not load.unrecorded,
    }
    for bar, reached in met.items():
        print(f"{'met   ' if reached else 'MISSED'} {bar}")
    return 0 if all(met.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
