"""Which line of the left view and which of the right are one curve in space, and which of their points correspond.

A left point's partners are the places where its epipolar line crosses the right line, read off the sign changes of the
distance map (paper eq. 9, in pixels) to a fraction of a pixel. Dynamic programming then picks the longest chain of
partners that keeps the order along both lines and leaps nowhere in space, which the paper's threshold does not ask
for. A stretch along the epipolar lines has no crossings and goes without a partner.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_map_px
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Centerline, Correspondences, Float, Reason
from needletrack.tracking.needle import Needle, Positive, Range, Workspace


class MatchParameters(BaseModel):
    """How well two lines must obey the epipolar geometry."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_candidates: int = Field(
        3, ge=1, description="So many of the best left-right pairs of lines are examined in full."
    )
    step_px: Positive = Field(4.0, description="Spacing of the points along each line that are matched, px.")
    max_gap_mm: Positive = Field(12.0, description="Longest stretch in the middle of the needle without a match, mm.")


# Along the needle, a step in space is at most so many times the step that the left view shows: turned 70 degrees away.
_MAX_FORESHORTENING = 3.0
_COARSE_STRIDE = 4
# Scenes with vessels have up to 100 pairs; a pattern of stripes has thousands, and none of them is a needle.
_MAX_PAIRS = 150
# Pairs are compared at every depth from half the nearest to four times the furthest of the workspace: a vessel behind
# it then finds its true partner and is not offered to the needle.
_DEPTH_MARGIN = (0.5, 4.0)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A left and a right line that may be one needle: points_mm (N, 3) in order, confidence (N,) in 0..1.

    A point's confidence is the sine of the angle at which the line crosses the epipolar line: near zero, the depth
    is not fixed. `length_mm` is the length of the matched stretch, `score` what it is ranked by.
    """

    left: Centerline
    right: Centerline
    correspondences: Correspondences
    points_mm: Float
    confidence: Float
    length_mm: float
    score: float


def match_lines(
    left: list[Centerline],
    right: list[Centerline],
    rig: StereoRig,
    needle: Needle,
    workspace: Workspace,
    parameters: MatchParameters,
) -> list[Candidate]:
    """Candidates for the needle, the best supported one first; raises NeedleNotFound where there is none."""
    if not left or not right:
        raise NeedleNotFound("match", Reason.NO_CANDIDATE)
    left_px = [_resampled(line, rig.left, parameters.step_px) for line in left]
    right_px = [_resampled(line, rig.right, parameters.step_px) for line in right]
    pairs = _exclusive_pairs(left_px, right_px, rig, workspace, parameters)
    found = []
    for i, j in pairs.within:
        chain = _best_chain(_crossings(left_px[i], right_px[j], rig, workspace), rig, parameters)
        if chain is not None:
            candidate = _candidate(left[i], right[j], chain)
            if candidate.length_mm >= needle.min_length_mm / 2:
                found.append(candidate)
    if not found:
        raise NeedleNotFound("match", Reason.OUTSIDE_WORKSPACE if pairs.elsewhere else Reason.NO_STEREO_MATCH)
    return sorted(found, key=lambda c: -c.score)[: parameters.max_candidates]


def inside(workspace: Workspace, points_mm: Float) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) lie in the workspace, (N,) bool; NaN does not."""
    lower = np.array([workspace.x_mm.min, workspace.y_mm.min, workspace.z_mm.min])
    upper = np.array([workspace.x_mm.max, workspace.y_mm.max, workspace.z_mm.max])
    return np.asarray(((points_mm >= lower) & (points_mm <= upper)).all(axis=1), dtype=np.bool_)


def _resampled(line: Centerline, camera: Camera, step_px: float) -> Float:
    length = arc_length(line.points_px)
    at = np.linspace(0.0, length[-1], max(2, round(length[-1] / step_px) + 1))
    return camera.undistort(np.column_stack([np.interp(at, length, column) for column in line.points_px.T]))


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Where epipolar lines of left points cross right lines: indices into both, points in both views and in space."""

    left_at: npt.NDArray[np.int64]
    right_at: Float
    left_px: Float
    right_px: Float
    points_mm: Float
    sine: Float

    def take(self, index: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> "_Crossings":
        return _Crossings(
            self.left_at[index],
            self.right_at[index],
            self.left_px[index],
            self.right_px[index],
            self.points_mm[index],
            self.sine[index],
        )


@dataclass(frozen=True, slots=True)
class _Chain:
    crossings: _Crossings
    score: float


def _crossings(left_px: Float, right_px: Float, rig: StereoRig, box: Workspace) -> _Crossings:
    distance = epipolar_distance_map_px(rig.fundamental, left_px, right_px)
    index, before = np.nonzero((distance[:, :-1] < 0) != (distance[:, 1:] < 0))
    near, far = distance[index, before], distance[index, before + 1]
    fraction = near / (near - far)
    step = right_px[before + 1] - right_px[before]
    crossing_px = right_px[before] + fraction[:, None] * step
    points = triangulate(rig, left_px[index], crossing_px)
    sine = np.abs(far - near) / np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    found = _Crossings(index, before + fraction, left_px[index], crossing_px, points, sine)
    return found.take(inside(box, points))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Lines that are each other's best partners: those within the workspace, and how many there are elsewhere."""

    within: list[tuple[int, int]]
    elsewhere: int


