"""Cameras of our own making behind the ioctl edge: the driver above it cannot tell them from the kernel's."""

import errno
import os
import select
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from ctypes import Structure, c_int
from dataclasses import dataclass, field
from threading import Event
from typing import TypeVar

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.kernel import Node
from needletrack.capture.v4l2_abi import Request

T = TypeVar("T")
MONOTONIC = abi.BUF_FLAG_TIMESTAMP_MONOTONIC
START = abi.BUF_FLAG_TSTAMP_SRC_SOE


def refusal(number: int) -> OSError:
    return OSError(number, os.strerror(number))


@dataclass
class FakeControl:
    id: int
    name: str
    minimum: int
    maximum: int
    value: int
    type: int = abi.ControlType.INTEGER
    step: int = 1
    # What the driver makes of a value: a real one rounds or clips without a word.
    becomes: Callable[[int], int] = lambda value: value
    entries: tuple[str, ...] = ()


def usual_controls() -> list[FakeControl]:
    return [
        FakeControl(abi.CID_GAIN, "Gain", 0, 100, 10),
        FakeControl(abi.CID_EXPOSURE_AUTO, "Exposure, Auto", 0, 3, 3, abi.ControlType.MENU, entries=("Auto", "Manual")),
        FakeControl(abi.CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 10_000, 156),
        FakeControl(0x009A0FF0, "Trigger Mode", 0, 1, 0, abi.ControlType.BOOLEAN),
    ]


