"""The calibration board before both cameras: the views that add something, with guidance, into a folder."""

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from needletrack.calibration.board import Board
from needletrack.capture.kernel import Kernel
from needletrack.capture.source import FrameSource
from needletrack.config import Config
from needletrack.daemon.cameras import both_cameras
from needletrack.errors import CaptureError
from needletrack.guidance import Guidance, collect
from needletrack.recording.board import BoardRecorder
from needletrack.records import DropReason, StereoPair
from needletrack.service import LatestSlot, newest_pairs

# USB cameras take most of a second to start; who holds a board does not wait long for a cable that is out.
PATIENCE_S = 10.0


class NewestPairs:
    """A source that gives its newest pair: to look for a board takes longer than a frame, and the cameras go on.

    has_begun: whether it gave one.
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self.has_begun = False

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Frames lost so far by reason, without the pairs that were passed over."""
        return self._source.dropped

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        """The newest pair each time; sets `stop` on every way out."""
        for arrival in newest_pairs(self._source, LatestSlot(), stop):
            self.has_begun = True
            yield arrival.pair


def collect_live(
    config: Config,
    board: Board,
    folder: Path,
    stop: threading.Event,
    told: Callable[[Guidance], None] = lambda guidance: None,
    *,
    enough: int | None = None,
    kernel: Kernel | None = None,
) -> Guidance | None:
    """Record the views of the board that add something, by `collect`; a camera that breaks off is waited for.

    Raises CaptureError where the cameras do not do what is configured, or give no pair within PATIENCE_S from the
    start; RecordingError as BoardRecorder does.
    """
    cameras = both_cameras(config, kernel)
    recorder = BoardRecorder(folder)
    newest = NewestPairs(cameras)
    gave_up = threading.Event()

    def give_up() -> None:
        if not newest.has_begun and not stop.is_set():
            gave_up.set()
            stop.set()

    patience = threading.Timer(PATIENCE_S, give_up)
    patience.daemon = True
    patience.start()
    try:
        last = collect(newest, board, recorder, stop, told, enough=enough)
    finally:
        patience.cancel()
    if gave_up.is_set() and last is None:
        why = cameras.last_error or "the cameras are there, but no left and right frame pair"
        raise CaptureError(f"no pair of pictures within {PATIENCE_S:g} s: {why}; `needletrack doctor` tells more")
    return last
