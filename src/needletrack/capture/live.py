"""Two running cameras as a source of pairs, which outlives their being unplugged."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import StrEnum
from threading import Event

from needletrack.capture.camera import Camera, CameraUnavailable, Grab, Side
from needletrack.capture.kernel import Kernel, LinuxKernel
from needletrack.capture.pairing import Paired, SkewMonitor, SkewReport, StampPairer, Trigger
from needletrack.capture.settings import CamerasSettings
from needletrack.errors import CaptureError
from needletrack.records import Clock, DropReason, Frame, StampPlace, StereoPair

_log = logging.getLogger(__name__)

SIDES: tuple[Side, Side] = ("left", "right")
_POLL_S = 0.1
# A camera that comes back is to deliver within 2 s; a USB one takes most of a second to answer.
_RETRY_S = 0.25
# After so many times `stall_s` the stream is started anew: some drivers never wake up by themselves.
_RESTART_AFTER_STALLS = 6
_RATE_OVER = 60
_NS = 1_000_000_000
# A frame that is late by a tenth of the period is still of its period.
_SHORTEST_PERIOD = 0.9


class CameraState(StrEnum):
    """How a camera is."""

    ABSENT = "absent"
    STARTING = "starting"
    STREAMING = "streaming"
    STALLED = "stalled"


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """One camera since the start: its state, node, and counts of what came and what did not.

    frames: buffers dequeued, those with an error included; lost_by_driver: gaps in the sequence numbers;
    buffer_errors: flagged, short or undecodable ones; queue_errors: refusals to take a buffer back; restarts: times
    that it was started anew.
    """

    state: CameraState = CameraState.ABSENT
    node: str = ""
    frames: int = 0
    lost_by_driver: int = 0
    buffer_errors: int = 0
    queue_errors: int = 0
    stalls: int = 0
    restarts: int = 0
    rate_hz: float | None = None
    exposure_us: float | None = None
    stamp_at: StampPlace | None = None


@dataclass(slots=True)
class _Stream:
    """What is known of a camera while it runs."""

    camera: Camera
    last_sequence: int | None = None
    last_frame_s: float = 0.0
    exposure_ns: int | None = None
    stalled: bool = False


@dataclass(slots=True)
class _Account:
    """A camera's counts, which outlive its being unplugged."""

    state: CameraState = CameraState.ABSENT
    node: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_RATE_OVER))
    exposure_ns: int | None = None
    stamp_at: StampPlace | None = None


@dataclass(frozen=True, slots=True)
class _Arrived:
    frame: Frame
    grab: Grab


