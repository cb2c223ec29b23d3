"""A fault and what was seen of it: the rows of the table, and the words in which they speak."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.faults.stage import Missed, Stage, Watcher


@dataclass(frozen=True)
class Seen:
    """What came of a fault: what the subscriber saw, seconds until healthy once its cause was gone, what was lost."""

    saw: str
    healthy_s: float | None
    lost: str


@dataclass(frozen=True)
class Fault:
    """A row of the table."""

    group: str
    name: str
    injected: str
    run: Callable[[Stage], Seen]


NOTHING = "nothing"
_LONGEST = 420


class Faults(list[Fault]):
    """Rows, in the order in which they were written."""

    def row(self, group: str, name: str, injected: str) -> Callable[[Callable[[Stage], Seen]], Callable[[Stage], Seen]]:
        """Add a function."""

        def add(run: Callable[[Stage], Seen]) -> Callable[[Stage], Seen]:
            self.append(Fault(group, name, injected, run))
            return run

        return add


def change(watcher: Watcher, at_s: float, *states: str) -> str:
    """`gone after 0.01 s`."""
    seen = watcher.health(at_s, *states)
    return f"{seen['health']} after {max(seen['at_s'] - at_s, 0):.2f} s"


def lost(watcher: Watcher, since_s: float) -> str:
    """What its tracks since a moment say of those between them."""
    dropped, lost, overflowed = watcher.missed(since_s)
    parts = [f"{dropped} pairs dropped" * bool(dropped), f"{lost} tracks lost on the way" * bool(lost)]
    parts.append(f"{overflowed} overflowed in the subscriber" * bool(overflowed))
    return ", ".join(part for part in parts if part) or NOTHING


def counted(watcher: Watcher, before: dict[str, int]) -> str:
    """By how much the daemon's own counts grew."""
    now = watcher.drops()
    grown = {reason: now[reason] - before.get(reason, 0) for reason in now if now[reason] != before.get(reason, 0)}
    return "counted: " + (", ".join(f"{reason} {count}" for reason, count in sorted(grown.items())) or NOTHING)


def require(condition: bool, what: str) -> None:
    """Raise Missed where it does not hold."""
    if not condition:
        raise Missed(what)


def changes(watcher: Watcher, since_s: float) -> str:
    """The states of health since a moment, but for fresh, and how long each was kept to: `silent for 0.04 s`."""
    seen = watcher.since(since_s, "health")
    ends_s = [each["at_s"] for each in seen[1:]] + [time.monotonic()]
    kept_s: dict[str, float] = {}
    for each, end_s in zip(seen, ends_s, strict=False):
        if each["health"] != "fresh":
            kept_s[each["health"]] = kept_s.get(each["health"], 0.0) + end_s - each["at_s"]
    return ", ".join(f"{state} for {time_s:.2f} s" for state, time_s in kept_s.items()) or "no change of health"


def p99_ms(watcher: Watcher, from_s: float, to_s: float) -> float:
    """The 99th percentile of the latency of what came meanwhile."""
    latencies = [s["latency_ms"] for s in watcher.since(from_s, "track") if s["at_s"] < to_s]
    return float(np.percentile(latencies, 99))


def short(told: str, stage: Stage) -> str:
    """What was told, without the stage's own folder, cut to a length that a table bears."""
    told = told.replace(str(stage.folder), "…")
    return told if len(told) < _LONGEST else f"{told[: _LONGEST - 3]}..."


def silence(watcher: Watcher, since_s: float) -> float:
    """The longest time without a track since a moment."""
    times = [since_s, *(seen["at_s"] for seen in watcher.since(since_s, "track"))]
    return max((float(gap) for gap in np.diff(times)), default=0.0)


class NotHere(Exception):
    """This machine does not let the fault be injected."""
