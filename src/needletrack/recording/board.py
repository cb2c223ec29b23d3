"""Pictures of the calibration board, which bring no rig: they are there to make one."""

import csv
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from needletrack.calibration.board import Board, BoardView, CharucoBoard, find_board
from needletrack.calibration.bundle import Terms
from needletrack.calibration.coverage import Coverage, coverage
from needletrack.calibration.drift import BoardCheck, check_views
from needletrack.calibration.stereo import StereoCalibration, calibrate_stereo
from needletrack.calibration.worth import (
    Expected,
    HeldOut,
    Improvement,
    expected,
    held_out,
    improvements,
    space_grid_mm,
)
from needletrack.errors import CalibrationError, RecordingError
from needletrack.reading import bytes_of, picture, text_of
from needletrack.recording.asl import UnusablePair
from needletrack.recording.bag import is_bag
from needletrack.recording.replay import ReplaySource, StoredRecording
from needletrack.recording.stored import open_pictures
from needletrack.records import Float, Image, StereoPair
from needletrack.rig import CalibrationInfo, CalibrationUncertainty, Rig
from needletrack.tracking.needle import Workspace

_METHOD = "needletrack calibrate"
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
# Without a workspace that both cameras see, the error is told where the boards were.
_LEAST_POINTS = 8
# Pictures taken one by one are further apart.
_FILM_S = 0.5
# Looked at in each stretch of a film, and how much smaller, to find the stillest pair.
_TRIED, _SMALLER = 6, 8
_LISTING_HEADER = "#timestamp [ns],filename\n"
_MOST_PICTURE_BYTES = 1 << 29


class BoardPictures(Protocol):
    """Stereo pairs of pictures by number: where they come from, the left ones' names, all pictures' size."""

    source: str
    size_px: tuple[int, int]
    names: tuple[str, ...]

    def read(self, index: int) -> tuple[Image, Image]:
        """Both images (rows, columns) of a pair; raises RecordingError that says why it cannot be used."""


class _Recorded:
    """Pairs of a recording of any kind, by their indices; all of them without any."""

    def __init__(self, recording: StoredRecording, indices: Sequence[int] | None = None) -> None:
        self._recording = recording
        self._indices = range(len(recording)) if indices is None else indices
        self.source = recording.folder.resolve().name
        self.size_px = recording.rig.left.size_px
        files = [recording.pairs[index].left.path for index in self._indices]
        self.names = tuple(
            f"pair {index}" if file == recording.folder else file.name
            for index, file in zip(self._indices, files, strict=True)
        )

    def read(self, index: int) -> tuple[Image, Image]:
        pair = self._recording.read(self._indices[index])
        return pair.left.image, pair.right.image


class _Folders:
    """Two folders, or one with left... and right..., whose pictures pair by the numbers in their names."""

    def __init__(self, left: Path, right: Path) -> None:
        found = [_numbered(left, "left" if left == right else ""), _numbered(right, "right" if left == right else "")]
        shared = [key for key in found[0] if key in found[1]]
        if not shared:
            raise RecordingError(
                f"{left} and {right}: no two pictures pair: those of a pair bear the same number, e.g. left01.png and "
                f"right01.png ({len(found[0])} and {len(found[1])} pictures)"
            )
        self._pairs = [(found[0][key], found[1][key]) for key in shared]
        height, width = _gray(self._pairs[0][0]).shape
        self.source, self.size_px = left.resolve().name, (width, height)
        self.names = tuple(pair[0].name for pair in self._pairs)

    def read(self, index: int) -> tuple[Image, Image]:
        images = [_gray(path) for path in self._pairs[index]]
        for path, image in zip(self._pairs[index], images, strict=True):
            if image.shape != self.size_px[::-1]:
                raise RecordingError(
                    f"{path}: the picture is {image.shape[1]}x{image.shape[0]}, the first one "
                    f"{self.size_px[0]}x{self.size_px[1]}"
                )
        return images[0], images[1]


def open_board_pictures(
    folder: Path, right: Path | None = None, *, most: int | None = None, tolerance_us: float = 1000.0
) -> BoardPictures:
    """The pairs of a recording of any kind, of two folders of pictures, or of one with left* and right*.

    most: of a recording that runs like a film, look at so many pairs at most: of each stretch the stillest one.
    tolerance_us: greatest difference of a recorded pair's stamps. Raises RecordingError where there are none.
    """
    if right is None and (folder.is_file() or is_bag(folder) or (folder / "cam0" / "data.csv").exists()):
        recording = open_pictures(folder, tolerance_us=tolerance_us)
        return _Recorded(recording, None if most is None else _stillest(recording, most))
    for path in (folder, right):
        if path is not None and not path.is_dir():
            raise RecordingError(f"{path}: there is no such folder")
    if right is None:
        inside = {name: folder / name for name in ("left", "right") if (folder / name).is_dir()}
        if len(inside) == 2:
            return _Folders(inside["left"], inside["right"])
        if not any(folder.glob("left*")):
            return _Recorded(open_pictures(folder))  # whose error says what an ASL folder holds
    return _Folders(folder, right or folder)


