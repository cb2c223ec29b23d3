"""`needletrack doctor`: everything that can keep a rig from tracking, looked at in turn, each with its remedy."""

import ctypes
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import numpy as np

from needletrack.capture.camera import Camera, Side, find_cameras
from needletrack.capture.kernel import Kernel, LinuxKernel
from needletrack.capture.live import SIDES, LiveSource
from needletrack.capture.pairing import Trigger
from needletrack.config import Config
from needletrack.daemon.process import AlreadyRunning, OnlyInstance, may_lock_memory, may_schedule
from needletrack.daemon.run import listened_on, require_fit
from needletrack.errors import NeedletrackError
from needletrack.publish.session import open_endpoints, open_session
from needletrack.publish.tls import TlsFiles
from needletrack.records import Clock, Image, StereoPair
from needletrack.rig import Rig

_SATURATED, _MOST_SATURATED = 250, 0.01
_DARK, _SAME_RATE, _MOST_LOST = 20, 0.02, 0.01
_DISK_TEST_MB, _COMPRESSED_TO, _DISK_RESERVE = 128, 0.65, 1.5
_CONNECT_WITHIN_S = 1.0
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronized


class Verdict(StrEnum):
    """How a check went."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's: what was looked at, how it is, what was seen, and what to do."""

    subject: str
    verdict: Verdict
    seen: str
    remedy: str = ""

    def __str__(self) -> str:
        """`warn  exposure      left: 3.1 % saturated -> shorten cameras.exposure_us`."""
        remedy = f" -> {self.remedy}" if self.remedy else ""
        return f"{self.verdict.value:4}  {self.subject:13} {self.seen}{remedy}"


def examine(
    config: Config, rig: Callable[[], Rig], *, seconds: float = 2.0, kernel: Kernel | None = None
) -> Iterator[Finding]:
    """Look at everything in turn; cameras stream for so many seconds. What cannot be looked at is a failure."""
    kernel = kernel or LinuxKernel()
    known = yield from _rig(config, rig)
    running = known is not None and _runs(known.name)
    if running:
        yield Finding("daemon", Verdict.WARN, "runs now, and has the cameras", "stop it to have them examined")
    else:
        yield from _cameras(config, kernel, seconds)
    yield from _disk(config)
    yield from _clock()
    yield from _rights(config)
    yield from _endpoints(config, listening=running)


def _rig(config: Config, rig: Callable[[], Rig]) -> Generator[Finding, None, Rig | None]:
    try:
        known = rig()
        require_fit(known, config)
    except NeedletrackError as error:
        yield Finding("rig", Verdict.FAIL, str(error), "needletrack calibrate, or --rig")
        return None
    info = known.calibration
    rms = "" if info.reprojection_rms_px is None else f", {info.reprojection_rms_px:.3f} px rms"
    if info.calibrated_at is None:
        yield Finding("rig", Verdict.WARN, f"{known.name}{rms}: nobody says when it was calibrated", "calibrate anew")
        return known
    now = datetime.now(UTC)
    age = f"calibrated {(now - info.calibrated_at).days} days ago"
    if known.age_warning(config.rig.max_age_days, now) is None:
        yield Finding("rig", Verdict.PASS, f"{known.name}{rms}, {age}")
    else:
        age += f", more than {config.rig.max_age_days:g} (rig.max_age_days)"
        yield Finding("rig", Verdict.WARN, f"{known.name}{rms}, {age}", "needletrack check, or calibrate anew")
    return known


def _runs(rig: str) -> bool:
    try:
        with OnlyInstance(rig):
            return False
    except AlreadyRunning:
        return True


def _cameras(config: Config, kernel: Kernel, seconds: float) -> Iterator[Finding]:
    found, refused = find_cameras(kernel)
    if refused:
        yield Finding("permissions", Verdict.FAIL, "; ".join(refused), "usermod -aG video USER, and log in anew")
    else:
        yield Finding("permissions", Verdict.PASS, "every video node may be opened")
    listed = ", ".join(map(str, found)) or "none"
    yield Finding(
        "cameras",
        Verdict.PASS if len(found) >= 2 else Verdict.FAIL,
        listed,
        "" if len(found) >= 2 else "connect both; see `v4l2-ctl --list-devices`",
    )
    both_fit = True
    for side in SIDES:
        finding = _camera(config, kernel, side)
        both_fit &= finding.verdict is not Verdict.FAIL
        yield finding
    if both_fit:
        yield from _stream(config, kernel, seconds)


