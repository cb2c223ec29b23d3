"""Files that tracks are written to: JSONL holds the whole messages, CSV what a spreadsheet can use."""

import csv
import errno
import io
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.records import NeedleTrack, StereoPair

CSV_COLUMNS = (
    *("sequence", "captured_at_ns", "clock", "captured_at_unix_ns", "published_at_ns", "latency_ms"),
    *("status", "reasons", "length_mm", "sigma_mm_max"),
    *("tip_x_mm", "tip_y_mm", "tip_z_mm", "tip_sigma_x_mm", "tip_sigma_y_mm", "tip_sigma_z_mm"),
    *("tip_direction_x", "tip_direction_y", "tip_direction_z"),
    *("tip_velocity_x_mm_s", "tip_velocity_y_mm_s", "tip_velocity_z_mm_s", "tip_seen"),
    *("base_x_mm", "base_y_mm", "base_z_mm", "base_direction_x", "base_direction_y", "base_direction_z"),
    *("reprojection_rms_px", "epipolar_rms_px", "coverage", "pair_skew_us", "dropped"),
)
_UNKNOWN = (None, None, None)


class TrackFile:
    """A sink that writes one line a pair: JSON where the name ends in .jsonl, a table where it ends in .csv.

    Each line has left this process when `take` returns; an older file of that name is replaced. Raises
    RecordingError with the remedy for another ending, and where the file cannot be written, also later, when
    the disk is full.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.lines = 0
        header, self._line = _form(self.path)
        try:
            self._file = self.path.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise self._unwritable(error) from error
        self._write(header)

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Add one message."""
        self._write(self._line(message))
        self.lines += 1

    def close(self) -> None:
        """Close the file; may be called twice."""
        try:
            self._file.close()
        except OSError as error:
            raise self._unwritable(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, text: str) -> None:
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            # Closing tries once more to write what is left, and fails as this did.
            with suppress(OSError):
                self._file.close()
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> RecordingError:
        remedies = {
            errno.ENOENT: f"make the folder {self.path.parent} first, or name another",
            errno.ENOSPC: f"free some space, or name a file on another disk ({self.lines} tracks are in it)",
        }
        remedy = remedies.get(error.errno or 0, "name a file in a folder that you may write to")
        fault = error.strerror or error
        return RecordingError(f"{self.path}: the tracks cannot be written: {fault}: {remedy}")


def _form(path: Path) -> tuple[str, Callable[[TrackMessage], str]]:
    """What a file begins with, and the line for a message."""
    match path.suffix.lower():
        case ".jsonl":
            return "", lambda message: message.to_json().decode() + "\n"
        case ".csv":
            return _csv_line(CSV_COLUMNS), lambda message: _csv_line(_csv_cells(message))
        case _:
            raise RecordingError(
                f"{path}: tracks are written as JSON lines or as a table: let the name end in .jsonl or .csv"
            )


def _csv_line(cells: Iterable[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _csv_cells(message: TrackMessage) -> tuple[object, ...]:
    """A message's values in the order of CSV_COLUMNS; None becomes an empty cell."""
    tip, base, quality = message.tip, message.base, message.quality
    return (
        message.sequence,
        message.captured_at_ns,
        message.clock.value,
        message.captured_at_unix_ns,
        message.published_at_ns,
        message.latency_ms,
        message.status.value,
        " ".join(message.reasons),
        message.length_mm,
        None if message.sigma_mm is None else max(message.sigma_mm),
        *(_UNKNOWN if tip is None else tip.position_mm),
        *(_UNKNOWN if tip is None else (math.sqrt(tip.covariance_mm2[axis][axis]) for axis in range(3))),
        *(_UNKNOWN if tip is None else tip.direction),
        *(_UNKNOWN if tip is None or tip.velocity_mm_s is None else tip.velocity_mm_s),
        None if tip is None else tip.seen,
        *(_UNKNOWN if base is None else base.position_mm),
        *(_UNKNOWN if base is None else base.direction),
        quality.reprojection_rms_px,
        quality.epipolar_rms_px,
        quality.coverage,
        quality.pair_skew_us,
        sum(message.dropped.values()),
    )