@dataclass
class FakeCamera:
    """A camera that is plugged in as `node`; `deliver` fills its next buffer."""

    node: str
    bus: str
    serial: str = ""
    index: int = 0
    card: str = "Fake Camera"
    formats: dict[str, list[tuple[int, int]]] = field(default_factory=lambda: {"GREY": [(8, 4)]})
    rates_hz: tuple[float, ...] = (30.0, 60.0)
    controls: list[FakeControl] = field(default_factory=usual_controls)
    stride: int = 16
    caps: int = abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
    flags: int = MONOTONIC | START
    most_buffers: int = 32
    openable: bool = True
    plugged: bool = True
    streaming: bool = False
    # Requests that fail, each so many times, with which error.
    faults: dict[Request, list[int]] = field(default_factory=dict)
    sequence: int = 0
    events: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.format = (abi.fourcc("GREY"), *self.formats.get("GREY", [(8, 4)])[0])
        self.buffers: list[bytearray] = []
        self.queued: deque[int] = deque()
        self.done: deque[abi.Buffer] = deque()
        self.streaming = False
        self.owner = 0

    @property
    def size(self) -> int:
        return self.stride * self.format[2]

    def deliver(
        self, stamp_us: int, data: bytes | None = None, *, error: bool = False, used: int | None = None, skip: int = 0
    ) -> None:
        """One frame; skip: so many before it were lost in the driver."""
        if not self.streaming:
            return
        self.sequence += skip
        if not self.queued:
            self.sequence += 1  # as a driver does that has no buffer
            return
        index = self.queued.popleft()
        content = data if data is not None else bytes([self.sequence % 256]) * self.size
        self.buffers[index][: len(content)] = content
        buffer = abi.Buffer(index=index, type=abi.CAPTURE, sequence=self.sequence)
        buffer.bytesused = len(content) if used is None else used
        buffer.flags = self.flags | (abi.BUF_FLAG_ERROR if error else 0)
        buffer.timestamp.seconds, buffer.timestamp.microseconds = divmod(stamp_us, 1_000_000)
        self.sequence += 1
        self.done.append(buffer)

    def answer(self, request: Request, argument: Structure | c_int) -> None:
        if not self.plugged:
            raise refusal(errno.ENODEV)
        if pending := self.faults.get(request):
            raise refusal(pending.pop(0))
        getattr(self, f"_{request.name.lower()}")(argument)

    def _querycap(self, capability: abi.Capability) -> None:
        capability.card, capability.bus_info = self.card.encode(), self.bus.encode()
        capability.capabilities, capability.device_caps = self.caps | abi.CAP_DEVICE_CAPS, self.caps

    def _enum_fmt(self, entry: abi.FormatDescription) -> None:
        entry.pixelformat = abi.fourcc(self._nth(list(self.formats), entry.index))

    def _enum_framesizes(self, entry: abi.FrameSize) -> None:
        sizes = self.formats.get(abi.fourcc_text(entry.pixel_format).rstrip(), [])
        entry.type = abi.FRAME_DISCRETE
        entry.values[0], entry.values[1] = self._nth(sizes, entry.index)

    def _enum_frameintervals(self, entry: abi.FrameInterval) -> None:
        entry.type = abi.FRAME_DISCRETE
        entry.values[0].numerator, entry.values[0].denominator = 1, int(self._nth(self.rates_hz, entry.index))

    def _s_fmt(self, request: abi.Format) -> None:
        pix = request.fmt.pix
        name = abi.fourcc_text(pix.pixelformat).rstrip()
        name = name if name in self.formats else next(iter(self.formats))
        size = (pix.width, pix.height) if (pix.width, pix.height) in self.formats[name] else self.formats[name][0]
        pix.pixelformat, (pix.width, pix.height) = abi.fourcc(name), size
        pix.bytesperline, pix.sizeimage = self.stride, self.stride * pix.height
        self.format = (pix.pixelformat, *size)

    def _s_parm(self, request: abi.StreamParameters) -> None:
        capture = request.parm.capture
        if not self.rates_hz:
            return
        wanted = capture.timeperframe.denominator / capture.timeperframe.numerator
        capture.capability = abi.CAP_TIMEPERFRAME
        nearest = min(self.rates_hz, key=lambda rate: abs(rate - wanted))
        capture.timeperframe.numerator, capture.timeperframe.denominator = 1000, round(nearest * 1000)

    def _queryctrl(self, query: abi.QueryControl) -> None:
        after = query.id & ~abi.CTRL_FLAG_NEXT_CTRL
        control = self._nth([c for c in sorted(self.controls, key=lambda c: c.id) if c.id > after], 0)
        query.id, query.name, query.type = control.id, control.name.encode(), control.type
        query.minimum, query.maximum, query.step = control.minimum, control.maximum, control.step

    def _querymenu(self, item: abi.QueryMenu) -> None:
        item.u.name = self._nth(self._control(item.id).entries, item.index).encode()

    def _g_ctrl(self, request: abi.Control) -> None:
        request.value = self._control(request.id).value

    def _s_ctrl(self, request: abi.Control) -> None:
        control = self._control(request.id)
        if not control.minimum <= request.value <= control.maximum:
            raise refusal(errno.ERANGE)
        control.value = control.becomes(request.value)

    def _reqbufs(self, request: abi.RequestBuffers) -> None:
        request.count = min(request.count, self.most_buffers)
        self.buffers = [bytearray(self.size) for _ in range(request.count)]
        self.events.append("armed")

    def _querybuf(self, buffer: abi.Buffer) -> None:
        buffer.length, buffer.m.offset = self.size, buffer.index * 4096

    def _qbuf(self, buffer: abi.Buffer) -> None:
        assert buffer.index not in self.queued
        self.queued.append(buffer.index)

    def _dqbuf(self, buffer: abi.Buffer) -> None:
        if not self.done:
            raise refusal(errno.EAGAIN)
        done = self.done.popleft()
        for name in ("index", "bytesused", "flags", "timestamp", "sequence"):
            setattr(buffer, name, getattr(done, name))

    def _streamon(self, kind: c_int) -> None:
        assert kind.value == abi.CAPTURE
        self.streaming = True
        self.events.append("started")

    def _control(self, control_id: int) -> FakeControl:
        return self._nth([control for control in self.controls if control.id == control_id], 0)

    @staticmethod
    def _nth(entries: Sequence[T], index: int) -> T:
        if index >= len(entries):
            raise refusal(errno.EINVAL)
        return entries[index]


