"""`needletrack run`: cameras to tracks on the wire, for as long as the day lasts."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

from needletrack.auditing import AuditedTracker
from needletrack.capture.kernel import Kernel
from needletrack.capture.live import LiveSource
from needletrack.capture.pairing import SkewReport
from needletrack.capture.source import FrameSource
from needletrack.config import Config
from needletrack.daemon.cameras import both_cameras
from needletrack.daemon.control import Operator, authority
from needletrack.daemon.metrics import Metrics
from needletrack.daemon.overlay import Overlays
from needletrack.daemon.process import AlreadyRunning, OnlyInstance, lock_memory, schedule_thread, settle_memory
from needletrack.daemon.systemd import Notifier
from needletrack.errors import CaptureError, ConfigError
from needletrack.publish.control import ControlCode, ControlDesk, ControlRefused
from needletrack.publish.keys import RigKeys
from needletrack.publish.message import RunContext, Source, TrackMessage, WireCamera, WireRecording, WireSkew
from needletrack.publish.overlay import OverlayPublisher
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.session import open_endpoints
from needletrack.publish.tls import TlsFiles
from needletrack.records import DropReason, NeedleTrack, StereoPair
from needletrack.rig import Rig
from needletrack.service import RunSummary, Service, Sink, Surroundings

if TYPE_CHECKING:
    from needletrack.recording.mcap_file import About
    from needletrack.recording.recorder import Recorder

_log = logging.getLogger(__name__)

# One that takes longer for a pair, or whose capture does not turn, is stuck: systemd may start it anew.
_STUCK_AFTER_S = 5.0
# A stop is done within a second: the pair in hand, the publisher, and this.
_RECORDER_ENDS_WITHIN_S = 0.4
_STATUS_EVERY_S = 1.0
# A needle changed is tracked from then on even where its second process is not there yet.
_AUDITOR_WITHIN_S, _LOOK_EVERY_S = 3.0, 0.05


class ExitCode(IntEnum):
    """How `needletrack run` ended."""

    STOPPED = 0
    FAILED = 1
    UNUSABLE = 2
    CAMERAS = 3
    ALREADY_RUNNING = 4


class RecordedSource:
    """A source whose every pair is offered to a recorder before it goes on."""

    def __init__(self, source: FrameSource, recorder: "Recorder") -> None:
        self._source, self._recorder = source, recorder

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Frames lost so far by reason; what was not recorded is not lost to tracking, and not here."""
        return self._source.dropped

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        """The source's pairs."""
        for pair in self._source.pairs(stop):
            self._recorder.offer(pair)
            yield pair


@dataclass(frozen=True)
class DaemonSummary:
    """What a run of the daemon did: the loop's summary, what the stamps say, and the recorder's counts."""

    run: RunSummary
    skew: SkewReport
    recorded: int | None
    unrecorded: int | None


