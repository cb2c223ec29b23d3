"""How near a track is to the truth, and whether a robot would have been misled by it.

Of the tracks called ok, none may be false: no needle there; tip or shape (95th percentile) off by more than a
millimetre; less than 0.8 of what both cameras see covered; base and tip exchanged. Every distance is in space.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from needletrack.errors import RecordingError
from needletrack.geometry.spline import arc_length, distance_from_curve, resample
from needletrack.reading import json_document, text_of
from needletrack.records import Float, NeedleTrack, Status
from needletrack.synthetic.world import Truth

GREATEST_ERROR_MM = 1.0
LEAST_COVER = 0.8
# A curve of kilometres is wrong, not large.
STEP_MM, MOST_POINTS = 0.5, 4000
_MOST_BYTES = 1 << 29


@dataclass(frozen=True, eq=False)
class TrueShape:
    """What is so: centerline_mm (N, 3) base -> tip, tip_direction (3,), seen (N,) by both cameras; N = 0: no needle.

    stated_tip_mm (3,): the tip where the truth states it apart from the centerline, whose end is rounded otherwise.
    """

    centerline_mm: Float
    tip_direction: Float
    seen: npt.NDArray[np.bool_]
    stated_tip_mm: Float | None = None

    @property
    def tip_mm(self) -> Float:
        """The tip (3,) of a needle that is there."""
        return self.centerline_mm[-1] if self.stated_tip_mm is None else self.stated_tip_mm

    @classmethod
    def none(cls) -> Self:
        """No needle is there."""
        return cls(np.zeros((0, 3)), np.zeros(3), np.zeros(0, np.bool_))

    @classmethod
    def drawn(cls, truth: Truth) -> Self:
        """The truth about a pair of the synthetic world."""
        if not truth.present:
            return cls.none()
        return cls(truth.centerline_mm, truth.tip_direction, np.asarray(truth.visible.all(axis=0)))


def recorded_truth(folder: Path) -> dict[int, TrueShape]:
    """The truth of a recording by the left camera's stamp, ns; raises RecordingError where there is none to read."""
    path = folder / "truth.json"
    try:
        return {int(frame["t_ns"]): _true_shape(frame) for frame in json_document(text_of(path, _MOST_BYTES))["frames"]}
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the truth: {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, OverflowError, AttributeError) as error:
        raise RecordingError(f"{path}: not the truth about a recording: {type(error).__name__}: {error}") from error


def _true_shape(frame: dict[str, Any]) -> TrueShape:
    if "centerline_mm" not in frame:
        return TrueShape.none()
    return TrueShape(
        np.array(frame["centerline_mm"], dtype=np.float64),
        np.array(frame["tip_direction"], dtype=np.float64),
        np.asarray(np.array(frame["visible"], np.bool_).all(axis=0)),
        np.array(frame["tip_mm"], dtype=np.float64),
    )


@dataclass(frozen=True, eq=False)
class Score:
    """One track against the truth; None where track or truth have nothing to compare.

    misleads: whether a robot that acts on the shape, whatever its status, would go wrong (see above).
    rms_mm, worst_mm (95th percentile): of the reported curve about the true one. tip_mm, direction_deg: only where both
    cameras see the tip. cover: share of what both cameras see that has a reported curve within a millimetre.
    off_in_sigmas (M,): distance of each reported point from the true curve over its stated sigma. sigma_mm: the median
    of the stated sigmas.
    """

    status: Status
    misleads: bool
    rms_mm: float | None = None
    worst_mm: float | None = None
    tip_mm: float | None = None
    direction_deg: float | None = None
    cover: float | None = None
    turned: bool | None = None
    off_in_sigmas: Float | None = None
    sigma_mm: float | None = None

    @property
    def false_ok(self) -> bool:
        """Whether the track is called ok and misleads."""
        return self.status is Status.OK and self.misleads

    def believed(self) -> "Score":
        """The score that the track would have if it were called ok; without a shape nothing can be believed."""
        return self if self.status is Status.INVALID else replace(self, status=Status.OK)


