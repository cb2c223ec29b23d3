"""Both cameras and the pose between them, from views of a board.

Views that cannot serve are left out with the reason. Each camera by itself (Zhang 2000, DOI 10.1109/34.888718), then
the order of corners in the right pictures, then OpenCV's stereo calibration as the start of a joint bundle adjustment.
Order: a checkerboard looks the same after a half turn, a square one after a quarter turn, and no single picture tells
which corner is the first. But the pose between the cameras is one for all views: of the turns that each view allows,
those are right that agree on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.calibration.board import Board, BoardView
from needletrack.calibration.bundle import Bundle, Terms, adjust
from needletrack.calibration.coverage import coverage, displacement_px
from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.records import Float

MIN_VIEWS = 4
# A turn of the board moves its corners by many squares; half as clear is not clear.
_CLEARLY_BETTER = 3.0
# Corners are found to a tenth of a pixel or better: views this far off are not merely noisy.
_OUTLIER_RATIO, _OUTLIER_PX = 4.0, 0.5
# A bad view pulls the rig towards itself and hides: the worst one goes where the others then agree so much better.
_SUSPECT_RATIO, _SUSPECT_PX, _AGREE_BETTER = 2.0, 0.1, 0.7
# Blurred: by so much more than the sharp half of the views, and by so much at all (sigma of the edges).
_BLUR_RATIO, _BLUR_PX = 2.2, 1.0
# The same view again, px rms in both pictures.
DUPLICATE_PX = 2.0
# Of two boards, the angle that makes them different; of the focal length, the sigma that makes it unknown.
_LEAST_TILT_DEG, _MOST_FOCAL_SIGMA = 10.0, 0.02
# Another lens model has to explain this much more than its terms cost (a Bayes factor of e^5).
_LENS_GAIN = 10.0
_LENSES: tuple[Terms, ...] = (4, 5, 8)
_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
_REMEDY = "show the whole board to both cameras at ten or more places, distances and tilts"


@dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that was left out: its place in the sequence of views, and why."""

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """The rig, and how well it explains the corners.

    rms_px: over all corners in both pictures; used: which views; view_rms_px (len(used), 2): of each, left
    and right. views: those used, the right corners in the order of the left ones; bundle: the solution itself; terms
    of the lens, and lens_bic of each model that was tried: the lower, the better.
    """

    rig: StereoRig
    rms_px: float
    used: tuple[int, ...]
    view_rms_px: Float
    rejected: tuple[RejectedView, ...]
    views: tuple[BoardView, ...]
    bundle: Bundle
    terms: Terms
    lens_bic: tuple[tuple[Terms, float], ...]


def calibrate_stereo(
    views: Sequence[BoardView],
    board: Board,
    size_px: tuple[int, int],
    *,
    lens: Terms | None = None,
    warp: bool = False,
) -> StereoCalibration:
    """Both cameras, for images of size_px (width, height).

    lens: terms of the distortion in OpenCV's order, 4 and 5 radial-tangential, 8 rational; None takes the one with
    the least Bayesian information criterion (Schwarz 1978). warp: the board's bend is solved for as well.
    A view is rejected, with the reason, where a picture lacks the board, is blurred, or repeats another view, where
    the order of corners stays ambiguous, or the corners contradict the other views. Raises CalibrationError where
    fewer than MIN_VIEWS remain, or where the views are too much alike; it says which to add.
    """
    found = _Selection(views, board, size_px)
    found.leave_out_unusable()
    found.require_enough()
    try:
        start = found.in_one_order()
        found.require_enough()
        bundle, terms, tried = _best_lens(found.pairs, board, start, lens, warp=warp)
        # One at a time: a bad view spoils its neighbours.
        while True:
            place = int(bundle.view_rms_px.max(axis=1).argmax())
            if not _is_suspect(bundle, place):
                break
            others = [*found.pairs[:place], *found.pairs[place + 1 :]]
            poses = (*bundle.left_from_board[:place], *bundle.left_from_board[place + 1 :])
            if len(others) < MIN_VIEWS and not _is_outlier(bundle, place):
                break
            without = _best_lens(others, board, _Start(bundle.rig, poses), lens, warp=warp)
            if not (_is_outlier(bundle, place) or _spoiled(bundle, place, without[0])):
                break
            found.leave_out(place, _why_off(without[0], bundle, found.pairs[place], place, board))
            found.require_enough()
            bundle, terms, tried = without
    except (cv2.error, ValueError, np.linalg.LinAlgError) as error:
        raise CalibrationError(f"{len(found.pairs)} views do not determine the cameras: {found.remedy()}") from error
    found.require_different(bundle)
    return StereoCalibration(
        bundle.rig,
        bundle.rms_px,
        tuple(pair.index for pair in found.pairs),
        bundle.view_rms_px,
        tuple(sorted(found.rejected, key=lambda view: view.index)),
        tuple(BoardView(pair.left_px, pair.right_px) for pair in found.pairs),
        bundle,
        terms,
        tried,
    )


