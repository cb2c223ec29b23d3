"""The demo: a recording at its own pace, through the live loop, to a subscriber in another process."""

import math
import socket
import subprocess
import sys
import threading
import time
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from needletrack.config import Config, load_config
from needletrack.errors import PublishError, RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.recording.replay import StoredRecording
from needletrack.recording.tracks import TrackFile
from needletrack.records import NeedleTrack, Status, StereoPair
from needletrack.replay import Published, Replay, open_recording
from needletrack.rig import Rig
from needletrack.service import RunSummary
from needletrack.terminal import counted, read_summary, statuses_text
from needletrack.tracking.track import track_pair
from needletrack.watch import WatchSummary

# A loaded machine takes seconds to start a Python process.
_SUBSCRIBED_WITHIN_S = 60.0
_GONE_WITHIN_S = 30.0

_RANK = {Status.INVALID: 0, Status.DEGRADED: 1, Status.OK: 2}


class SubscriberFailed(PublishError):
    """The subscriber's process failed, or did not do what it was started for."""


@dataclass(frozen=True, slots=True)
class LeftFile:
    """A file that the demo left, and what is in it."""

    name: str
    content: str


@dataclass(frozen=True, slots=True)
class DemoReport:
    """What the demo did: the run as this process counted it and as the subscriber did; the files in `folder`."""

    run: RunSummary
    received: WatchSummary
    folder: Path
    files: tuple[LeftFile, ...]

    def __str__(self) -> str:
        """The summary at the end of the demo."""
        run, received = self.run, self.received
        p50_ms, p99_ms = _number(received.latency_ms_p50), _number(received.latency_ms_p99)
        dropped = counted(run.dropped) or "none"
        lines = [
            f"pairs     {run.pairs} tracked in {run.duration_s:.1f} s; dropped: {dropped}",
            f"status    {statuses_text(run)}",
            f"received  {received.messages} tracks by the other process, {received.lost} lost on the way",
            f"rate      {_number(received.rate_hz)} tracks a second",
            f"latency   p50 {p50_ms} ms, p99 {p99_ms} ms, from the release of a pair to its receipt",
            f"\nin {self.folder}",
            *(f"  {file.name:24}  {file.content}" for file in self.files),
        ]
        return "\n".join(lines)


def run_demo(folder: Path, output: Path, *, seconds: float, stop: threading.Event) -> DemoReport:
    """Play a recording forward and backward for about `seconds`, and leave pictures and tracks in a folder.

    The subscriber has this process's terminal to itself meanwhile. Raises SubscriberFailed, and
    NeedletrackError where recording, rig, configuration or folder cannot be used.
    """
    config = load_config()
    recording = open_recording(folder, config)
    end, loop = _played(recording, seconds)
    replay = Replay(recording, config, paced=True, end=end, loop=loop)
    _make_folder(output)
    kept = _Kept()
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    with ExitStack() as opened:
        tracks = opened.enter_context(TrackFile(output / "tracks.jsonl"))
        publisher = opened.enter_context(replay.publisher(endpoint))
        subscriber = opened.enter_context(
            _Subscriber(publisher, endpoint, config.publishing.key_prefix, output / "received.json", stop)
        )
        replay.warm_up()  # while the other process starts
        subscriber.wait_until_there()
        run = replay.service.run([Published(publisher), tracks, kept], stop)
        publisher.close()  # which the subscriber is waiting for
        received = subscriber.finish(run)
    files = _pictures(kept, recording.rig, config, output, folder.resolve().name)
    files.append(LeftFile(tracks.path.name, "every track, one message a line"))
    files.append(LeftFile(subscriber.report.name, "what the subscriber counted"))
    return DemoReport(run, received, output, tuple(files))


