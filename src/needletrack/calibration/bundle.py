"""All parameters of both cameras and the poses of all boards together, with the covariance of what is found.

Bundle adjustment (Triggs et al. 1999, DOI 10.1007/3-540-44480-7_21): Levenberg-Marquardt on the squared distances of
all corners in both pictures of every view. The boards' poses are eliminated from the normal equations (Schur
complement), which leaves as many unknowns as the rig has, however many views there are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import Board, BoardView
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.geometry.uncertainty import cross_matrices, linearized, parameter_count, perturbed
from needletrack.records import Float

Terms = Literal[4, 5, 8]
_MOST_ROUNDS = 100
_SETTLED = 1e-9
# What is known of any camera before a picture is taken, for a small board leaves some of it to chance. Standard
# deviations: of fy / fx from one; of the principal point from the middle, share of the width; of the shift at the
# image's corner by each radial and by each tangential term, share of the corner's distance from the middle.
_ASPECT, _CENTER, _RADIAL, _TANGENTIAL = 2e-3, 0.05, 0.5, 2e-3
# A corner this many robust standard deviations off is a false one.
_FALSE_CORNER = 5.0
_MOST_FALSE = 0.15


@dataclass(frozen=True, slots=True)
class Bundle:
    """The rig that explains the corners best, and how well.

    covariance (P, P): of the parameters of `geometry.uncertainty`, scaled by what the residuals are. left_from_board:
    of each view. residual_px (V, 2, N, 2): view, camera, corner; NaN where a corner was not seen or was left out as
    false. sigma_px: standard deviation of one coordinate of a corner, from the residuals and the degrees of freedom.
    bic: Bayesian information criterion, by which lens models are compared. warp_mm: how far the middle of the board
    stands out along its x and its y; None where it was taken for flat.
    """

    rig: StereoRig
    covariance: Float
    left_from_board: tuple[RigidTransform, ...]
    residual_px: Float
    sigma_px: float
    false_corners: int
    bic: float
    warp_mm: tuple[float, float] | None

    @property
    def rms_px(self) -> float:
        """Root mean square distance of all corners in both pictures."""
        return float(np.sqrt(np.nanmean((self.residual_px**2).sum(axis=-1))))

    @property
    def view_rms_px(self) -> Float:
        """The same of each view in each camera, (V, 2)."""
        return np.asarray(np.sqrt(np.nanmean((self.residual_px**2).sum(axis=-1), axis=2)))


def adjust(
    views: Sequence[BoardView],
    board: Board,
    start: StereoRig,
    left_from_board: Sequence[RigidTransform],
    terms: Terms = 5,
    *,
    warp: bool = False,
) -> Bundle:
    """The rig and boards at which all corners' squared distances are least, from a start that is near.

    views: with the right corners in the order of the left ones, NaN where a corner was not seen. terms: of the
    distortion, in OpenCV's order. warp: the board is bent like a parabola along x and along y. Raises
    CalibrationError where the views do not determine it.
    """
    problem = _Problem(views, board, start)
    state = _State(
        _with_terms(start, terms),
        np.array([pose.rotation for pose in left_from_board]),
        np.array([pose.translation_mm for pose in left_from_board]),
        np.zeros(2 if warp else 0),
    )
    false = np.zeros(problem.seen.shape, dtype=bool)
    state, left_over = _minimized(problem, state, problem.seen)
    for _ in range(3):
        distance = np.linalg.norm(np.where(problem.seen[..., None], left_over, 0.0), axis=-1)
        # The median of a Rayleigh distribution is 1.177 standard deviations of a coordinate.
        limit = _FALSE_CORNER * np.sqrt(2) * float(np.median(distance[problem.seen & ~false])) / 1.177
        found = problem.seen & (distance > max(limit, 1e-6))
        # Where many corners of one picture are off, it is the view that is false, and not its corners.
        few = found.mean(axis=2, keepdims=True) <= _MOST_FALSE
        found = found & few
        if (found == false).all():
            break
        false = found
        state, left_over = _minimized(problem, state, problem.seen & ~false)
    used = problem.seen & ~false
    count = 2 * int(used.sum())
    free = parameter_count(state.rig) + len(state.warp) + 6 * len(views)
    squares = float((left_over[used] ** 2).sum())
    sigma = float(np.sqrt(squares / max(count - free, 1)))
    size = parameter_count(state.rig)
    residual = np.where(used[..., None], left_over, np.nan)
    return Bundle(
        state.rig,
        _inverse(problem.normal(state, used, max(sigma, 1e-6)).reduced())[:size, :size],
        tuple(
            RigidTransform(orthonormalized(turn), shift)
            for turn, shift in zip(state.board_turns, state.board_shifts, strict=True)
        ),
        residual,
        sigma,
        int(false.sum()),
        count * float(np.log(squares / count)) + free * float(np.log(count)),
        (float(state.warp[0]), float(state.warp[1])) if warp else None,
    )


@dataclass(frozen=True, slots=True)
class Refit:
    """A calibrated rig fitted again to few views: cost is minus twice the log posterior.

    sigma_px: of one coordinate of a corner, from these views' residuals. bump (6,): turn (rad) and shift (mm) of the
    right camera since the calibration, as in its parameters, with its covariance (6, 6); zero where none is allowed.
    """

    rig: StereoRig
    cost: float
    sigma_px: float
    bump: Float
    bump_covariance: Float


def refit(
    rig: StereoRig,
    covariance: Float | None,
    views: Sequence[BoardView],
    board: Board,
    sigma_px: float,
    *,
    bump: tuple[float, float] | None = None,
) -> Refit:
    """The rig that its calibration, of that covariance (P, P), and fresh views of a board agree on.

    bump: standard deviations, in degrees and mm, by which the right camera may have moved since. sigma_px: noise of the
    corners. Raises CalibrationError where the views fit no board.
    """
    size = parameter_count(rig)
    known = np.zeros((size, size)) if covariance is None else covariance.copy()
    # A calibration without a stated covariance counts as exact but for rounding.
    known[np.diag_indices(size)] += (1e-9 * np.maximum(1.0, _scales(rig))) ** 2
    allowed = np.zeros(6) if bump is None else np.repeat([np.radians(bump[0]) ** 2, bump[1] ** 2], 3)
    known[range(-6, 0), range(-6, 0)] += allowed
    precision = _inverse(known)
    prior = _Prior(rig, precision)
    problem = _Problem(views, board, rig, prior)
    poses = []
    for view in views:
        assert view.left_px is not None
        seen = np.isfinite(view.left_px).all(axis=1)
        is_found, turn, shift = cv2.solvePnP(
            np.ascontiguousarray(board.points_mm[seen]), view.left_px[seen], rig.left.matrix, rig.left.distortion
        )
        if not is_found:
            raise CalibrationError("a view fits no board: check the number of squares and their side in mm")
        poses.append(RigidTransform(orthonormalized(cv2.Rodrigues(turn)[0]), np.ravel(shift)))
    state = _State(
        rig,
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation_mm for pose in poses]),
        np.zeros(0),
    )
    state, left_over = _minimized(problem, state, problem.seen, sigma_px)
    squares = float((left_over[problem.seen] ** 2).sum())
    degrees = 2 * int(problem.seen.sum()) - 6 * len(views)
    # The camera's motion is a part of the change of its pose; the rest belongs to the calibration's own uncertainty.
    gain = allowed[:, None] * precision[-6:]
    found = _inverse(problem.normal(state, problem.seen, sigma_px).reduced())
    left_open = np.diag(allowed) - gain[:, -6:] * allowed
    return Refit(
        state.rig,
        problem.cost(state, problem.seen, sigma_px),
        float(np.sqrt(squares / max(degrees, 1))),
        gain @ prior.change(state.rig),
        left_open + gain @ found @ gain.T,
    )


def _scales(rig: StereoRig) -> Float:
    """The order of magnitude (P,) of each parameter."""
    parts = []
    for camera in (rig.left, rig.right):
        parts += [np.full(4, camera.focal_px), np.ones(len(camera.distortion))]
    return np.concatenate([*parts, np.ones(3), np.full(3, rig.baseline_mm)])


class _Prior:
    """A calibration: the rig, and the precision (P, P) of its parameters."""

    def __init__(self, rig: StereoRig, precision: Float) -> None:
        self._rig = rig
        scale = np.sqrt(np.diag(precision))
        self._root = np.linalg.cholesky(precision / np.outer(scale, scale)).T * scale

    def known(self, rig: StereoRig) -> tuple[Float, Float]:
        return self._root, -self._root @ self.change(rig)

    def change(self, rig: StereoRig) -> Float:
        """By which parameters (P,) a rig differs from the calibrated one."""
        parts = []
        for camera, before in ((rig.left, self._rig.left), (rig.right, self._rig.right)):
            change = (camera.matrix - before.matrix)[[0, 1, 0, 1], [0, 1, 2, 2]]
            parts += [change, camera.distortion - before.distortion]
        pose, before_pose = rig.right_from_left, self._rig.right_from_left
        parts += [
            Rotation.from_matrix(pose.rotation @ before_pose.rotation.T).as_rotvec(),
            pose.translation_mm - before_pose.translation_mm,
        ]
        return np.concatenate(parts)


@dataclass(frozen=True, slots=True)
class _State:
    """Where the search stands: board_turns (V, 3, 3) and board_shifts (V, 3) are left_from_board."""

    rig: StereoRig
    board_turns: Float
    board_shifts: Float
    warp: Float

    def moved(self, rig_step: Float, board_steps: Float) -> "_State":
        size = parameter_count(self.rig)
        turns = Rotation.from_rotvec(board_steps[:, :3]).as_matrix()
        rig = perturbed(self.rig, rig_step[:size])
        pose = rig.right_from_left
        rig = replace(rig, right_from_left=RigidTransform(orthonormalized(pose.rotation), pose.translation_mm))
        return _State(
            rig, turns @ self.board_turns, self.board_shifts + board_steps[:, 3:], self.warp + rig_step[size:]
        )


@dataclass(frozen=True, slots=True)
class _Normal:
    """The normal equations at a state: of the rig (P, P), of each board (V, 6, 6), and between them (V, P, 6)."""

    rig: Float
    boards: Float
    between: Float
    rig_gradient: Float
    board_gradients: Float

    def step(self, damping: float) -> tuple[Float, Float]:
        boards = self.boards + damping * _diagonal(self.boards)
        rig = self.rig + damping * _diagonal(self.rig[None])[0]
        gain = np.linalg.solve(boards, self.between.swapaxes(1, 2))
        reduced = rig - np.einsum("vpb,vbq->pq", self.between, gain)
        right = self.rig_gradient - np.einsum("vbp,vb->p", gain, self.board_gradients)
        rig_step = _scaled_solve(reduced, right)
        board_steps = np.linalg.solve(boards, self.board_gradients[..., None])[..., 0] - gain @ rig_step
        return rig_step, board_steps

    def reduced(self) -> Float:
        gain = np.linalg.solve(self.boards, self.between.swapaxes(1, 2))
        return np.asarray(self.rig - np.einsum("vpb,vbq->pq", self.between, gain))


def expected_covariance(
    rig: StereoRig,
    board: Board,
    left_from_board: Sequence[RigidTransform],
    sigma_px: float,
    *,
    warp: bool = False,
) -> Float:
    """The covariance (P, P) that views of a board at these places would give, before any picture is taken.

    sigma_px: of one coordinate of a corner. Corners outside of an image count for nothing.
    """
    views = []
    for pose in left_from_board:
        points_mm = pose.apply(board.points_mm)
        pixels = []
        for camera, local_mm in ((rig.left, points_mm), (rig.right, rig.right_from_left.apply(points_mm))):
            px = camera.project(local_mm)
            pixels.append(np.where((camera.contains(px) & (local_mm[:, 2] > 0))[:, None], px, np.nan))
        views.append(BoardView(pixels[0], pixels[1]))
    problem = _Problem(views, board, rig)
    state = _State(
        rig,
        np.array([pose.rotation for pose in left_from_board]),
        np.array([pose.translation_mm for pose in left_from_board]),
        np.zeros(2 if warp else 0),
    )
    size = parameter_count(rig)
    return _inverse(problem.normal(state, problem.seen, sigma_px).reduced())[:size, :size]


def _inverse(matrix: Float) -> Float:
    """Of a symmetric positive matrix whose rows differ in scale by many powers of ten."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = np.linalg.inv(matrix * np.outer(scale, scale))
    return np.asarray((scaled + scaled.T) / 2 * np.outer(scale, scale))


