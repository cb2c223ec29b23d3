import json
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks.accuracy import textbook
from benchmarks.accuracy.cli import main
from benchmarks.accuracy.lines import PairLines, ViewLine, by_detector, by_reference
from benchmarks.accuracy.methods import ICP_RECONSTRUCTOR, OURS, REFERENCE, TEXTBOOK, WITH_MEMORY
from benchmarks.accuracy.peers import EPIPOLAR, ICP, PeerError, ask, peer_versions
from benchmarks.accuracy.report import AccuracyReport
from benchmarks.accuracy.run import is_sequence, measure, trackable
from benchmarks.accuracy.tables import BEGIN, END, updated
from benchmarks.frames import RECORDINGS

from needletrack.errors import RecordingError
from needletrack.geometry.spline import distance_from_curve
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.recording.asl import AslRecording
from needletrack.records import Centerline, Evidence, Float, NeedleTrack, Reason, Status
from needletrack.scoring import TrueShape, recorded_truth

LAB = RECORDINGS / "lab-a"
RIG = AslRecording(LAB).rig
# Leaves the sleeve at (-20, 10, 240) and bends away from the cameras.
AT = np.linspace(0.0, 1.0, 200)
NEEDLE_MM = np.column_stack([-20 + 60 * AT, 10 + 15 * np.sin(2 * AT), 240 + 12 * AT**2])
TRUE = TrueShape(NEEDLE_MM, NEEDLE_MM[-1] - NEEDLE_MM[-2], np.ones(200, np.bool_))


def drawn(points_mm: Float = NEEDLE_MM) -> PairLines:
    """Noise-free lines of a needle in both views."""
    views = [
        ViewLine(line_px, camera.undistort(line_px), line_px)
        for line_px, camera in zip(RIG.project(points_mm), (RIG.left, RIG.right), strict=True)
    ]
    return PairLines(*views)


def test_every_method_has_its_row_and_the_rows_add_up() -> None:
    found = measure(LAB, None, frames=2)

    assert not found.sequence
    assert (found.frames, found.size_px) == (2, (1280, 1024))
    ours, believed, reference, *others = found.rows
    assert (ours.method, reference.method) == (OURS, REFERENCE)
    assert [row.method.split(";")[0] for row in others] == [TEXTBOOK, TEXTBOOK]
    for row in found.rows:
        answers = 2 - row.invalid
        assert row.frames == 2
        assert 0 <= row.false_if_believed <= answers
        assert sum(row.failures.values()) == row.invalid
        assert (row.false_ok is None) == row.believed
    assert ours.ok is not None
    assert ours.degraded is not None
    assert ours.ok + ours.degraded + ours.invalid == 2
    assert believed.false_if_believed == ours.false_if_believed
    assert (reference.ok, reference.degraded) == (0, 2)
    # On these two needles the 2017 method is right to a millimetre, and the textbook on its masks to a tenth.
    assert reference.rms_mm == pytest.approx(0.25, abs=0.1)
    assert others[0].rms_mm == pytest.approx(0.0, abs=0.3)
    assert {row.sigma_mm for row in others} == {None}


def test_what_is_named_a_sequence_is_followed_and_nothing_else() -> None:
    followed = measure(RECORDINGS / "absent-a", ["absent-a"], frames=2)
    assert followed.sequence
    assert [row.method for row in followed.rows][:3:2] == [WITH_MEMORY, OURS]
    alone = measure(RECORDINGS / "absent-a", ["steer-b"], frames=1)
    assert not alone.sequence
    assert alone.rows[0].method == OURS


def test_a_sequence_is_told_by_its_truth() -> None:
    assert is_sequence(list(recorded_truth(RECORDINGS / "steer-b").values()))
    assert not is_sequence(list(recorded_truth(LAB).values()))
    assert not is_sequence([TRUE])
    assert not is_sequence([TrueShape.none()] * 3)


def test_boards_and_files_are_no_scenes() -> None:
    assert trackable([RECORDINGS / "calib-a", LAB, LAB / "truth.json"]) == [LAB]
    with pytest.raises(RecordingError, match="truth"):
        trackable([RECORDINGS / "calib-a"])
    with pytest.raises(RecordingError, match="there is no"):
        trackable([LAB, RECORDINGS / "lab-z"])


def test_the_textbook_is_exact_on_exact_lines() -> None:
    points_mm = textbook.reconstruct(drawn(), RIG)

    # The spline may smooth by what half a pixel is worth, a quarter of a millimetre here.
    assert distance_from_curve(points_mm, NEEDLE_MM).max() < 0.3
    assert np.linalg.norm(points_mm[-1] - NEEDLE_MM[-1]) < 1.0
    assert np.linalg.norm(points_mm[0] - NEEDLE_MM[0]) < 1.0


def test_the_textbook_has_no_answer_where_lines_run_along_the_epipolar_lines() -> None:
    along_mm = np.linspace(NEEDLE_MM[0], NEEDLE_MM[0] + [30.0, 0.0, 0.0], 100)
    right_from_left = RigidTransform(np.eye(3), np.array([-70.0, 0.0, 0.0]))
    rectified = StereoRig(RIG.left, RIG.left, right_from_left)
    # Half a pixel apart, so that no rounding makes them cross.
    left_px, right_px = (RIG.left.undistort(px) for px in rectified.project(along_mm))
    lines_px = left_px, right_px + np.array([0.0, 0.5])
    views = [ViewLine(px, px, px) for px in lines_px]
    with pytest.raises(ValueError, match="epipolar"):
        textbook.reconstruct(PairLines(*views), rectified)


