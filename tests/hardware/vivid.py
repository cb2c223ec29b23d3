"""The kernel's vivid cameras and how to break them, through handles of our own, as another process would."""

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import Structure, c_int
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.camera import find_cameras
from needletrack.capture.kernel import LinuxKernel
from needletrack.capture.live import LiveSource
from needletrack.capture.settings import CamerasSettings
from needletrack.capture.v4l2_abi import Request
from needletrack.records import StereoPair

LEFT, RIGHT = "platform:vivid-000", "platform:vivid-001"
SIZE_PX = (640, 360)
_DRIVER = Path("/sys/bus/platform/drivers/vivid")
# The guest's processor is emulated: only a hang takes so long.
WAIT_S = 90.0


def vivid_nodes() -> list[str]:
    """The nodes of vivid's capture devices."""
    names = Path("/sys/class/video4linux").glob("*/name")
    return sorted(f"/dev/{path.parent.name}" for path in names if path.read_text().startswith("vivid-"))


def node_of(bus: str) -> str:
    """Where a camera is now."""
    found, _ = find_cameras(LinuxKernel())
    return next(camera.node.path for camera in found if camera.bus_info == bus)


def control(bus: str, **values: int) -> None:
    """Set controls of a camera: `v4l2-ctl -c name=value`."""
    for name, value in values.items():
        subprocess.run(["v4l2-ctl", "-d", node_of(bus), "-c", f"{name}={value}"], check=True, capture_output=True)


def unbind() -> None:
    """Unplug both cameras."""
    (_DRIVER / "unbind").write_text("vivid.0")


def bind() -> None:
    """Plug both in again."""
    (_DRIVER / "bind").write_text("vivid.0")


def unbound() -> bool:
    """Whether both are unplugged."""
    return not (_DRIVER / "vivid.0").exists()


def wait_for(condition: Callable[[], bool]) -> None:
    until_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until_s, "it never came"
        time.sleep(0.02)


def settings(**values: Any) -> CamerasSettings:
    plain = {"size_px": SIZE_PX, "rate_hz": 10.0, "left": {"id": LEFT}, "right": {"id": RIGHT}}
    return CamerasSettings.model_validate(plain | values)


@dataclass
class Dequeued:
    """What the kernel handed out, as seen at the edge."""

    bus: str
    sequence: int
    error: bool
    stamp_ns: int


class SpyKernel(LinuxKernel):
    """The kernel, with a note of every buffer that it hands out."""

    def __init__(self) -> None:
        self.dequeued: list[Dequeued] = []
        self.refused_queues = 0
        self._bus: dict[int, str] = {}

    def ioctl(self, descriptor: int, request: Request, argument: Structure | c_int) -> None:
        try:
            super().ioctl(descriptor, request, argument)
        except OSError:
            self.refused_queues += request is Request.QBUF
            raise
        if isinstance(argument, abi.Capability):
            self._bus[descriptor] = argument.bus_info.decode()
        elif request is Request.REQBUFS:
            capability = abi.Capability()
            super().ioctl(descriptor, Request.QUERYCAP, capability)
            self._bus[descriptor] = capability.bus_info.decode()
        elif request is Request.DQBUF and isinstance(argument, abi.Buffer):
            stamp_ns = argument.timestamp.seconds * 10**9 + argument.timestamp.microseconds * 1000
            error = bool(argument.flags & abi.BUF_FLAG_ERROR)
            self.dequeued.append(Dequeued(self._bus[descriptor], argument.sequence, error, stamp_ns))

    def of(self, bus: str) -> list[Dequeued]:
        return [each for each in self.dequeued if each.bus == bus]

    def gaps(self, bus: str) -> int:
        """Sequence numbers that were left out; where they begin anew, nothing was."""
        numbers = [each.sequence for each in self.of(bus)]
        return sum(max(later - earlier - 1, 0) for earlier, later in pairwise(numbers))


@dataclass
class Running:
    """A source that runs in a thread, and what it gave."""

    source: LiveSource
    kernel: SpyKernel
    stop: threading.Event = field(default_factory=threading.Event)
    pairs: list[StereoPair] = field(default_factory=list)
    error: BaseException | None = None

    def run(self) -> None:
        try:
            for pair in self.source.pairs(self.stop):
                self.pairs.append(pair)
        except BaseException as error:
            self.error = error

    def more(self, count: int = 3) -> None:
        """Wait for so many further pairs."""
        target = len(self.pairs) + count
        wait_for(lambda: len(self.pairs) >= target or self.error is not None)
        assert self.error is None, self.error


@contextmanager
def running(**values: Any) -> Iterator[Running]:
    """Both cameras, which are not in step: a pair is whatever is nearest."""
    kernel = SpyKernel()
    ran = Running(LiveSource(settings(**values), tolerance_us=50_000, kernel=kernel), kernel)
    thread = threading.Thread(target=ran.run)
    thread.start()
    try:
        yield ran
    finally:
        ran.stop.set()
        thread.join()


def accounted_for(ran: Running) -> None:
    """The counters against the note taken at the edge, exactly: call it after the source has ended."""
    health, dropped = ran.source.health, ran.source.dropped
    counted = {reason.value: count for reason, count in dropped.items()}
    for side, bus in (("left", LEFT), ("right", RIGHT)):
        of_camera = health[side]  # type: ignore[index]
        assert of_camera.frames == len(ran.kernel.of(bus))
        assert of_camera.buffer_errors == sum(each.error for each in ran.kernel.of(bus))
        assert of_camera.lost_by_driver == ran.kernel.gaps(bus)
    assert counted.get("lost_by_driver", 0) == ran.kernel.gaps(LEFT) + ran.kernel.gaps(RIGHT)
    assert counted.get("buffer_error", 0) == sum(each.error for each in ran.kernel.dequeued)
    singles = sum(
        counted.get(name, 0) for name in ("unpaired_left", "unpaired_right", "stamp_out_of_order", "buffer_error")
    )
    assert len(ran.kernel.dequeued) == 2 * len(ran.pairs) + singles
    stamps = {each.stamp_ns for each in ran.kernel.dequeued}
    assert {pair.left.captured_at_ns for pair in ran.pairs} <= stamps
    assert {pair.right.captured_at_ns for pair in ran.pairs} <= stamps
