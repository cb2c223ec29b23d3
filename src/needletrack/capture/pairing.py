"""Which frames of two running cameras belong together, by their stamps; and what the stamps say of the trigger."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, Literal, TypeVar

import numpy as np

from needletrack.records import DropReason

T = TypeVar("T")
Side = Literal["left", "right"]

_OTHER: dict[Side, Side] = {"left": "right", "right": "left"}
UNPAIRED: dict[Side, DropReason] = {"left": DropReason.UNPAIRED_LEFT, "right": DropReason.UNPAIRED_RIGHT}
# A camera that has nothing yet for so many frames of the other will have nothing for the first of them.
_MOST_WAITING = 6
# A frame that is early by a tenth of the period is still of its period.
_SHORTEST_PERIOD = 0.9
_INTERVALS_REMEMBERED = 32
# A stamp far ahead must cost its own frame, not all that follow: after so many, they are believed.
_BELIEVED_AFTER = 3


@dataclass(frozen=True, slots=True)
class Paired(Generic[T]):
    """Two frames of one instant."""

    left: T
    right: T


@dataclass(frozen=True, slots=True)
class Unpaired(Generic[T]):
    """A frame that is in no pair, and why."""

    reason: DropReason
    frame: T


class StampPairer(Generic[T]):
    """Pairs frames as they come: each other's nearest in time, at most tolerance_ns apart, never a frame twice.

    offset_ns: what the right stamp of an instant is later than the left one by the nature of the cameras. period_ns:
    the least time between two frames of one camera; two stamps within half of it are each other's nearest, so that
    their pair is given at once, without a look at the next frame. None: it is learnt from the stamps. Every frame comes
    out once, in a pair or unpaired.
    """

    def __init__(self, tolerance_ns: int, *, offset_ns: int = 0, period_ns: int | None = None) -> None:
        self._tolerance_ns, self._period_ns = tolerance_ns, period_ns
        self._shift_ns: dict[Side, int] = {"left": 0, "right": -offset_ns}
        self._waiting: dict[Side, deque[tuple[int, T]]] = {"left": deque(), "right": deque()}
        self._newest: dict[Side, int | None] = {"left": None, "right": None}
        self._disordered: dict[Side, int] = {"left": 0, "right": 0}
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS_REMEMBERED)

    def add(self, side: Side, stamp_ns: int, frame: T) -> Iterator[Paired[T] | Unpaired[T]]:
        """Take a frame, and give every pair and every loss that is decided by it, in order."""
        newest = self._newest[side]
        if newest is not None and stamp_ns <= newest:
            self._disordered[side] += 1
            if self._disordered[side] < _BELIEVED_AFTER:
                yield Unpaired(DropReason.STAMP_OUT_OF_ORDER, frame)
                return
            yield from self._lose_all(side)
        elif newest is not None:
            self._intervals_ns.append(stamp_ns - newest)
        self._disordered[side] = 0
        self._newest[side] = stamp_ns
        self._waiting[side].append((stamp_ns + self._shift_ns[side], frame))
        yield from self._decided()
        while len(self._waiting[side]) > _MOST_WAITING:
            yield self._lose_first(side)

    def flush(self) -> Iterator[Unpaired[T]]:
        """Give every frame that still waits as lost: a camera stalled or is gone."""
        for side in _OTHER:
            yield from self._lose_all(side)
            self._newest[side] = None

    def _decided(self) -> Iterator[Paired[T] | Unpaired[T]]:
        left, right = self._waiting["left"], self._waiting["right"]
        while left and right:
            apart_ns = right[0][0] - left[0][0]
            earlier: Side = "left" if apart_ns >= 0 else "right"
            if abs(apart_ns) > self._tolerance_ns:
                # Whatever comes from the other camera is later still.
                yield self._lose_first(earlier)
                continue
            rivals = self._waiting[earlier]
            later_ns = self._waiting[_OTHER[earlier]][0][0]
            if len(rivals) > 1:
                if abs(later_ns - rivals[1][0]) < abs(apart_ns):
                    yield self._lose_first(earlier)
                    continue
            elif self._next_may_be_nearer(abs(apart_ns)):
                return
            yield Paired(left.popleft()[1], right.popleft()[1])

    def _next_may_be_nearer(self, apart_ns: int) -> bool:
        """Whether the earlier camera's next frame could be nearer than this one, which is so far away."""
        if self._period_ns is not None:
            return apart_ns > 0 and 2 * apart_ns > self._period_ns
        return bool(self._intervals_ns) and 2 * apart_ns > _SHORTEST_PERIOD * min(self._intervals_ns)

    def _lose_first(self, side: Side) -> Unpaired[T]:
        return Unpaired(UNPAIRED[side], self._waiting[side].popleft()[1])

    def _lose_all(self, side: Side) -> Iterator[Unpaired[T]]:
        while self._waiting[side]:
            yield self._lose_first(side)