def test_lines_begin_at_the_base_whatever_their_order() -> None:
    beyond_mm = np.vstack([NEEDLE_MM[0] + [[-9.0, 0, 0], [-4.0, 0, 0]], NEEDLE_MM])[::-1]
    left, right = (Centerline(px, np.full(len(px), 4.0)) for px in RIG.project(beyond_mm))
    track = NeedleTrack(0, Status.INVALID, (Reason.TOO_SHORT,), evidence=Evidence(left, right))
    pair = AslRecording(LAB).read(0)

    found = by_detector(pair, track, RIG, TRUE)

    assert found is not None
    for view, true_px in zip((found.left, found.right), RIG.project(NEEDLE_MM), strict=True):
        assert np.linalg.norm(view.points_px[0] - true_px[0]) < 1.0
        assert np.linalg.norm(view.points_px[-1] - true_px[-1]) < 1.0
    assert by_detector(pair, NeedleTrack(0, Status.INVALID, (Reason.TOO_SHORT,)), RIG, TRUE) is None


def test_the_reference_s_masks_hold_their_own_lines() -> None:
    pair = AslRecording(LAB).read(0)
    truth = recorded_truth(LAB)[pair.captured_at_ns]

    found = by_reference(pair, NeedleTrack(0, Status.INVALID, (Reason.TOO_SHORT,)), RIG, truth)

    assert found is not None
    for view, true_px in zip((found.left, found.right), RIG.project(truth.centerline_mm), strict=True):
        assert {tuple(point) for point in view.points_px} <= {tuple(point) for point in view.region_px}
        assert np.median(distance_from_curve(view.points_px, true_px)) < 1.0


# The peers' process, with a stand-in for their package.

STAND_IN = """
import json, sys
job = json.load(sys.stdin)
answers = []
for frame in job["frames"]:
    told = {"points_mm": [[0, 0, 250], [0, 0, 260]], "ms": 2.0, "failure": None}
    lost = {"points_mm": None, "ms": 1.0, "failure": "Ipopt: Infeasible"}
    answers.append({"epipolar": told, "epipolar + ICP": lost if frame["length_m"] else told})
json.dump(answers, sys.stdout)
"""


def test_a_peer_s_answers_and_failures_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text(STAND_IN)
    monkeypatch.setattr("benchmarks.accuracy.peers.WORKER", worker)
    monkeypatch.setattr("benchmarks.accuracy.methods.PYTHON", Path(sys.executable))

    answers = ask(Path(sys.executable), RIG, [drawn(), drawn()], [TRUE, TrueShape.none()])

    assert [answer.failure for answer in answers[EPIPOLAR]] == [None, None]
    assert [answer.failure for answer in answers[ICP]] == ["Ipopt: Infeasible", None]
    assert ask(Path(sys.executable), RIG, [], []) == {EPIPOLAR: [], ICP: []}

    rows = {row.method: row for row in measure(LAB, None, frames=1, peers=True).rows}
    lost = rows[f"{ICP_RECONSTRUCTOR}, {ICP}; 2017 masks"]
    assert (lost.invalid, lost.failures, lost.rms_mm) == (1, {"Ipopt: Infeasible": 1}, None)
    told = rows[f"{ICP_RECONSTRUCTOR}, {EPIPOLAR}; 2017 masks"]
    assert (told.invalid, told.ms, told.false_if_believed) == (0, 2.0, 1)


def test_a_peer_that_is_not_there_or_breaks_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PeerError, match="make peers"):
        peer_versions(tmp_path / "python")
    with pytest.raises(PeerError, match="icpReconstructor"):
        peer_versions(Path(sys.executable))
    worker = tmp_path / "worker.py"
    worker.write_text("raise RuntimeError('out of memory')")
    monkeypatch.setattr("benchmarks.accuracy.peers.WORKER", worker)
    with pytest.raises(PeerError, match="out of memory"):
        ask(Path(sys.executable), RIG, [drawn()], [TRUE])


def test_the_command_prints_writes_and_updates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, figures = tmp_path / "page.md", tmp_path / "figures" / "accuracy.json"
    page.write_text(f"Before\n\n{BEGIN}\nold\n{END}\n\nAfter\n", encoding="utf-8")

    main([str(RECORDINGS / "absent-a"), "--frames", "1", "--json", str(figures), "--update", str(page)])

    report = AccuracyReport.model_validate_json(figures.read_text(encoding="utf-8"))
    assert [found.frames for found in report.recordings] == [1]
    assert json.loads(figures.read_text(encoding="utf-8"))["format"] == 1
    printed = capsys.readouterr().out
    assert "### tests/data/recordings/absent-a: 1 pair, 1280×1024, stills" in printed
    written = page.read_text(encoding="utf-8")
    assert written.startswith(f"Before\n\n{BEGIN}\n\n### tests/data")
    assert written.endswith(f"{END}\n\nAfter\n")
    assert "old" not in written
    tables = [line for line in printed.splitlines() if line.startswith("|")]
    assert all(line in written for line in tables)


def test_a_page_without_markers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="markers"):
        updated(f"{END} {BEGIN}", "tables")
    page = tmp_path / "page.md"
    page.write_text("no markers")
    with pytest.raises(SystemExit, match="markers"):
        main(["--update", str(page)])