def score(track: NeedleTrack, truth: TrueShape) -> Score:
    """The score of one track."""
    if track.curve is None or len(truth.centerline_mm) == 0:
        return Score(track.status, misleads=track.curve is not None)
    line, points = truth.centerline_mm, track.curve.points_mm
    even = resample(points, int(np.clip(arc_length(points)[-1] / STEP_MM, 2, MOST_POINTS)))
    off_mm = distance_from_curve(even, line)
    worst_mm = float(np.percentile(off_mm, 95))
    cover = float((distance_from_curve(line[truth.seen], even) < GREATEST_ERROR_MM).mean()) if truth.seen.any() else 0.0
    turned = bool(np.linalg.norm(points[-1] - line[0]) < np.linalg.norm(points[0] - line[0]))
    tip_mm = np.inf if track.tip is None else float(np.linalg.norm(track.tip.position_mm - truth.tip_mm))
    sees_tip = track.tip is not None and bool(truth.seen[-1])
    return Score(
        track.status,
        tip_mm > GREATEST_ERROR_MM or worst_mm > GREATEST_ERROR_MM or cover < LEAST_COVER or turned,
        float(np.sqrt((off_mm**2).mean())),
        worst_mm,
        tip_mm if sees_tip else None,
        angle_deg(track.tip.direction, truth.tip_direction) if track.tip is not None and sees_tip else None,
        cover,
        turned,
        distance_from_curve(points, line) / track.curve.sigma_mm,
        float(np.median(track.curve.sigma_mm)),
    )


@dataclass(frozen=True)
class Summary:
    """How many tracks carry each status, how many ok ones were false, and how far off the ok ones are.

    Medians over the ok tracks, and 95th percentiles where the name says p95; within_two_sigma: share of all their
    points within twice their sigma. degraded_*: medians over the degraded tracks. NaN: there is nothing to sum up.
    """

    frames: int
    ok: int
    degraded: int
    invalid: int
    false_ok: int
    tip_mm: float
    tip_p95_mm: float
    direction_deg: float
    rms_mm: float
    worst_p95_mm: float
    cover: float
    within_two_sigma: float
    sigma_mm: float
    degraded_rms_mm: float
    degraded_cover: float

    @classmethod
    def of(cls, scores: Sequence[Score]) -> Self:
        """Summed up over the tracks of one or several recordings."""
        ok, degraded, invalid = ([one for one in scores if one.status is status] for status in Status)
        points = [one.off_in_sigmas for one in ok if one.off_in_sigmas is not None]
        return cls(
            frames=len(scores),
            ok=len(ok),
            degraded=len(degraded),
            invalid=len(invalid),
            false_ok=sum(one.false_ok for one in scores),
            tip_mm=_percentile([one.tip_mm for one in ok], 50),
            tip_p95_mm=_percentile([one.tip_mm for one in ok], 95),
            direction_deg=_percentile([one.direction_deg for one in ok], 50),
            rms_mm=_percentile([one.rms_mm for one in ok], 50),
            worst_p95_mm=_percentile([one.worst_mm for one in ok], 95),
            cover=_percentile([one.cover for one in ok], 50),
            within_two_sigma=float((np.concatenate(points) <= 2).mean()) if points else np.nan,
            sigma_mm=_percentile([one.sigma_mm for one in ok], 50),
            degraded_rms_mm=_percentile([one.rms_mm for one in degraded], 50),
            degraded_cover=_percentile([one.cover for one in degraded], 50),
        )


def angle_deg(one: Float, other: Float) -> float:
    """Angle between two vectors (3,), degrees."""
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _percentile(values: Sequence[float | None], percent: float) -> float:
    known = [value for value in values if value is not None]
    return float(np.percentile(known, percent)) if known else np.nan