def _camera(config: Config, kernel: Kernel, side: Side) -> Finding:
    try:
        camera = Camera(kernel, side, config.cameras)
    except NeedletrackError as error:
        return Finding(f"{side} camera", Verdict.FAIL, str(error), "see docs/cameras.md")
    with ExitStack() as opened:
        opened.callback(camera.close)
        exposure_ns = camera.exposure_ns
    layout = camera.layout
    exposure = "exposure automatic or unknown" if exposure_ns is None else f"exposure {exposure_ns / 1000:g} us"
    seen = f"{camera.found}: {layout.format} {layout.width}x{layout.height}, {exposure}"
    if exposure_ns is None:
        return Finding(
            f"{side} camera", Verdict.WARN, seen, "set cameras.exposure_us: automatic exposure blurs and jumps"
        )
    return Finding(f"{side} camera", Verdict.PASS, seen)


def _stream(config: Config, kernel: Kernel, seconds: float) -> Iterator[Finding]:
    source = LiveSource(
        config.cameras, tolerance_us=config.pairing.tolerance_us, offset_us=config.pairing.offset_us, kernel=kernel
    )
    stop = threading.Event()
    # Also where nothing ever comes.
    timer = threading.Timer(seconds, stop.set)
    timer.daemon = True
    timer.start()
    count, newest = 0, None
    try:
        for pair in source.pairs(stop):
            count, newest = count + 1, pair
    except NeedletrackError as error:
        yield Finding("stream", Verdict.FAIL, str(error), "see docs/cameras.md")
        return
    finally:
        stop.set()
        timer.cancel()
    yield from _rates(config, source)
    lost = sum(source.dropped.values())
    share = lost / max(lost + 2 * count, 1)
    reasons = ", ".join(f"{reason.value} {number}" for reason, number in source.dropped.items()) or "no frame lost"
    if newest is None:
        yield Finding("pairs", Verdict.FAIL, f"none in {seconds:g} s; {reasons}", source.last_error or "see the rates")
        return
    verdict = Verdict.PASS if share <= _MOST_LOST else Verdict.WARN
    remedy = "" if verdict is Verdict.PASS else "one camera an USB controller; fewer frames; see docs/cameras.md"
    yield Finding("pairs", verdict, f"{count} in {seconds:g} s; {reasons}", remedy)
    yield _skew(config, source)
    yield from _pictures(newest)
    yield Finding("stamps", Verdict.PASS, f"clock {newest.clock.value}, at {newest.stamp_at or 'different places'}")


def _rates(config: Config, source: LiveSource) -> Iterator[Finding]:
    wanted_hz = config.cameras.rate_hz
    for side, health in source.health.items():
        if health.rate_hz is None:
            yield Finding("rate", Verdict.FAIL, f"{side}: no frames", "is the trigger running? is the cable in?")
        elif wanted_hz is not None and abs(health.rate_hz - wanted_hz) > _SAME_RATE * wanted_hz:
            yield Finding(
                "rate",
                Verdict.WARN,
                f"{side}: {health.rate_hz:g} a second, configured {wanted_hz:g}",
                "shorten the exposure, or leave the bus more room",
            )
        else:
            yield Finding("rate", Verdict.PASS, f"{side}: {health.rate_hz:g} a second")


def _skew(config: Config, source: LiveSource) -> Finding:
    skew = source.skew
    if skew.offset_us is None:
        return Finding("skew", Verdict.WARN, "too few frames to tell", "examine for longer: --seconds 10")
    spread = "" if skew.spread_us is None else f" ± {skew.spread_us:.0f}"
    seen = f"right is {skew.offset_us:.0f}{spread} us after left; looks {skew.looks.value}"
    if skew.looks is Trigger.FREE_RUNNING:
        return Finding("skew", Verdict.WARN, seen, "trigger both cameras by one signal")
    if abs(skew.offset_us - config.pairing.offset_us) > config.pairing.tolerance_us / 2:
        return Finding("skew", Verdict.WARN, seen, f"if triggered, set pairing.offset_us = {skew.offset_us:.0f}")
    return Finding("skew", Verdict.PASS, seen)


def _pictures(pair: StereoPair) -> Iterator[Finding]:
    for side, image in (("left", pair.left.image), ("right", pair.right.image)):
        yield _picture(side, image)


def _picture(side: str, image: Image) -> Finding:
    saturated, middle = float(np.mean(image >= _SATURATED)), float(np.median(image))
    seen = f"{side}: median {middle:.0f} of 255, {100 * saturated:.1f} % saturated"
    if saturated > _MOST_SATURATED:
        return Finding("exposure", Verdict.WARN, seen, "shorten cameras.exposure_us, or lower cameras.gain")
    if middle < _DARK:
        return Finding("exposure", Verdict.WARN, seen, "more light, or a longer cameras.exposure_us")
    return Finding("exposure", Verdict.PASS, seen)