def _diagonal(matrices: Float) -> Float:
    return np.asarray(matrices * np.eye(matrices.shape[-1]))


def _scaled_solve(matrix: Float, right: Float) -> Float:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right))


class _Problem:
    """The corners of all views, and what they say at a state."""

    def __init__(
        self, views: Sequence[BoardView], board: Board, start: StereoRig, prior: "_Prior | None" = None
    ) -> None:
        self.prior = prior
        nothing = np.full((len(board.points_mm), 2), np.nan)
        self.corners = np.array(
            [[nothing if px is None else px for px in (view.left_px, view.right_px)] for view in views]
        )
        self.seen = np.isfinite(self.corners).all(axis=-1)
        self.board_mm = board.points_mm
        middle = (self.board_mm.max(axis=0) + self.board_mm.min(axis=0)) / 2
        self.middle_mm = middle
        half = np.ptp(self.board_mm, axis=0)[:2] / 2
        # One in the middle, zero at the borders (mrcal's model of a bent board).
        self.bulge = 1 - ((self.board_mm[:, :2] - middle[:2]) / half) ** 2
        self.corner_radius = [
            float(np.hypot(*camera.size_px)) / 2 / camera.focal_px for camera in (start.left, start.right)
        ]

    def known(self, state: _State) -> tuple[Float, Float]:
        """What is known before any picture: derivatives (K, P) and what is missing (K,), in standard deviations."""
        if self.prior is not None:
            return self.prior.known(state.rig)
        size = parameter_count(state.rig) + len(state.warp)
        rows, missing = [], []
        at = 0
        for camera, corner in zip((state.rig.left, state.rig.right), self.corner_radius, strict=True):
            (fx, _, cx), (_, fy, cy), _ = camera.matrix
            width, height = camera.size_px
            aspect = np.zeros(size)
            aspect[[at, at + 1]] = -fy / fx**2, 1 / fx
            rows.append(aspect / _ASPECT)
            missing.append((1 - fy / fx) / _ASPECT)
            for offset, value, sigma in (
                (2, cx - (width - 1) / 2, _CENTER * width),
                (3, cy - (height - 1) / 2, _CENTER * width),
                *((4 + i, k, _lens_sigma(i, corner)) for i, k in enumerate(camera.distortion)),
            ):
                row = np.zeros(size)
                row[at + offset] = 1 / sigma
                rows.append(row)
                missing.append(-value / sigma)
            at += 4 + len(camera.distortion)
        return np.array(rows), np.array(missing)

    def residual(self, state: _State) -> Float:
        """Corner minus projection (V, 2, N, 2)."""
        turned = self._turned(state)
        left = turned + state.board_shifts[:, None]
        right = left @ state.rig.right_from_left.rotation.T + state.rig.right_from_left.translation_mm
        views, count = len(left), len(self.board_mm)
        pixels = [
            camera.project(points.reshape(-1, 3)).reshape(views, count, 2)
            for camera, points in ((state.rig.left, left), (state.rig.right, right))
        ]
        return np.asarray(self.corners - np.stack(pixels, axis=1))

    def _turned(self, state: _State) -> Float:
        points = np.broadcast_to(self.board_mm, (len(state.board_turns), *self.board_mm.shape))
        if len(state.warp):
            points = points + np.array([0.0, 0.0, 1.0]) * (self.bulge @ state.warp)[:, None]
        return np.asarray(points @ state.board_turns.swapaxes(1, 2))

    def normal(self, state: _State, used: npt.NDArray[np.bool_], sigma: float) -> _Normal:
        """The normal equations, weighted by 1 / sigma^2, with what is known before."""
        turned = self._turned(state)
        views, count = turned.shape[:2]
        rotation = state.rig.right_from_left.rotation
        left = (turned + state.board_shifts[:, None]).reshape(-1, 3)
        from_left = left @ rotation.T
        seen = [
            linearized(state.rig.left, left),
            linearized(state.rig.right, from_left + state.rig.right_from_left.translation_mm),
        ]
        sizes = [4 + len(state.rig.left.distortion), 4 + len(state.rig.right.distortion)]
        size = parameter_count(state.rig) + len(state.warp)
        rows, missing_before = self.known(state)
        precision, pull = rows.T @ rows, rows.T @ missing_before
        boards, between = np.zeros((views, 6, 6)), np.zeros((views, size, 6))
        board_gradients = np.zeros((views, 6))
        arms = cross_matrices(turned.reshape(-1, 3))
        by_warp = None
        if len(state.warp):
            normals = np.repeat(state.board_turns[:, :, 2], count, axis=0)
            by_warp = normals[:, :, None] * np.tile(self.bulge, (views, 1))[:, None, :]
        for side, view in enumerate(seen):
            by_left = view.by_point if side == 0 else view.by_point @ rotation
            by_rig = np.zeros((len(left), 2, size))
            start = sizes[0] * side
            by_rig[:, :, start : start + sizes[side]] = view.by_camera
            if side == 1:
                end = sum(sizes)
                by_rig[:, :, end : end + 3] = -view.by_point @ cross_matrices(from_left)
                by_rig[:, :, end + 3 : end + 6] = view.by_point
            if by_warp is not None:
                by_rig[:, :, -2:] = by_left @ by_warp
            by_board = np.concatenate([-by_left @ arms, by_left], axis=2)
            here = used[:, side].reshape(-1)
            left_over = np.where(here[:, None], self.corners[:, side].reshape(-1, 2) - view.pixels, 0.0) / sigma
            weight = np.where(here, 1 / sigma, 0.0)[:, None, None]
            rig_rows = (by_rig * weight).reshape(views, 2 * count, size)
            board_rows = (by_board * weight).reshape(views, 2 * count, 6)
            missing = left_over.reshape(views, 2 * count)
            precision = precision + np.einsum("vip,viq->pq", rig_rows, rig_rows, optimize=True)
            pull = pull + np.einsum("vip,vi->p", rig_rows, missing)
            transposed = board_rows.swapaxes(1, 2)
            boards += transposed @ board_rows
            between += rig_rows.swapaxes(1, 2) @ board_rows
            board_gradients += (transposed @ missing[..., None])[..., 0]
        return _Normal(precision, boards, between, pull, board_gradients)

    def cost(self, state: _State, used: npt.NDArray[np.bool_], sigma: float) -> float:
        """What is minimised."""
        _, missing = self.known(state)
        return float((missing**2).sum()) + float((self.residual(state)[used] ** 2).sum()) / sigma**2


