"""What the daemon does when it is told to, while it tracks (docs/wire.md, Control)."""

import hmac
import stat
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from needletrack.config import DEFAULT_NEEDLE, Config, ControlConfig
from needletrack.errors import ConfigError, RecordingError
from needletrack.publish.control import (
    ControlCode,
    ControlRefused,
    ControlRequest,
    Handler,
    NeedleRequest,
    Outcome,
    RedetectRequest,
    SnapshotRequest,
    StartRecordingRequest,
    StopRecordingRequest,
)
from needletrack.publish.message import TrackMessage
from needletrack.recording.snapshot import write_snapshot
from needletrack.records import NeedleTrack, StereoPair
from needletrack.rig import Rig
from needletrack.service import Service, Tracker

if TYPE_CHECKING:
    from needletrack.recording.mcap_file import About
    from needletrack.recording.recorder import Recorder

_PAIR_WITHIN_S = 2.0
_FILE_BEGUN_WITHIN_S = 1.0
_FILE_FINISHED_WITHIN_S = 5.0
_LOOK_EVERY_S = 0.01
_LEAST_TOKEN = 16


class Newest:
    """A sink that keeps the newest pair with its track, for whoever waits for the next one."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: tuple[StereoPair, TrackMessage] | None = None
        self._count = 0

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """One pair's result; returns at once."""
        with self._changed:
            self._newest = pair, message
            self._count += 1
            self._changed.notify_all()

    def next(self, timeout_s: float) -> tuple[StereoPair, TrackMessage] | None:
        """The first pair from now on and its message; None where none came in time."""
        with self._changed:
            seen = self._count
            self._changed.wait_for(lambda: self._count > seen, timeout_s)
            return self._newest if self._count > seen else None


