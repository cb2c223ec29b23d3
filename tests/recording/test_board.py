"""A recording of the board to a rig, against the exact truth of the bundled one."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from needletrack.calibration.board import Checkerboard
from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording.board import calibrate_from_recording

BOARD = Path(__file__).parents[1] / "data" / "recordings" / "calib-a"
NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
PAPER = Checkerboard(11, 11, 2.0)


def test_a_rig_from_the_pairs_that_can_be_read(tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    shutil.copytree(BOARD, folder)
    broken = min((folder / "cam1" / "data").glob("*.png"))
    broken.write_bytes(broken.read_bytes()[:-20])
    views = sum(1 for _ in broken.parent.glob("*.png")) - 1
    found = calibrate_from_recording(folder, PAPER, "bench-2", NOW)
    assert len(found.left_out) == 1
    assert str(broken) in found.left_out[0]
    info = found.rig.calibration
    assert found.rig.name == "bench-2"
    assert (info.calibrated_at, info.views) == (NOW, views)
    assert info.source == "bench, board of 11 x 11 squares of 2 mm"
    assert info.reprojection_rms_px is not None
    # Corners are found to a tenth of a pixel.
    assert info.reprojection_rms_px <= found.worst_view_rms_px < 0.2
    truth = json.loads((folder / "truth.json").read_text())["cameras"]
    assert found.rig.left.size_px == tuple(truth[0]["size"])
    # Four views of a small board leave the baseline uncertain by about a hundredth.
    np.testing.assert_allclose(found.rig.baseline_mm, np.linalg.norm(truth[1]["t"]), rtol=0.03)


def test_a_recording_without_the_board(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"0 usable views.*board was not found"):
        calibrate_from_recording(BOARD.parent / "absent-a", PAPER, "bench-2", NOW)


def test_no_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recording: cam0/data\.csv"):
        calibrate_from_recording(tmp_path, PAPER, "bench-2", NOW)