class FakeKernel:
    """The edge, with cameras behind it. Each poll that finds nothing runs the next step of the script, and the last
    one sets `stop`; time passes only in polls that find nothing and in `sleep`."""

    def __init__(self, cameras: Sequence[FakeCamera], script: Iterable[Callable[[], object]] = ()) -> None:
        self.cameras = list(cameras)
        self.script = iter(script)
        self.stop = ScriptStop(self)
        self.now_s = 100.0
        self._open: dict[int, FakeCamera] = {}
        self._next = 1000
        self.mapped = 0

    @property
    def left_open(self) -> int:
        return len(self._open)

    def monotonic(self) -> float:
        return self.now_s

    def step(self, waited_s: float) -> None:
        self.now_s += waited_s
        action = next(self.script, None)
        if action is None:
            self.stop.set()
        else:
            action()

    def nodes(self) -> list[Node]:
        return [Node(c.node, c.index, c.serial) for c in sorted(self.cameras, key=lambda c: c.node) if c.plugged]

    def open(self, path: str) -> int:
        camera = next((camera for camera in self.cameras if camera.node == path and camera.plugged), None)
        if camera is None:
            raise refusal(errno.ENOENT)
        if not camera.openable:
            raise refusal(errno.EACCES)
        self._next += 1
        self._open[self._next] = camera
        return self._next

    def ioctl(self, descriptor: int, request: Request, argument: Structure | c_int) -> None:
        camera = self._open[descriptor]
        camera.answer(request, argument)
        if request is Request.REQBUFS:
            camera.owner = descriptor

    def map(self, descriptor: int, length: int, offset: int) -> memoryview:
        self.mapped += 1
        return memoryview(self._open[descriptor].buffers[offset // 4096])

    def unmap(self, buffer: memoryview) -> None:
        self.mapped -= 1
        buffer.release()

    def poll(self, descriptors: Sequence[int], timeout_s: float) -> Mapping[int, int]:
        ready = {
            descriptor: select.POLLIN if camera.plugged else select.POLLERR
            for descriptor in descriptors
            if (camera := self._open[descriptor]).done or not camera.plugged
        }
        if not ready:
            self.step(timeout_s)
        return ready

    def close(self, descriptor: int) -> None:
        camera = self._open.pop(descriptor)
        if camera.owner == descriptor:
            camera.reset()


class ScriptStop(Event):
    """A stop event whose waiting is a step of the script."""

    def __init__(self, kernel: FakeKernel) -> None:
        super().__init__()
        self._kernel = kernel

    def wait(self, timeout: float | None = None) -> bool:
        if not self.is_set():
            self._kernel.step(timeout or 0.0)
        return self.is_set()


class RunningKernel(FakeKernel):
    """Two cameras that run in real time, in step, stamped with the machine's monotonic clock.

    pictures: the nth pair's buffers, or None for none now; a pair comes at most `rate_hz` times a second.
    """

    def __init__(
        self,
        cameras: Sequence[FakeCamera],
        pictures: Callable[[int], tuple[bytes, bytes] | None],
        rate_hz: float = 50.0,
        skew_us: int = 40,
    ) -> None:
        super().__init__(cameras)
        self._pictures, self._period_s, self._skew_us = pictures, 1 / rate_hz, skew_us
        self._due_s = 0.0
        self.delivered = 0
        self.stamps_us: list[int] = []

    def step(self, waited_s: float) -> None:
        time.sleep(min(waited_s, max(self._due_s - time.monotonic(), 0.001)))
        if time.monotonic() < self._due_s or not all(camera.streaming for camera in self.cameras):
            return
        pictures = self._pictures(self.delivered)
        if pictures is None:
            return
        self._due_s = time.monotonic() + self._period_s
        stamp_us = time.monotonic_ns() // 1000
        for number, camera in enumerate(self.cameras):
            camera.deliver(stamp_us + number * self._skew_us, pictures[number])
        self.delivered += 1
        self.stamps_us.append(stamp_us)


def two_cameras(size_px: tuple[int, int], rate_hz: float = 50.0, pixels: str = "GREY") -> list[FakeCamera]:
    """A left and a right camera of a size, on two sockets of a bus."""
    return [
        FakeCamera(
            f"/dev/video{n}",
            f"usb-{n + 1}",
            formats={pixels: [size_px]},
            rates_hz=(rate_hz,),
            stride=size_px[0] * (1 if pixels == "GREY" else 2),
        )
        for n in range(2)
    ]
