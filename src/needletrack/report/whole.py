"""A file that appears whole or not at all."""

import os
from contextlib import suppress
from pathlib import Path

from needletrack.errors import RecordingError


class WholeFile:
    """A file that appears whole or not at all; opened first, so that ten minutes' work is not done for nothing."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")

    def __enter__(self) -> "WholeFile":
        if self._path.is_dir():
            raise RecordingError(f"{self._path}: the report cannot be written: a folder; name a file, e.g. report.html")
        try:
            self._file = self._temporary.open("w", encoding="utf-8")
        except OSError as error:
            raise self._unwritable(error) from error
        return self

    def __exit__(self, *raised: object) -> None:
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink()

    def write(self, text: str) -> None:
        """Add to it."""
        try:
            self._file.write(text)
        except OSError as error:
            raise self._unwritable(error) from error

    def finish(self) -> int:
        """Give it its name; returns its size."""
        try:
            self._file.close()
            self._temporary.replace(self._path)
            return self._path.stat().st_size
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> RecordingError:
        remedy = "name a file in a folder that is there and that you may write to"
        if isinstance(error, FileNotFoundError):
            remedy = f"make the folder {self._path.parent} first, or name another"
        return RecordingError(f"{self._path}: the report cannot be written: {error.strerror or error}: {remedy}")
