"""Table 1 of the 2017 paper, repeated on a recorded pair: each stage's time, with and without distance map.

Beside it what the paper cannot see, the error against the recording's truth, and our own method on the same
frames.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.spatial import cKDTree

from needletrack.errors import NeedleNotFound, RecordingError
from needletrack.geometry.spline import arc_length, resample
from needletrack.recording.replay import StoredRecording
from needletrack.recording.stored import open_stored
from needletrack.records import Float, Int, NeedleTrack, StereoPair
from needletrack.rig import Rig
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.reference import (
    GREATEST_K,
    ProjectionError,
    ReferenceParameters,
    ReferenceResult,
    View,
    distance_map,
    extract_centerline,
    fundamental_matrix,
    pairs_by_loop,
    pairs_in_map,
    projection_error,
    reconstruct,
    reference_stages,
    segment,
    skeleton,
    threshold_px,
    track_reference,
)
from needletrack.tracking.track import track_pair

# k: skeleton points, seconds with the double loop, seconds with the distance map.
PAPER = {
    1: (331, 19.21, 1.01),
    2: (165, 11.56, 0.59),
    3: (110, 8.54, 0.43),
    4: (83, 6.89, 0.48),
    5: (65, 5.13, 0.29),
}
PAPER_ERROR_PX, PAPER_ERROR_MM = 30.3, 1.01
# At the paper's own threshold most skeleton points find no partner; at this one nearly all do.
WIDER_THRESHOLD = 1e-3
_TRUTH_SPACING_MM = 0.01
_SHAPE_SPACING_MM = 0.5

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class ShapeError:
    """Distance of a curve from the true one, rms, and of its tip; None where there is no truth, curve or tip.

    The reference names no tip: its end nearer to the true one is taken.
    """

    rms_mm: float | None
    tip_mm: float | None


@dataclass(frozen=True, slots=True)
class Row:
    """The reference method at one k: medians in ms, eq. 13, and the error against truth."""

    k: int
    points: int
    pairs: int
    segmentation_ms: float
    skeleton_ms: float
    loop_ms: float
    map_ms: float
    reconstruction_ms: float
    projection: ProjectionError | None
    error: ShapeError

    @property
    def with_loop_ms(self) -> float:
        """All stages, matching by the double loop."""
        return self.segmentation_ms + self.skeleton_ms + self.loop_ms + self.reconstruction_ms

    @property
    def with_map_ms(self) -> float:
        """All stages, matching by the distance map."""
        return self.segmentation_ms + self.skeleton_ms + self.map_ms + self.reconstruction_ms


@dataclass(frozen=True, slots=True)
class OwnRow:
    """Our method on the same pair: medians in ms of each stage when searching anew, and of a whole pair.

    tracked_ms: when the pair before is known. projection: eq. 13 against the reference's skeletons.
    """

    status: str
    segment_ms: float
    centerline_ms: float
    match_ms: float
    refine_ms: float
    total_ms: float
    tracked_ms: float
    projection: ProjectionError | None
    error: ShapeError


@dataclass(frozen=True, slots=True)
class FrameRow:
    """Both methods' shapes in a pair: the reference at the paper's and at the wider threshold, and ours."""

    stamp_ns: int
    points: int
    reference: ShapeError
    reference_wider: ShapeError
    own: ShapeError
    own_status: str


@dataclass(frozen=True, slots=True)
class Table1:
    """The measurement: rows for k = 1 to 5, our own method, and every pair of the recording."""

    recording: str
    stamp_ns: int
    left_points: int
    right_points: int
    repeats: int
    threshold_px: float
    rows: tuple[Row, ...]
    own: OwnRow
    as_printed_pairs: int
    as_printed_px: float
    frames: tuple[FrameRow, ...]


def table1(folder: Path | str, repeats: int = 9, parameters: TrackingParameters | None = None) -> Table1:
    """Measure on the pair of a recording whose left skeleton is nearest to the paper's 331 points.

    repeats: runs of each stage, of which the median counts. Raises RecordingError where no pair can be used,
    ValueError for less than one repeat.
    """
    if repeats < 1:
        raise ValueError(f"{repeats} runs have no median")
    recording = open_stored(Path(folder))
    truth = _read_truth(recording.folder)
    pairs, results = _usable(recording)
    best = min(range(len(pairs)), key=lambda i: abs(len(results[i].left.skeleton_px) - PAPER[1][0]))
    pair, result, rig = pairs[best], results[best], recording.rig
    own = [track_pair(each, rig, parameters) for each in pairs]
    as_printed = reference_stages(pair.left.image, pair.right.image, rig, ReferenceParameters(absolute_residual=False))
    at_px = threshold_px(fundamental_matrix(rig), result.left.points_px, ReferenceParameters().threshold)
    return Table1(
        recording=recording.folder.name,
        stamp_ns=pair.captured_at_ns,
        left_points=len(result.left.skeleton_px),
        right_points=len(result.right.skeleton_px),
        repeats=repeats,
        threshold_px=float(np.median(at_px)),
        rows=tuple(_rows(pair, rig, repeats, truth)),
        own=_own_row(pair, rig, result, own[best], repeats, truth, parameters),
        as_printed_pairs=len(as_printed.pairs),
        as_printed_px=as_printed.error.mean_px,
        frames=tuple(
            _frame_row(each, rig, found, track, truth) for each, found, track in zip(pairs, results, own, strict=True)
        ),
    )


def _usable(recording: StoredRecording) -> tuple[list[StereoPair], list[ReferenceResult]]:
    pairs, results = [], []
    for index in range(len(recording)):
        pair = recording.read(index)
        try:
            found = reference_stages(pair.left.image, pair.right.image, recording.rig)
        except NeedleNotFound:
            continue
        pairs.append(pair)
        results.append(found)
    if not pairs:
        raise RecordingError(f"{recording.folder}: the reference method finds a needle in none of the pairs")
    return pairs, results


def _rows(pair: StereoPair, rig: Rig, repeats: int, truth: dict[int, Float]) -> Iterator[Row]:
    parameters = ReferenceParameters()
    images, cameras = (pair.left.image, pair.right.image), (rig.left, rig.right)
    segmentation_ms, regions = _timed(repeats, lambda: [segment(image, parameters) for image in images])
    skeleton_ms, _ = _timed(
        repeats,
        lambda: [camera.undistort(skeleton(region)) for camera, region in zip(cameras, regions, strict=True)],
    )
    for k in range(1, GREATEST_K + 1):
        parameters = ReferenceParameters(k=k)
        left = extract_centerline(pair.left.image, rig.left, parameters)
        right = extract_centerline(pair.right.image, rig.right, parameters)
        matching = _Matching(rig, left.points_px, right.points_px, parameters)
        loop_ms, _ = _timed(repeats, matching.by_loop)
        map_ms, found = _timed(repeats, matching.by_map)
        reconstruction_ms, points_mm = _timed(repeats, partial(matching.reconstruct, found))
        points_mm = points_mm[np.isfinite(points_mm).all(axis=1)]
        yield Row(
            k=k,
            points=len(left.points_px),
            pairs=len(found),
            segmentation_ms=segmentation_ms,
            skeleton_ms=skeleton_ms,
            loop_ms=loop_ms,
            map_ms=map_ms,
            reconstruction_ms=reconstruction_ms,
            projection=_projection(rig, points_mm, left, right),
            error=_shape_error(track_reference(pair, rig, parameters), truth),
        )


class _Matching:
    """Sections 3 and 4 on one pair's point sets (N, 2)."""

    def __init__(self, rig: Rig, left_px: Float, right_px: Float, parameters: ReferenceParameters) -> None:
        self._rig, self._left_px, self._right_px, self._parameters = rig, left_px, right_px, parameters
        self._fundamental = fundamental_matrix(rig, parameters.fundamental_scale)

    def by_loop(self) -> Int:
        return pairs_by_loop(self._fundamental, self._left_px, self._right_px, self._parameters.threshold)

    def by_map(self) -> Int:
        distances = distance_map(self._fundamental, self._left_px, self._right_px)
        return pairs_in_map(distances, self._parameters.threshold)

    def reconstruct(self, pairs: Int) -> Float:
        left_px, right_px = self._left_px[pairs[:, 0]], self._right_px[pairs[:, 1]]
        return reconstruct(self._rig, left_px, right_px, self._parameters.triangulation)


