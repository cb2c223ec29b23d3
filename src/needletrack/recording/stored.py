"""Any recording by its path: a folder in the ASL layout, a file of ours, a ROS bag."""

import shutil
from pathlib import Path
from typing import Literal

import cv2

from needletrack.errors import RecordingError
from needletrack.recording.asl import AslRecording, UnusablePair
from needletrack.recording.bag import BagRecording, Copied, is_bag, write_bag, write_recording
from needletrack.recording.mcap_file import UNCALIBRATED, McapRecording, is_recording, size_only_rig
from needletrack.recording.png import png_size
from needletrack.recording.replay import StoredRecording
from needletrack.rig import RIG_FILE, Rig, write_rig


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


def write_asl(recording: StoredRecording, output: Path, *, with_rig: bool = True) -> Copied:
    """A recording as a folder in the EuRoC / ASL layout, PNG and data.csv; raises RecordingError, leaving nothing."""
    if output.exists():
        raise RecordingError(f"{output} exists already: name another folder, nothing is overwritten")
    listings: tuple[list[str], list[str]] = ([], [])
    left_out = []
    try:
        for camera in ("cam0", "cam1"):
            (output / camera / "data").mkdir(parents=True)
        for index in range(len(recording)):
            try:
                pair = recording.read(index)
            except UnusablePair as error:
                left_out.append(str(error))
                continue
            for number, frame in enumerate((pair.left, pair.right)):
                file = output / f"cam{number}" / "data" / f"{frame.captured_at_ns}.png"
                whole, data = cv2.imencode(".png", frame.pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                assert whole
                file.write_bytes(data.tobytes())
                listings[number].append(f"{frame.captured_at_ns},{file.name}\n")
        for number, lines in enumerate(listings):
            text = "#timestamp [ns],filename\n" + "".join(lines)
            (output / f"cam{number}" / "data.csv").write_text(text, encoding="utf-8")
        if with_rig:
            write_rig(recording.rig, output / RIG_FILE)
    except OSError as error:
        shutil.rmtree(output, ignore_errors=True)
        raise RecordingError(f"{output}: cannot be written: {error.strerror or error}") from error
    return Copied(output, len(listings[0]), tuple(left_out))