class Daemon:
    """Cameras, tracker, publisher, recorder and metrics of one rig, as configured.

    kernel: where the cameras are (None: this machine's). Raises ConfigError where rig and cameras contradict each
    other, CalibrationError where the rig sees nothing of the workspace.
    """

    def __init__(self, rig: Rig, config: Config, *, kernel: Kernel | None = None) -> None:
        require_fit(rig, config)
        self.rig, self.config = rig, config
        self.context = RunContext(rig.name, Source.LIVE, config.digest, rig.digest, frame_id=rig.frame_id)
        self._cameras = both_cameras(config, kernel)
        self._recorder: Recorder | None = None
        self._operator: Operator | None = None
        self._desk: ControlDesk | None = None
        self._overlays: Overlays | None = None
        self.service: Service | None = None

    def run(self, stop: threading.Event, *, ready: Callable[[], None] = lambda: None) -> DaemonSummary:
        """Run until `stop` is set; ready is called once everything but the cameras is there.

        Raises AlreadyRunning, CaptureError, PublishError, RecordingError, and whatever a thread raised.
        """
        config, rig = self.config, self.rig
        with ExitStack() as opened:
            opened.enter_context(OnlyInstance(rig.name))
            may_control = authority(config.control)
            notifier = Notifier()
            opened.callback(notifier.close)
            source: FrameSource = self._cameras
            if config.recording.folder is not None:
                self._recorder = self._new_recorder(config.recording.folder)
                opened.callback(self._recorder.close, _RECORDER_ENDS_WITHIN_S)
                source = RecordedSource(source, self._recorder)
            trackers = _Trackers(rig)
            opened.callback(trackers.close)
            tracker = trackers.of(config)
            service = self.service = Service(
                source,
                tracker,
                rig,
                self.context,
                heartbeat_s=config.publishing.heartbeat_s,
                drift=config.drift,
                max_age_days=config.rig.max_age_days,
                surroundings=self.surroundings,
                in_threads=self._in_thread,
            )
            operator = self._operator = Operator(
                rig, config, service, self._recorder, tracker_of=trackers.ready, about=self._about
            )
            keys = RigKeys(rig.name, config.publishing.key_prefix)
            desk = self._desk = ControlDesk(self.context, keys, operator.handlers, may_control)
            publisher = opened.enter_context(self._publisher(service, desk))
            if config.publishing.overlay.rate_hz > 0:
                self._overlays = opened.enter_context(self._overlays_of(publisher))
            for endpoint in open_endpoints(listened_on(config)):
                may = "read and publish"
                if config.control.enabled and config.control.token_file is None:
                    may = "read, publish and command"
                _log.warning("anybody on the network may %s at %s: set publishing.tls", may, endpoint)
            metrics = opened.enter_context(Metrics(service, self.surroundings, config.daemon.metrics_port))
            if config.daemon.lock_memory:
                lock_memory()
            # The second process comes up meanwhile, which takes as long again: the first pairs need not wait for it.
            tracker.warm_up(within_s=0.0)
            settle_memory()
            opened.enter_context(_Pulse(notifier, service, self._cameras))
            opened.enter_context(desk)
            notifier.ready("waiting for both cameras")
            ready()
            if warning := rig.age_warning(config.rig.max_age_days, datetime.now(UTC)):
                _log.warning("%s", warning)
            _log.info("the daemon runs", extra={"rig_digest": rig.digest, "config_digest": config.digest})
            sinks: list[Sink] = [_Published(publisher), metrics, operator.newest]
            if self._recorder is not None:
                sinks.append(self._recorder)
            if self._overlays is not None:
                sinks.append(self._overlays)
            run = service.run(sinks, stop)
            notifier.stopping()
        recorder = self._recorder
        return DaemonSummary(
            run,
            self._cameras.skew,
            None if recorder is None else recorder.recorded,
            None if recorder is None else recorder.dropped,
        )

    def surroundings(self) -> Surroundings:
        """Cameras, skew and recorder as a heartbeat tells them."""
        cameras: dict[str, WireCamera] = {
            side: WireCamera.model_validate(asdict(health)) for side, health in self._cameras.health.items()
        }
        recording, recorder = None, self._recorder
        last_error = self._cameras.last_error
        if recorder is not None and recorder.begun:
            state = recorder.state
            recording = WireRecording(
                file=state.file,
                pairs=recorder.recorded,
                dropped=recorder.dropped,
                megabytes=state.megabytes,
                error=state.error,
            )
            last_error = state.error or last_error
        if self._overlays is not None:
            last_error = last_error or self._overlays.last_error
        skew = WireSkew.model_validate(asdict(self._cameras.skew))
        needle = None if self._operator is None else self._operator.needle
        counters = {} if self._desk is None else {f"control_{name}": n for name, n in self._desk.counts.items()}
        return Surroundings(cameras, skew, recording, last_error, needle, counters)

    def _publisher(self, service: Service, desk: ControlDesk) -> ZenohPublisher:
        settings = self.config.publishing
        return ZenohPublisher(
            self.context,
            service.status,
            listen=settings.listen,
            connect=settings.connect,
            key_prefix=settings.key_prefix,
            heartbeat_s=settings.heartbeat_s,
            control=desk.receive,
            tls=TlsFiles.configured(settings.tls),
        )

    def _overlays_of(self, publisher: ZenohPublisher) -> Overlays:
        settings, tls = self.config.publishing.overlay, TlsFiles.configured(self.config.publishing.tls)
        pictures = OverlayPublisher(publisher.keys, listen=settings.listen, connect=settings.connect, tls=tls)
        return Overlays(pictures, self.rig, settings.rate_hz, settings.jpeg_quality)

    def _new_recorder(self, folder: Path) -> "Recorder":
        # MCAP and ROS take 0.1 s to load, for which a daemon that records nothing does not wait.
        from needletrack.recording.recorder import Recorder, RecorderSettings

        settings = self.config.recording
        return Recorder(
            RecorderSettings(
                folder,
                buffer_mb=settings.buffer_mb,
                min_free_mb=settings.min_free_mb,
                max_file_mb=settings.max_file_mb,
            ),
            self._about(self.config),
            self.config.cameras.size_px,
            bits=self.config.cameras.recorded_bits,
            begun=settings.at_start,
        )

    def _about(self, config: Config) -> "About":
        from needletrack.recording.mcap_file import About  # the recorder has it already

        return About(self.rig, self.rig.name, self.context.run_id, config.model_dump_json())

    def _in_thread(self, name: str) -> None:
        settings = self.config.daemon
        # Capture before tracking: a late pair can be tracked, a lost buffer cannot.
        priority = settings.realtime_priority - (name == "tracking" and settings.realtime_priority > 1)
        schedule_thread(name, priority, settings.cpus)