def _projection(rig: Rig, points_mm: Float, left: View, right: View) -> ProjectionError | None:
    if len(points_mm) == 0:
        return None
    return projection_error(rig, points_mm, left.centerline_px, right.centerline_px)


def _own_row(
    pair: StereoPair,
    rig: Rig,
    reference: ReferenceResult,
    track: NeedleTrack,
    repeats: int,
    truth: dict[int, Float],
    parameters: TrackingParameters | None,
) -> OwnRow:
    stages: dict[str, list[float]] = {"segment": [], "centerline": [], "match": [], "refine": []}

    def search() -> NeedleTrack:
        found = track_pair(pair, rig, parameters)
        for stage, times_ms in stages.items():
            times_ms.append(found.timing_ms.get(stage, 0.0))
        return found

    total_ms, _ = _timed(repeats, search, warm_up=False)
    tracked_ms, _ = _timed(repeats, lambda: track_pair(pair, rig, parameters, track), warm_up=False)
    curve_mm = np.zeros((0, 3)) if track.curve is None else track.curve.points_mm
    return OwnRow(
        status=track.status.value,
        segment_ms=float(np.median(stages["segment"])),
        centerline_ms=float(np.median(stages["centerline"])),
        match_ms=float(np.median(stages["match"])),
        refine_ms=float(np.median(stages["refine"])),
        total_ms=total_ms,
        tracked_ms=tracked_ms,
        projection=_projection(rig, curve_mm, reference.left, reference.right),
        error=_shape_error(track, truth),
    )


