"""All methods on all recordings."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.accuracy.methods import (
    OURS,
    WITH_MEMORY,
    row_of_reference,
    rows_of_others,
    rows_of_ours,
    run_ours,
    run_reference,
)
from benchmarks.accuracy.report import AccuracyReport, RecordingAccuracy, Row
from benchmarks.machine import Machine, now
from benchmarks.threads import one_thread
from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording.asl import AslRecording
from needletrack.rig import find_rig
from needletrack.scoring import TrueShape, recorded_truth

# A needle that moves less than this from one frame to the next is the same one, and may be followed.
_GREATEST_STEP_MM = 10.0


def trackable(folders: Sequence[Path]) -> list[Path]:
    """Those of the folders that are recordings of scenes with truth; raises RecordingError where none is.

    Left out are files, and recordings of boards: they come without a rig. What is not there at all is an error, too.
    """
    absent = [str(folder) for folder in folders if not folder.exists()]
    if absent:
        raise RecordingError(f"there is no {', '.join(absent)}")
    chosen = [folder for folder in folders if (folder / "truth.json").is_file() and _has_rig(folder)]
    if not chosen:
        raise RecordingError("none of the folders is a recording with a rig and truth.json")
    return chosen


def run(
    folders: Sequence[Path],
    sequences: Sequence[str] | None,
    peers: Mapping[str, str],
    frames: int | None,
    console: Console,
) -> AccuracyReport:
    """Score every method on every recording; progress goes to the console where it is a terminal.

    sequences: names of the recordings that are tracked with memory as well; None: those whose needle moves little.
    peers: their versions where they are to run. frames: how many pairs of each recording, all where None.
    """
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with one_thread(), Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        machine = Machine.here()
        task = progress.add_task("recordings", total=len(folders))
        recordings = []
        for folder in folders:
            progress.update(task, description=folder.name)
            recordings.append(measure(folder, sequences, frames, peers=bool(peers)))
            progress.advance(task)
    return AccuracyReport(machine=machine, measured_at=now(), peers=peers, recordings=recordings)


def measure(
    folder: Path, sequences: Sequence[str] | None, frames: int | None, *, peers: bool = False
) -> RecordingAccuracy:
    """All methods on one recording; raises RecordingError where a frame with truth has no usable pair."""
    recording, truth = AslRecording(folder), recorded_truth(folder)
    missing = set(truth) - {pair.left.stamp_ns for pair in recording.pairs}
    if missing:
        raise RecordingError(f"{folder}: truth.json tells of {min(missing)} ns, of which the recording has no pair")
    known = [index for index, pair in enumerate(recording.pairs) if pair.left.stamp_ns in truth]
    pairs = [recording.read(index) for index in known[:frames]]
    truths = [truth[pair.captured_at_ns] for pair in pairs]
    sequence = is_sequence(list(truth.values())) if sequences is None else folder.name in sequences
    rig = recording.rig
    alone = run_ours(pairs, rig, memory=False)
    rows: list[Row] = []
    if sequence:
        rows += rows_of_ours(WITH_MEMORY, run_ours(pairs, rig, memory=True), truths)
    rows += rows_of_ours(OURS, alone, truths)
    rows.append(row_of_reference(run_reference(pairs, rig), truths))
    rows += rows_of_others(pairs, rig, truths, alone, peers=peers)
    return RecordingAccuracy(
        recording=str(folder), frames=len(pairs), sequence=sequence, size_px=rig.left.size_px, rows=rows
    )


def is_sequence(truths: Sequence[TrueShape]) -> bool:
    """Whether the needle of one frame is mostly close to that of the next."""
    steps_mm = [
        max(np.linalg.norm(after.centerline_mm[end] - before.centerline_mm[end]) for end in (0, -1))
        for before, after in pairwise(truths)
        if len(before.centerline_mm) and len(after.centerline_mm)
    ]
    return bool(steps_mm) and bool(np.median(steps_mm) < _GREATEST_STEP_MM)


def _has_rig(folder: Path) -> bool:
    try:
        find_rig(folder)
    except CalibrationError:
        return False
    return True
