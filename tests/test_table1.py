"""Table 1 on one bundled pair: the paper's numbers of points, and figures that can be trusted."""

import json
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from needletrack.errors import RecordingError
from needletrack.table1 import PAPER, Table1, render, table1, to_markdown

RECORDINGS = Path(__file__).parent / "data" / "recordings"


def excerpt(folder: Path, name: str, pairs: Sequence[int], frames_with_truth: Sequence[int]) -> Path:
    """A recording with some pairs of a bundled one, and the truth of some frames."""
    source = RECORDINGS / name
    for camera in ("cam0", "cam1"):
        header, *lines = (source / camera / "data.csv").read_text().splitlines()
        (folder / camera).mkdir(parents=True)
        (folder / camera / "data").symlink_to(source / camera / "data")
        (folder / camera / "data.csv").write_text("\n".join([header, *(lines[i] for i in pairs)]) + "\n")
    (folder / "camchain.yaml").symlink_to(source / "camchain.yaml")
    truth = json.loads((source / "truth.json").read_text())
    truth["frames"] = [truth["frames"][i] for i in frames_with_truth]
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Table1:
    """Of the two pairs, the second has a skeleton of about 331 points; the first has no truth."""
    return table1(excerpt(tmp_path_factory.mktemp("lab"), "lab-a", [1, 2], [2]), repeats=1)


def test_the_pair_is_the_one_with_the_paper_s_number_of_points(measured: Table1) -> None:
    assert measured.stamp_ns == 1066666666
    assert measured.left_points == pytest.approx(331, abs=5)
    for row in measured.rows:
        assert row.points == pytest.approx(PAPER[row.k][0], abs=3)


def test_every_stage_is_timed_for_k_1_to_5(measured: Table1) -> None:
    assert [row.k for row in measured.rows] == [1, 2, 3, 4, 5]
    for row in measured.rows:
        stages = row.segmentation_ms, row.skeleton_ms, row.loop_ms, row.map_ms, row.reconstruction_ms
        assert min(stages) > 0
        assert row.with_loop_ms - row.with_map_ms == pytest.approx(row.loop_ms - row.map_ms)
    own = measured.own
    assert min(own.segment_ms, own.centerline_ms, own.match_ms, own.refine_ms, own.tracked_ms) > 0


def test_the_projection_error_is_within_the_threshold_and_the_shape_is_not_right(measured: Table1) -> None:
    first = measured.rows[0]
    assert first.projection is not None
    assert first.projection.mean_px < measured.threshold_px
    assert measured.threshold_px == pytest.approx(0.14, abs=0.005)
    assert measured.as_printed_px > 10
    assert first.error.rms_mm is not None
    assert first.error.rms_mm > 10


def test_our_method_is_measured_on_the_same_frames(measured: Table1) -> None:
    assert measured.own.status == "ok"
    assert measured.own.error.rms_mm is not None
    assert measured.own.error.rms_mm < 0.15


def test_a_pair_without_truth_has_no_error(measured: Table1) -> None:
    without, with_truth = measured.frames
    assert (without.stamp_ns, with_truth.stamp_ns) == (1033333333, 1066666666)
    for error in (without.reference, without.reference_wider, without.own):
        assert error.rms_mm is None
        assert error.tip_mm is None
    assert with_truth.own == measured.own.error
    assert with_truth.reference == measured.rows[0].error


def test_a_truth_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    folder = excerpt(tmp_path, "lab-a", [3], [])
    (folder / "truth.json").write_text(json.dumps({"frames": [{"centerline_mm": []}]}))
    with pytest.raises(RecordingError, match=r"truth\.json: no truth"):
        table1(folder, repeats=1)


def test_markdown_has_the_paper_s_figures_beside_ours(measured: Table1) -> None:
    text = to_markdown(measured)
    first = next(line for line in text.splitlines() if line.startswith("| 1 |"))
    assert first.endswith("| 19210 (331) | 1010 | 19 |")
    tables = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert [len(lines) - 2 for lines in tables] == [6, 6, 2]
    for lines in tables:
        assert len({line.count("|") for line in lines}) == 1


def test_the_terminal_shows_the_same_figures(measured: Table1) -> None:
    terminal = Console(file=StringIO(), width=200)
    terminal.print(render(measured))
    assert isinstance(terminal.file, StringIO)
    shown = terminal.file.getvalue()
    for lines in (line for line in to_markdown(measured).splitlines() if line.startswith("| 1")):
        for cell in (cell.strip() for cell in lines.strip("|").split("|")):
            assert cell in shown
