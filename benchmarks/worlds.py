"""Drawn sequences: slow steering of a steel needle before texture, vessels and a rod, in two sizes; and steer-b.

A few pairs are drawn once and played forward and backward, so that the needle never jumps; stamps go on at the rate.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, count, cycle
from threading import Event

from benchmarks.frames import SEQUENCE, PreloadedRecording
from needletrack.records import DropReason, StereoPair
from needletrack.rig import Rig
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import STEEL, Rod, World

SMALL_PX, LARGE_PX = (1280, 1024), (2560, 2048)
# 60 of 2560x2048 are 630 MB.
DRAWN_PAIRS, RATE_HZ = 40, 60.0
_ROD = Rod((-45.0, -30.0, 235.0), (-38.0, 45.0, 240.0))
STEERED = NeedleMotion(
    (8.0, -34.0, 246.0),
    (0.12, 1.0, 0.12),
    Wave(60.0, 8.0, 8.0),
    bend_per_mm=Wave(0.003, 0.003, 6.0),
    bend_plane_rad=Wave(0.3, 0.3, 7.0),
    shift_mm=(Wave(0.0, 1.0, 5.0), Wave(0.0, 1.0, 6.0), Wave(0.0, 1.0, 7.0)),
)


@dataclass(frozen=True, eq=False)
class Sequence:
    """Pairs in memory, to be played forward and backward at a rate."""

    name: str
    rig: Rig
    pairs: tuple[StereoPair, ...]
    rate_hz: float

    @property
    def frames_mb(self) -> float:
        """What the images take in memory, megabytes (10^6 bytes)."""
        return sum(pair.left.image.nbytes + pair.right.image.nbytes for pair in self.pairs) / 1e6

    def play(self) -> Iterator[StereoPair]:
        """The pairs without end, with stamps and numbers that go on."""
        order = chain(range(len(self.pairs)), range(len(self.pairs) - 2, 0, -1))
        for number, index in zip(count(), cycle(order), strict=False):
            yield stamped(self.pairs[index], round(number * 1e9 / self.rate_hz), number)


def stamped(pair: StereoPair, stamp_ns: int, sequence: int) -> StereoPair:
    """The pair under another stamp and number."""
    left, right = (replace(frame, captured_at_ns=stamp_ns) for frame in (pair.left, pair.right))
    return replace(pair, left=left, right=right, sequence=sequence)


def steered_world(size_px: tuple[int, int], needle: NeedleMotion = STEERED) -> World:
    """The world of the drawn sequences, before cameras of an image size (width, height)."""
    return World(default_rig(size_px), needle, Background(contrast=12.0, vessels=5), STEEL, seed=1, rods=(_ROD,))


def rig_of(size_px: tuple[int, int]) -> Rig:
    """The drawn worlds' rig of an image size, with a name."""
    rig = default_rig(size_px)
    return Rig(rig.left, rig.right, rig.right_from_left, f"drawn-{size_px[0]}")


def drawn(size_px: tuple[int, int], pairs: int = DRAWN_PAIRS, done: Callable[[], None] = lambda: None) -> Sequence:
    """Slow steering, drawn at an image size; a tenth of a second a pair at 1280x1024, three at 2560x2048."""
    taken = []
    for pair, _ in steered_world(size_px).pairs(RATE_HZ, pairs):
        taken.append(pair)
        done()
    return Sequence(f"drawn {size_px[0]}×{size_px[1]}", rig_of(size_px), tuple(taken), RATE_HZ)


def recorded() -> Sequence:
    """The bundled sequence, decoded."""
    recording = PreloadedRecording(SEQUENCE.folder)
    pairs = tuple(recording.read(index) for index in range(len(recording)))
    seconds = (pairs[-1].captured_at_ns - pairs[0].captured_at_ns) / 1e9
    return Sequence(SEQUENCE.name, recording.rig, pairs, (len(pairs) - 1) / seconds)


class Playing:
    """A source of a sequence's pairs without end, as fast as they are taken."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Nothing is lost here."""
        return {}

    def pairs(self, stop: Event) -> Iterator[StereoPair]:
        """The pairs until `stop` is set."""
        for pair in self._sequence.play():
            if stop.is_set():
                return
            yield pair
