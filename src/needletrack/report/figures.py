"""The figures of each pair that a report keeps: a few numbers, so that a long recording's fit into memory."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from needletrack.records import NeedleTrack, Reason, Status, StereoPair
from needletrack.scoring import TrueShape, score


@dataclass(frozen=True, slots=True)
class Truth:
    """What the truth says about one track; None where there is nothing to compare.

    has_needle: whether a needle is there at all. Errors as of `needletrack.scoring.Score`; within_two_sigma is the
    share of the curve's points that lie within twice their stated sigma of the true one.
    """

    has_needle: bool
    false_ok: bool
    tip_mm: float | None = None
    direction_deg: float | None = None
    rms_mm: float | None = None
    worst_mm: float | None = None
    cover: float | None = None
    turned: bool | None = None
    within_two_sigma: float | None = None

    @property
    def greatest_mm(self) -> float | None:
        """The larger of the tip's and the shape's error."""
        return max((error for error in (self.tip_mm, self.worst_mm) if error is not None), default=None)


@dataclass(frozen=True, slots=True)
class PairFigures:
    """One pair's numbers; None where the track has none.

    tip_sigma_mm: the tip's largest standard deviation in any direction; sigma_p50_mm, sigma_p95_mm and sigma_max_mm:
    of the stated sigma along the curve.
    """

    sequence: int
    captured_at_ns: int
    skew_us: float
    status: Status
    reasons: tuple[Reason, ...]
    since_detection: int
    timing_ms: Mapping[str, float]
    tip_sigma_mm: float | None = None
    sigma_p50_mm: float | None = None
    sigma_p95_mm: float | None = None
    sigma_max_mm: float | None = None
    reprojection_rms_px: float | None = None
    epipolar_rms_px: float | None = None
    coverage: float | None = None
    length_mm: float | None = None
    diameter_mm: float | None = None
    truth: Truth | None = None

    @property
    def total_ms(self) -> float | None:
        """All stages together; None where the method does not time itself."""
        return sum(self.timing_ms.values()) if self.timing_ms else None

    @property
    def false_ok(self) -> bool:
        """Whether the truth is known, and a robot would have been misled."""
        return self.truth is not None and self.truth.false_ok

    @property
    def rightly_invalid(self) -> bool:
        """Whether the truth is known to hold no needle, and none was tracked."""
        return self.status is Status.INVALID and self.truth is not None and not self.truth.has_needle


def pair_figures(pair: StereoPair, track: NeedleTrack, truth: TrueShape | None) -> PairFigures:
    """The figures of one track; truth None: not known."""
    curve, tip, quality = track.curve, track.tip, track.quality
    p50, p95, most = (None, None, None) if curve is None else np.percentile(curve.sigma_mm, (50, 95, 100)).tolist()
    return PairFigures(
        sequence=pair.sequence,
        captured_at_ns=pair.captured_at_ns,
        skew_us=pair.skew_us,
        status=track.status,
        reasons=track.reasons,
        since_detection=track.since_detection,
        timing_ms=dict(track.timing_ms),
        tip_sigma_mm=None if tip is None else float(np.sqrt(np.linalg.eigvalsh(tip.covariance_mm2)[-1])),
        sigma_p50_mm=p50,
        sigma_p95_mm=p95,
        sigma_max_mm=most,
        reprojection_rms_px=quality.reprojection_rms_px,
        epipolar_rms_px=quality.epipolar_rms_px,
        coverage=quality.coverage,
        length_mm=None if curve is None else curve.length_mm,
        diameter_mm=track.diameter_mm,
        truth=None if truth is None else _against(truth, track),
    )


def _against(truth: TrueShape, track: NeedleTrack) -> Truth:
    found = score(track, truth)
    off = found.off_in_sigmas
    return Truth(
        has_needle=len(truth.centerline_mm) > 0,
        false_ok=found.false_ok,
        tip_mm=found.tip_mm,
        direction_deg=found.direction_deg,
        rms_mm=found.rms_mm,
        worst_mm=found.worst_mm,
        cover=found.cover,
        turned=found.turned,
        within_two_sigma=None if off is None else float((off <= 2).mean()),
    )
