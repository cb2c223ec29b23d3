"""A recording through the live loop: what the replay command, its tool and the demo share."""

import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Event
from typing import Literal

from needletrack.auditing import AuditedTracker, RepeatedTracker
from needletrack.config import Config
from needletrack.errors import RecordingError
from needletrack.publish.message import RunContext, Source, TrackMessage
from needletrack.publish.publisher import ZenohPublisher
from needletrack.publish.tls import TlsFiles
from needletrack.reading import text_of
from needletrack.recording.asl import UnusablePair
from needletrack.recording.mcap_file import McapRecording
from needletrack.recording.replay import ReplaySource, StoredRecording
from needletrack.recording.stored import open_stored
from needletrack.recording.tracks import TrackFile
from needletrack.records import NeedleTrack, StereoPair
from needletrack.rig import Rig, find_rig, import_camchain, read_rig
from needletrack.service import RunSummary, Service, Sink, Tracker
from needletrack.tracking.reference import track_reference
from needletrack.tracking.track import track_pair

_log = logging.getLogger(__name__)

Method = Literal["curve", "reference"]


class Replay:
    """A recording that is ready to run through the same service as live pairs.

    method: our own, or the 2017 reference. paced: at the recorded pace, pairs are dropped where tracking is
    too slow; otherwise every pair is tracked, and two runs give the same bytes. independent: every pair
    starts without memory. as_published: the pairs that were tracked live, each from what it was tracked from live, so
    that the tracks are those that were published; otherwise what an audit finds in a pair is gone on from at once,
    which is better. start, end, loop: as of ReplaySource. Raises CalibrationError where the rig sees nothing of the
    workspace, RecordingError where there is nothing to play or no track was recorded to go by.
    """

    def __init__(
        self,
        recording: StoredRecording,
        config: Config,
        *,
        method: Method = "curve",
        paced: bool = False,
        independent: bool = False,
        as_published: bool = False,
        start: int = 0,
        end: int | None = None,
        loop: int = 1,
    ) -> None:
        rig = recording.rig
        rig.require_view_of(config.tracking.workspace)
        self.recording, self.config, self.method, self.independent = recording, config, method, independent
        self._start, self._paced = start, paced
        self._tracker = _tracker(method, rig, config, paced=paced)
        tracked_ns: Mapping[int, int | None] | None = None
        if as_published:
            if paced or independent or method != "curve" or loop > 1:
                raise RecordingError(
                    "tracks are repeated as published once, by our own method, every pair from the one before: "
                    "leave --paced, --independent, --loop and --method out"
                )
            tracked_ns = _published(recording)
            searched_in_ns = {now: searched for now, searched in tracked_ns.items() if searched is not None}
            self._tracker = RepeatedTracker(rig, config.tracking, searched_in_ns)
        self.source = ReplaySource(recording, paced=paced, start=start, end=end, loop=loop, only_ns=tracked_ns)
        if warning := rig.age_warning(config.rig.max_age_days, datetime.now(UTC)):
            _log.warning("%s", warning)
        self.context = RunContext(
            rig.name, Source.REPLAY, config.digest, rig.digest, frame_id=rig.frame_id, deterministic=not paced
        )
        self.service = Service(
            self.source,
            self._tracker,
            rig,
            self.context,
            every_frame=not paced,
            independent=independent,
            heartbeat_s=config.publishing.heartbeat_s,
            drift=config.drift,
            max_age_days=config.rig.max_age_days,
        )

    def warm_up(self) -> None:
        """Track the first pair once, for nothing: the first call of every library takes a multiple of the next."""
        with suppress(UnusablePair):  # it will be counted when its turn comes
            self._tracker(self.recording.read(self._start), None)

    def publisher(self, endpoint: str) -> ZenohPublisher:
        """Where this run's messages are published: listens on `endpoint`, the rest as configured."""
        return ZenohPublisher(
            self.context,
            self.service.status,
            listen=[endpoint],
            connect=self.config.publishing.connect,
            key_prefix=self.config.publishing.key_prefix,
            heartbeat_s=self.config.publishing.heartbeat_s,
            tls=TlsFiles.configured(self.config.publishing.tls),
        )

    def run(
        self,
        stop: Event,
        *,
        output: Path | None = None,
        publish: str | None = None,
        sinks: Sequence[Sink] = (),
    ) -> RunSummary:
        """Play to the end or until `stop` is set, into a file of tracks, to an endpoint, and into sinks."""
        if self._paced:
            self.warm_up()
        with ExitStack() as opened:
            if self._paced and isinstance(self._tracker, AuditedTracker):
                opened.enter_context(self._tracker).warm_up()
            into: list[Sink] = []
            # Opened before the endpoint: a file that cannot be written must not be announced on the wire.
            if output is not None:
                into.append(opened.enter_context(TrackFile(output)))
            if publish is not None:
                into.insert(0, Published(opened.enter_context(self.publisher(publish))))
            return self.service.run([*into, *sinks], stop)


class Published:
    """A sink that publishes every message."""

    def __init__(self, publisher: ZenohPublisher) -> None:
        self._publisher = publisher

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Publish the message; waits for no subscriber."""
        self._publisher.publish(message)


def open_recording(folder: Path, config: Config, rig_path: Path | None = None) -> StoredRecording:
    """A recording with its rig: rig_path's, else that of the configuration's rig.path, else its own.

    Raises RecordingError, CalibrationError.
    """
    chosen = rig_path or config.rig.path
    rig = None if chosen is None else rig_at(chosen)
    return open_stored(folder, rig, tolerance_us=config.pairing.tolerance_us)


def rig_at(path: Path) -> Rig:
    """The rig in a rig file, in a Kalibr camchain, or in a folder with either; raises CalibrationError."""
    if path.is_dir():
        return find_rig(path)
    return import_camchain(path) if _is_camchain(path) else read_rig(path)


def _is_camchain(path: Path) -> bool:
    # What cannot be read is no camchain: reading it as a rig file then says why.
    with suppress(OSError, UnicodeDecodeError):
        return re.search(r"(?m)^cam0\s*:", text_of(path)) is not None
    return False


def _published(recording: StoredRecording) -> dict[int, int | None]:
    """By the stamp of each pair that was tracked: that of the pair that was searched for its track, None for none."""
    told = recording.tracks() if isinstance(recording, McapRecording) else []
    if not told:
        raise RecordingError(
            f"{recording.folder}: no tracks were recorded with the pairs: replay without --as-published"
        )
    messages = [TrackMessage.from_json(message) for _, message in told]
    stamps_ns = {message.sequence: message.captured_at_ns for message in messages}
    return {
        message.captured_at_ns: None if message.searched_sequence is None else stamps_ns.get(message.searched_sequence)
        for message in messages
    }


def _tracker(method: Method, rig: Rig, config: Config, *, paced: bool) -> Tracker:
    def by_reference(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        return track_reference(pair, rig)

    def by_curve(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        return track_pair(pair, rig, config.tracking, previous)

    if method == "reference":
        return by_reference
    return AuditedTracker(rig, config.tracking) if paced else by_curve
