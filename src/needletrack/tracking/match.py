"""Which line of the left view and which of the right are one curve in space, and which of their points correspond.

A left point's partners are the places where its epipolar line crosses the right line, read off the sign changes of the
distance map (paper eq. 9, in pixels) to a fraction of a pixel. Dynamic programming then picks the longest chain of
partners that keeps the order along both lines and leaps nowhere in space, which the paper's threshold does not ask
for. A stretch along the epipolar lines has no crossings and goes without a partner; lines that run along them as a
whole are matched by their ends.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_map_px, homogeneous
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Centerline, Correspondences, Float, Reason
from needletrack.tracking.needle import Needle, Positive, Range, Workspace


class MatchParameters(BaseModel):
    """How well two lines must obey the epipolar geometry."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_candidates: int = Field(
        3, ge=1, description="So many of the best stretches that both views show are examined in full."
    )
    step_px: Positive = Field(4.0, description="Spacing of the points along each line that are matched, px.")
    max_gap_mm: Positive = Field(12.0, description="Longest stretch in the middle of the needle without a match, mm.")


# Along the needle, a step in space is at most so many times the step that the left view shows: turned 70 degrees away.
_MAX_FORESHORTENING = 3.0
_COARSE_STRIDE = 4
# Scenes with vessels have up to 100 pairs; a pattern of stripes has thousands, and none of them is a needle.
_MAX_PAIRS = 150
# So many are offered; which of them the images support is told later.
_MAX_CANDIDATES = 12
# Lines run along the epipolar lines where the sine of the angle is below this.
_LENGTHWISE = 0.35
# They are then matched by their ends, where that makes the curve longer than crossings do.
_LENGTHENS = 1.3
_MAX_ENDS_APART_PX = 30.0
# How well a traced line and its ends are known.
_ACROSS_PX, _ENDS_PX = 1.5, 12.0
# Precision of the Legendre coefficients of the inverse depth, 1/mm.
_BEND_PRIOR = (1 / 1e-2**2, 1 / 5e-4**2, 1 / 1e-4**2, 1 / 4e-5**2)
# Pairs are compared at every depth from half the nearest to four times the furthest of the workspace: a vessel behind
# it then finds its true partner and is not offered to the needle.
_DEPTH_MARGIN = (0.5, 4.0)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A left and a right line that may be one needle: points_mm (N, 3) in order, confidence (N,) in 0..1.

    A point's confidence is the sine of the angle at which the line crosses the epipolar line: near zero, the depth
    is not fixed. `length_mm` is the length of the matched stretch, `score` what it is ranked by.
    `plausible` in 0..1 is small where both lines have better partners elsewhere, or where the curve runs towards the
    cameras, as lines do that do not belong together.
    """

    left: Centerline
    right: Centerline
    correspondences: Correspondences
    points_mm: Float
    confidence: Float
    length_mm: float
    score: float
    plausible: float

    def part(self, chosen: npt.NDArray[np.bool_], score: float) -> "Candidate":
        """The chosen points alone, with their score."""
        pairs, points_mm = self.correspondences, self.points_mm[chosen]
        return Candidate(
            self.left,
            self.right,
            Correspondences(pairs.left_undistorted_px[chosen], pairs.right_undistorted_px[chosen]),
            points_mm,
            self.confidence[chosen],
            float(arc_length(points_mm)[-1]),
            score,
            self.plausible,
        )


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
    pairs = _pairs(left_px, right_px, rig, workspace, parameters)
    found: list[Candidate] = []
    crossing_mm: dict[tuple[int, int], float] = {}
    for i, j, own in pairs.within:
        chain = _best_chain(_crossings(left_px[i], right_px[j], rig, workspace), rig, parameters)
        if chain is not None:
            candidate = _candidate(left[i], right[j], chain, own)
            found.append(candidate)
            if np.median(candidate.confidence) > _LENGTHWISE / 2:
                crossing_mm[i, j] = candidate.length_mm
    for i, j, chain in _lengthwise(left_px, right_px, rig, workspace):
        candidate = _candidate(left[i], right[j], chain, 1.0)
        if candidate.length_mm > _LENGTHENS * crossing_mm.get((i, j), 0.0):
            found.append(candidate)
    found = [candidate for candidate in found if candidate.length_mm >= needle.min_length_mm / 2]
    if not found:
        raise NeedleNotFound("match", Reason.OUTSIDE_WORKSPACE if pairs.elsewhere else Reason.NO_STEREO_MATCH)
    return sorted(found, key=lambda c: -c.score)[:_MAX_CANDIDATES]


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
    """Lines that may be one needle within the workspace, and how many are each other's best partners elsewhere.

    With each pair comes the share of its stretches that has no better partner elsewhere.
    """

    within: list[tuple[int, int, float]]
    elsewhere: int


def _pairs(
    left: list[Float], right: list[Float], rig: StereoRig, workspace: Workspace, parameters: MatchParameters
) -> _Pairs:
    """Pairs of lines that meet in the workspace, but for those that both have their best partners elsewhere.

    Within the workspace a line is offered with every partner: a needle in front of a vessel, or seen as two rims and a
    streak, has its own among them. What lies elsewhere is exclusive.
    """
    nearest, furthest = workspace.z_mm.min * _DEPTH_MARGIN[0], workspace.z_mm.max * _DEPTH_MARGIN[1]
    everywhere = Range(min=-furthest, max=furthest)
    anywhere = Workspace(x_mm=everywhere, y_mm=everywhere, z_mm=Range(min=nearest, max=furthest))
    sparse = [points[:: _COARSE_STRIDE if len(points) > 4 * _COARSE_STRIDE else 1] for points in left]
    chains, chains_within = [], []
    for i, j in _promising(sparse, right, rig, anywhere):
        crossings = _crossings(sparse[i], right[j], rig, anywhere)
        is_within = inside(workspace, crossings.points_mm)
        chain = _best_chain(crossings, rig, parameters)
        if chain is not None:
            chains.append((i, j, chain))
        if not is_within.all():
            chain = _best_chain(crossings.take(is_within), rig, parameters)
        if chain is not None:
            chains_within.append((i, j, chain))
    taken, gone = (_Taken({}, {}), _Taken({}, {}))
    elsewhere = 0
    for i, j, chain in sorted(chains, key=lambda c: -c[2].score):
        if max(taken.shares(i, j, chain)) > 0.5:
            continue
        taken.add(i, j, chain)
        if np.mean(inside(workspace, chain.crossings.points_mm)) <= 0.5:
            gone.add(i, j, chain)
            elsewhere += 1
    within = []
    for i, j, chain in chains_within:
        shares = gone.shares(i, j, chain)
        if min(shares) <= 0.5:
            within.append((i, j, 1 - float(np.mean(shares))))
    return _Pairs(within, elsewhere)


_Place = tuple[dict[int, list[tuple[float, float]]], int, Float]


@dataclass(frozen=True, slots=True)
class _Taken:
    """Stretches, as first and last index, of left and right lines that have found a partner."""

    left: dict[int, list[tuple[float, float]]]
    right: dict[int, list[tuple[float, float]]]

    def add(self, i: int, j: int, chain: _Chain) -> None:
        for lines, line, at in self._places(i, j, chain):
            lines.setdefault(line, []).append((float(at.min()), float(at.max())))

    def shares(self, i: int, j: int, chain: _Chain) -> tuple[float, float]:
        """How much of the chain's left and of its right stretch is taken."""
        left, right = (
            float(np.mean(np.any([(at >= a) & (at <= b) for a, b in lines.get(line, [(1.0, 0.0)])], axis=0)))
            for lines, line, at in self._places(i, j, chain)
        )
        return left, right

    def _places(self, i: int, j: int, chain: _Chain) -> tuple[_Place, _Place]:
        at = chain.crossings
        return (self.left, i, at.left_at.astype(np.float64)), (self.right, j, at.right_at)


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