def _disk(config: Config) -> Iterator[Finding]:
    cameras = config.cameras
    pair_bytes = 2 * cameras.size_px[0] * cameras.size_px[1] * cameras.recorded_bits // 8
    needed = pair_bytes * (cameras.rate_hz or 60.0) * _COMPRESSED_TO / 1e6
    folder = config.recording.folder or Path.cwd()
    try:
        reached = _written_mb_per_s(folder)
        free_gb = _free_gb(folder)
    except OSError as error:
        yield Finding("disk", Verdict.FAIL, f"{folder}: {error.strerror}", "name another in recording.folder")
        return
    seen = f"{folder}: {reached:.0f} MB/s, recording needs about {needed:.0f}; {free_gb:.0f} GB free"
    if reached < needed * _DISK_RESERVE:
        yield Finding("disk", Verdict.WARN, seen, "an NVMe disk, or record fewer frames: some will be dropped")
    else:
        yield Finding("disk", Verdict.PASS, seen)


def _written_mb_per_s(folder: Path) -> float:
    block = np.random.default_rng(0).bytes(1 << 20)
    with tempfile.TemporaryFile(dir=folder) as file:
        began_s = time.perf_counter()
        for _ in range(_DISK_TEST_MB):
            file.write(block)
        file.flush()
        os.fdatasync(file.fileno())
        return _DISK_TEST_MB * len(block) / 1e6 / (time.perf_counter() - began_s)


def _free_gb(folder: Path) -> float:
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize / 1e9


def _clock() -> Iterator[Finding]:
    state = 0
    with suppress(AttributeError):
        # struct timex, all zero: a question and no change.
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))
    if state == _TIME_ERROR:
        yield Finding(
            "clock", Verdict.WARN, "Unix time is not synchronized", "run chrony, or PTP where hosts compare times"
        )
    else:
        yield Finding("clock", Verdict.PASS, f"Unix time is synchronized; stamps are {Clock.MONOTONIC.value} as a rule")


def _rights(config: Config) -> Iterator[Finding]:
    priority = config.daemon.realtime_priority
    if priority and not may_schedule(priority):
        yield Finding("scheduling", Verdict.WARN, "no real-time scheduling", f"LimitRTPRIO={priority} in the unit")
    else:
        yield Finding(
            "scheduling", Verdict.PASS, "real-time scheduling is permitted" if priority else "ordinary, as set"
        )
    if config.daemon.lock_memory and not may_lock_memory():
        yield Finding("memory", Verdict.WARN, "may not be locked", "LimitMEMLOCK=infinity in the unit")
    else:
        yield Finding("memory", Verdict.PASS, "may be locked" if config.daemon.lock_memory else "is not to be locked")


def _endpoints(config: Config, *, listening: bool) -> Iterator[Finding]:
    listen = config.publishing.listen
    if not listening:
        try:
            open_session(listen, tls=TlsFiles.configured(config.publishing.tls)).close()  # type: ignore[no-untyped-call]
            yield Finding("zenoh", Verdict.PASS, f"can listen on {', '.join(listen)}")
        except NeedletrackError as error:
            yield Finding("zenoh", Verdict.FAIL, str(error), "see publishing.listen")
    for endpoint in open_endpoints(listened_on(config)):
        yield Finding(
            "security",
            Verdict.WARN,
            f"{endpoint}: anybody on the network may read, publish on our keys, and answer in our place",
            "listen on loopback, or set publishing.tls (docs/security.md)",
        )
    for endpoint in config.publishing.connect:
        yield _reached(endpoint)


def _reached(endpoint: str) -> Finding:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdecimal():
        return Finding("zenoh", Verdict.WARN, f"{endpoint}: only tcp and tls are tried here")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_WITHIN_S).close()
    except OSError as error:
        fault = error.strerror or str(error)
        return Finding("zenoh", Verdict.WARN, f"{endpoint}: {fault}", "start the router, or correct publishing.connect")
    return Finding("zenoh", Verdict.PASS, f"{endpoint} answers")


def worst(findings: Sequence[Finding]) -> Verdict:
    """The worst of several verdicts."""
    found = {finding.verdict for finding in findings}
    return Verdict.FAIL if Verdict.FAIL in found else Verdict.WARN if Verdict.WARN in found else Verdict.PASS