def _lens_sigma(term: int, corner: float) -> float:
    """Of one of the distortion's terms, in OpenCV's order; corner: the image corner's distance from the middle / f."""
    if term in (2, 3):
        return _TANGENTIAL / corner
    # k1 k2 - - k3 k4 k5 k6: powers 2 4 6 of the radius, above and below the fraction's line.
    power = {0: 2, 1: 4, 4: 6, 5: 2, 6: 4, 7: 6}[term]
    return float(_RADIAL / corner**power)


def _minimized(
    problem: _Problem, state: _State, used: npt.NDArray[np.bool_], stated: float | None = None
) -> tuple[_State, Float]:
    """Levenberg-Marquardt; the corners' sigma, against which the prior weighs, is stated or found on the way."""
    damping = 1e-4
    sigma = stated or max(float(np.sqrt((problem.residual(state)[used] ** 2).mean())), 1e-6)
    for _ in range(_MOST_ROUNDS):
        try:
            normal = problem.normal(state, used, sigma)
            cost = problem.cost(state, used, sigma)
            while True:
                ahead = _ahead(state, normal.step(damping))
                gained = -1.0 if ahead is None else cost - problem.cost(ahead, used, sigma)
                if ahead is not None and gained >= 0:
                    break
                damping *= 10
                if damping > 1e12:
                    ahead, gained = state, 0.0
                    break
        except (np.linalg.LinAlgError, cv2.error) as error:
            raise CalibrationError("the views do not determine the cameras") from error
        state, damping = ahead, max(damping / 10, 1e-12)
        now = stated or max(float(np.sqrt((problem.residual(state)[used] ** 2).mean())), 1e-6)
        settled = gained < _SETTLED * max(cost, 1.0) and abs(now - sigma) < 1e-6 * sigma
        sigma = now
        if settled:
            break
    return state, problem.residual(state)


def _ahead(state: _State, step: tuple[Float, Float]) -> _State | None:
    try:
        return state.moved(*step)
    except ValueError:
        return None


def _with_terms(rig: StereoRig, terms: int) -> StereoRig:
    def camera(of: Camera) -> Camera:
        lens = np.zeros(terms)
        kept = min(terms, len(of.distortion))
        lens[:kept] = of.distortion[:kept]
        return Camera(of.matrix, lens, of.size_px)

    return StereoRig(camera(rig.left), camera(rig.right), rig.right_from_left)