@dataclass(frozen=True, slots=True)
class _Pair:
    """A view whose corners (N, 2) both pictures show; NaN for a corner that one does not."""

    index: int
    left_px: Float
    right_px: Float


@dataclass(frozen=True, slots=True)
class _Start:
    rig: StereoRig
    left_from_board: tuple[RigidTransform, ...]


class _Selection:
    """The views that serve, and those that do not, with the reason."""

    def __init__(self, views: Sequence[BoardView], board: Board, size_px: tuple[int, int]) -> None:
        self._views, self._board, self._size_px = views, board, size_px
        self.pairs: list[_Pair] = []
        self.rejected: list[RejectedView] = []

    def leave_out_unusable(self) -> None:
        """Views without the board, blurred ones, and those that repeat another one."""
        blurs = np.sort([max(known) for view in self._views if (known := [b for b in view.blur_px if b is not None])])
        sharp_px = float(np.median(blurs[: max(1, (len(blurs) + 1) // 2)])) if len(blurs) else 0.0
        most_px = max(_BLUR_RATIO * sharp_px, _BLUR_PX)
        kept: list[int] = []
        for index, view in enumerate(self._views):
            reason = _missing(view, self._board) or _blurred(view, most_px) or self._repeated(index, kept)
            if reason:
                self.rejected.append(RejectedView(index, reason))
            elif view.left_px is not None and view.right_px is not None:
                kept.append(index)
                self.pairs.append(_Pair(index, view.left_px, view.right_px))

    def _repeated(self, index: int, kept: Sequence[int]) -> str:
        for other in kept:
            apart_px = displacement_px(self._views[index], self._views[other])
            if apart_px < DUPLICATE_PX:
                return f"it repeats view {other}: the board moved by {apart_px:.1f} px, which tells nothing new"
        return ""

    def leave_out(self, place: int, reason: str) -> None:
        self.rejected.append(RejectedView(self.pairs.pop(place).index, reason))

    def remedy(self) -> str:
        """What to show; says which poses are missing."""
        covered = coverage([BoardView(pair.left_px, pair.right_px) for pair in self.pairs], self._board, self._size_px)
        missing = covered.missing
        return f"{_REMEDY}; what is missing: {'; '.join(missing)}" if missing else _REMEDY

    def require_enough(self) -> None:
        if len(self.pairs) < MIN_VIEWS:
            reasons = "".join(f"; view {view.index}: {view.reason}" for view in self.rejected)
            raise CalibrationError(
                f"{len(self.pairs)} usable views of the board are fewer than {MIN_VIEWS}: {self.remedy()}{reasons}"
            )

    def require_different(self, bundle: Bundle) -> None:
        """CalibrationError where the boards all face the same way, or leave the focal length open."""
        normals = np.array([pose.rotation[:, 2] for pose in bundle.left_from_board])
        tilt_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
        if tilt_deg < _LEAST_TILT_DEG:
            raise CalibrationError(
                f"the views are too much alike: no two boards differ in tilt by more than {tilt_deg:.0f} degrees, "
                f"which leaves the focal length open: {self.remedy()}"
            )
        sigma = float(np.sqrt(bundle.covariance[0, 0])) / bundle.rig.left.focal_px
        if sigma > _MOST_FOCAL_SIGMA:
            raise CalibrationError(
                f"the views leave the focal length uncertain by {100 * sigma:.1f} %: {self.remedy()}, or use a "
                "larger board"
            )

    def in_one_order(self) -> _Start:
        """OpenCV's solution, once the right corners are in the order of the left ones; the other views are left out.

        Every turn of every view says where the right camera stands; the best such answer is the one under which
        the views, each with the turn that suits it best, leave the least error.
        """
        board, pairs = self._board, self.pairs
        left = _solve_camera([pair.left_px for pair in pairs], board, self._size_px)
        right = _solve_camera([pair.right_px for pair in pairs], board, self._size_px)
        errors_px = []
        for from_left, from_right in zip(left.camera_from_board, right.camera_from_board, strict=True):
            for turn in board.turns:
                right_from_left = from_right @ turn.turned @ from_left.inverse()
                errors_px.append(_turn_errors_px(pairs, board, left.camera_from_board, right.camera, right_from_left))
        by_answer = np.array(errors_px)  # (answers, views, turns)
        chosen = by_answer.argmin(axis=2)
        remaining_px = np.median(by_answer.min(axis=2), axis=1)
        best = int(remaining_px.argmin())
        different = remaining_px[(chosen != chosen[best]).mean(axis=1) > 0.5]
        if len(different) and different.min() < _CLEARLY_BETTER * remaining_px[best]:
            raise CalibrationError(
                "the board looks the same after a turn, and the views are too much alike to tell which was made: "
                f"{self.remedy()}; or use a board that no turn repeats, such as one of even by odd squares, or ChArUco"
            )
        ordered = []
        for pair, view_errors_px, turn_index in zip(pairs, by_answer[best], chosen[best], strict=True):
            least_px, *more_px = np.sort(view_errors_px)
            if more_px and more_px[0] < _CLEARLY_BETTER * least_px:
                reason = (
                    "its corners fit the other views in no order, or in several: "
                    f"{least_px:.1f} px off in the best, {more_px[0]:.1f} in the next"
                )
                self.rejected.append(RejectedView(pair.index, reason))
            else:
                ordered.append(replace(pair, right_px=pair.right_px[board.turns[turn_index].order]))
        self.pairs = ordered
        self.require_enough()
        return _solve(ordered, board, self._size_px, left.camera, right.camera)


def _missing(view: BoardView, board: Board) -> str:
    found = {"left": view.left_px, "right": view.right_px}
    for side, corners_px in found.items():
        if corners_px is not None and len(corners_px) != len(board.points_mm):
            return f"the {side} picture has {len(corners_px)} corners, the board {len(board.points_mm)}"
    without = [side for side, corners_px in found.items() if corners_px is None]
    if not without:
        return ""
    faults = sorted({fault for side, fault in zip(("left", "right"), view.faults, strict=True) if fault})
    why = f" ({'; '.join(faults)})" if faults else ""
    return f"the board was not found in the {' and the '.join(without)} picture{why}"


def _blurred(view: BoardView, most_px: float) -> str:
    for side, blur_px in zip(("left", "right"), view.blur_px, strict=True):
        if blur_px is not None and blur_px > most_px:
            return (
                f"the {side} picture is blurred: its edges have a sigma of {blur_px:.1f} px, {most_px:.1f} px are the "
                "limit here: hold the board still and in focus"
            )
    return ""


def _is_outlier(bundle: Bundle, place: int) -> bool:
    by_view_px = bundle.view_rms_px.max(axis=1)
    return bool(by_view_px[place] > max(_OUTLIER_RATIO * np.median(by_view_px), _OUTLIER_PX))


def _is_suspect(bundle: Bundle, place: int) -> bool:
    by_view_px = bundle.view_rms_px.max(axis=1)
    return bool(by_view_px[place] > max(_SUSPECT_RATIO * np.median(by_view_px), _SUSPECT_PX))


def _spoiled(bundle: Bundle, place: int, without: Bundle) -> bool:
    """Whether the other views agree much better without this one: it had pulled the rig towards itself."""
    others_px = np.delete(bundle.view_rms_px, place, axis=0)
    return bool(np.median(without.view_rms_px) < _AGREE_BETTER * np.median(others_px))


def _why_off(without: Bundle, bundle: Bundle, pair: _Pair, place: int, board: Board) -> str:
    """What is wrong with a view that the others contradict."""
    others_px = float(np.median(without.view_rms_px))
    off = f"its corners are {bundle.view_rms_px[place].max():.2f} px rms off, those of the others {others_px:.2f} px: "
    alone_px = max(
        _alone_px(corners_px, camera, board)
        for corners_px, camera in ((pair.left_px, without.rig.left), (pair.right_px, without.rig.right))
    )
    if alone_px < max(_OUTLIER_RATIO * others_px, _SUSPECT_PX):
        return (
            f"{off}each picture alone fits to {alone_px:.2f} px: the board or a camera moved between the two exposures"
        )
    return f"{off}not even one picture alone fits: the board is bent or moved in the exposure, or corners are false"


def _alone_px(corners_px: Float, camera: Camera, board: Board) -> float:
    """RMS distance of one picture's corners from a board that is free to be anywhere."""
    known = np.isfinite(corners_px).all(axis=1)
    points = np.ascontiguousarray(board.points_mm[known])
    found, turn, shift = cv2.solvePnP(points, corners_px[known], camera.matrix, camera.distortion)
    if not found:
        return float("inf")
    pose = RigidTransform(orthonormalized(cv2.Rodrigues(turn)[0]), np.ravel(shift))
    off_px = corners_px[known] - camera.project(pose.apply(points))
    return float(np.sqrt((off_px**2).sum(axis=1).mean()))


def _best_lens(
    pairs: Sequence[_Pair], board: Board, start: _Start, lens: Terms | None, *, warp: bool
) -> tuple[Bundle, Terms, tuple[tuple[Terms, float], ...]]:
    """The solution with the lens model that is wanted, or that the views call for."""
    views = [BoardView(pair.left_px, pair.right_px) for pair in pairs]
    solved: dict[Terms, Bundle] = {}
    for terms in _LENSES if lens is None else (lens,):
        solved[terms] = adjust(views, board, start.rig, start.left_from_board, terms, warp=warp)
    best = next(iter(solved))
    for terms, bundle in solved.items():
        if bundle.bic < solved[best].bic - _LENS_GAIN:
            best = terms
    return solved[best], best, tuple((terms, bundle.bic) for terms, bundle in solved.items())


def _turn_errors_px(
    pairs: Sequence[_Pair],
    board: Board,
    left_from_board: Sequence[RigidTransform],
    right: Camera,
    right_from_left: RigidTransform,
) -> Float:
    """Error (views, turns), px rms, of the right corners in each order under one right_from_left."""
    errors_px = np.empty((len(pairs), len(board.turns)))
    for i, (pair, from_board) in enumerate(zip(pairs, left_from_board, strict=True)):
        projected_px = right.project((right_from_left @ from_board).apply(board.points_mm))
        for j, turn in enumerate(board.turns):
            off_px = np.linalg.norm(pair.right_px[turn.order] - projected_px, axis=1)
            errors_px[i, j] = np.sqrt(np.nanmean(off_px**2))
    return errors_px


# OpenCV's solvers


@dataclass(frozen=True, slots=True)
class _CameraSolution:
    camera: Camera
    camera_from_board: tuple[RigidTransform, ...]


def _solve_camera(corners_px: Sequence[Float], board: Board, size_px: tuple[int, int]) -> _CameraSolution:
    known = [np.isfinite(corners).all(axis=1) for corners in corners_px]
    _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
        _for_opencv([board.points_mm[which] for which in known]),
        _for_opencv([corners[which] for corners, which in zip(corners_px, known, strict=True)]),
        size_px,
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
        criteria=_UNTIL,
    )
    poses = tuple(
        RigidTransform(orthonormalized(cv2.Rodrigues(rotation)[0]), np.ravel(translation))
        for rotation, translation in zip(rotations, translations, strict=True)
    )
    return _CameraSolution(_camera(matrix, distortion, size_px), poses)


def _solve(pairs: Sequence[_Pair], board: Board, size_px: tuple[int, int], left: Camera, right: Camera) -> _Start:
    known = [np.isfinite(pair.left_px + pair.right_px).all(axis=1) for pair in pairs]
    # OpenCV wants corners that both pictures show, and enough of them.
    both = [which for which in known if which.sum() >= MIN_VIEWS]
    if len(both) < MIN_VIEWS:
        raise CalibrationError(f"{len(both)} views show the same corners to both cameras: {_REMEDY}")
    chosen = [(pair, which) for pair, which in zip(pairs, known, strict=True) if which.sum() >= MIN_VIEWS]
    (_, left_matrix, left_distortion, right_matrix, right_distortion, rotation, translation, *_) = cv2.stereoCalibrate(
        _for_opencv([board.points_mm[which] for _, which in chosen]),
        _for_opencv([pair.left_px[which] for pair, which in chosen]),
        _for_opencv([pair.right_px[which] for pair, which in chosen]),
        left.matrix.copy(),
        left.distortion.copy(),
        right.matrix.copy(),
        right.distortion.copy(),
        size_px,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
        criteria=_UNTIL,
    )
    rig = StereoRig(
        _camera(left_matrix, left_distortion, size_px),
        _camera(right_matrix, right_distortion, size_px),
        RigidTransform(orthonormalized(rotation), np.ravel(translation)),
    )
    return _Start(rig, tuple(_pose(pair.left_px, rig.left, board) for pair in pairs))


def _pose(corners_px: Float, camera: Camera, board: Board) -> RigidTransform:
    known = np.isfinite(corners_px).all(axis=1)
    points = np.ascontiguousarray(board.points_mm[known])
    found, turn, shift = cv2.solvePnP(points, corners_px[known], camera.matrix, camera.distortion)
    if not found:
        raise ValueError("a board's pose could not be found")
    return RigidTransform(orthonormalized(cv2.Rodrigues(turn)[0]), np.ravel(shift))


def _camera(matrix: npt.ArrayLike, distortion: npt.ArrayLike, size_px: tuple[int, int]) -> Camera:
    return Camera(np.asarray(matrix, dtype=np.float64), np.ravel(distortion)[:5], size_px)


def _for_opencv(points: Sequence[Float]) -> list[npt.NDArray[np.float32]]:
    return [np.ascontiguousarray(each, dtype=np.float32) for each in points]