def _frame_row(
    pair: StereoPair, rig: Rig, found: ReferenceResult, own: NeedleTrack, truth: dict[int, Float]
) -> FrameRow:
    wider = ReferenceParameters(threshold=WIDER_THRESHOLD)
    return FrameRow(
        stamp_ns=pair.captured_at_ns,
        points=len(found.left.skeleton_px),
        reference=_shape_error(track_reference(pair, rig), truth),
        reference_wider=_shape_error(track_reference(pair, rig, wider), truth),
        own=_shape_error(own, truth),
        own_status=own.status.value,
    )


def _timed(repeats: int, run: Callable[[], Result], *, warm_up: bool = True) -> tuple[float, Result]:
    """Median of the runs, ms, and what the last one gave; the first run of all pays for caches."""
    if warm_up:
        run()
    elapsed_ms, results = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        results.append(run())
        elapsed_ms.append((time.perf_counter() - start) * 1e3)
    return float(np.median(elapsed_ms)), results[-1]


# Truth


def _read_truth(folder: Path) -> dict[int, Float]:
    """The true centerlines (N, 3), base to tip, by stamp; empty where the recording has no truth."""
    path = folder / "truth.json"
    if not path.is_file():
        return {}
    try:
        frames = json.loads(path.read_text(encoding="utf-8"))["frames"]
        return {
            int(frame["t_ns"]): np.asarray(frame["centerline_mm"], dtype=np.float64)
            for frame in frames
            if "centerline_mm" in frame
        }
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: no truth can be read from it: {error!r}") from error


def _shape_error(track: NeedleTrack, truth: dict[int, Float]) -> ShapeError:
    true_mm = truth.get(track.captured_at_ns)
    if true_mm is None or track.curve is None:
        return ShapeError(None, None)
    dense_mm = resample(true_mm, 1 + round(arc_length(true_mm)[-1] / _TRUTH_SPACING_MM))
    # Evenly spaced, so that a curve's long jumps count with their length; a wrong one may be kilometres long.
    count = int(np.clip(track.curve.length_mm / _SHAPE_SPACING_MM, 2, 4000))
    distance_mm, _ = cKDTree(dense_mm).query(resample(track.curve.points_mm, count))
    ends_mm = track.curve.points_mm[[0, -1]] if track.tip is None else track.tip.position_mm[None]
    tip_mm = np.linalg.norm(ends_mm - true_mm[-1], axis=1).min()
    return ShapeError(float(np.sqrt(np.mean(distance_mm**2))), float(tip_mm))


# Rendering


def render(table: Table1) -> Group:
    """The tables for a terminal."""
    parts: list[Table | Text] = []
    for title, header, rows in _tables(table):
        grid = Table(title=title, title_justify="left")
        for column in header:
            grid.add_column(column, justify="right")
        for row in rows:
            grid.add_row(*row)
        parts += [grid, Text()]
    return Group(*parts, *(Text(note) for note in _notes(table)))


