"""One pair and its track, kept: a recording of a single pair in the ASL layout, which replays as any other."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.recording.asl import ListedPair, Loss
from needletrack.recording.asl_writer import write_asl
from needletrack.records import StereoPair
from needletrack.rig import Rig

TRACK_FILE = "track.json"
_MB = 1_000_000


@dataclass(frozen=True)
class _OnePair:
    folder: Path
    rig: Rig
    pair: StereoPair
    pairs: Sequence[ListedPair] = ()
    losses: Sequence[Loss] = ()

    def __len__(self) -> int:
        return 1

    def read(self, index: int) -> StereoPair:
        return replace(self.pair, sequence=index)


def write_snapshot(folder: Path, rig: Rig, pair: StereoPair, message: TrackMessage, *, min_free_mb: int) -> Path:
    """A new folder below `folder`, named by rig, time and sequence, with the images, the rig and track.json.

    Under a name with a leading dot until it is whole. Raises RecordingError where the disk does not take it.
    """
    now = datetime.now(UTC)
    path = folder / f"{rig.name}-{now:%Y%m%dT%H%M%S}-snapshot-{pair.sequence}"
    partial = folder / f".{path.name}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        disk = os.statvfs(folder)
        free_mb = disk.f_bavail * disk.f_frsize / _MB
        if free_mb < min_free_mb:
            raise RecordingError(
                f"{folder}: {free_mb:.0f} MB are free, recording.min_free_mb is {min_free_mb}: free some space"
            )
        write_asl(_OnePair(partial, rig, pair), partial)
        (partial / TRACK_FILE).write_bytes(message.to_json() + b"\n")
        partial.rename(path)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path
