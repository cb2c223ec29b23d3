"""The results, as they are written to JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import isfinite
from typing import Literal, Self

from benchmarks.machine import Machine
from benchmarks.report import Part
from needletrack.scoring import Summary


class Row(Part):
    """One method on one recording; None where it has nothing of the kind.

    believed: every answer is taken for ok, and turned so that it begins at the true base where the method does not
    tell its ends. frames, ok, degraded, invalid: how many, as the method calls them; a method without a status has only
    answers and invalid. All other figures are those of `scoring.Summary`. false_if_believed: answers that would be
    false if all were taken for ok. ms: median time a pair. failures: frames without an answer, by what failed.
    """

    method: str
    believed: bool
    frames: int
    ok: int | None
    degraded: int | None
    invalid: int
    tip_mm: float | None
    tip_p95_mm: float | None
    direction_deg: float | None
    rms_mm: float | None
    worst_p95_mm: float | None
    cover: float | None
    within_two_sigma: float | None
    sigma_mm: float | None
    degraded_rms_mm: float | None
    degraded_cover: float | None
    false_ok: int | None
    false_if_believed: int
    ms: float | None
    failures: Mapping[str, int]

    @classmethod
    def of(
        cls,
        method: str,
        summary: Summary,
        counts: tuple[int | None, int | None, int],
        *,
        believed: bool,
        false_if_believed: int,
        ms: float | None,
        failures: Mapping[str, int],
    ) -> Self:
        """A row with the figures of a summary; counts: how many the method itself calls ok, degraded and invalid."""
        figures = {name: value if isfinite(value) else None for name, value in asdict(summary).items()}
        ok, degraded, invalid = counts
        figures |= {"ok": ok, "degraded": degraded, "invalid": invalid}
        if believed:
            figures["false_ok"] = None
        return cls(
            method=method,
            believed=believed,
            false_if_believed=false_if_believed,
            ms=ms,
            failures=failures,
            **figures,
        )


class RecordingAccuracy(Part):
    """All methods on one recording; sequence: neighbouring frames show one needle, which may be followed."""

    recording: str
    frames: int
    sequence: bool
    size_px: tuple[int, int]
    rows: Sequence[Row]


class AccuracyReport(Part):
    """One run; peers: the versions of what ran beside needletrack, by name."""

    format: Literal[1] = 1
    machine: Machine
    measured_at: str
    peers: Mapping[str, str]
    recordings: Sequence[RecordingAccuracy]
