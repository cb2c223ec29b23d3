"""A recording played as a source of pairs: at its own pace, or as fast as they are taken."""

import logging
import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Protocol

from needletrack.errors import RecordingError
from needletrack.recording.asl import ListedPair, Loss, UnusablePair
from needletrack.records import DropReason, StereoPair
from needletrack.rig import Rig

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Copied:
    """What was written: where, pairs, and a sentence for each pair that could not be read."""

    path: Path
    pairs: int
    left_out: tuple[str, ...]


class StoredRecording(Protocol):
    """What every kind of recording offers: its pairs in the order of their stamps, read one at a time."""

    @property
    def folder(self) -> Path:
        """Where it lies: a folder or a file."""
        ...

    @property
    def rig(self) -> Rig:
        """The rig that it was taken with, or that was named in its place."""
        ...

    @property
    def pairs(self) -> Sequence[ListedPair]:
        """Its pairs, images unread."""
        ...

    @property
    def losses(self) -> Sequence[Loss]:
        """Its frames that are in no pair."""
        ...

    def __len__(self) -> int:
        """Number of its pairs."""
        ...

    def read(self, index: int) -> StereoPair:
        """The pair at an index, which is its sequence number; raises UnusablePair. Called by one thread at a time."""
        ...


@dataclass(frozen=True, slots=True)
class _Step:
    """One pair's turn: which, under which stamp and number, and the losses that are passed with it."""

    index: int
    stamp_ns: int
    sequence: int
    losses: tuple[Loss, ...]


class ReplaySource:
    """Plays pairs `start` to `end` (exclusive, as in a Python slice; end None: to the last) of a recording.

    loop passes are played, alternately forward and backward, so that the needle never jumps; the pair at
    which the direction turns is played once. The first pass has the recorded stamps; later ones go on with
    the recorded intervals, mirrored where they run backward, so that stamps always increase. A pair's
    sequence number is its index in the first pass and counts on from there; an unusable pair leaves a gap.

    paced: each pair is released when the recorded interval since the first has passed, and says when that
    was; a late consumer gets every pair, without waiting, until it has caught up. Otherwise pairs come as
    fast as they are taken. only_ns: the stamps of the pairs to be played, None for all; the others are counted as
    overwritten. Raises RecordingError where the range is empty, or a loop has but one pair.
    """

    def __init__(
        self,
        recording: StoredRecording,
        *,
        paced: bool = False,
        start: int = 0,
        end: int | None = None,
        loop: int = 1,
        only_ns: Container[int] | None = None,
    ) -> None:
        self._recording, self._only_ns = recording, only_ns
        self._paced = paced
        self._range = range(start, len(recording) if end is None else min(end, len(recording)))
        self._loop = loop
        self._dropped: dict[DropReason, int] = {}
        if start < 0 or (end is not None and end < 0):
            raise RecordingError(f"start and end count from 0 and are not negative: {start}, {end}")
        if not self._range:
            wanted = f"{start} to {'the last' if end is None else end}"
            raise RecordingError(f"{recording.folder}: no pair from {wanted}: the recording has {len(recording)}")
        if loop < 1:
            raise RecordingError(f"a recording is played once or more, not {loop} times")
        if loop > 1 and len(self._range) < 2:
            raise RecordingError(f"{recording.folder}: a loop needs two pairs or more")

    def __len__(self) -> int:
        """Pairs to be played in all passes, unusable ones included."""
        return len(self._range) + (self._loop - 1) * (len(self._range) - 1)

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        """Frames lost so far by reason, each time that they were passed; may be read from another thread."""
        return dict(self._dropped)

    def pairs(self, stop: Event) -> Iterator[StereoPair]:
        """Yield the pairs until the last or until `stop` is set; the next one is decoded meanwhile."""
        origin_ns: int | None = None
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="needletrack-decode") as decoder:
            for step, pair in self._decoded_ahead(decoder):
                if self._paced and origin_ns is not None and _stopped_before(origin_ns + step.stamp_ns, stop):
                    return
                if stop.is_set():
                    return
                now_ns = time.monotonic_ns()
                origin_ns = now_ns - step.stamp_ns if origin_ns is None else origin_ns
                self._count(step.losses)
                if isinstance(pair, UnusablePair):
                    self._count(pair.losses)
                    if step.sequence == step.index:
                        _log.warning("pair %d is left out: %s", step.index, pair)
                    continue
                if self._only_ns is not None and step.stamp_ns not in self._only_ns:
                    self._dropped[DropReason.OVERWRITTEN] = self._dropped.get(DropReason.OVERWRITTEN, 0) + 1
                    continue
                yield _as_played(pair, step, now_ns if self._paced else None)

    def _count(self, losses: Iterable[Loss]) -> None:
        for loss in losses:
            self._dropped[loss.reason] = self._dropped.get(loss.reason, 0) + 1

    def _decoded_ahead(self, decoder: Executor) -> Iterator[tuple[_Step, StereoPair | UnusablePair]]:
        ahead: tuple[_Step, Future[StereoPair | UnusablePair]] | None = None
        for step in self._steps():
            following = step, decoder.submit(self._read, step.index)
            if ahead is not None:
                yield ahead[0], ahead[1].result()
            ahead = following
        if ahead is not None:
            yield ahead[0], ahead[1].result()

    def _read(self, index: int) -> StereoPair | UnusablePair:
        try:
            return self._recording.read(index)
        except UnusablePair as unusable:
            return unusable

    def _steps(self) -> Iterator[_Step]:
        count, first, last = len(self._recording), self._range[0], self._range[-1]
        stamps_ns = [listed.left.stamp_ns for listed in self._recording.pairs]
        losses: dict[int, list[Loss]] = {}
        for loss in self._recording.losses:
            losses.setdefault(loss.before, []).append(loss)
        sequence = first
        for number in range(self._loop):
            backward = number % 2 == 1
            turn = last if backward else first
            turned_at_ns = stamps_ns[first] + number * (stamps_ns[last] - stamps_ns[first])
            for index in reversed(self._range) if backward else self._range:
                if number and index == turn:
                    continue
                gaps = [] if index == turn and index > 0 else [index + backward]
                if number == 0 and index == count - 1:
                    gaps.append(count)
                passed = tuple(loss for gap in gaps for loss in losses.get(gap, ()))
                yield _Step(index, turned_at_ns + abs(stamps_ns[index] - stamps_ns[turn]), sequence, passed)
                sequence += 1


def _stopped_before(due_ns: int, stop: Event) -> bool:
    """Wait for a moment of the monotonic clock; True where `stop` was set before it came."""
    while (early_ns := due_ns - time.monotonic_ns()) > 0:
        if stop.wait(early_ns / 1e9):
            return True
    return False


def _as_played(pair: StereoPair, step: _Step, released_at_ns: int | None) -> StereoPair:
    """The pair under its step's stamp and number; both frames move by the same time."""
    shift_ns = step.stamp_ns - pair.left.captured_at_ns
    return replace(
        pair,
        left=replace(pair.left, captured_at_ns=pair.left.captured_at_ns + shift_ns),
        right=replace(pair.right, captured_at_ns=pair.right.captured_at_ns + shift_ns),
        sequence=step.sequence,
        released_at_ns=released_at_ns,
    )