class _Trackers:
    """The tracker in use, and those that come in its place; none outlives `close`."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._changing, self._closed = threading.Lock(), False
        self._newest: AuditedTracker | None = None

    def of(self, config: Config) -> AuditedTracker:
        """A configuration's tracker, its second process started, in place of the one before.

        That process ends with the thread that calls this.
        """
        with self._changing:
            self._refuse_at_the_end()
            self._newest = AuditedTracker(self._rig, config.tracking, after=self._newest).__enter__()
            return self._newest

    def ready(self, config: Config) -> AuditedTracker:
        """The same, once its second process is there: until then a needle that is lost is not looked for."""
        tracker, until_s = self.of(config), time.monotonic() + _AUDITOR_WITHIN_S
        while time.monotonic() < until_s:
            with self._changing:
                self._refuse_at_the_end()
                if tracker.warm_up(_LOOK_EVERY_S):
                    break
        return tracker

    def close(self) -> None:
        """End the second processes of all of them; to be called when nobody tracks any more."""
        with self._changing:
            self._closed = True
            if self._newest is not None:
                self._newest.close()

    def _refuse_at_the_end(self) -> None:
        if self._closed:
            raise ControlRefused(ControlCode.STOPPING, "the daemon is about to end")


class _Published:
    def __init__(self, publisher: ZenohPublisher) -> None:
        self._publisher = publisher

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self._publisher.publish(message)


class _Pulse:
    """Tells systemd twice in its interval that neither thread is stuck, as long as that is so."""

    def __init__(self, notifier: Notifier, service: Service, cameras: LiveSource) -> None:
        self._notifier, self._service, self._cameras = notifier, service, cameras
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="needletrack-pulse", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        self._thread.join()

    def _beat(self) -> None:
        every_s = min(self._notifier.watchdog_s / 2 or _STATUS_EVERY_S, _STATUS_EVERY_S)
        told = False
        while not self._stop.wait(every_s):
            silent_s = time.monotonic() - self._cameras.alive_at_s
            if max(silent_s, self._service.busy_s) < _STUCK_AFTER_S:
                states = ", ".join(f"{side} {health.state.value}" for side, health in self._cameras.health.items())
                self._notifier.alive(f"cameras: {states}; {sum(self._service.statuses.values())} pairs tracked")
                told = False
            elif not told:
                _log.error("stuck: capture for %.1f s, tracking for %.1f s", silent_s, self._service.busy_s)
                told = True


def require_fit(rig: Rig, config: Config) -> None:
    """Raise where the cameras' images are not the rig's, or the rig sees nothing of the workspace."""
    rig.require_view_of(config.tracking.workspace)
    if rig.left.size_px != config.cameras.size_px:
        wanted, set_to = ("x".join(map(str, size)) for size in (rig.left.size_px, config.cameras.size_px))
        raise ConfigError(
            f"cameras.size_px is {set_to}, but rig {rig.name} was calibrated at {wanted}: a calibration holds for its "
            "own size alone"
        )


def exit_code(error: Exception) -> ExitCode:
    """The code for an error that is raised on purpose."""
    if isinstance(error, AlreadyRunning):
        return ExitCode.ALREADY_RUNNING
    return ExitCode.CAMERAS if isinstance(error, CaptureError) else ExitCode.UNUSABLE


def listened_on(config: Config) -> tuple[str, ...]:
    """All endpoints at which the daemon listens, as configured."""
    settings = config.publishing
    return (*settings.listen, *(settings.overlay.listen if settings.overlay.rate_hz > 0 else ()))