def to_markdown(table: Table1) -> str:
    """The tables for the documentation."""
    parts = []
    for title, header, rows in _tables(table):
        lines = [f"**{title}**", "", *(_line(cells) for cells in (header, ["--:"] * len(header), *rows))]
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, *_notes(table)]) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _tables(table: Table1) -> list[tuple[str, list[str], list[list[str]]]]:
    times = ["k", "points", "segment", "skeleton", "match: loop", "match: map", "ratio", "reconstruct"]
    times += ["all: loop", "all: map", "paper: loop", "paper: map", "paper's ratio"]
    errors = ["k", "points", "pairs", "mean px", "mean mm", "shape rms mm", "tip mm"]
    frames = ["pair, ns", "points", "rms mm", "tip mm", "rms mm, wider", "tip mm, wider"]
    frames += ["ours: rms mm", "ours: tip mm", "ours: status"]
    return [
        (
            f"Time per pair, ms: {table.recording}, {table.stamp_ns} ns",
            times,
            [*map(_time_cells, table.rows), _own_time_cells(table.own)],
        ),
        (
            "The same pair: projection error (eq. 13), and error against truth",
            errors,
            [*map(_result_cells, table.rows), ["ours", "", "", *_own_result_cells(table.own)]],
        ),
        (
            f"Error against truth in every pair: at the paper's threshold, at {WIDER_THRESHOLD:g}, and ours",
            frames,
            list(map(_frame_cells, table.frames)),
        ),
    ]


def _time_cells(row: Row) -> list[str]:
    points, loop_s, map_s = PAPER[row.k]
    stages_ms = [row.segmentation_ms, row.skeleton_ms, row.loop_ms, row.map_ms]
    return [
        f"{row.k}",
        f"{row.points}",
        *(f"{value:.2f}" for value in stages_ms),
        f"{row.loop_ms / row.map_ms:.0f}",
        f"{row.reconstruction_ms:.2f}",
        f"{row.with_loop_ms:.1f}",
        f"{row.with_map_ms:.1f}",
        f"{loop_s * 1e3:.0f} ({points})",
        f"{map_s * 1e3:.0f}",
        f"{loop_s / map_s:.0f}",
    ]


def _own_time_cells(own: OwnRow) -> list[str]:
    return [
        "ours",
        "",
        f"{own.segment_ms:.2f}",
        f"{own.centerline_ms:.2f}",
        "",
        f"{own.match_ms:.2f}",
        "",
        f"{own.refine_ms:.2f}",
        "",
        f"{own.total_ms:.1f}",
        "",
        "",
        "",
    ]


def _result_cells(row: Row) -> list[str]:
    projection, error = _projection_cells(row.projection), _error_cells(row.error)
    return [f"{row.k}", f"{row.points}", f"{row.pairs}", *projection, *error]


def _own_result_cells(own: OwnRow) -> list[str]:
    return [*_projection_cells(own.projection), *_error_cells(own.error)]


def _frame_cells(frame: FrameRow) -> list[str]:
    reference, wider = _error_cells(frame.reference), _error_cells(frame.reference_wider)
    return [
        f"{frame.stamp_ns}",
        f"{frame.points}",
        *reference,
        *wider,
        *_error_cells(frame.own),
        frame.own_status,
    ]


def _projection_cells(projection: ProjectionError | None) -> list[str]:
    if projection is None:
        return ["-", "-"]
    return [_number(projection.mean_px, 3), _number(projection.mean_mm, 4)]


def _error_cells(error: ShapeError) -> list[str]:
    return [_number(error.rms_mm, 3), _number(error.tip_mm, 2)]


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _notes(table: Table1) -> list[str]:
    median = (
        f"Medians of {table.repeats} runs, both views together, on the pair whose left skeleton is nearest "
        f"to the paper's {PAPER[1][0]} points: {table.left_points} left, {table.right_points} right. In "
        "brackets the paper's number of points."
    )
    threshold = (
        f"The threshold 1e-4 is {table.threshold_px:.2f} px here, F having a translation of length one. A "
        "right point within it projects that near, whatever the shape is: eq. 13 measures the threshold. The "
        f"paper reports {PAPER_ERROR_PX:g} px, {PAPER_ERROR_MM:g} mm. Eq. 8 as printed, without the absolute "
        f"value, accepts {table.as_printed_pairs} pairs, of which eq. 13 makes {table.as_printed_px:.1f} px."
    )
    own = (
        "The reference names no tip: its end nearer to the true tip is taken. Ours "
        f"({table.own.status}) is searched for anew; from the pair before it takes "
        f"{table.own.tracked_ms:.1f} ms. Its projection error is from the reference's skeletons, half a "
        "pixel off at best."
    )
    return [median, threshold, own]
