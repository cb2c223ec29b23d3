"""Any recording by its path: a folder in the ASL layout, a file of ours, a ROS bag."""

from pathlib import Path
from typing import Literal

from needletrack.errors import RecordingError
from needletrack.recording.asl import AslRecording
from needletrack.recording.asl_writer import write_asl
from needletrack.recording.bag import BagRecording, is_bag, write_bag, write_recording
from needletrack.recording.mcap_file import UNCALIBRATED, McapRecording, is_recording, size_only_rig
from needletrack.recording.png import png_size
from needletrack.recording.replay import Copied, StoredRecording
from needletrack.rig import Rig


def open_stored(path: Path, rig: Rig | None = None, *, tolerance_us: float = 1000.0) -> StoredRecording:
    """The recording at a path, of whatever kind; rig: the one to use, or None for the recording's own.

    Raises RecordingError, CalibrationError.
    """
    if path.is_file() and is_recording(path):
        return McapRecording(path, rig)
    if is_bag(path):
        return BagRecording(path, rig, tolerance_us=tolerance_us)
    return AslRecording(path, rig, tolerance_us=tolerance_us)


def open_pictures(path: Path, *, tolerance_us: float = 1000.0) -> StoredRecording:
    """The recording at a path for its images alone: it needs no rig, and one that does not fit is no fault.

    Raises RecordingError.
    """
    if path.is_file() and is_recording(path):
        return McapRecording(path, without_rig=True)
    if is_bag(path):
        return BagRecording(path, tolerance_us=tolerance_us, without_rig=True)
    pictures = sorted((path / "cam0" / "data").glob("*.png"))
    # One whose images are all broken says so itself.
    size_px = next((size for picture in pictures if (size := png_size(picture))), (640, 480))
    return AslRecording(path, size_only_rig(size_px, UNCALIBRATED), tolerance_us=tolerance_us)


def export(path: Path, output: Path, to: Literal["asl", "ros2"], rig: Rig | None = None) -> Copied:
    """Any recording as ASL folders or as a ROS 2 bag; one without a rig is written without one.

    Raises RecordingError, CalibrationError.
    """
    if path.is_file() and is_recording(path):
        ours = McapRecording(path, rig, without_rig=True)
        if to == "asl":
            return write_asl(ours, output, with_rig=ours.has_rig)
        return write_bag(ours, output, with_rig=ours.has_rig, tracks=ours.tracks())
    stored = open_stored(path, rig)
    return write_asl(stored, output) if to == "asl" else write_bag(stored, output)


def import_recording(
    path: Path, output: Path, rig: Rig, *, topics: tuple[str, str] | None = None, tolerance_us: float = 1000.0
) -> Copied:
    """A ROS bag, or an ASL folder, as a recording of ours that holds the rig; raises RecordingError."""
    if output.exists():
        raise RecordingError(f"{output} exists already: name another file, nothing is overwritten")
    if is_bag(path):
        source: StoredRecording = BagRecording(path, rig, tolerance_us=tolerance_us, topics=topics)
    else:
        source = AslRecording(path, rig, tolerance_us=tolerance_us)
    return write_recording(source, output, rig)
