"""Tracking beside which a second process looks again, without haste.

The needle is followed from pair to pair in the caller's thread, which takes milliseconds. Searches of whole images take
ten times as long: a process of its own makes them meanwhile. What it finds is gone on from at the next pair, and that
pair's track says in which pair it was found: a replay that makes the same searches at the same pairs gives the same
tracks, however busy the machine was. So no pair waits for a search but the first.
"""

import copyreg
import logging
import multiprocessing
import pickle
import time
from collections.abc import Mapping
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from types import MappingProxyType, TracebackType
from typing import Any, Self

import cv2
import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from needletrack.aside import give_way
from needletrack.records import Frame, NeedleTrack, StereoPair
from needletrack.rig import Rig
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import PAIRS_PER_AUDIT_OF_WEAK, adopted, audit, follow, search, warm_up

_log = logging.getLogger(__name__)

# An audit begins so many pairs after the one before at the soonest: at 60 pairs a second it takes as long as four of
# them, so that a track that has slid is noticed within ten.
_PAIRS_PER_AUDIT = 5
# A needle that is lost is looked for where it was for so long, in case something only passed before it.
_REMEMBERED_NS = 2_000_000_000
_RESTART_AFTER_S, _STARTS_WITHIN_S, _ENDS_WITHIN_S = 5.0, 30.0, 1.0


def _read_only(values: dict[str, float]) -> MappingProxyType[str, float]:
    return MappingProxyType(values)


# A track goes from one process to the other and back.
copyreg.pickle(MappingProxyType, lambda proxy: (_read_only, (dict(proxy),)))


class _Follower:
    """Follows a needle from pair to pair, and remembers where it was seen last."""

    def __init__(self, rig: Rig, parameters: TrackingParameters) -> None:
        self._rig, self._parameters = rig, parameters
        self._seen: NeedleTrack | None = None

    def begin(self, pair: StereoPair) -> NeedleTrack:
        """The track of a pair without memory: searched."""
        self._seen = None
        return self._remembered(search(pair, self._rig, self._parameters))

    def go_on(
        self, pair: StereoPair, previous: NeedleTrack, found: NeedleTrack | None, asked: NeedleTrack | None
    ) -> NeedleTrack:
        """The track of a pair after `previous`; found: what a search since made of a pair before, tracked `asked`."""
        is_from_found = found is not None and found.curve is not None
        if found is not None and is_from_found:
            previous = found if previous.curve is None else adopted(previous, found, asked)
        track = self._followed(pair, previous)
        if found is not None and is_from_found:
            track = replace(track, searched_sequence=found.searched_sequence)
        return self._remembered(track)

    def _followed(self, pair: StereoPair, previous: NeedleTrack) -> NeedleTrack:
        track, seen = follow(pair, self._rig, self._parameters, previous), self._seen
        if track.curve is not None or seen is None or seen is previous:
            return track
        if not 0 <= pair.captured_at_ns - seen.captured_at_ns < _REMEMBERED_NS:
            return track
        again = follow(pair, self._rig, self._parameters, seen)
        return again if again.curve is not None else track

    def _remembered(self, track: NeedleTrack) -> NeedleTrack:
        if track.curve is not None:
            self._seen = track
        return track


