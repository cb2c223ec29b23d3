"""`needletrack record`: both cameras into a file, without tracking."""

import threading
import time
from dataclasses import dataclass
from pathlib import Path

from needletrack.capture.kernel import Kernel
from needletrack.capture.pairing import SkewReport
from needletrack.config import Config
from needletrack.daemon.cameras import both_cameras
from needletrack.daemon.process import schedule_thread
from needletrack.recording.mcap_file import UNCALIBRATED, About
from needletrack.recording.recorder import Recorder, RecorderSettings
from needletrack.records import DropReason
from needletrack.rig import Rig


@dataclass(frozen=True)
class RecordSummary:
    """What was recorded: pairs, those that were not, frames lost by reason, seconds, and what the stamps say."""

    pairs: int
    unrecorded: int
    dropped: dict[DropReason, int]
    duration_s: float
    megabytes: float
    skew: SkewReport


def record(
    config: Config,
    output: Path,
    stop: threading.Event,
    *,
    rig: Rig | None = None,
    seconds: float | None = None,
    pairs: int | None = None,
    kernel: Kernel | None = None,
) -> RecordSummary:
    """Record until `stop` is set, or so many seconds or pairs have come; rig: put into the file, not needed for it.

    Raises CaptureError, RecordingError.
    """
    cameras = both_cameras(config, kernel)
    name = UNCALIBRATED if rig is None else rig.name
    settings = RecorderSettings(
        output.parent,
        output,
        config.recording.buffer_mb,
        config.recording.min_free_mb,
        config.recording.max_file_mb,
    )
    about = About(rig, name, config=config.model_dump_json())
    with Recorder(settings, about, config.cameras.size_px, bits=config.cameras.recorded_bits) as recorder:
        schedule_thread("capture", config.daemon.realtime_priority, config.daemon.cpus)
        began_s: float | None = None
        until_s: float | None = None
        for number, pair in enumerate(cameras.pairs(stop), start=1):
            if began_s is None:
                began_s = time.monotonic()
                until_s = None if seconds is None else began_s + seconds
            recorder.offer(pair)
            if (until_s is not None and time.monotonic() >= until_s) or number == pairs:
                stop.set()
        duration_s = 0.0 if began_s is None else time.monotonic() - began_s
        # Nothing waits for it, so that it may take its time.
        recorder.close(timeout_s=30.0)
    return RecordSummary(
        recorder.recorded,
        recorder.dropped,
        dict(cameras.dropped),
        duration_s,
        recorder.state.megabytes,
        cameras.skew,
    )
