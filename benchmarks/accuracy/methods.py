"""Each method on each pair, and its answers as scores: by its own status, and all believed."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.accuracy import textbook
from benchmarks.accuracy.lines import SEGMENTATIONS, PairLines
from benchmarks.accuracy.peers import PYTHON, PeerAnswer, ask
from benchmarks.accuracy.report import Row
from needletrack.geometry.spline import arc_length, tangents
from needletrack.records import Float, NeedleCurve, NeedleTrack, Status, StereoPair, TipPose
from needletrack.rig import Rig
from needletrack.scoring import Score, Summary, TrueShape, score
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.reference import track_reference
from needletrack.tracking.track import track_pair

OURS, WITH_MEMORY, REFERENCE = "needletrack", "needletrack, with memory", "2017 method"
TEXTBOOK, ICP_RECONSTRUCTOR = "OpenCV textbook", "icpReconstructor"
NOT_SEGMENTED = "no line found"


@dataclass(frozen=True, eq=False)
class Run:
    """One method's tracks of all pairs, and what each took, ms."""

    tracks: Sequence[NeedleTrack]
    ms: Sequence[float]


def run_ours(pairs: Sequence[StereoPair], rig: Rig, *, memory: bool) -> Run:
    """Our own tracks, each pair alone or following the one before."""
    parameters = TrackingParameters()
    track_pair(pairs[0], rig, parameters)  # the first call of every library takes a multiple of the next
    tracks: list[NeedleTrack] = []
    ms = []
    for pair in pairs:
        started = time.perf_counter()
        tracks.append(track_pair(pair, rig, parameters, tracks[-1] if memory and tracks else None))
        ms.append((time.perf_counter() - started) * 1e3)
    return Run(tracks, ms)


def run_reference(pairs: Sequence[StereoPair], rig: Rig) -> Run:
    """The 2017 method's tracks."""
    track_reference(pairs[0], rig)
    tracks, ms = [], []
    for pair in pairs:
        started = time.perf_counter()
        tracks.append(track_reference(pair, rig))
        ms.append((time.perf_counter() - started) * 1e3)
    return Run(tracks, ms)


def rows_of_ours(method: str, run: Run, truths: Sequence[TrueShape]) -> list[Row]:
    """Two rows: the ok tracks as they are meant, and every answer believed, as it stands."""
    scores = [score(track, truth) for track, truth in zip(run.tracks, truths, strict=True)]
    believed = [one.believed() for one in scores]
    summary = Summary.of(scores)
    counts = summary.ok, summary.degraded, summary.invalid
    false_if_believed = sum(one.false_ok for one in believed)
    failures = _failures(run.tracks)
    ms = float(np.median(run.ms))
    return [
        Row.of(method, summary, counts, believed=False, false_if_believed=false_if_believed, ms=ms, failures=failures),
        Row.of(
            f"{method}, all believed",
            Summary.of(believed),
            counts,
            believed=True,
            false_if_believed=false_if_believed,
            ms=None,
            failures=failures,
        ),
    ]


def row_of_reference(run: Run, truths: Sequence[TrueShape]) -> Row:
    """The 2017 method, every answer believed; its end far from the true base is its tip."""
    scores = []
    for track, truth in zip(run.tracks, truths, strict=True):
        if track.curve is None:
            scores.append(score(track, truth))
            continue
        forward = not _turned(track.curve.points_mm, truth)
        sigma_mm = track.curve.sigma_mm if forward else track.curve.sigma_mm[::-1]
        points_mm = track.curve.points_mm if forward else track.curve.points_mm[::-1]
        scores.append(score(_ok(track.captured_at_ns, points_mm, sigma_mm), truth))
    counts = Counter(track.status for track in run.tracks)
    return Row.of(
        REFERENCE,
        Summary.of(scores),
        (counts[Status.OK], counts[Status.DEGRADED], counts[Status.INVALID]),
        believed=True,
        false_if_believed=sum(one.false_ok for one in scores),
        ms=float(np.median(run.ms)),
        failures=_failures(run.tracks),
    )


def rows_of_others(
    pairs: Sequence[StereoPair], rig: Rig, truths: Sequence[TrueShape], ours: Run, *, peers: bool
) -> list[Row]:
    """The textbook, and the peers where they are asked for, on the lines of both segmentations."""
    rows = []
    for segmentation, find in SEGMENTATIONS.items():
        lines = [find(pair, track, rig, truth) for pair, track, truth in zip(pairs, ours.tracks, truths, strict=True)]
        found = [index for index, each in enumerate(lines) if each is not None]
        given = [each for each in lines if each is not None]
        methods = {TEXTBOOK: [_by_textbook(each, rig) for each in given]}
        if peers:
            answers = ask(PYTHON, rig, given, [truths[index] for index in found])
            methods |= {f"{ICP_RECONSTRUCTOR}, {stage}": of_stage for stage, of_stage in answers.items()}
        for method, of_method in methods.items():
            rows.append(_row_of_answers(f"{method}; {segmentation}", dict(zip(found, of_method, strict=True)), truths))
    return sorted(rows, key=lambda row: [*methods].index(row.method.split(";")[0]))


def _by_textbook(lines: PairLines, rig: Rig) -> PeerAnswer:
    started = time.perf_counter()
    points_mm, failure = None, None
    try:
        points_mm = textbook.reconstruct(lines, rig)
    except ValueError as error:
        failure = str(error)
    return PeerAnswer(points_mm, (time.perf_counter() - started) * 1e3, failure)


def _row_of_answers(method: str, answers: dict[int, PeerAnswer], truths: Sequence[TrueShape]) -> Row:
    scores, failures = [], Counter[str]()
    for index, truth in enumerate(truths):
        answer = answers.get(index)
        if answer is None or answer.points_mm is None:
            failures[NOT_SEGMENTED if answer is None else answer.failure or "no points"] += 1
            scores.append(Score(Status.INVALID, misleads=False))
        else:
            points_mm = answer.points_mm
            found = score(_ok(0, points_mm, np.ones(len(points_mm))), truth)
            # They state no sigma: the ones above only fill the record.
            scores.append(replace(found, off_in_sigmas=None, sigma_mm=None))
    return Row.of(
        method,
        Summary.of(scores),
        (None, None, failures.total()),
        believed=True,
        false_if_believed=sum(one.false_ok for one in scores),
        ms=float(np.median([answer.ms for answer in answers.values()])) if answers else None,
        failures=failures,
    )


def _failures(tracks: Sequence[NeedleTrack]) -> dict[str, int]:
    return dict(Counter(track.reasons[0].value for track in tracks if track.status is Status.INVALID))


def _turned(points_mm: Float, truth: TrueShape) -> bool:
    if len(truth.centerline_mm) == 0:
        return False
    base_mm = truth.centerline_mm[0]
    return bool(np.linalg.norm(points_mm[-1] - base_mm) < np.linalg.norm(points_mm[0] - base_mm))


def _ok(stamp_ns: int, points_mm: Float, sigma_mm: Float) -> NeedleTrack:
    """A track called ok whose tip is the end of its curve."""
    direction = tangents(points_mm)[-1]
    count = len(points_mm)
    curve = NeedleCurve(points_mm, sigma_mm, np.full(count, 2), np.zeros(count), float(arc_length(points_mm)[-1]))
    tip = TipPose(points_mm[-1], direction, np.array([0.0, 0.0, 0.0, 1.0]), np.eye(3), None, 2)
    return NeedleTrack(stamp_ns, Status.OK, (), curve, tip)