def _candidate(left: Centerline, right: Centerline, chain: _Chain, own: float) -> Candidate:
    found = chain.crossings
    forward = found.right_at[-1] > found.right_at[0]
    length_mm = float(arc_length(found.points_mm)[-1])
    # The length across the line of sight: depth that changes without reason makes a curve long.
    towards = found.points_mm / np.linalg.norm(found.points_mm, axis=1, keepdims=True)
    step = np.diff(found.points_mm[:: max(1, len(found.points_mm) // 10)], axis=0)
    depth = (step * towards[: len(step)]).sum(axis=1)
    across = 1 - float((depth**2).sum() / max((step**2).sum(), 1e-12))
    plausible = own * across
    return Candidate(
        left,
        right if forward else right.reversed(),
        Correspondences(found.left_px, found.right_px),
        found.points_mm,
        found.sine,
        length_mm,
        plausible * chain.score,
        plausible,
    )


def _lengthwise(
    left: list[Float], right: list[Float], rig: StereoRig, workspace: Workspace
) -> list[tuple[int, int, _Chain]]:
    """Pairs of lines that run mostly along the epipolar lines, matched by their ends and by how they bend.

    The inverse depth along the left line is a polynomial that brings it onto the right line, with its ends near the
    right line's ends: where the lines do not cross the epipolar lines, the ends alone fix the depth.
    """
    ends_left, ends_right = (np.concatenate([points[[0, -1]] for points in lines]) for lines in (left, right))
    apart = epipolar_distance_map_px(rig.fundamental, ends_left, ends_right).reshape(len(left), 2, len(right), 2)
    chord = np.linalg.norm(ends_right[1::2] - ends_right[::2], axis=1)
    is_along = np.abs(apart[..., 1] - apart[..., 0]).max(axis=1) < _LENGTHWISE * chord
    found = []
    for turned in (False, True):
        # First end to first end, or to the last one.
        ends = np.stack([apart[:, 0, :, int(turned)], apart[:, 1, :, 1 - int(turned)]])
        for i, j in zip(*np.nonzero(is_along & (np.abs(ends).max(axis=0) < _MAX_ENDS_APART_PX)), strict=True):
            chain = _by_ends(left[i], right[j][::-1] if turned else right[j], rig, workspace)
            if chain is not None:
                found.append((int(i), int(j), chain))
    return found


def _by_ends(left_px: Float, right_px: Float, rig: StereoRig, workspace: Workspace) -> _Chain | None:
    """The left line at the depth that brings it onto the right line, both in the same order; None: not in the box."""
    ends_mm = triangulate(rig, left_px[[0, -1]], right_px[[0, -1]])
    # Ends are traced too short or too long: the start may lie somewhat outside.
    if not ((ends_mm[:, 2] > workspace.z_mm.min / 1.5) & (ends_mm[:, 2] < workspace.z_mm.max * 1.5)).all():
        return None
    rays = homogeneous(left_px) @ np.linalg.inv(rig.left.matrix).T
    pose = rig.right_from_left
    # A point of the left line at inverse depth q projects to far + q * near, homogeneous.
    far = rays @ pose.rotation.T @ rig.right.matrix.T
    near = rig.right.matrix @ pose.translation_mm
    s = np.linspace(-1.0, 1.0, len(left_px))
    design = np.polynomial.legendre.legvander(s, 3)
    first, last = 1 / ends_mm[:, 2]
    coefficients = np.array([(first + last) / 2, (last - first) / 2, 0.0, 0.0])
    prior = np.diag(_BEND_PRIOR)
    segments = np.diff(right_px, axis=0)
    length = np.maximum(np.linalg.norm(segments, axis=1), 1e-9)
    along = segments / length[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])

    def at(c: Float) -> tuple[Float, Float]:
        q = design @ c
        h = far + q[:, None] * near
        px = h[:, :2] / h[:, 2:]
        return px, (near[:2] - px * near[2]) / h[:, 2:]

    for _ in range(5):
        px, by_q = at(coefficients)
        nearest = np.linalg.norm(px[:, None] - (right_px[:-1] + segments / 2), axis=2).argmin(axis=1)
        across = ((right_px[nearest] - px) * normal[nearest]).sum(axis=1)
        rows = design * (by_q * normal[nearest]).sum(axis=1)[:, None]
        ends = ((right_px[[0, -1]] - px[[0, -1]]) * along[[0, -1]]).sum(axis=1)
        end_rows = design[[0, -1]] * (by_q[[0, -1]] * along[[0, -1]]).sum(axis=1)[:, None]
        residual = np.concatenate([across / _ACROSS_PX, ends / _ENDS_PX])
        matrix = np.concatenate([rows / _ACROSS_PX, end_rows / _ENDS_PX])
        weight = 1 / (1 + residual**2)
        normal_matrix = matrix.T @ (weight[:, None] * matrix) + prior
        coefficients = coefficients + np.linalg.solve(
            normal_matrix, matrix.T @ (weight * residual) - prior @ coefficients
        )
    px, _ = at(coefficients)
    points_mm = rays / (design @ coefficients)[:, None]
    nearest = np.linalg.norm(px[:, None] - right_px, axis=2).argmin(axis=1)
    offset = np.linalg.norm(px - right_px[nearest], axis=1)
    good = inside(workspace, points_mm) & (offset < 2 * length.max())
    if good.sum() < 3:
        return None
    index = np.flatnonzero(good)
    crossings = _Crossings(
        index, nearest[index].astype(np.float64), left_px[index], px[index], points_mm[index], np.ones(len(index))
    )
    return _Chain(crossings, float(len(index)) * _LENGTHWISE)


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
