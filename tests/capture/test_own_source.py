"""A source that is not V4L2, as docs/cameras.md describes it, through the loop that runs live."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from needletrack.capture.pairing import Paired, Side, StampPairer
from needletrack.capture.source import FrameSource
from needletrack.publish.message import RunContext, Source, TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.records import Clock, DropReason, Frame, Image, NeedleTrack, StereoPair
from needletrack.service import Service
from needletrack.tracking.track import track_pair

STEER = Path(__file__).parents[1] / "data" / "recordings" / "steer-b"
# Only a hang takes so long.
WAIT_S = 60.0


@dataclass
class SdkBuffer:
    """What an SDK hands to its callback: pixels that it will overwrite, and the camera's own stamp."""

    pixels: Image
    timestamp_ns: int


class SdkDevice:
    """A camera of an SDK, which calls back in a thread of its own."""

    def __init__(self) -> None:
        self._callback: Callable[[SdkBuffer], None] = lambda buffer: None

    def on_frame(self, callback: Callable[[SdkBuffer], None]) -> None:
        self._callback = callback

    def acquire(self, pixels: Image, timestamp_ns: int) -> None:
        scratch = pixels.copy()
        self._callback(SdkBuffer(scratch, timestamp_ns))
        scratch[:] = 0


class SdkSource:
    """Pairs of two devices of an SDK."""

    def __init__(self, left: SdkDevice, right: SdkDevice) -> None:
        self._arrived: queue.Queue[tuple[Side, Frame]] = queue.Queue(16)
        self._dropped: Counter[DropReason] = Counter()
        sides: tuple[tuple[Side, SdkDevice], ...] = (("left", left), ("right", right))
        for side, device in sides:
            device.on_frame(partial(self._take, side))

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        return dict(self._dropped)

    def _take(self, side: Side, buffer: SdkBuffer) -> None:
        frame = Frame(buffer.pixels.copy(), buffer.timestamp_ns)
        try:
            self._arrived.put_nowait((side, frame))
        except queue.Full:
            self._dropped[DropReason.LOST_BY_DRIVER] += 1

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        pairer: StampPairer[Frame] = StampPairer(tolerance_ns=1_000_000, period_ns=15_000_000)
        sequence = 0
        while not stop.is_set():
            try:
                side, frame = self._arrived.get(timeout=0.1)
            except queue.Empty:
                continue
            for decided in pairer.add(side, frame.captured_at_ns, frame):
                if isinstance(decided, Paired):
                    arrived_ns = time.monotonic_ns()
                    yield StereoPair(decided.left, decided.right, sequence, Clock.MONOTONIC, arrived_at_ns=arrived_ns)
                    sequence += 1
                else:
                    self._dropped[decided.reason] += 1


def test_frames_of_an_sdk_become_tracks() -> None:
    recording = AslRecording(STEER)
    rig, stop = recording.rig, threading.Event()
    left, right = SdkDevice(), SdkDevice()
    source: FrameSource = SdkSource(left, right)
    messages: list[TrackMessage] = []
    taken = threading.Semaphore(0)

    class Kept:
        def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
            messages.append(message)
            taken.release()

    def cameras() -> None:
        for number in range(3):
            pair, now_ns = recording.read(number), time.monotonic_ns()
            left.acquire(pair.left.image, now_ns)
            if number == 1:
                continue  # the right camera lost one
            right.acquire(pair.right.image, now_ns + 20_000)
            assert taken.acquire(timeout=WAIT_S)
        stop.set()

    def tracker(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        return track_pair(pair, rig, None, previous)

    run = RunContext(rig.name, Source.LIVE, "c" * 12, rig.digest)
    acquisition = threading.Thread(target=cameras)
    acquisition.start()
    summary = Service(source, tracker, rig, run).run([Kept()], stop)
    acquisition.join()
    assert [message.sequence for message in messages] == [0, 1]
    assert summary.dropped == {DropReason.UNPAIRED_LEFT: 1}
    assert all(message.centerline_mm for message in messages)
    assert {message.quality.pair_skew_us for message in messages} == {20.0}


def test_what_nobody_takes_is_counted() -> None:
    left, right = SdkDevice(), SdkDevice()
    source = SdkSource(left, right)
    image = AslRecording(STEER).read(0).left.image
    for number in range(20):
        left.acquire(image, number)
    assert source.dropped == {DropReason.LOST_BY_DRIVER: 4}


@pytest.mark.parametrize("line", ["StampPairer(tolerance_ns=1_000_000, period_ns=15_000_000)", "put_nowait"])
def test_the_page_shows_this_source(line: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "cameras.md").read_text(encoding="utf-8")
    assert line in page
    assert line in Path(__file__).read_text(encoding="utf-8")
