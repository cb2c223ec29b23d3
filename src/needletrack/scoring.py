"""How near a track is to the truth, and whether a robot would have been misled by it.

Of the tracks called ok, none may be false: no needle there; tip or shape (95th percentile) off by more than a
millimetre; less than 0.8 of what both cameras see covered; base and tip exchanged. Every distance is in space.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from needletrack.errors import RecordingError
from needletrack.geometry.spline import arc_length, resample
from needletrack.records import Float, NeedleTrack, Status
from needletrack.synthetic.world import Truth

GREATEST_ERROR_MM = 1.0
LEAST_COVER = 0.8
# A curve of kilometres is wrong, not large.
STEP_MM, MOST_POINTS = 0.5, 4000


@dataclass(frozen=True, eq=False)
class TrueShape:
    """What is so: centerline_mm (N, 3) base -> tip, tip_direction (3,), seen (N,) by both cameras; N = 0: no needle."""

    centerline_mm: Float
    tip_direction: Float
    seen: npt.NDArray[np.bool_]

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
        return {
            int(frame["t_ns"]): _true_shape(frame) for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]
        }
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the truth: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: not the truth about a recording: {error!r}") from error


def _true_shape(frame: dict[str, Any]) -> TrueShape:
    if "centerline_mm" not in frame:
        return TrueShape.none()
    return TrueShape(
        np.array(frame["centerline_mm"], dtype=np.float64),
        np.array(frame["tip_direction"], dtype=np.float64),
        np.asarray(np.array(frame["visible"], np.bool_).all(axis=0)),
    )


@dataclass(frozen=True, eq=False)
class Score:
    """One track against the truth; None where track or truth have nothing to compare.

    rms_mm, worst_mm (95th percentile): of the reported curve about the true one. tip_mm, direction_deg: only where both
    cameras see the tip. cover: share of what both cameras see that has a reported curve within a millimetre.
    off_in_sigmas (M,): distance of each reported point from the true curve over its stated sigma.
    """

    status: Status
    false_ok: bool
    rms_mm: float | None = None
    worst_mm: float | None = None
    tip_mm: float | None = None
    direction_deg: float | None = None
    cover: float | None = None
    turned: bool | None = None
    off_in_sigmas: Float | None = None


def score(track: NeedleTrack, truth: TrueShape) -> Score:
    """The score of one track."""
    is_ok = track.status is Status.OK
    if track.curve is None or len(truth.centerline_mm) == 0:
        return Score(track.status, false_ok=is_ok)
    line, points = truth.centerline_mm, track.curve.points_mm
    even = resample(points, int(np.clip(arc_length(points)[-1] / STEP_MM, 2, MOST_POINTS)))
    off_mm = off_polyline(even, line)
    worst_mm = float(np.percentile(off_mm, 95))
    cover = float((off_polyline(line[truth.seen], even) < GREATEST_ERROR_MM).mean()) if truth.seen.any() else 0.0
    turned = bool(np.linalg.norm(points[-1] - line[0]) < np.linalg.norm(points[0] - line[0]))
    tip_mm = np.inf if track.tip is None else float(np.linalg.norm(track.tip.position_mm - line[-1]))
    sees_tip = track.tip is not None and bool(truth.seen[-1])
    return Score(
        track.status,
        is_ok and (tip_mm > GREATEST_ERROR_MM or worst_mm > GREATEST_ERROR_MM or cover < LEAST_COVER or turned),
        float(np.sqrt((off_mm**2).mean())),
        worst_mm,
        tip_mm if sees_tip else None,
        angle_deg(track.tip.direction, truth.tip_direction) if track.tip is not None and sees_tip else None,
        cover,
        turned,
        off_polyline(points, line) / track.curve.sigma_mm,
    )


@dataclass(frozen=True)
class Summary:
    """Medians over the ok tracks, the share of all their points within twice their sigma, and how many were false."""

    ok: int
    false_ok: int
    rms_mm: float
    tip_mm: float
    cover: float
    within_two_sigma: float

    @classmethod
    def of(cls, scores: Sequence[Score]) -> Self:
        """Summed up over the tracks of one or several recordings."""
        ok = [one for one in scores if one.status is Status.OK]
        points = [one.off_in_sigmas for one in ok if one.off_in_sigmas is not None]
        return cls(
            len(ok),
            sum(one.false_ok for one in scores),
            _median([one.rms_mm for one in ok]),
            _median([one.tip_mm for one in ok]),
            _median([one.cover for one in ok]),
            float((np.concatenate(points) <= 2).mean()) if points else np.nan,
        )


def off_polyline(points: Float, line: Float) -> Float:
    """Distance (N,) of each point (N, D) from a polyline (M, D)."""
    start, step = line[:-1], np.diff(line, axis=0)
    along = ((points[:, None] - start) * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-12)
    nearest = start + np.clip(along, 0, 1)[..., None] * step
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1))


def angle_deg(one: Float, other: Float) -> float:
    """Angle between two vectors (3,), degrees."""
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _median(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else np.nan