def board_stream(path: Path) -> ReplaySource:
    """A recording of the board, of any kind, as a stream at its own pace, as cameras would give it."""
    return ReplaySource(open_pictures(path), paced=True)


@dataclass(frozen=True, slots=True)
class BoardCalibration:
    """The rig that pictures of the board give, and all that was found on the way.

    left_out: a sentence for each pair that could not serve; worst_view_rms_px: of those that did, of the
    worst one in its worse picture. views: of all pairs that could be read, at their `places` in the pictures; solved:
    by their places in `views`. points_mm (N, 3): where the error is told.
    """

    rig: Rig
    left_out: tuple[str, ...]
    worst_view_rms_px: float
    views: tuple[BoardView, ...]
    places: tuple[int, ...]
    solved: StereoCalibration
    covered: Coverage
    expected: Expected
    held_out: HeldOut
    improvements: tuple[Improvement, ...]
    points_mm: Float

    def told(self) -> tuple[str, ...]:
        """What it is worth, in a few lines for a person."""
        judged, stated = self.held_out, self.expected
        used, terms = len(self.solved.used), self.solved.terms
        lines = [
            ("views", f"{used} used, {len(self.left_out)} left out; worst {self.worst_view_rms_px:.3f} px rms"),
            ("lens", f"{terms} terms of distortion"),
            ("held out", f"{judged.epipolar_px:.3f} px rms off epipolar lines"),
            ("", f"lengths up to {judged.longest_mm:g} mm to {judged.length_mm:.4f} mm rms"),
            ("in space", f"{stated.before_mm:.3f} mm rms to expect in the workspace, in the left camera's frame"),
            ("", f"{stated.after_mm:.3f} mm after the best rigid alignment, such as a registration to a robot"),
        ]
        lines += [
            ("better", f"{each.change}: {each.expected.before_mm:.3f} mm, aligned {each.expected.after_mm:.3f} mm")
            for each in self.improvements
        ]
        lines += [("missing", sentence) for sentence in self.covered.missing[:3]]
        return tuple(f"{name:12}{text}" for name, text in lines)


def calibrate_from_recording(folder: Path | str, board: Board, name: str, calibrated_at: datetime) -> BoardCalibration:
    """Calibrate both cameras from the pairs of a folder that show the board: `calibrate_from_pictures`."""
    return calibrate_from_pictures(open_board_pictures(Path(folder)), board, name, calibrated_at)


