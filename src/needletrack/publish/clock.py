"""How far the clocks of two hosts differ: asked of the daemon over its own session, as NTP asks.

D. Mills, J. Martin (ed.), J. Burbank, W. Kasch: Network Time Protocol Version 4, RFC 5905 (2010), sections 8 and 10.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, ValidationError

from needletrack.errors import PublishError
from needletrack.publish.message import WIRE_VERSION, Stamp, WirePart

CLOCK_ENCODING = "application/json;needletrack.clock.v1"
# Of the last answers the one with the shortest way counts (RFC 5905, section 10, whose filter keeps eight).
_ANSWERS_KEPT = 8
# Two quartz clocks drift apart by less than this (RFC 5905's PHI is 15 ppm a clock).
_DRIFT_PPM = 30.0
# An answer has a hundred bytes.
_MOST_BYTES = 10_000


class ClockMessage(WirePart):
    """The daemon's answer on `<prefix>/<rig>/clock`: its Unix time as it took the question and as it answered."""

    version: Literal[1] = Field(description="as in the track message")
    received_at_ns: Stamp = Field(description="Unix time (CLOCK_REALTIME of the daemon's host) as the query came in")
    replied_at_ns: Stamp = Field(description="the same clock, as the answer went out")

    @classmethod
    def now(cls, received_at_ns: int, replied_at_ns: int) -> Self:
        """The answer to a query that came in and is answered at these moments."""
        return cls(version=WIRE_VERSION, received_at_ns=received_at_ns, replied_at_ns=replied_at_ns)

    @classmethod
    def from_json(cls, data: bytes) -> Self:
        """The message in a reply's payload; raises PublishError."""
        if len(data) > _MOST_BYTES:
            raise PublishError(f"not a needletrack.clock.v{WIRE_VERSION} message: it has {len(data)} bytes")
        try:
            return cls.model_validate_json(data, strict=True)
        except ValidationError as error:
            raise PublishError(
                f"not a needletrack.clock.v{WIRE_VERSION} message: {error.error_count()} faults"
            ) from error

    def to_json(self) -> bytes:
        """UTF-8 JSON on one line."""
        return self.model_dump_json().encode()


@dataclass(frozen=True, slots=True)
class ClockDifference:
    """Our clock minus the daemon's, ms, and how far from that it can be at most: half of the round trip, and drift."""

    ours_minus_daemons_ms: float
    uncertainty_ms: float

    def __str__(self) -> str:
        """`ours is 0.12 ± 0.30 ms ahead`."""
        side = "behind" if self.ours_minus_daemons_ms < 0 else "ahead"
        return f"ours is {abs(self.ours_minus_daemons_ms):.2f} ± {self.uncertainty_ms:.2f} ms {side}"


@dataclass(frozen=True, slots=True)
class Question:
    """When a question went out, on both clocks of this host."""

    unix_ns: int
    monotonic_ns: int


class ClockFilter:
    """The difference by the last answers; one that contradicts what was known says that a clock was set."""

    def __init__(self) -> None:
        self._answers: deque[tuple[ClockDifference, int]] = deque(maxlen=_ANSWERS_KEPT)

    def add(self, asked: Question, answer: ClockMessage, answered_monotonic_ns: int) -> None:
        """Take an answer that came at this moment of our monotonic clock; one that cannot be is left out."""
        round_trip_ns = answered_monotonic_ns - asked.monotonic_ns
        held_ns = answer.replied_at_ns - answer.received_at_ns
        if not 0 <= held_ns <= round_trip_ns:
            return
        # Section 8: theta = ((T2 - T1) + (T3 - T4)) / 2, delta = (T4 - T1) - (T3 - T2). Our T4 is T1 and what passed on
        # the monotonic clock, so that a clock set meanwhile does no harm.
        daemons_minus_ours_ns = (
            (answer.received_at_ns - asked.unix_ns) + (answer.replied_at_ns - asked.unix_ns - round_trip_ns)
        ) / 2
        found = ClockDifference(-daemons_minus_ours_ns / 1e6, (round_trip_ns - held_ns) / 2e6)
        known = self.at(answered_monotonic_ns)
        if known is not None:
            apart_ms = abs(found.ours_minus_daemons_ms - known.ours_minus_daemons_ms)
            if apart_ms > found.uncertainty_ms + known.uncertainty_ms:
                self._answers.clear()
        self._answers.append((found, answered_monotonic_ns))

    def forget(self) -> None:
        """The daemon is another one."""
        self._answers.clear()

    def at(self, monotonic_ns: int) -> ClockDifference | None:
        """The difference at a moment of our monotonic clock; None before the first answer."""
        aged = [
            ClockDifference(
                answer.ours_minus_daemons_ms, answer.uncertainty_ms + (monotonic_ns - at_ns) / 1e6 * _DRIFT_PPM / 1e6
            )
            for answer, at_ns in self._answers
        ]
        return min(aged, key=lambda answer: answer.uncertainty_ms, default=None)