class Trigger(StrEnum):
    """What makes two cameras expose, as far as their stamps tell."""

    UNKNOWN = "unknown"
    HARDWARE = "hardware_triggered"
    FREE_RUNNING = "free_running"


@dataclass(frozen=True, slots=True)
class SkewReport:
    """Right stamps minus the nearest left ones over the last minute.

    offset_us: the median; spread_us: half the width that holds nine of ten, after the drift is taken off; drift_ppm:
    how much faster the right stamps run away, microseconds a second; None where too little was seen.
    """

    offset_us: float | None = None
    spread_us: float | None = None
    drift_ppm: float | None = None
    drift_sigma_ppm: float | None = None
    looks: Trigger = Trigger.UNKNOWN


class SkewMonitor:
    """Watches the skew of all frames, paired or not, so that an offset beyond the tolerance is found as well."""

    KEPT = 600
    LEAST = 30
    # Free-running crystals differ by 5 to 100 ppm.
    _SAME_CLOCK_PPM = 2.0

    def __init__(self, *, window_s: float = 60.0) -> None:
        self._spacing_ns = round(window_s * 1e9 / self.KEPT)
        self._newest: dict[Side, deque[int]] = {"left": deque(maxlen=2), "right": deque(maxlen=2)}
        self._skews: deque[tuple[int, int]] = deque(maxlen=self.KEPT)
        self._wrapped = False

    def add(self, side: Side, stamp_ns: int) -> None:
        """Take a frame's stamp."""
        mine, others = self._newest[side], self._newest[_OTHER[side]]
        if mine and stamp_ns <= mine[-1]:
            mine.clear()
        mine.append(stamp_ns)
        # The middle one of three stamps has its nearest among the other two.
        if len(others) < 2 or not others[0] <= (candidate := mine[0]) <= others[1]:
            return
        other = min(others, key=lambda stamp: abs(stamp - candidate))
        skew_ns = other - candidate if side == "left" else candidate - other
        if self._skews:
            last_at_ns, last_skew_ns = self._skews[-1]
            # The nearest became the next one: two rates that are not one.
            self._wrapped |= 2 * abs(skew_ns - last_skew_ns) > others[1] - others[0]
            if self._spacing_ns > candidate - last_at_ns >= 0 and len(self._skews) > self.LEAST:
                return
        self._skews.append((candidate, skew_ns))

    def clear(self) -> None:
        """Forget what was seen: the cameras were started anew."""
        self._newest["left"].clear()
        self._newest["right"].clear()
        self._skews.clear()
        self._wrapped = False

    def report(self) -> SkewReport:
        """What the skews of the last minute say; a straight line is fitted to them by least squares."""
        seen = np.array(self._skews, dtype=np.int64)
        if len(seen) < self.LEAST:
            return SkewReport()
        skew_us = seen[:, 1] / 1e3
        offset_us = float(np.median(skew_us))
        if self._wrapped:
            return SkewReport(offset_us, looks=Trigger.FREE_RUNNING)
        at_s = (seen[:, 0] - seen[0, 0]) / 1e9
        centred_s = at_s - at_s.mean()
        weight = float((centred_s**2).sum())
        drift_ppm = float((centred_s * skew_us).sum() / weight)
        rest_us = skew_us - skew_us.mean() - drift_ppm * centred_s
        sigma_ppm = float(np.sqrt((rest_us**2).sum() / (len(seen) - 2) / weight))
        low, high = np.percentile(rest_us, [5, 95])
        looks = Trigger.UNKNOWN
        if abs(drift_ppm) > self._SAME_CLOCK_PPM + 4 * sigma_ppm:
            looks = Trigger.FREE_RUNNING
        elif abs(drift_ppm) + 2 * sigma_ppm < self._SAME_CLOCK_PPM:
            looks = Trigger.HARDWARE
        return SkewReport(offset_us, float(high - low) / 2, drift_ppm, sigma_ppm, looks)
