"""The page about a calibration: what it says is what was found, and it says at a glance whether to trust it."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from tests.report.html_page import Node, parsed

from needletrack.calibration.board import Checkerboard
from needletrack.calibration.stereo import calibrate_stereo
from needletrack.errors import RecordingError
from needletrack.recording.board import BoardCalibration, calibrate_from_pictures, open_board_pictures
from needletrack.report.calibration import checks, verdict, write_calibration_report

BOARD = Checkerboard(11, 11, 2.0)
FOLDER = Path(__file__).parents[1] / "data" / "recordings" / "calib-a"


@pytest.fixture(scope="module")
def found() -> BoardCalibration:
    return calibrate_from_pictures(
        open_board_pictures(FOLDER), BOARD, "bench", datetime(2026, 5, 1, 12, tzinfo=UTC), warp=True
    )


@pytest.fixture(scope="module")
def page(found: BoardCalibration, tmp_path_factory: pytest.TempPathFactory) -> Node:
    output = tmp_path_factory.mktemp("report") / "calibration.html"
    size = write_calibration_report(found, open_board_pictures(FOLDER), BOARD, output)
    assert size == output.stat().st_size < 2_000_000
    return parsed(output.read_text())


def test_the_head_has_verdict_and_figures(found: BoardCalibration, page: Node) -> None:
    # Five views are too few to be trusted without a second look.
    assert page.one("p", "verdict").classes == {"verdict", verdict(checks(found))[0]}
    assert verdict(checks(found))[0] != "ok"
    tiles = [tile.text for tile in page.all("div", "tile")]
    assert f"{found.expected.after_mm:.3f} mm to expect, aligned" in tiles
    assert f"{found.solved.rms_px:.3f} px rms of the corners" in tiles
    answers = page.one("ul", "checks").all("li")
    assert len(answers) == len(checks(found))
    assert [("bad" in answer.classes) for answer in answers] == [not check.good for check in checks(found)]


def test_a_small_board_is_told_what_cures_it(page: Node) -> None:
    text = page.text
    assert "a board 3 times as large (66 x 66 mm)" in text
    assert "8 more views, tilted by 35 degrees" in text


def test_every_picture_that_the_page_promises_is_there(found: BoardCalibration, page: Node) -> None:
    labels = {svg.attributes.get("aria-label") for svg in page.all("svg")}
    for expected in (
        "coverage of the left view",
        "coverage of the right view",
        "residuals of the left view",
        "residual along rows (x), px",
        "RMS of each view",
        "rectified pair with epipolar lines",
        "distance from the epipolar line, px",
        "the rig in space",
    ):
        assert expected in labels
    assert len(page.all("svg", "map")) == 6
    assert len(page.all("path", "board")) == len(found.solved.used)
    assert len(page.all("rect", "bar")) == 2 * len(found.solved.used)


def test_views_that_were_left_out_show_with_their_reason(found: BoardCalibration, tmp_path: Path) -> None:
    # As if the third view's right picture had lacked the board.
    without = replace(found.views[2], right_px=None, faults=("", "9 x 3 inner corners show"))
    views = (*found.views[:2], without, *found.views[3:])
    solved = calibrate_stereo(views, BOARD, (1280, 1024))
    output = tmp_path / "calibration.html"
    write_calibration_report(replace(found, views=views, solved=solved), open_board_pictures(FOLDER), BOARD, output)
    rejected = parsed(output.read_text()).all("div", "reject")
    assert len(rejected) == 1
    assert "view 2" in rejected[0].text
    assert "not found in the right picture (9 x 3 inner corners show)" in rejected[0].text
    assert len(rejected[0].all("svg", "thumbnail")) == 2


def test_the_verdict_follows_the_checks(found: BoardCalibration) -> None:
    answers = checks(found)
    assert verdict(tuple(replace(answer, good=True) for answer in answers))[0] == "ok"
    assert verdict(tuple(replace(answer, good=index != 4) for index, answer in enumerate(answers)))[0] == "degraded"
    assert verdict(tuple(replace(answer, good=index != 0) for index, answer in enumerate(answers)))[0] == "invalid"


def test_a_page_that_cannot_be_written_is_an_error(found: BoardCalibration, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the report cannot be written"):
        write_calibration_report(found, open_board_pictures(FOLDER), BOARD, tmp_path / "none" / "page.html")
