"""Which line of the left view and which of the right are one curve in space, and which of their points correspond.

A left point's partners are the places where its epipolar line crosses the right line, read off the sign changes of the
distance map (paper eq. 9, in pixels) to a fraction of a pixel. Dynamic programming then picks the longest chain of
partners that keeps the order along both lines and leaps nowhere in space, which the paper's threshold does not ask
for. A stretch along the epipolar lines has no crossings and goes without a partner; lines that run along them as a
whole are matched by their ends.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_map_px, epipolar_lines
from needletrack.geometry.spline import arc_length
from needletrack.geometry.stereo import StereoRig
from needletrack.kernels import call
from needletrack.records import Centerline, Correspondences, Float, Int, Reason
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
# Points along the lines are no closer than this far away.
_LEAST_STEP_MM = 0.85
# Scenes with vessels have up to 100 pairs; a pattern of stripes has thousands, and none of them is a needle.
_MAX_PAIRS = 150
# Room for crossings to begin with.
_USUAL_CROSSINGS = 20_000
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
    # Lines of large images were traced on reduced ones: more points than that tell nothing new.
    step_px = max(parameters.step_px, _LEAST_STEP_MM * rig.left.focal_px / workspace.z_mm.max)
    views = _Views(_resampled(left, rig.left, step_px), _resampled(right, rig.right, step_px), rig, workspace)
    pairs = _pairs(views, parameters)
    least_mm = needle.min_length_mm / 2
    shape = len(left), len(right)
    own, crossing_mm = np.ones(shape), np.zeros(shape)
    own[tuple(pairs.within.T)] = pairs.own
    found = _crossings(views, views.left, pairs.within, workspace)
    chains = _best_chains(found, pairs.within, views.rig, parameters)
    offered = _offers(chains, own[tuple(chains.lines.T)], chains.lengths_mm >= least_mm)
    for offer in offered:
        if np.median(offer.chain.crossings.sine) > _LENGTHWISE / 2:
            crossing_mm[offer.left, offer.right] = offer.length_mm
    along = _lengthwise(views)
    longer = along.lengths_mm > _LENGTHENS * crossing_mm[tuple(along.lines.T)]
    offered += _offers(along, np.ones(len(along)), longer & (along.lengths_mm >= least_mm))
    if not offered:
        raise NeedleNotFound("match", Reason.OUTSIDE_WORKSPACE if pairs.elsewhere else Reason.NO_STEREO_MATCH)
    best: list[Candidate] = []
    for offer in sorted(offered, key=lambda o: -o.at_best):
        if len(best) == _MAX_CANDIDATES and offer.at_best <= best[-1].score:
            break
        best.append(_candidate(left[offer.left], right[offer.right], offer))
        best = sorted(best, key=lambda c: -c.score)[:_MAX_CANDIDATES]
    return best


def inside(workspace: Workspace, points_mm: Float) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) lie in the workspace, (N,) bool; NaN does not."""
    lower = np.array([workspace.x_mm.min, workspace.y_mm.min, workspace.z_mm.min])
    upper = np.array([workspace.x_mm.max, workspace.y_mm.max, workspace.z_mm.max])
    return np.asarray(((points_mm >= lower) & (points_mm <= upper)).all(axis=1), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of one view, one behind the other: undistorted points (N, 2), each from a start to before a stop (L,)."""

    points_px: Float
    starts: Int
    stops: Int

    def __len__(self) -> int:
        return len(self.starts)

    def ends_px(self) -> Float:
        """First and last point of each, (L, 2, 2)."""
        return self.points_px[np.stack([self.starts, self.stops - 1], axis=1)]

    def sparse(self) -> "_Lines":
        """Every fourth point of those that are long enough for it."""
        count = self.stops - self.starts
        stride = np.where(count > 4 * _COARSE_STRIDE, _COARSE_STRIDE, 1)
        at = np.arange(len(self.points_px)) - np.repeat(self.starts, count)
        stops = np.cumsum(-(-count // stride))
        return _Lines(
            self.points_px[at % np.repeat(stride, count) == 0],
            np.concatenate([[0], stops[:-1]]).astype(np.int64),
            stops,
        )


def _starts(stops: Int) -> Int:
    """Where each of several begins (P,) that lie one behind the other, from where they stop."""
    return np.concatenate([[0], stops]).astype(np.int64)[: len(stops)]


def _resampled(lines: list[Centerline], camera: Camera, step_px: float) -> _Lines:
    """Points along each line, evenly spaced by about so much."""
    points = np.concatenate([line.points_px for line in lines])
    given = np.cumsum([len(line.points_px) for line in lines])
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Along all lines as if they were one, with a step of one from each to the next: a single interpolation serves all.
    step[given[:-1] - 1] = 1.0
    along = np.concatenate([[0.0], np.cumsum(step)])
    first, last = along[np.concatenate([[0], given[:-1]])], along[given - 1]
    count = np.maximum(2, np.rint((last - first) / step_px).astype(np.int64) + 1)
    stops = np.cumsum(count)
    starts = stops - count
    share = (np.arange(stops[-1]) - np.repeat(starts, count)) / np.repeat(count - 1, count)
    at = np.repeat(first, count) + share * np.repeat(last - first, count)
    return _Lines(
        camera.undistort(np.column_stack([np.interp(at, along, column) for column in points.T])), starts, stops
    )


@dataclass(frozen=True, eq=False)
class _Views:
    """All lines of both views, and the rig that sees them."""

    left: _Lines
    right: _Lines
    rig: StereoRig
    workspace: Workspace

    def ranges(self, left: _Lines, pairs: Int) -> Int:
        """Where the left and the right line of each pair start and stop, (P, 4), as the kernels take them."""
        i, j = pairs.T
        return np.column_stack([left.starts[i], left.stops[i], self.right.starts[j], self.right.stops[j]])

    @cached_property
    def packed_rig(self) -> Float:
        """As the kernels take it."""
        pose = self.rig.right_from_left
        return np.concatenate(
            [
                self.rig.fundamental.ravel(),
                np.linalg.inv(self.rig.left.matrix).ravel(),
                np.linalg.inv(self.rig.right.matrix).ravel(),
                pose.rotation.T.ravel(),
                -pose.rotation.T @ pose.translation_mm,
            ]
        )


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Where epipolar lines of left points cross right lines: indices into both, points in both views and in space."""

    left_at: npt.NDArray[np.int64]
    right_at: Float
    left_px: Float
    right_px: Float
    points_mm: Float
    sine: Float

    @property
    def arrays(self) -> tuple[Int, Float, Float, Float, Float, Float]:
        return self.left_at, self.right_at, self.left_px, self.right_px, self.points_mm, self.sine

    def take(self, index: Int | npt.NDArray[np.bool_] | slice) -> "_Crossings":
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


@dataclass(frozen=True, eq=False)
class _Found:
    """Crossings of several pairs of lines, each pair's from a start to before a stop (P,), by left point."""

    crossings: _Crossings
    starts: Int
    stops: Int

    def within(self, chosen: npt.NDArray[np.bool_]) -> "_Found":
        """The chosen crossings alone."""
        before = np.concatenate([[0], np.cumsum(chosen)])
        return _Found(self.crossings.take(chosen), before[self.starts], before[self.stops])

    def of(self, pairs: Int) -> "_Found":
        """Of these pairs alone."""
        return _Found(self.crossings, self.starts[pairs], self.stops[pairs])


def _corners(box: Workspace) -> Float:
    """Lowest and highest corner, (6,), mm."""
    ranges = (box.x_mm, box.y_mm, box.z_mm)
    return np.array([r.min for r in ranges] + [r.max for r in ranges])


def _crossings(views: _Views, left: _Lines, pairs: Int, box: Workspace) -> _Found:
    """Where the epipolar lines of left points cross right lines, in the box, for pairs of lines (P, 2)."""
    ranges = views.ranges(left, pairs)
    ends = np.zeros(len(ranges), np.int64)
    distance = np.empty(len(views.right.points_px))
    lines = epipolar_lines(views.rig.fundamental, left.points_px)
    given = views.packed_rig, left.points_px, lines, views.right.points_px, ranges, len(ranges), _corners(box)
    capacity = _USUAL_CROSSINGS
    while True:
        room = _Crossings(
            np.empty(capacity, np.int64),
            np.empty(capacity),
            np.empty((capacity, 2)),
            np.empty((capacity, 2)),
            np.empty((capacity, 3)),
            np.empty(capacity),
        )
        count = call("crossings", *given, capacity, distance, *room.arrays, ends)
        if count <= capacity:
            return _Found(room.take(slice(count)), _starts(ends), ends)
        capacity = count


@dataclass(frozen=True, eq=False)
class _Chains:
    """Chains of crossings, the best first: their lines (C, 2), each from a start to before a stop (C,), scores (C,)."""

    crossings: _Crossings
    lines: Int
    starts: Int
    stops: Int
    scores: Float

    def __len__(self) -> int:
        return len(self.scores)

    def chain(self, index: int) -> _Chain:
        """One of them."""
        cut = slice(int(self.starts[index]), int(self.stops[index]))
        return _Chain(self.crossings.take(cut), float(self.scores[index]))

    def means(self, values: Float) -> Float:
        """The mean (C,) along each chain of values (N,) of the crossings."""
        total = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray((total[self.stops] - total[self.starts]) / (self.stops - self.starts))

    @cached_property
    def lengths_mm(self) -> Float:
        """Length (C,) of each in space."""
        along = arc_length(self.crossings.points_mm)
        return along[self.stops - 1] - along[self.starts]

    @cached_property
    def places(self) -> Float:
        """Places (2, N) on the left and on the right lines."""
        return np.stack([self.crossings.left_at, self.crossings.right_at])

    @cached_property
    def reach(self) -> tuple[Float, Float]:
        """Lowest and highest place (2, C) of each."""
        order = np.argsort(self.starts)
        back = np.argsort(order)
        low, high = (
            extreme.reduceat(self.places, self.starts[order], axis=1)[:, back] if len(self) else np.zeros((2, 0))
            for extreme in (np.minimum, np.maximum)
        )
        return np.ascontiguousarray(low), np.ascontiguousarray(high)

    def gone(self, workspace: Workspace) -> Int:
        """Those that are each other's best partners, outside the workspace."""
        is_outside = self.means(inside(workspace, self.crossings.points_mm).astype(np.float64)) <= 0.5
        gone = np.empty(len(self), np.int64)
        lost = call(
            "gone_elsewhere",
            np.ascontiguousarray(self.lines.T),
            self.places,
            self.places.shape[1],
            self.starts,
            self.stops,
            *self.reach,
            is_outside,
            len(self),
            np.empty(len(self), np.int64),
            gone,
        )
        return gone[:lost]

    def shares(self, others: "_Chains", gone: Int) -> Float:
        """How much of each chain's left and right stretch (C, 2) is taken by the others that are gone."""
        shares = np.zeros((2, len(self)))
        call(
            "shares_gone",
            np.ascontiguousarray(self.lines.T),
            self.places,
            self.places.shape[1],
            self.starts,
            self.stops,
            len(self),
            np.ascontiguousarray(others.lines[gone].T),
            *(np.ascontiguousarray(reach[:, gone]) for reach in others.reach),
            len(gone),
            np.empty(len(gone), np.int64),
            shares,
        )
        return shares.T


def _best_chains(found: _Found, lines: Int, rig: StereoRig, parameters: MatchParameters) -> _Chains:
    """Of each pair of lines (P, 2) that has one the longest chain that keeps order and leaps nowhere.

    The right line may be taken either way.
    """
    at, groups = found.crossings, len(found.starts)
    most = int((found.stops - found.starts).max(initial=0))
    chosen, ends, scores = np.empty(len(at.left_at), np.int64), np.empty(groups, np.int64), np.empty(groups)
    call(
        "best_chains",
        at.left_at,
        at.right_at,
        at.left_px,
        at.points_mm,
        at.sine,
        found.starts,
        found.stops,
        groups,
        rig.left.focal_px,
        _MAX_FORESHORTENING,
        parameters.max_gap_mm,
        np.empty(2 * most),
        np.empty(2 * most, np.int64),
        chosen,
        ends,
        scores,
    )
    return _ordered(at.take(chosen[: ends.max(initial=0)]), ends, lines, scores)


def _ordered(crossings: _Crossings, ends: Int, lines: Int, scores: Float) -> _Chains:
    """Chains that lie one behind the other, some of them of no length."""
    starts = _starts(ends)
    order = np.argsort(-scores, kind="stable")
    order = order[ends[order] > starts[order]]
    return _Chains(crossings, lines[order], starts[order], ends[order], scores[order])


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Lines that may be one needle within the workspace, (P, 2), and how many are each other's best partners elsewhere.

    own (P,): the share of their stretches that has no better partner elsewhere.
    """

    within: Int
    own: Float
    elsewhere: int


def _pairs(views: _Views, parameters: MatchParameters) -> _Pairs:
    """Pairs of lines that meet in the workspace, but for those that both have their best partners elsewhere.

    Within the workspace a line is offered with every partner: a needle in front of a vessel, or seen as two rims and a
    streak, has its own among them. What lies elsewhere is exclusive.
    """
    workspace = views.workspace
    nearest, furthest = workspace.z_mm.min * _DEPTH_MARGIN[0], workspace.z_mm.max * _DEPTH_MARGIN[1]
    everywhere = Range(min=-furthest, max=furthest)
    anywhere = Workspace(x_mm=everywhere, y_mm=everywhere, z_mm=Range(min=nearest, max=furthest))
    sparse = views.left.sparse()
    lines = np.indices((len(sparse), len(views.right))).reshape(2, -1).T
    found = _crossings(views, sparse, lines, anywhere)
    promising = _promising(found)
    found = found.of(promising)
    chains = _best_chains(found, lines[promising], views.rig, parameters)
    is_within = inside(workspace, found.crossings.points_mm)
    within = _best_chains(found.within(is_within), lines[promising], views.rig, parameters)
    gone = chains.gone(workspace)
    shares = within.shares(chains, gone)
    kept = shares.min(axis=1, initial=1.0) <= 0.5
    return _Pairs(within.lines[kept], 1 - shares[kept].mean(axis=1), len(gone))


def _promising(found: _Found) -> Int:
    """The pairs of lines of which at least three left points have a crossing, the most crossings first."""
    at = found.crossings.left_at
    owner = np.repeat(np.arange(len(found.starts)), found.stops - found.starts)
    is_new = np.ones(len(at), np.bool_)
    is_new[1:] = (at[1:] != at[:-1]) | (owner[1:] != owner[:-1])
    votes = np.bincount(owner[is_new], minlength=len(found.starts))
    most = np.argsort(-votes, kind="stable")[:_MAX_PAIRS]
    return most[votes[most] >= 3]


@dataclass(frozen=True, slots=True)
class _Offer:
    """A chain of a left and a right line, of which `own` is not better matched elsewhere."""

    left: int
    right: int
    chain: _Chain
    own: float
    length_mm: float

    @property
    def at_best(self) -> float:
        """What it may be ranked by."""
        return self.own * self.chain.score


def _offers(chains: _Chains, own: Float, chosen: npt.NDArray[np.bool_]) -> list[_Offer]:
    return [
        _Offer(int(i), int(j), chains.chain(k), float(own[k]), float(chains.lengths_mm[k]))
        for k, (i, j) in enumerate(chains.lines)
        if chosen[k]
    ]


def _candidate(left: Centerline, right: Centerline, offer: _Offer) -> Candidate:
    found = offer.chain.crossings
    forward = found.right_at[-1] > found.right_at[0]
    # The length across the line of sight: depth that changes without reason makes a curve long.
    towards = found.points_mm / np.linalg.norm(found.points_mm, axis=1, keepdims=True)
    step = np.diff(found.points_mm[:: max(1, len(found.points_mm) // 10)], axis=0)
    depth = (step * towards[: len(step)]).sum(axis=1)
    across = 1 - float((depth**2).sum() / max((step**2).sum(), 1e-12))
    plausible = offer.own * across
    return Candidate(
        left,
        right if forward else right.reversed(),
        Correspondences(found.left_px, found.right_px),
        found.points_mm,
        found.sine,
        offer.length_mm,
        plausible * offer.chain.score,
        plausible,
    )


def _lengthwise(views: _Views) -> _Chains:
    """Pairs of lines that run mostly along the epipolar lines, matched by their ends and by how they bend.

    The inverse depth along the left line is a polynomial that brings it onto the right line, with its ends near the
    right line's ends: where the lines do not cross the epipolar lines, the ends alone fix the depth.
    """
    ends_left, ends_right = views.left.ends_px(), views.right.ends_px()
    apart = epipolar_distance_map_px(views.rig.fundamental, ends_left.reshape(-1, 2), ends_right.reshape(-1, 2))
    apart = apart.reshape(len(views.left), 2, len(views.right), 2)
    chord = np.linalg.norm(ends_right[:, 1] - ends_right[:, 0], axis=1)
    is_along = np.abs(apart[..., 1] - apart[..., 0]).max(axis=1) < _LENGTHWISE * chord
    pairs, turned = [], []
    for is_turned in (False, True):
        # First end to first end, or to the last one.
        ends = np.stack([apart[:, 0, :, int(is_turned)], apart[:, 1, :, 1 - int(is_turned)]])
        pairs.append(np.argwhere(is_along & (np.abs(ends).max(axis=0) < _MAX_ENDS_APART_PX)))
        turned.append(np.full(len(pairs[-1]), is_turned))
    return _by_ends(views, np.concatenate(pairs), np.concatenate(turned))


def _by_ends(views: _Views, pairs: Int, turned: npt.NDArray[np.bool_]) -> _Chains:
    """The left lines at the depth that brings them onto the right ones, some turned round, where that is in the box."""
    ranges = views.ranges(views.left, pairs)
    count = int((ranges[:, 1] - ranges[:, 0]).sum())
    z_mm, pose = views.workspace.z_mm, views.rig.right_from_left
    limits = np.array([_ACROSS_PX, _ENDS_PX, *_BEND_PRIOR, z_mm.min, z_mm.max, *_corners(views.workspace)])
    at, nearest, ends = np.empty(count, np.int64), np.empty(count), np.empty(len(pairs), np.int64)
    right_px, points_mm = np.empty((count, 2)), np.empty((count, 3))
    call(
        "by_ends",
        views.packed_rig,
        np.ascontiguousarray(views.rig.right.matrix),
        np.ascontiguousarray(pose.rotation),
        np.ascontiguousarray(pose.translation_mm),
        views.left.points_px,
        views.right.points_px,
        ranges,
        turned,
        len(pairs),
        limits,
        np.empty(6 * len(views.left.points_px) + 2 * len(views.right.points_px)),
        at,
        nearest,
        right_px,
        points_mm,
        ends,
    )
    kept = int(ends.max(initial=0))
    lengths = np.diff(ends, prepend=0)
    left_px = views.left.points_px[np.repeat(ranges[:, 0], lengths) + at[:kept]]
    crossings = _Crossings(at[:kept], nearest[:kept], left_px, right_px[:kept], points_mm[:kept], np.ones(kept))
    return _ordered(crossings, ends, pairs, lengths * _LENGTHWISE)
