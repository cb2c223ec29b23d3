"""Which pairs are shown in full, where not all are: the worst, but not all of one kind."""

import heapq
from itertools import zip_longest
from typing import NamedTuple

from needletrack.records import NeedleTrack, Status
from needletrack.report.figures import PairFigures

# In the order in which they are asked; what nobody need look at comes last.
_KINDS = 5


class _Entry(NamedTuple):
    """badness, then the earlier pair first; what follows is never compared, because no two pairs have one number."""

    badness: float
    minus_sequence: int
    figures: PairFigures
    track: NeedleTrack


class Worst:
    """Keeps at most `most` tracks of every kind, so that memory does not grow with the recording.

    The kinds, worst first: falsely ok; invalid although a needle is there, as far as is known; degraded; ok; invalid
    where no needle is.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: tuple[list[_Entry], ...] = tuple([] for _ in range(_KINDS))
        self._before: Status | None = None

    def add(self, figures: PairFigures, track: NeedleTrack) -> None:
        """One more track; the least bad of its kind is forgotten where there are too many."""
        # Of many pairs without a shape, the one at which the needle was lost says most.
        is_loss = self._before is not Status.INVALID
        self._before = figures.status
        entry = _Entry(badness(figures, is_loss=is_loss), -figures.sequence, figures, track)
        kept = self._kept[_kind(figures)]
        heapq.heappush(kept, entry)
        if len(kept) > self._most:
            heapq.heappop(kept)

    def chosen(self) -> list[tuple[PairFigures, NeedleTrack]]:
        """At most `most` tracks, worst first: all falsely ok ones, then as many of each kind as the places allow."""
        false_ok, *others, empty = (sorted(kept, reverse=True) for kept in self._kept)
        in_turn = [entry for entries in zip_longest(*others) for entry in entries if entry is not None]
        places = [*false_ok, *in_turn, *empty][: self._most]
        places.sort(key=lambda entry: (_kind(entry.figures), -entry.badness, -entry.minus_sequence))
        return [(entry.figures, entry.track) for entry in places]


def badness(figures: PairFigures, *, is_loss: bool = False) -> float:
    """How bad a track is among its kind: its true error where that is known, else its stated sigma."""
    if figures.status is Status.INVALID:
        return float(is_loss)
    error_mm = None if figures.truth is None else figures.truth.greatest_mm
    if error_mm is not None:
        return error_mm
    return max(figures.tip_sigma_mm or 0.0, figures.sigma_p95_mm or 0.0)


def _kind(figures: PairFigures) -> int:
    if figures.false_ok:
        return 0
    if figures.rightly_invalid:
        return _KINDS - 1
    return {Status.INVALID: 1, Status.DEGRADED: 2, Status.OK: 3}[figures.status]