class _Subscriber:
    """`needletrack watch` in a process of its own, on this terminal; sets `stop` when it ends."""

    def __init__(
        self,
        publisher: ZenohPublisher,
        endpoint: str,
        key_prefix: str,
        report: Path,
        stop: threading.Event,
    ) -> None:
        self.report = report
        self._publisher, self._stop = publisher, stop
        report.unlink(missing_ok=True)
        command = [sys.executable, "-m", "needletrack", "watch", publisher.keys.rig, "--until-gone"]
        command += ["--connect", endpoint, "--key-prefix", key_prefix, "--report", str(report)]
        sys.stdout.flush()
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        # Otherwise the replay would go on for nobody.
        threading.Thread(target=self._stop_when_ended, name="needletrack-demo", daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        self._process.wait()

    def wait_until_there(self) -> None:
        """Return once it has subscribed, or once `stop` is set by a person."""
        deadline_s = time.monotonic() + _SUBSCRIBED_WITHIN_S
        while not self._publisher.wait_for_subscriber(0.1):
            self._require_alive()
            if self._stop.is_set():
                return
            if time.monotonic() > deadline_s:
                raise SubscriberFailed(f"the subscriber did not subscribe within {_SUBSCRIBED_WITHIN_S:g} s")

    def finish(self, run: RunSummary) -> WatchSummary:
        """What it received, once it has ended by itself."""
        try:
            code = self._process.wait(_GONE_WITHIN_S)
        except subprocess.TimeoutExpired:
            raise SubscriberFailed(
                f"the subscriber has not noticed within {_GONE_WITHIN_S:g} s that the publisher has gone"
            ) from None
        if code != 0:
            raise SubscriberFailed(f"the subscriber ended with code {code}")
        received = read_summary(self.report)
        if received.messages == 0 and run.pairs > 0:
            raise SubscriberFailed(f"the subscriber received none of {run.pairs} tracks")
        return received

    def _require_alive(self) -> None:
        if (code := self._process.poll()) is not None:
            raise SubscriberFailed(f"the subscriber ended with code {code} before it had subscribed")

    def _stop_when_ended(self) -> None:
        self._process.wait()
        self._stop.set()


class _Kept:
    """A sink that keeps all messages, and the best track with its pair."""

    def __init__(self) -> None:
        self.messages: list[TrackMessage] = []
        self.best: tuple[StereoPair, NeedleTrack] | None = None

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """One more."""
        self.messages.append(message)
        if self.best is None or _worth(track) > _worth(self.best[1]):
            self.best = (pair, track)


def _worth(track: NeedleTrack) -> tuple[int, int, float]:
    """Which of two tracks is better: ok before degraded, few reasons before many, then the surer one."""
    sigma_mm = math.inf if track.curve is None else float(track.curve.sigma_mm.max())
    return _RANK[track.status], -len(track.reasons), -sigma_mm


def _pictures(kept: _Kept, rig: Rig, config: Config, output: Path, name: str) -> list[LeftFile]:
    if kept.best is None:
        return []
    # matplotlib: not needed before, and slow to import.
    from needletrack.pictures.files import write_pictures
    from needletrack.pictures.png import write_png
    from needletrack.pictures.timeline import Moment, timeline_figure

    pair, track = kept.best
    if track.evidence.correspondences is None:
        # A followed track has matched no points: found anew, the pictures show how it was found.
        anew = track_pair(pair, rig, config.tracking)
        track = anew if _RANK[anew.status] >= _RANK[track.status] else track
    contents = (
        f"both views of pair {pair.sequence} ({track.status.value}) with the curve projected into them",
        "the distance of its right points from its left points' epipolar lines",
        "its shape in space, from several sides",
    )
    paths = write_pictures(track, pair, rig, output, "needle")
    moments = [Moment.of_message(message) for message in kept.messages]
    timeline = write_png(timeline_figure(moments, f"{name} at its own pace"), output / "timeline.png")
    pictures = [LeftFile(path.name, content) for path, content in zip(paths, contents, strict=True)]
    return [*pictures, LeftFile(timeline.name, "tip, length, residual and latency over time")]


def _played(recording: StoredRecording, seconds: float) -> tuple[int, int]:
    """How many pairs, and how often in turns forward and backward, last about so long."""
    stamps_ns: Sequence[int] = [pair.left.stamp_ns for pair in recording.pairs]
    end = max(1, bisect_right(stamps_ns, stamps_ns[0] + seconds * 1e9))
    pass_s = (stamps_ns[end - 1] - stamps_ns[0]) / 1e9
    return end, max(1, round(seconds / pass_s)) if pass_s > 0 else 1


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder}: no such folder can be made: {error.strerror or error}") from error


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _number(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.1f}"