class Operator:
    """Carries requests out: each method takes one and returns what its answer says; raises ControlRefused.

    One thread calls it; nothing here waits for tracking, or lets tracking wait. tracker_of: the tracker of a
    configuration, ready to be called in place of the one before; about: what a recording of it says of itself.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config,
        service: Service,
        recorder: "Recorder | None",
        *,
        tracker_of: Callable[[Config], Tracker],
        about: "Callable[[Config], About]",
    ) -> None:
        self._rig, self._config, self._service, self._recorder = rig, config, service, recorder
        self._tracker_of, self._about = tracker_of, about
        self.newest = Newest()
        self.needle = DEFAULT_NEEDLE
        self._in_use = config

    @property
    def handlers(self) -> Mapping[str, Handler]:
        """The work of each command."""
        return {
            StartRecordingRequest.command: self.start_recording,
            StopRecordingRequest.command: self.stop_recording,
            SnapshotRequest.command: self.snapshot,
            RedetectRequest.command: self.redetect,
            NeedleRequest.command: self.change_needle,
        }

    def start_recording(self, request: StartRecordingRequest) -> dict[str, object]:
        """Record from the next pair on; the answer waits for the file's name as long as cameras usually take."""
        recorder = self._required_recorder()
        changed = recorder.begin(self._about(self._in_use))
        until_s = time.monotonic() + _FILE_BEGUN_WITHIN_S
        while not recorder.state.is_open and recorder.state.error is None and time.monotonic() < until_s:
            time.sleep(_LOOK_EVERY_S)
        state = recorder.state
        if state.error is not None:
            # It is tried again for as long as recording is on: that is for whoever asked to decide.
            raise ControlRefused(
                ControlCode.DISK, f"recording is on, but pauses: {state.error}", outcome=Outcome.FAILED
            )
        return {"changed": changed, "file": state.file if state.is_open else None}

    def stop_recording(self, request: StopRecordingRequest) -> dict[str, object]:
        """Record no more, and finish the file."""
        recorder = self._required_recorder()
        try:
            changed = recorder.end(_FILE_FINISHED_WITHIN_S)
        except RecordingError as error:
            raise ControlRefused(ControlCode.DISK, str(error), outcome=Outcome.FAILED) from error
        return {
            "changed": changed,
            "file": recorder.state.file or None,
            "pairs": recorder.recorded,
            "dropped": recorder.dropped,
        }

    def snapshot(self, request: SnapshotRequest) -> dict[str, object]:
        """Write the next pair, its rig and its track into a folder."""
        folder = self._config.control.snapshot_folder or self._config.recording.folder
        if folder is None:
            raise ControlRefused(
                ControlCode.NOT_CONFIGURED, "there is no folder: set control.snapshot_folder or recording.folder"
            )
        if (next_one := self.newest.next(_PAIR_WITHIN_S)) is None:
            raise ControlRefused(
                ControlCode.NO_PAIR,
                f"no pair was tracked within {_PAIR_WITHIN_S:g} s: do the cameras deliver any (status.cameras)?",
                outcome=Outcome.FAILED,
            )
        pair, message = next_one
        try:
            path = write_snapshot(folder, self._rig, pair, message, min_free_mb=self._config.recording.min_free_mb)
        except RecordingError as error:
            raise ControlRefused(ControlCode.DISK, str(error), outcome=Outcome.FAILED) from error
        return {"folder": str(path), "sequence": message.sequence, "status": message.status}

    def redetect(self, request: RedetectRequest) -> dict[str, object]:
        """Track the next pair without memory of the ones before."""
        return {"after_sequence": self._service.forget()}

    def change_needle(self, request: NeedleRequest) -> dict[str, object]:
        """Track the next pair as a needle of another type; a recording goes on in a new file, which says so."""
        try:
            config = self._config.with_needle(request.needle)
        except ConfigError as error:
            raise ControlRefused(ControlCode.UNKNOWN_NEEDLE, str(error)) from error
        if request.needle == self.needle:
            return {"changed": False, "needle": self.needle, "config_digest": config.digest}
        after = self._service.use(self._tracker_of(config), config.digest)
        self.needle, self._in_use = request.needle, config
        if self._recorder is not None:
            try:
                self._recorder.renew(self._about(config))
            except RecordingError as error:
                raise ControlRefused(
                    ControlCode.DISK,
                    f"the needle is {request.needle} from now on, but the recording's file says another: {error}",
                    outcome=Outcome.FAILED,
                ) from error
        return {"changed": True, "needle": request.needle, "config_digest": config.digest, "after_sequence": after}

    def _required_recorder(self) -> "Recorder":
        if self._recorder is None:
            raise ControlRefused(
                ControlCode.NOT_CONFIGURED, "recording.folder is not set in the daemon's configuration"
            )
        return self._recorder


def authority(settings: ControlConfig) -> Callable[[ControlRequest], None]:
    """Who is let in: nobody where control is not enabled, else whoever bears the token, where there is one.

    Which certificates may ask at all is for the access rules of the session. Raises ConfigError for a token file that
    cannot be used; the token itself is in no message.
    """
    token = None if settings.token_file is None or not settings.enabled else read_token(settings.token_file)

    def require(request: ControlRequest) -> None:
        if not settings.enabled:
            raise ControlRefused(
                ControlCode.DISABLED, "control is not enabled: set control.enabled in the daemon's configuration"
            )
        if token is not None and not hmac.compare_digest(token.encode(), (request.token or "").encode()):
            raise ControlRefused(
                ControlCode.UNAUTHORISED,
                f"the token is {'wrong' if request.token else 'missing'}: it is in the daemon's control.token_file",
            )

    return require


def read_token(path: Path) -> str:
    """The secret in a file that its owner alone may read; raises ConfigError that says how to mend it."""
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ConfigError(f"{path}: cannot read the control token: {reason}") from error
    if not stat.S_ISREG(mode):
        raise ConfigError(f"{path}: the control token is no regular file")
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{path}: others may read the control token (mode {mode & 0o777:o}): chmod 600 {path}")
    if not _LEAST_TOKEN <= len(text) <= 256 or not text.isascii() or not text.isprintable():
        raise ConfigError(
            f"{path}: a control token has {_LEAST_TOKEN} to 256 printable ASCII characters on one line; "
            f"`openssl rand -hex 32 > {path}` makes one"
        )
    return text
