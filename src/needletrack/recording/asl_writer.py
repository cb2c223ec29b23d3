"""Recordings written as folders in the EuRoC / ASL layout."""

import shutil
from pathlib import Path

import cv2

from needletrack.errors import RecordingError
from needletrack.recording.asl import UnusablePair
from needletrack.recording.replay import Copied, StoredRecording
from needletrack.rig import RIG_FILE, write_rig


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
