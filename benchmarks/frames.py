"""The bundled recordings, from memory: decoding is measured apart."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from threading import Event

from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import StereoPair

RECORDINGS = Path(__file__).parents[1] / "tests" / "data" / "recordings"


@dataclass(frozen=True)
class Scene:
    """A bundled recording; independent: stills, each tracked without memory of the one before."""

    name: str
    independent: bool

    @property
    def folder(self) -> Path:
        """Where the recording lies."""
        return RECORDINGS / self.name


STILLS = Scene("lab-a", independent=True)
SEQUENCE = Scene("steer-b", independent=False)


class PreloadedRecording(AslRecording):
    """A recording whose pairs are all decoded on construction."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._decoded = tuple(super(PreloadedRecording, self).read(index) for index in range(len(self)))

    def read(self, index: int) -> StereoPair:
        """The decoded pair at an index."""
        return self._decoded[index]


def looped(recording: AslRecording, pairs: int) -> ReplaySource:
    """At least so many pairs of a recording, forward and backward in turn, as fast as they are taken."""
    turns = max(len(recording) - 1, 1)
    return ReplaySource(recording, loop=max(1, -(-(pairs - 1) // turns)))


def pairs_of(recording: AslRecording, count: int) -> Iterator[StereoPair]:
    """Exactly so many pairs of a recording, played forward and backward in turn."""
    return islice(looped(recording, count).pairs(Event()), count)
