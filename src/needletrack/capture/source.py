"""What a source of stereo pairs promises, live or recorded."""

from collections.abc import Iterator, Mapping
from threading import Event
from typing import Protocol

from needletrack.records import DropReason, StereoPair


class FrameSource(Protocol):
    """Delivers stereo pairs in the order of their stamps and counts every frame that it could not pair."""

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Frames lost so far by reason; may be read from another thread while `pairs` runs."""
        ...

    def pairs(self, stop: Event) -> Iterator[StereoPair]:
        """Yield pairs until the stream ends or `stop` is set; raises CaptureError or RecordingError."""
        ...
