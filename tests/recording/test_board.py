"""A recording of the board to a rig, against the exact truth of the bundled one."""

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from tests.recording.small_recording import image_of
from typer.testing import CliRunner

from needletrack.calibration.board import Checkerboard
from needletrack.cli import app
from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording.asl import AslRecording
from needletrack.recording.bag import write_bag, write_recording
from needletrack.recording.board import board_stream, calibrate_from_recording, open_board_pictures
from needletrack.recording.mcap_file import About, PairWriter
from needletrack.recording.stored import open_pictures
from needletrack.rig import read_rig

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


def as_file(folder: Path, output: Path) -> Path:
    recording = AslRecording(folder, open_pictures(folder).rig)
    return write_recording(recording, output, None).path


def as_bag(folder: Path, output: Path) -> Path:
    recording = AslRecording(folder, open_pictures(folder).rig)
    return write_bag(recording, output.with_suffix(""), with_rig=False).path


@pytest.mark.parametrize("stored", [as_file, as_bag])
def test_every_kind_of_recording_shows_the_same_pictures(stored: Callable[[Path, Path], Path], tmp_path: Path) -> None:
    pictures, known = open_board_pictures(stored(BOARD, tmp_path / "bench.mcap")), open_board_pictures(BOARD)
    assert (pictures.size_px, len(pictures.names)) == (known.size_px, len(known.names))
    for index in range(len(known.names)):
        for ours, theirs in zip(pictures.read(index), known.read(index), strict=True):
            assert np.array_equal(ours, theirs)


@pytest.mark.slow
@pytest.mark.parametrize("stored", [as_file, as_bag])
def test_every_kind_of_recording_gives_the_same_rig(stored: Callable[[Path, Path], Path], tmp_path: Path) -> None:
    path, output = stored(BOARD, tmp_path / "bench.mcap"), tmp_path / "rig.yaml"
    given = ["--square-mm", "2"]
    result = CliRunner().invoke(app, ["calibrate", str(path), *given, "--output", str(output)])
    assert result.exit_code == 0, result.stderr
    found, folder = read_rig(output), calibrate_from_recording(BOARD, PAPER, "bench", NOW)
    assert (found.name, found.digest) == ("bench", folder.rig.digest)
    checked = CliRunner().invoke(app, ["check", str(output), str(path), *given])
    assert checked.exit_code == 0, checked.stderr
    assert f"views       {len(folder.views)} of the board" in checked.stdout
    assert len(board_stream(path)) == len(folder.views)


def test_of_a_film_the_stillest_pairs_are_looked_at(tmp_path: Path) -> None:
    still = {3, 8, 14, 20}

    def written(name: str, every_ns: int) -> Path:
        writer = PairWriter(tmp_path / name, About(rig=None, name="uncalibrated"))
        for number in range(24):
            # As the pair before it, where that one is still.
            image = image_of(number - 1 if number - 1 in still else number)
            writer.add_pair(number, image, number * every_ns, image, number * every_ns)
        writer.finish()
        return tmp_path / name

    film = open_board_pictures(written("film.mcap", 20_000_000), most=4)
    assert film.names == tuple(f"pair {number}" for number in sorted(still))
    assert np.array_equal(film.read(2)[0], image_of(14))
    assert len(open_board_pictures(tmp_path / "film.mcap", most=24).names) == 24
    assert len(open_board_pictures(tmp_path / "film.mcap").names) == 24
    # Who takes pictures one by one has chosen already.
    assert len(open_board_pictures(written("stills.mcap", 2_000_000_000), most=4).names) == 24


def test_a_recording_without_the_board(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"0 usable views.*board was not found"):
        calibrate_from_recording(BOARD.parent / "absent-a", PAPER, "bench-2", NOW)


def test_no_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recording: cam0/data\.csv"):
        calibrate_from_recording(tmp_path, PAPER, "bench-2", NOW)