class AuditedTracker:
    """Our method, one pair after another, of a rig; as a context audits and searches run beside it, else in line.

    The first pair, and each that has no track before it, is searched here and now. after: the tracker in whose place
    this one comes; the thread that calls both closes it with the first pair given to this one, or `close` does.
    """

    def __init__(self, rig: Rig, parameters: TrackingParameters, *, after: "AuditedTracker | None" = None) -> None:
        self._rig, self._parameters = rig, parameters
        self._before = after
        self._auditor: _Auditor | None = None
        self._is_open, self._is_warm, self._failed_at_s = False, False, 0.0
        self._follower = _Follower(rig, parameters)
        self._since_audit = 0
        self._asked: tuple[StereoPair, NeedleTrack] | None = None
        self.failures = 0

    def __enter__(self) -> Self:
        self._auditor, self._is_open = _Auditor(self._rig, self._parameters), True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the second process, and that of the tracker before; what they are at is dropped. May be called twice."""
        self._is_open = False
        self._end()
        self._close_the_one_before()

    def _close_the_one_before(self) -> None:
        if self._before is not None:
            self._before.close()
            self._before = None

    def _end(self) -> None:
        if self._auditor is not None:
            self._auditor.close()
            self._auditor = None

    @property
    def pid(self) -> int | None:
        """The second process, while there is one."""
        return None if self._auditor is None else self._auditor.pid

    def warm_up(self, within_s: float = _STARTS_WITHIN_S) -> bool:
        """Make ready what the first pair needs, and wait until the second process is there.

        Whether it is, or there is none to wait for.
        """
        if not self._is_warm:
            warm_up(self._rig, self._parameters)
            self._is_warm = True
        if self._auditor is None:
            return True
        try:
            return self._auditor.wait(within_s)
        except (EOFError, OSError):
            self._give_up()
            return True

    def __call__(self, pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        """The track of this pair; previous: that of the pair before, None to start without memory."""
        self._close_the_one_before()
        if previous is None:
            self._asked, self._since_audit = None, 0
            track = self._follower.begin(pair)
        else:
            asked = None if self._asked is None else self._asked[1]
            track = self._follower.go_on(pair, previous, self._found(), asked)
        self._since_audit += 1
        self._look_again(pair, track)
        return track

    def _found(self) -> NeedleTrack | None:
        """What was found in the pair that was last looked at again, once, when it is there."""
        if self._asked is None:
            return None
        if not self._is_open:
            found: NeedleTrack | None = looked_again(*self._asked, self._rig, self._parameters)
        elif self._auditor is None:
            found = None
        else:
            try:
                found = self._auditor.found(0.0)
            except (EOFError, OSError):
                self._give_up()
                return None
        if found is not None:
            self._asked = None
        return found

    def _look_again(self, pair: StereoPair, track: NeedleTrack) -> None:
        wanted = PAIRS_PER_AUDIT_OF_WEAK if track.reasons else _PAIRS_PER_AUDIT
        if self._asked is not None or (track.curve is not None and self._since_audit < wanted):
            return
        if self._is_open and not self._is_asked(pair, track):
            return
        self._asked, self._since_audit = (pair, track), 0

    def _is_asked(self, pair: StereoPair, track: NeedleTrack) -> bool:
        if self._auditor is None:
            if time.monotonic() - self._failed_at_s < _RESTART_AFTER_S:
                return False
            self._auditor = _Auditor(self._rig, self._parameters)
        try:
            return self._auditor.look(pair, track)
        except (EOFError, OSError):
            self._give_up()
            return False

    def _give_up(self) -> None:
        self.failures += 1
        self._asked = None
        self._failed_at_s = time.monotonic()
        _log.warning("the process that audits tracks has ended; it is started again in %g s", _RESTART_AFTER_S)
        self._end()


class RepeatedTracker:
    """The tracks of a live run once more: its searches are made in line, and gone on from at the same pairs.

    searched_in_ns: by stamp, for each pair whose track says so, the stamp of the pair that was searched for it; its own
    where it was itself searched without memory.
    """

    def __init__(self, rig: Rig, parameters: TrackingParameters, searched_in_ns: Mapping[int, int]) -> None:
        self._rig, self._parameters = rig, parameters
        self._follower = _Follower(rig, parameters)
        self._searched_in_ns = dict(searched_in_ns)
        self._wanted_ns = frozenset(self._searched_in_ns.values())
        self._kept: dict[int, tuple[StereoPair, NeedleTrack]] = {}

    def __call__(self, pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        """The track of this pair; previous: that of the pair before, None to start without memory."""
        now_ns = pair.captured_at_ns
        searched_ns = self._searched_in_ns.get(now_ns)
        if previous is None or searched_ns == now_ns:
            track = self._follower.begin(pair)
        else:
            asked = None if searched_ns is None else self._kept.get(searched_ns)
            # Searches are gone on from in the order in which they were asked for.
            self._kept = {ns: kept for ns, kept in self._kept.items() if searched_ns is None or ns > searched_ns}
            found = None if asked is None else looked_again(*asked, self._rig, self._parameters)
            track = self._follower.go_on(pair, previous, found, None if asked is None else asked[1])
        if now_ns in self._wanted_ns:
            self._kept[now_ns] = (pair, track)
        return track


def looked_again(pair: StereoPair, followed: NeedleTrack, rig: Rig, parameters: TrackingParameters) -> NeedleTrack:
    """What a search makes of a pair to which a track was followed, or was not."""
    if followed.curve is None:
        return search(pair, rig, parameters)
    return audit(pair, rig, parameters, followed)


class _Auditor:
    """The second process, which looks at one pair at a time; raises OSError or EOFError where it has ended."""

    def __init__(self, rig: Rig, parameters: TrackingParameters) -> None:
        width, height = rig.left.size_px
        self._shape = (2, height, width)
        self._memory = SharedMemory(create=True, size=2 * width * height)
        self._images: Any = np.ndarray(self._shape, np.uint8, self._memory.buf)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=give_way,
            args=(pickle.dumps((_audit_pairs, (rig, parameters, self._memory.name, self._shape))), theirs),
            name="needletrack-audit",
            daemon=True,
        )
        self._process.start()
        theirs.close()
        self._is_up, self._is_busy = False, False

    @property
    def pid(self) -> int | None:
        """Its number."""
        return self._process.pid

    def wait(self, seconds: float) -> bool:
        """Wait for it to be there and to have nothing to do, at most so long; whether it is."""
        if not self._is_up and self._pipe.poll(seconds):
            self._pipe.recv()
            self._is_up = True
        if self._is_busy:
            self.found(seconds)
        return self._is_up and not self._is_busy

    def look(self, pair: StereoPair, track: NeedleTrack) -> bool:
        """Give it a pair and the track that was followed to it; False where it is still at another one.

        What it made of another one, which nobody asked for any more, is dropped.
        """
        if not self.wait(0.0):
            return False
        self._images[0], self._images[1] = pair.left.image, pair.right.image
        self._pipe.send((pair.left.captured_at_ns, pair.right.captured_at_ns, pair.sequence, track))
        self._is_busy = True
        return True

    def found(self, seconds: float) -> NeedleTrack | None:
        """What it made of the pair that it was given, waiting at most so long; None where it is not done."""
        if not self._is_busy or not self._pipe.poll(seconds):
            return None
        self._is_busy = False
        found: NeedleTrack = self._pipe.recv()
        return found

    def close(self) -> None:
        """End it, whatever it is at."""
        self._process.kill()
        self._process.join(_ENDS_WITHIN_S)
        self._pipe.close()
        del self._images
        self._memory.close()
        self._memory.unlink()


def _audit_pairs(
    rig: Rig, parameters: TrackingParameters, memory_name: str, shape: tuple[int, int, int], pipe: Connection
) -> None:
    """The second process's life: a pair in, a track out."""
    cv2.setNumThreads(1)
    # As in the process that follows: matrices as small as ours are slower with two, which wait for one another.
    threadpool_limits(1)
    memory = SharedMemory(memory_name)
    images: Any = np.ndarray(shape, np.uint8, memory.buf)
    warm_up(rig, parameters)
    pipe.send(None)
    while True:
        try:
            left_ns, right_ns, sequence, followed = pipe.recv()
        except EOFError:
            return
        pair = StereoPair(Frame(images[0].copy(), left_ns), Frame(images[1].copy(), right_ns), sequence)
        pipe.send(looked_again(pair, followed, rig, parameters))