def calibrate_from_pictures(
    pictures: BoardPictures,
    board: Board,
    name: str,
    calibrated_at: datetime,
    *,
    lens: Terms | None = None,
    warp: bool = False,
    workspace: Workspace | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> BoardCalibration:
    """Calibrate both cameras from pairs that show the board.

    calibrated_at: with a time zone, for the rig file. workspace: where the error is to be told. progress: called with
    the number of pairs that were looked at. Raises RecordingError where nothing can be read, CalibrationError where
    the pictures do not determine the cameras.
    """
    left_out: list[str] = []
    views, places = [], []
    for index, found in _found(pictures, board, progress):
        if isinstance(found, RecordingError):
            left_out.append(str(found))
        else:
            views.append(found)
            places.append(index)
    solved = calibrate_stereo(views, board, pictures.size_px, lens=lens, warp=warp)
    left_out += [f"{pictures.names[places[each.index]]}: {each.reason}" for each in solved.rejected]
    points_mm = _workspace_points(solved, board, workspace or Workspace())
    stated, judged = expected(solved.rig, solved.bundle.covariance, points_mm), held_out(solved, board)
    uncertainty = CalibrationUncertainty(
        corner_sigma_px=_significant(solved.bundle.sigma_px),
        covariance=CalibrationUncertainty.rows(solved.bundle.covariance),
        before_alignment_mm=_significant(stated.before_mm),
        after_alignment_mm=_significant(stated.after_mm),
        held_out_epipolar_px=_significant(judged.epipolar_px),
        held_out_length_mm=_significant(judged.length_mm),
    )
    info = CalibrationInfo(
        method=_METHOD,
        calibrated_at=calibrated_at,
        reprojection_rms_px=solved.rms_px,
        views=len(solved.used),
        source=f"{pictures.source}, {described(board)}",
        uncertainty=uncertainty,
    )
    geometry = solved.rig
    try:
        rig = Rig(geometry.left, geometry.right, geometry.right_from_left, name, info)
    except ValueError as error:
        raise CalibrationError(
            f"{pictures.source}: no rig: {error}; check the number of squares, their side in mm, and left and right"
        ) from error
    return BoardCalibration(
        rig,
        tuple(left_out),
        float(solved.view_rms_px.max()),
        tuple(views),
        tuple(places),
        solved,
        coverage(solved.views, board, pictures.size_px, geometry.left),
        stated,
        judged,
        improvements(solved, board, points_mm),
        points_mm,
    )


@dataclass(frozen=True, slots=True)
class RigCheck:
    """What fresh pictures of the board say about a rig; left_out: a sentence for each pair that could not serve.

    is_exact: the rig file states no uncertainty, so that the calibration counts as exact.
    """

    check: BoardCheck
    left_out: tuple[str, ...]
    is_exact: bool = False

    def told(self) -> tuple[str, ...]:
        """The verdict and what it rests on, in a few lines for a person."""
        found, caused = self.check, self.check.effect.error
        lines = [("left out", sentence) for sentence in self.left_out]
        lines += [
            ("views", f"{found.views} of the board"),
            (
                "epipolar",
                f"{found.epipolar_rms_px:.3f} px rms off the lines, {found.epipolar_mean_px:+.3f} px on average",
            ),
            ("lengths", f"{100 * found.length_error:+.3f} % on the board"),
        ]
        names = ("pitch", "yaw", "roll")
        turn = zip(names, found.motion.turn_deg.tolist(), found.motion_sigma.turn_deg.tolist(), strict=True)
        shift = zip("xyz", found.motion.shift_mm.tolist(), found.motion_sigma.shift_mm.tolist(), strict=True)
        lines += [
            ("turned", ", ".join(f"{name} {value:+.3f} ± {sigma:.3f}°" for name, value, sigma in turn)),
            ("shifted", ", ".join(f"{name} {value:+.3f} ± {sigma:.3f} mm" for name, value, sigma in shift)),
        ]
        verdict = ("ok", "the right camera stands where it was calibrated, as far as these views tell")
        if found.moved:
            error = f"{caused.before_mm:.2f} mm rms off in the workspace, {caused.after_mm:.2f} mm in shape"
            verdict = ("MOVED", f"tracks are {error}: calibrate anew")
        lines.append(verdict)
        if self.is_exact:
            lines.append(("note", "the rig file states no uncertainty: its own error counts as a motion"))
        return tuple(f"{name:12}{text}" for name, text in lines)


def check_pictures(rig: Rig, pictures: BoardPictures, board: Board, workspace: Workspace | None = None) -> RigCheck:
    """Judge a rig by fresh pictures of a board, by `check_views`.

    Raises CalibrationError where the pictures have another size than the rig's, or none shows the board to both.
    """
    if pictures.size_px != rig.left.size_px:
        raise CalibrationError(f"the pictures are {pictures.size_px}, the rig says {rig.left.size_px}")
    left_out, views = [], []
    for index, found in _found(pictures, board, lambda done: None):
        if isinstance(found, RecordingError):
            left_out.append(str(found))
        elif found.left_px is None or found.right_px is None:
            without = [side for side, px in (("left", found.left_px), ("right", found.right_px)) if px is None]
            left_out.append(
                f"{pictures.names[index]}: the board was not found in the {' and the '.join(without)} picture"
            )
        else:
            views.append(found)
    wanted = workspace or Workspace()
    ranges = [(axis.min, axis.max) for axis in (wanted.x_mm, wanted.y_mm, wanted.z_mm)]
    stated = rig.calibration.uncertainty
    checked = check_views(
        rig,
        None if stated is None else stated.matrix,
        None if stated is None else stated.corner_sigma_px,
        views,
        board,
        space_grid_mm(rig, ranges[0], ranges[1], ranges[2]),
    )
    return RigCheck(checked, tuple(left_out), stated is None)


def described(board: Board) -> str:
    """`board of 11 x 11 squares of 2 mm`."""
    markers = f", with markers of {board.marker_mm:g} mm" if isinstance(board, CharucoBoard) else ""
    return f"board of {board.squares_x} x {board.squares_y} squares of {board.square_mm:g} mm{markers}"


class BoardRecorder:
    """Writes pairs as an EuRoC / ASL folder, so that what was taken live can be calibrated again.

    An empty one is begun at once, so that a folder that cannot be written shows before the board is held up. Raises
    RecordingError where the folder holds pictures already, or cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for camera in ("cam0", "cam1"):
            listing = folder / camera / "data.csv"
            try:
                if listing.exists() and text_of(listing, _MOST_PICTURE_BYTES) != _LISTING_HEADER:
                    raise RecordingError(f"{listing}: there is a recording already: name a new folder")
                (folder / camera / "data").mkdir(parents=True, exist_ok=True)
                listing.write_text(_LISTING_HEADER, encoding="utf-8")
            except OSError as error:
                raise RecordingError(f"{listing}: cannot be written: {error.strerror or error}") from error

    def write(self, pair: StereoPair) -> None:
        """Add a pair: its images first, then their lines."""
        for camera, frame in (("cam0", pair.left), ("cam1", pair.right)):
            name = f"{frame.captured_at_ns}.png"
            whole, data = cv2.imencode(".png", frame.pixels)
            path = self.folder / camera / "data" / name
            try:
                if not whole:
                    raise RecordingError(f"{path}: the picture cannot be encoded")
                path.write_bytes(data.tobytes())
                with (self.folder / camera / "data.csv").open("a", encoding="utf-8", newline="") as file:
                    csv.writer(file, lineterminator="\n").writerow([frame.captured_at_ns, name])
            except OSError as error:
                raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error


def _found(
    pictures: BoardPictures, board: Board, progress: Callable[[int], None]
) -> Iterator[tuple[int, BoardView | RecordingError]]:
    def view(index: int) -> BoardView | RecordingError:
        try:
            left, right = pictures.read(index)
        except RecordingError as unusable:
            return unusable
        return find_board(left, right, board)

    # The detector leaves Python's lock alone and takes most of the time.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for index, found in enumerate(pool.map(view, range(len(pictures.names)))):
            progress(index + 1)
            yield index, found


def _workspace_points(solved: StereoCalibration, board: Board, workspace: Workspace) -> Float:
    ranges = [(axis.min, axis.max) for axis in (workspace.x_mm, workspace.y_mm, workspace.z_mm)]
    points_mm = space_grid_mm(solved.rig, ranges[0], ranges[1], ranges[2])
    if len(points_mm) >= _LEAST_POINTS:
        return points_mm
    corners = np.concatenate([pose.apply(board.points_mm) for pose in solved.bundle.left_from_board])
    low, high = corners.min(axis=0), corners.max(axis=0)
    ends = [(float(a), float(b)) for a, b in zip(low, high, strict=True)]
    seen = space_grid_mm(solved.rig, ends[0], ends[1], ends[2])
    return seen if len(seen) >= _LEAST_POINTS else corners


def _numbered(folder: Path, prefix: str) -> dict[tuple[int, ...], Path]:
    """The pictures of a folder by the numbers in their names."""
    paths = sorted(
        path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.name.lower().startswith(prefix)
    )
    return {tuple(int(number) for number in re.findall(r"\d+", path.stem)): path for path in paths}


def _gray(path: Path) -> Image:
    try:
        return np.asarray(picture(bytes_of(path, _MOST_PICTURE_BYTES), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _significant(value: float) -> float:
    return float(f"{value:.4g}")


def _stillest(recording: StoredRecording, most: int) -> list[int]:
    """Indices of so many pairs at most; of a film, from each of so many stretches the pair with the least motion."""
    count = len(recording)
    stamps_ns = [pair.left.stamp_ns for pair in (recording.pairs[0], recording.pairs[-1])]
    if count <= most or (stamps_ns[1] - stamps_ns[0]) / 1e9 > _FILM_S * (count - 1):
        return list(range(count))
    edges = np.linspace(0, count - 1, most + 1).round().astype(int).tolist()
    chosen = []
    for start, end in pairwise(edges):
        tried = np.unique(np.linspace(start, end - 1, min(_TRIED, end - start)).round().astype(int)).tolist()
        motion = [_motion_gray(recording, index) for index in tried]
        chosen.append(tried[int(np.argmin(motion))])
    return chosen


def _motion_gray(recording: StoredRecording, index: int) -> float:
    """How much the left picture changes until the next pair, mean gray; infinite where either cannot be read."""
    try:
        small = [
            cv2.resize(
                recording.read(at).left.image, None, fx=1 / _SMALLER, fy=1 / _SMALLER, interpolation=cv2.INTER_AREA
            )
            for at in (index, index + 1)
        ]
    except UnusablePair:
        return float("inf")
    return float(np.mean(cv2.absdiff(small[0], small[1])))
