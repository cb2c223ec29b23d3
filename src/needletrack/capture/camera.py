"""One V4L2 camera: found by what it is, set as configured and read back, its buffers taken as they come.

Nothing here waits: the descriptor is non-blocking, and whoever owns two of these polls both.
"""

import errno
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from ctypes import Structure, c_int
from dataclasses import dataclass
from typing import Literal, get_args

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.kernel import Kernel, Node
from needletrack.capture.pixels import Layout, decoded
from needletrack.capture.settings import CamerasSettings, PixelFormat
from needletrack.capture.v4l2_abi import Request
from needletrack.errors import CaptureError
from needletrack.records import Clock, Pixels, StampPlace

Side = Literal["left", "right"]

_GONE = {errno.ENODEV, errno.ENXIO}
# A rate within this share of the wanted one is the same: 29.97 for 30.
_SAME_RATE = 0.005
_MOST_LISTED = 12
# Drivers that never say that there is no more.
_MOST_ENUMERATED = 256


class CameraUnavailable(CaptureError):
    """A camera is not there, or broke off; it may be back in a moment."""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A capture node: where it is and what it says of itself."""

    node: Node
    card: str
    bus_info: str

    def answers_to(self, identity: str) -> bool:
        """Whether it is the camera that a configuration means: bus place or serial number, `#n` for its nth node."""
        name, hash_, index = identity.partition("#")
        if hash_ and index != str(self.node.index):
            return False
        return name != "" and name in (self.bus_info, self.node.serial)

    def __str__(self) -> str:
        """`usb-0000:00:14.0-1 (HD Camera, /dev/video0, serial 1234)`."""
        serial = f", serial {self.node.serial}" if self.node.serial else ""
        return f"{self.bus_info} ({self.card}, {self.node.path}{serial})"


@dataclass(frozen=True, slots=True)
class Grab:
    """One dequeued buffer: its picture, or what is wrong with it; stamp, clock and place as the driver gave them.

    clock: None where the driver names none.
    """

    image: Pixels | None
    fault: str
    stamp_ns: int
    sequence: int
    clock: Clock | None
    stamp_at: StampPlace


def find_cameras(kernel: Kernel) -> tuple[list[FoundCamera], list[str]]:
    """The capture nodes that can be opened, and a sentence for each node that may not."""
    found, refused = [], []
    for node in kernel.nodes():
        try:
            descriptor = kernel.open(node.path)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM):
                refused.append(f"{node.path} may not be opened ({error.strerror})")
            continue
        try:
            capability = abi.Capability()
            kernel.ioctl(descriptor, Request.QUERYCAP, capability)
        except OSError:
            continue  # no V4L2 device, or just unplugged
        finally:
            kernel.close(descriptor)
        if _captures(capability):
            found.append(FoundCamera(node, capability.card.decode("utf-8", "replace"), _bus(capability)))
    return found, refused


class Camera:
    """An open camera, set as `settings` say. Close it on every way out.

    Raises CameraUnavailable where it is not connected, CaptureError with the remedy where it may not be opened, is
    ambiguous, or does not do what the settings ask, with what it offers in their place.
    """

    def __init__(self, kernel: Kernel, side: Side, settings: CamerasSettings) -> None:
        self._kernel, self.side, self._settings = kernel, side, settings
        self.identity = settings.of(side).id
        self.found = _the_one(kernel, side, self.identity)
        self._maps: list[memoryview] = []
        self._to_queue: list[int] = []
        self._streaming = False
        try:
            self.descriptor = kernel.open(self.found.node.path)
        except OSError as error:
            raise self._not_opened(error) from error
        try:
            self.layout = self._set_format()
            self._set_rate()
            self._set_controls()
        except BaseException:
            self.close()
            raise

    def __str__(self) -> str:
        return f"{self.side} camera {self.identity} ({self.found.node.path})"

    @property
    def exposure_ns(self) -> int | None:
        """Length of the exposure, where the driver has it in known units and it is set by hand; asks the driver."""
        if self._control_value(abi.CID_EXPOSURE_AUTO) not in (None, abi.EXPOSURE_MANUAL):
            return None
        units = self._control_value(abi.CID_EXPOSURE_ABSOLUTE)
        return None if units is None else units * abi.EXPOSURE_UNIT_US * 1000

    def arm(self) -> None:
        """Have buffers mapped and queued, so that only the start is missing; raises CameraUnavailable."""
        request = abi.RequestBuffers(count=self._settings.buffers, type=abi.CAPTURE, memory=abi.MEMORY_MMAP)
        self._ask(Request.REQBUFS, request)
        if request.count < 2:  # the driver's word counts, not ours
            raise CameraUnavailable(f"{self}: the driver gives {request.count} buffers, two are the least")
        for index in range(request.count):
            buffer = self._buffer(index)
            self._ask(Request.QUERYBUF, buffer)
            try:
                self._maps.append(self._kernel.map(self.descriptor, buffer.length, buffer.m.offset))
            except OSError as error:
                raise CameraUnavailable(f"{self}: a buffer cannot be mapped: {error.strerror}") from error
        self._to_queue = list(range(request.count))
        self._queue()
        if self._to_queue:
            raise CameraUnavailable(f"{self}: the driver refuses its buffers (QBUF)")

    def start(self) -> None:
        """Start the stream; raises CameraUnavailable."""
        self._ask(Request.STREAMON, c_int(abi.CAPTURE))
        self._streaming = True

    def take(self) -> Grab | None:
        """The next buffer, or None where none is ready; raises CameraUnavailable where none will come any more."""
        self._queue()
        buffer = self._buffer(0)
        try:
            self._kernel.ioctl(self.descriptor, Request.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise CameraUnavailable(f"{self}: {self._broke_off(error)}") from error
        self._to_queue.append(buffer.index)
        grab = self._grab(buffer)
        self._queue()
        return grab

    @property
    def refused_buffers(self) -> int:
        """Buffers that the driver would not take back yet (QBUF); they are offered again with every `take`."""
        return len(self._to_queue)

    def close(self) -> None:
        """Stop, unmap and close; whatever an unplugged camera answers. May be called twice."""
        if self.descriptor < 0:
            return
        for mapped in self._maps:
            self._kernel.unmap(mapped)
        self._maps = []
        descriptor, self.descriptor = self.descriptor, -1
        # The kernel stops the stream and frees the buffers with the last descriptor.
        self._kernel.close(descriptor)

    def _grab(self, buffer: abi.Buffer) -> Grab:
        image, fault = None, ""
        if buffer.flags & abi.BUF_FLAG_ERROR:
            fault = "the driver flags it as an error"
        else:
            # A driver that leaves bytesused at zero means all of it.
            used = buffer.bytesused or len(self._maps[buffer.index])
            try:
                image = decoded(self._maps[buffer.index][:used], self.layout)
            except ValueError as error:
                fault = str(error)
        flags = buffer.flags
        monotonic = flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
        start = flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE
        return Grab(
            image=image,
            fault=fault,
            stamp_ns=buffer.timestamp.seconds * 1_000_000_000 + buffer.timestamp.microseconds * 1000,
            sequence=buffer.sequence,
            clock=Clock.MONOTONIC if monotonic else None,
            stamp_at=StampPlace.START_OF_EXPOSURE if start else StampPlace.END_OF_FRAME,
        )

    def _queue(self) -> None:
        """Offer the driver the buffers that it has not; what it refuses stays on the list."""
        left: list[int] = []
        for index in self._to_queue:
            try:
                self._kernel.ioctl(self.descriptor, Request.QBUF, self._buffer(index))
            except OSError as error:
                if error.errno in _GONE:
                    raise CameraUnavailable(f"{self}: {self._broke_off(error)}") from error
                left.append(index)
        self._to_queue = left

    def _set_format(self) -> Layout:
        wanted, (width, height) = self._settings.format, self._settings.size_px
        request = abi.Format(type=abi.CAPTURE)
        pix = request.fmt.pix
        pix.width, pix.height, pix.pixelformat, pix.field = width, height, abi.fourcc(wanted), abi.FIELD_NONE
        try:
            self._kernel.ioctl(self.descriptor, Request.S_FMT, request)
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise CameraUnavailable(f"{self} is in use: another program streams from it") from error
            if error.errno in _GONE:
                raise CameraUnavailable(f"{self}: {self._broke_off(error)}") from error
            raise CaptureError(f"{self}: no format {wanted}: {error.strerror}; it offers {self.offers()}") from error
        got = (abi.fourcc_text(pix.pixelformat).rstrip(), pix.width, pix.height)
        if got != (wanted, width, height):
            raise CaptureError(
                f"{self} does not do {wanted} {width}x{height}, it would do {got[0]} {got[1]}x{got[2]}: set "
                f"cameras.format and cameras.size_px to what it offers: {self.offers()}"
            )
        return Layout(wanted, width, height, pix.bytesperline, self._settings.significant_bits)

    def _set_rate(self) -> None:
        wanted_hz = self._settings.rate_hz
        if wanted_hz is None:
            return
        request = abi.StreamParameters(type=abi.CAPTURE)
        interval = request.parm.capture.timeperframe
        interval.numerator, interval.denominator = 1000, round(wanted_hz * 1000)
        self._ask(Request.S_PARM, request)
        if not request.parm.capture.capability & abi.CAP_TIMEPERFRAME:
            raise CaptureError(
                f"{self}: the driver sets no frame rate: leave cameras.rate_hz empty, and set the trigger's rate"
            )
        got_hz = interval.denominator / interval.numerator if interval.numerator else 0.0
        if abs(got_hz - wanted_hz) > _SAME_RATE * wanted_hz:
            raise CaptureError(
                f"{self} does not do {wanted_hz:g} frames a second, it would do {got_hz:.4g}: at this format and "
                f"size it offers {self._rates_offered()}; set cameras.rate_hz"
            )

    def _set_controls(self) -> None:
        settings, known = self._settings, self.controls()
        for name, value in {**settings.controls, **settings.of(self.side).controls}.items():
            if name not in known:
                raise CaptureError(f"{self} has no control {name}; it has {', '.join(sorted(known)) or 'none'}")
            self._set_control(name, known[name], value)
        by_id = {control.id: (name, control) for name, control in known.items()}
        if settings.exposure_us is not None:
            if abi.CID_EXPOSURE_ABSOLUTE not in by_id:
                raise CaptureError(
                    f"{self} has no exposure in microseconds: leave cameras.exposure_us empty, and set its own "
                    f"control in cameras.controls; it has {', '.join(sorted(known)) or 'none'}"
                )
            if abi.CID_EXPOSURE_AUTO in by_id:
                self._set_control(*by_id[abi.CID_EXPOSURE_AUTO], abi.EXPOSURE_MANUAL)
            units = round(settings.exposure_us / abi.EXPOSURE_UNIT_US)
            self._set_control(*by_id[abi.CID_EXPOSURE_ABSOLUTE], units)
        if settings.gain is not None:
            gains = [cid for cid in (abi.CID_GAIN, abi.CID_ANALOGUE_GAIN) if cid in by_id]
            if not gains:
                raise CaptureError(f"{self} has no gain: leave cameras.gain empty")
            if abi.CID_AUTOGAIN in by_id:
                self._set_control(*by_id[abi.CID_AUTOGAIN], 0)
            self._set_control(*by_id[gains[0]], settings.gain)

    def controls(self) -> Mapping[str, abi.QueryControl]:
        """The controls that hold a number, by the names of `v4l2-ctl --list-ctrls`."""
        found: dict[str, abi.QueryControl] = {}
        last = 0
        for _ in range(_MOST_ENUMERATED):
            control = abi.QueryControl(id=last | abi.CTRL_FLAG_NEXT_CTRL)
            if not self._answered(Request.QUERYCTRL, control):
                break
            last = control.id
            if control.type in set(abi.ControlType) and not control.flags & abi.CTRL_FLAG_DISABLED:
                found[_control_name(control.name)] = control
        return found

    def offers(self) -> str:
        """`GREY 640x360, 1280x720; YUYV 640x480`, what the driver says it can do."""
        usable, others = [], []
        for entry in self._enumerated(Request.ENUM_FMT, lambda n: abi.FormatDescription(index=n, type=abi.CAPTURE)):
            assert isinstance(entry, abi.FormatDescription)
            name = abi.fourcc_text(entry.pixelformat).rstrip()
            if name in get_args(PixelFormat):
                usable.append(f"{name} {_listed(self._sizes(entry.pixelformat))}")
            else:
                others.append(name)
        unusable = f"; and, which needletrack cannot use, {_listed(others)}" if others else ""
        return ("; ".join(usable) or "nothing that needletrack can use") + unusable

    def _sizes(self, pixelformat: int) -> list[str]:
        sizes = []
        for entry in self._enumerated(
            Request.ENUM_FRAMESIZES, lambda n: abi.FrameSize(index=n, pixel_format=pixelformat)
        ):
            assert isinstance(entry, abi.FrameSize)
            v = entry.values
            if entry.type == abi.FRAME_DISCRETE:
                sizes.append(f"{v[0]}x{v[1]}")
            else:
                return [f"{v[0]}x{v[3]} to {v[1]}x{v[4]}"]
        return sizes

    def _rates_offered(self) -> str:
        width, height = self._settings.size_px
        code, rates = abi.fourcc(self._settings.format), []
        for entry in self._enumerated(
            Request.ENUM_FRAMEINTERVALS,
            lambda n: abi.FrameInterval(index=n, pixel_format=code, width=width, height=height),
        ):
            assert isinstance(entry, abi.FrameInterval)
            hz = [v.denominator / v.numerator if v.numerator else 0.0 for v in entry.values]
            if entry.type == abi.FRAME_DISCRETE:
                rates.append(f"{hz[0]:.4g}")
            else:
                return f"{hz[1]:.4g} to {hz[0]:.4g} a second"
        return f"{_listed(rates)} a second" if rates else "no list of rates"

    def _enumerated(self, request: Request, entry: Callable[[int], Structure]) -> Iterator[Structure]:
        for index in range(_MOST_ENUMERATED):
            asked = entry(index)
            if not self._answered(request, asked):
                return
            yield asked

    def _set_control(self, name: str, control: abi.QueryControl, value: int) -> None:
        request = abi.Control(id=control.id, value=value)
        offered = f"it takes {control.minimum} to {control.maximum} in steps of {control.step}{self._menu(control)}"
        try:
            self._kernel.ioctl(self.descriptor, Request.S_CTRL, request)
        except OSError as error:
            if error.errno in _GONE:
                raise CameraUnavailable(f"{self}: {self._broke_off(error)}") from error
            raise CaptureError(f"{self}: control {name} = {value} is refused ({error.strerror}): {offered}") from error
        if control.type == abi.ControlType.BUTTON:
            return
        got = self._control_value(control.id)
        if got != value:
            raise CaptureError(f"{self}: control {name} became {got} in place of {value}: {offered}")

    def _menu(self, control: abi.QueryControl) -> str:
        if control.type not in (abi.ControlType.MENU, abi.ControlType.INTEGER_MENU):
            return ""
        entries = []
        for index in range(control.minimum, min(control.maximum, control.minimum + _MOST_LISTED) + 1):
            item = abi.QueryMenu(id=control.id, index=index)
            if self._answered(Request.QUERYMENU, item):
                named = control.type == abi.ControlType.MENU
                entries.append(f"{index} {item.u.name.decode('utf-8', 'replace') if named else item.u.value}")
        return f" ({', '.join(entries)})"

    def _control_value(self, control_id: int) -> int | None:
        request = abi.Control(id=control_id)
        return int(request.value) if self._answered(Request.G_CTRL, request) else None

    def _answered(self, request: Request, argument: Structure) -> bool:
        try:
            self._kernel.ioctl(self.descriptor, request, argument)
        except OSError:
            return False
        return True

    def _ask(self, request: Request, argument: Structure | c_int) -> None:
        try:
            self._kernel.ioctl(self.descriptor, request, argument)
        except OSError as error:
            raise CameraUnavailable(f"{self}: {request.name} failed: {self._broke_off(error)}") from error

    def _buffer(self, index: int) -> abi.Buffer:
        return abi.Buffer(index=index, type=abi.CAPTURE, memory=abi.MEMORY_MMAP)

    def _broke_off(self, error: OSError) -> str:
        if error.errno in _GONE:
            return "it was unplugged"
        if error.errno == errno.EBUSY:
            return "another program streams from it"
        return f"the driver says {error.strerror or error}"

    def _not_opened(self, error: OSError) -> CaptureError:
        path = self.found.node.path
        if error.errno in (errno.EACCES, errno.EPERM):
            return CaptureError(f"{self.side} camera {path}: {_PERMISSION_REMEDY}")
        return CameraUnavailable(f"{self.side} camera {path}: cannot be opened: {error.strerror}")


_PERMISSION_REMEDY = "this user may not open it: add the user to the group video (usermod -aG video USER), log in anew"


def _the_one(kernel: Kernel, side: Side, identity: str) -> FoundCamera:
    found, refused = find_cameras(kernel)
    here = f"cameras here: {', '.join(map(str, found)) or 'none'}"
    if not identity:
        raise CaptureError(f"cameras.{side}.id is not configured: say which camera is the {side} one; {here}")
    matching = [camera for camera in found if camera.answers_to(identity)]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise CaptureError(
            f"cameras.{side}.id {identity!r} fits {' and '.join(map(str, matching))}: add the node's index, "
            f"{identity}#{matching[0].node.index} for the first"
        )
    if refused:
        raise CaptureError(f"the {side} camera {identity} was not found; {'; '.join(refused)}: {_PERMISSION_REMEDY}")
    raise CameraUnavailable(f"the {side} camera {identity} is not connected (cameras.{side}.id); {here}")


def _captures(capability: abi.Capability) -> bool:
    of_node = capability.capabilities & abi.CAP_DEVICE_CAPS
    bits = capability.device_caps if of_node else capability.capabilities
    return bool(bits & abi.CAP_VIDEO_CAPTURE) and bool(bits & abi.CAP_STREAMING)


def _bus(capability: abi.Capability) -> str:
    return str(capability.bus_info.decode("utf-8", "replace"))


def _control_name(name: bytes) -> str:
    """As v4l2-ctl writes it: "Exposure, Auto" is exposure_auto."""
    return re.sub(r"[^a-z0-9]+", "_", name.decode("utf-8", "replace").lower()).strip("_")


def _listed(entries: Sequence[str]) -> str:
    more = f" and {len(entries) - _MOST_LISTED} more" if len(entries) > _MOST_LISTED else ""
    return ", ".join(entries[:_MOST_LISTED]) + more