def _exclusive_pairs(
    left: list[Float], right: list[Float], rig: StereoRig, workspace: Workspace, parameters: MatchParameters
) -> _Pairs:
    """Pairs of lines that are each other's best partners at any depth."""
    nearest, furthest = workspace.z_mm.min * _DEPTH_MARGIN[0], workspace.z_mm.max * _DEPTH_MARGIN[1]
    everywhere = Range(min=-furthest, max=furthest)
    anywhere = Workspace(x_mm=everywhere, y_mm=everywhere, z_mm=Range(min=nearest, max=furthest))
    sparse = [points[:: _COARSE_STRIDE if len(points) > 4 * _COARSE_STRIDE else 1] for points in left]
    chains = []
    for i, j in _promising(sparse, right, rig, anywhere):
        chain = _best_chain(_crossings(sparse[i], right[j], rig, anywhere), rig, parameters)
        if chain is not None:
            chains.append((i, j, chain))
    taken_left: dict[int, list[tuple[float, float]]] = {}
    taken_right: dict[int, list[tuple[float, float]]] = {}
    within, elsewhere = [], 0
    for i, j, chain in sorted(chains, key=lambda c: -c[2].score):
        stretches = [(float(at.min()), float(at.max())) for at in (chain.crossings.left_at, chain.crossings.right_at)]
        if _is_taken(stretches[0], taken_left.get(i, [])) or _is_taken(stretches[1], taken_right.get(j, [])):
            continue
        taken_left.setdefault(i, []).append(stretches[0])
        taken_right.setdefault(j, []).append(stretches[1])
        if np.mean(inside(workspace, chain.crossings.points_mm)) > 0.5:
            within.append((i, j))
        else:
            elsewhere += 1
    return _Pairs(within, elsewhere)


def _is_taken(stretch: tuple[float, float], taken: list[tuple[float, float]]) -> bool:
    length = max(stretch[1] - stretch[0], 1e-9)
    return any(min(stretch[1], b) - max(stretch[0], a) > length / 2 for a, b in taken)


def _promising(left: list[Float], right: list[Float], rig: StereoRig, box: Workspace) -> list[tuple[int, int]]:
    """Pairs of lines of which at least three left points have a crossing in the box, the most crossings first."""
    left_owner = np.repeat(np.arange(len(left)), [len(p) for p in left])
    right_owner = np.repeat(np.arange(len(right)), [len(p) for p in right])
    found = _crossings(np.concatenate(left), np.concatenate(right), rig, box)
    before = found.right_at.astype(np.int64)
    within = right_owner[before] == right_owner[np.minimum(before + 1, len(right_owner) - 1)]
    rows = np.unique(np.column_stack([found.left_at, right_owner[before]])[within], axis=0)
    votes = np.zeros((len(left), len(right)), np.int64)
    np.add.at(votes, (left_owner[rows[:, 0]], rows[:, 1]), 1)
    most = np.argsort(-votes, axis=None, kind="stable")[:_MAX_PAIRS]
    return [(int(i), int(j)) for i, j in zip(*np.unravel_index(most, votes.shape), strict=True) if votes[i, j] >= 3]


def _candidate(left: Centerline, right: Centerline, chain: _Chain) -> Candidate:
    found = chain.crossings
    forward = found.right_at[-1] > found.right_at[0]
    return Candidate(
        left,
        right if forward else right.reversed(),
        Correspondences(found.left_px, found.right_px),
        found.points_mm,
        found.sine,
        float(arc_length(found.points_mm)[-1]),
        chain.score,
    )


def _best_chain(found: _Crossings, rig: StereoRig, parameters: MatchParameters) -> _Chain | None:
    """The longest chain of crossings, the right line taken either way, that keeps order and leaps nowhere in space."""
    if len(found.left_at) < 3:
        return None
    leap = np.linalg.norm(found.points_mm[None] - found.points_mm[:, None], axis=2)
    shown_px = np.linalg.norm(found.left_px[None] - found.left_px[:, None], axis=2)
    shown_mm = shown_px * found.points_mm[:, 2] / rig.left.focal_px
    possible = (leap < _MAX_FORESHORTENING * shown_mm) & (shown_mm < parameters.max_gap_mm)
    possible &= found.left_at[None] > found.left_at[:, None]
    # What a step costs: the left points that it skips, and the depth that it gains for nothing seen.
    stride = max(1, int(np.min(np.diff(np.unique(found.left_at)), initial=1)))
    skipped = (found.left_at[None] - found.left_at[:, None]) / stride - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(possible, 0.2 * skipped + 0.3 * (leap / shown_mm - 1), np.inf)
    ways = [_follow(found, cost, turn) for turn in (1.0, -1.0)]
    best, score = max(ways, key=lambda way: way[1])
    return _Chain(found.take(best), score) if len(best) >= 3 else None


def _follow(found: _Crossings, cost: Float, turn: float) -> tuple[npt.NDArray[np.int64], float]:
    at = turn * found.right_at
    ordered_cost = np.where(at[None] > at[:, None], cost, np.inf)
    # A crossing counts by how well it fixes the depth.
    worth = found.sine + 0.05
    score = worth.copy()
    previous = np.full(len(at), -1)
    for k in np.argsort(found.left_at, kind="stable"):
        gain = score - ordered_cost[:, k]
        best = int(np.argmax(gain))
        if gain[best] > 0:
            score[k] = worth[k] + gain[best]
            previous[k] = best
    chain = [int(np.argmax(score))]
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    return np.array(chain[::-1]), float(score.max())