class LiveSource:
    """Pairs of two V4L2 cameras, in the order of their stamps.

    tolerance_us, offset_us: of the configuration's `pairing`. What cannot be right at the first opening (settings that
    a camera does not take, a missing permission) is raised as CaptureError; a camera that is absent, breaks off or
    stalls is waited for, from the first moment on, and that is said in `health`, `last_error` (the newest) and the log.
    alive_at_s: when the loop last turned, on `monotonic`'s clock.
    """

    def __init__(
        self,
        settings: CamerasSettings,
        *,
        tolerance_us: float = 1000.0,
        offset_us: float = 0.0,
        kernel: Kernel | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._kernel, self._monotonic = settings, kernel or LinuxKernel(), monotonic
        self._tolerance_ns, self._offset_ns = round(tolerance_us * 1000), round(offset_us * 1000)
        self._accounts: dict[Side, _Account] = {"left": _Account(), "right": _Account()}
        self._dropped: Counter[DropReason] = Counter()
        self._skews = SkewMonitor()
        self._sequence = 0
        self._advised = False
        self._said: str | None = None
        self.last_error: str | None = None
        self.alive_at_s = monotonic()

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Frames lost so far by reason; may be read from another thread while `pairs` runs."""
        return dict(self._dropped)

    @property
    def skew(self) -> SkewReport:
        """What the stamps of the last minute say about offset, drift and trigger."""
        return self._skews.report()

    @property
    def health(self) -> dict[Side, CameraHealth]:
        """Both cameras as they are now; may be called from another thread."""
        return {side: _health(self._accounts[side]) for side in SIDES}

    def pairs(self, stop: Event) -> Iterator[StereoPair]:
        """Yield pairs until `stop` is set; raises CaptureError where waiting would not help."""
        while not stop.is_set():
            try:
                with ExitStack() as opened:
                    streams = self._started(opened)
                    yield from self._streamed(streams, stop)
                    return
            except CameraUnavailable as error:
                self._say(str(error))
            except CaptureError as error:
                if not self._sequence:
                    raise
                # It ran before: what is plugged in now is another camera, or not permitted yet.
                self._say(str(error))
            for side in SIDES:
                self._accounts[side].state = CameraState.ABSENT
            self.alive_at_s = self._monotonic()
            stop.wait(_RETRY_S)

    def _started(self, opened: ExitStack) -> dict[Side, _Stream]:
        cameras: dict[Side, Camera] = {}
        for side in SIDES:
            cameras[side] = Camera(self._kernel, side, self._settings)
            opened.callback(cameras[side].close)
        if cameras["left"].found.node == cameras["right"].found.node:
            raise CaptureError(
                f"cameras.left.id and cameras.right.id both mean {cameras['left'].found}: name two cameras"
            )
        # Both armed before either starts: the first frames then belong together.
        for camera in cameras.values():
            camera.arm()
        for camera in cameras.values():
            camera.start()
        now_s = self._monotonic()
        for side, camera in cameras.items():
            account = self._accounts[side]
            account.counts["starts"] += 1
            account.state, account.node = CameraState.STARTING, camera.found.node.path
            account.exposure_ns = camera.exposure_ns
            account.stamps_ns.clear()
        self._skews.clear()
        again = " again" if self._accounts["left"].counts["starts"] > 1 else ""
        _log.warning("both cameras stream%s: %s, %s", again, cameras["left"], cameras["right"])
        return {side: _Stream(camera, last_frame_s=now_s) for side, camera in cameras.items()}

    def _streamed(self, streams: dict[Side, _Stream], stop: Event) -> Iterator[StereoPair]:
        rate_hz = self._settings.rate_hz
        period_ns = round(_NS / rate_hz * _SHORTEST_PERIOD) if rate_hz else None
        pairer: StampPairer[_Arrived] = StampPairer(self._tolerance_ns, offset_ns=self._offset_ns, period_ns=period_ns)
        sides = {stream.camera.descriptor: side for side, stream in streams.items()}
        try:
            while not stop.is_set():
                ready = self._kernel.poll(list(sides), _POLL_S)
                self.alive_at_s = self._monotonic()
                for descriptor in ready:
                    side = sides[descriptor]
                    while (grab := streams[side].camera.take()) is not None:
                        yield from self._taken(side, streams[side], grab, pairer)
                self._watch_for_stalls(streams)
        finally:
            for lost in pairer.flush():
                self._dropped[lost.reason] += 1

    def _taken(self, side: Side, stream: _Stream, grab: Grab, pairer: StampPairer[_Arrived]) -> Iterator[StereoPair]:
        account = self._accounts[side]
        stream.last_frame_s = self._monotonic()
        if stream.stalled:
            stream.stalled = False
            _log.warning("%s delivers again", stream.camera)
        account.state = CameraState.STREAMING
        account.counts["frames"] += 1
        account.counts["queue_errors"] += stream.camera.refused_buffers
        gap = 0 if stream.last_sequence is None else grab.sequence - stream.last_sequence - 1
        stream.last_sequence = grab.sequence
        if gap > 0:
            account.counts["lost_by_driver"] += gap
            self._dropped[DropReason.LOST_BY_DRIVER] += gap
        if grab.image is None:
            account.counts["buffer_errors"] += 1
            self._dropped[DropReason.BUFFER_ERROR] += 1
            return
        account.stamps_ns.append(grab.stamp_ns)
        account.stamp_at = grab.stamp_at
        self._skews.add(side, grab.stamp_ns)
        frame = Frame.of(grab.image, grab.stamp_ns)
        for decided in pairer.add(side, grab.stamp_ns, _Arrived(frame, grab)):
            if isinstance(decided, Paired):
                yield self._pair(decided.left, decided.right)
            else:
                self._dropped[decided.reason] += 1
                self._advise()

    def _pair(self, left: _Arrived, right: _Arrived) -> StereoPair:
        exposures_ns = {account.exposure_ns for account in self._accounts.values()}
        places = {left.grab.stamp_at, right.grab.stamp_at}
        pair = StereoPair(
            left.frame,
            right.frame,
            sequence=self._sequence,
            clock=self._clock(left.grab),
            # Of two exposures that differ neither is the pair's.
            exposure_ns=exposures_ns.pop() if len(exposures_ns) == 1 else None,
            stamp_at=places.pop() if len(places) == 1 else None,
            arrived_at_ns=time.monotonic_ns(),
        )
        self._sequence += 1
        self._said = None
        return pair

    def _clock(self, grab: Grab) -> Clock:
        configured = self._settings.clock
        if configured != "driver":
            return Clock(configured)
        if grab.clock is None:
            raise CaptureError(
                "the driver does not say which clock its stamps are on: set cameras.clock to monotonic or realtime"
            )
        return grab.clock

    def _watch_for_stalls(self, streams: dict[Side, _Stream]) -> None:
        now_s = self._monotonic()
        for side, stream in streams.items():
            silent_s = now_s - stream.last_frame_s
            if silent_s > _RESTART_AFTER_STALLS * self._settings.stall_s:
                raise CameraUnavailable(f"{stream.camera} has sent nothing for {silent_s:.1f} s: it is started anew")
            if silent_s > self._settings.stall_s and not stream.stalled:
                stream.stalled = True
                self._accounts[side].state = CameraState.STALLED
                self._accounts[side].counts["stalls"] += 1
                self._say(f"{stream.camera} has sent nothing for {silent_s:.1f} s (trigger, cable, or exposure)")

    def _advise(self) -> None:
        """Once, where no pair was ever found though the skew is steady: what that may be."""
        if self._advised or self._sequence:
            return
        skew = self._skews.report()
        if skew.offset_us is None or abs(skew.offset_us * 1000 - self._offset_ns) <= self._tolerance_ns:
            return
        self._advised = True
        remedy = (
            f"if one signal triggers both, set pairing.offset_us = {skew.offset_us:.0f}; else synchronize them"
            if skew.looks is not Trigger.FREE_RUNNING
            else "they run free: trigger both by one signal, or widen pairing.tolerance_us if the needle is slow"
        )
        self._say(
            f"no left and right frame pair: the right stamps are {skew.offset_us:.0f} us later than the nearest left "
            f"ones, more than pairing.tolerance_us allows: {remedy}"
        )

    def _say(self, error: str) -> None:
        if error != self._said:
            _log.warning(error)
        self._said = self.last_error = error


def _health(account: _Account) -> CameraHealth:
    stamps_ns = list(account.stamps_ns)
    spent_s = (stamps_ns[-1] - stamps_ns[0]) / 1e9 if len(stamps_ns) > 1 else 0.0
    return CameraHealth(
        state=account.state,
        node=account.node,
        frames=account.counts["frames"],
        lost_by_driver=account.counts["lost_by_driver"],
        buffer_errors=account.counts["buffer_errors"],
        queue_errors=account.counts["queue_errors"],
        stalls=account.counts["stalls"],
        restarts=max(account.counts["starts"] - 1, 0),
        rate_hz=round((len(stamps_ns) - 1) / spent_s, 2) if spent_s > 0 else None,
        exposure_us=None if account.exposure_ns is None else account.exposure_ns / 1000,
        stamp_at=account.stamp_at,
    )
