"""The board held before both cameras, through the commands: drawn boards in, views recorded, a rig or a verdict out."""

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.capture.fake_kernel import FakeCamera, RunningKernel, two_cameras
from tests.recording.small_recording import image_of
from typer.testing import CliRunner, Result

from needletrack.calibration.board import Checkerboard
from needletrack.calibration.worth import actual
from needletrack.cli import app
from needletrack.daemon import board as board_module
from needletrack.daemon.board import NewestPairs
from needletrack.geometry.transform import RigidTransform
from needletrack.recording.asl import AslRecording
from needletrack.records import DropReason, Frame, StereoPair
from needletrack.rig import CalibrationInfo, Rig, read_rig, write_rig
from needletrack.synthetic.board import checkerboard_texture, draw_board
from needletrack.synthetic.rig import default_rig

SIZE_PX = (640, 512)
DRAWN = default_rig(SIZE_PX)
RIG = Rig(DRAWN.left, DRAWN.right, DRAWN.right_from_left, "bench", CalibrationInfo(calibrated_at=datetime.now(UTC)))
BOARD = Checkerboard(9, 7, 8.0)
GIVEN = ("--squares", "9x7", "--square-mm", "8")
# x, y, z mm of its middle; how far its left and its bottom side are turned away, degrees. All that a calibration wants.
PLACES = (
    (-40, -48, 280, 25, 0),
    (75, -48, 280, -25, 0),
    (-40, 48, 280, -25, 0),
    (75, 48, 280, 25, 0),
    (-40, 0, 270, 0, 25),
    (75, 0, 270, 0, -25),
    (35, -40, 260, 0, 25),
    (35, 40, 260, 0, -25),
    (35, 0, 222, 20, 20),
    (35, 0, 290, -20, -20),
    (-10, -50, 290, 0, -25),
    (20, 0, 290, -25, 0),
)


def drawn(place: tuple[int, int, int, int, int], seed: int) -> tuple[bytes, bytes]:
    x, y, z, about_y, about_x = place
    turn = Rotation.from_euler("yx", [about_y, about_x], degrees=True).as_matrix()
    pose = RigidTransform(turn, np.array([x, y, z]) - turn @ BOARD.points_mm.mean(axis=0))
    left, right = draw_board(RIG, checkerboard_texture((9, 7), 8.0), pose, seed=seed)
    return left.tobytes(), right.tobytes()


class Person:
    """Holds the board at one place after another, moves on when a view was taken; `then`, once, when none is left."""

    def __init__(self, folder: Path, places: int, then: Callable[[], object] = lambda: None) -> None:
        self._listing, self._then = folder / "cam1" / "data.csv", then
        self._pictures = [drawn(place, seed) for seed, place in enumerate(PLACES[:places])]

    def __call__(self, number: int) -> tuple[bytes, bytes]:
        taken = len(self._listing.read_text().splitlines()) - 1
        if taken == len(self._pictures):
            # A second Ctrl-C would end the program.
            then, self._then = self._then, lambda: None
            then()
        return self._pictures[min(taken, len(self._pictures) - 1)]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "my.toml"
    path.write_text(
        '[cameras]\nsize_px = [640, 512]\nrate_hz = 50.0\nleft.id = "usb-1"\nright.id = "usb-2"\n'
        # The right stamps of these cameras are late by more than recordings usually allow.
        "[pairing]\noffset_us = 3000.0\n"
    )
    return path


def cameras_of(
    monkeypatch: pytest.MonkeyPatch,
    pictures: Callable[[int], tuple[bytes, bytes]],
    cameras: list[FakeCamera] | None = None,
) -> RunningKernel:
    kernel = RunningKernel(cameras or two_cameras(SIZE_PX), pictures, skew_us=3000)
    monkeypatch.setattr("needletrack.capture.live.LinuxKernel", lambda: kernel)
    return kernel


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_a_rig_from_live_cameras(tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, output = tmp_path / "board", tmp_path / "rig.yaml"
    kernel = cameras_of(monkeypatch, Person(folder, len(PLACES)))
    result = run("calibrate", folder, *GIVEN, "--live", "--config", config, "--output", output)
    assert result.exit_code == 0, result.stderr
    assert "next: tilt the board by 30 degrees" in result.stderr
    assert "nothing is missing" in result.stderr
    assert f"{folder}: 12 views taken" in result.stderr
    assert kernel.left_open == 0
    found = read_rig(output)
    assert (found.name, found.calibration.views) == ("board", 12)
    # Twelve views of a board of 56 mm: what the calibration itself says that it is worth holds.
    stated = found.calibration.uncertainty
    assert stated is not None
    assert stated.before_alignment_mm is not None
    points_mm = np.array([[x, y, z] for x, y, z, _, _ in PLACES], dtype=np.float64)
    assert actual(found, RIG, points_mm).before_mm < 3 * stated.before_alignment_mm
    # What was taken can be calibrated again, with the stamps of the cameras.
    stamps = [pair.left.stamp_ns for pair in AslRecording(folder, RIG, tolerance_us=4000).pairs]
    assert set(stamps) <= {stamp_us * 1000 for stamp_us in kernel.stamps_us}
    again = tmp_path / "again.yaml"
    assert run("calibrate", folder, *GIVEN, "--config", config, "--output", again).exit_code == 0
    assert read_rig(again).digest == found.digest


def test_a_check_with_live_cameras(tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_rig(RIG, tmp_path / "rig.yaml")
    cameras_of(monkeypatch, Person(tmp_path / "fresh", 2))
    given = ("--config", config, "--live", "--views", 2)
    result = run("check", tmp_path / "rig.yaml", tmp_path / "fresh", *GIVEN, *given)
    assert result.exit_code == 0, result.stderr
    assert "next: hold the board still at 1 more place" in result.stderr
    assert "2 views taken" in result.stderr
    assert "views       2 of the board" in result.stdout
    assert "stands where it was calibrated" in result.stdout
    # The views are kept, and never written over.
    again = run("check", tmp_path / "rig.yaml", tmp_path / "fresh", *GIVEN, *given)
    assert again.exit_code == 2
    assert "there is a recording already: name a new folder" in again.stderr
    # A rig for other pictures is refused before anybody holds up a board.
    write_rig(replace(RIG, left=default_rig().left, right=default_rig().right), tmp_path / "other.yaml")
    other = run("check", tmp_path / "other.yaml", tmp_path / "new", *GIVEN, *given)
    assert other.exit_code == 2
    assert "cameras.size_px is 640x512" in other.stderr


def test_ctrl_c_ends_the_guidance_and_what_was_taken_stays(
    tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "board"
    cameras_of(monkeypatch, Person(folder, 1, then=lambda: os.kill(os.getpid(), signal.SIGINT)))
    monkeypatch.setattr(board_module, "PATIENCE_S", 60.0)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = run("calibrate", folder, *GIVEN, "--live", "--config", config)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 2
    assert "1 usable view" in result.stderr.splitlines()[-1]
    assert len(AslRecording(folder, RIG, tolerance_us=4000)) == 1


def test_a_camera_that_is_not_there_is_told_and_the_folder_can_be_used_after(
    tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_module, "PATIENCE_S", 0.5)
    cameras = two_cameras(SIZE_PX)
    cameras[1].plugged = False
    cameras_of(monkeypatch, lambda number: (b"", b""), cameras)
    for _ in range(2):
        result = run("calibrate", tmp_path / "board", *GIVEN, "--live", "--config", config)
        assert result.exit_code == 2
        told = result.stderr.splitlines()[-1]
        assert "no pair of pictures within 0.5 s: the right camera usb-2 is not connected" in told
        assert "needletrack doctor" in told


def test_without_a_board_nothing_is_calibrated(tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gray = np.resize(image_of(1), SIZE_PX[::-1]).tobytes()

    def pictures(number: int) -> tuple[bytes, bytes]:
        if number == 20:
            os.kill(os.getpid(), signal.SIGTERM)
        return gray, gray

    cameras_of(monkeypatch, pictures)
    result = run("calibrate", tmp_path / "board", *GIVEN, "--live", "--config", config)
    assert result.exit_code == 2
    assert "no view of the board was taken (of the last pair: not in the left and the right picture" in result.stderr


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--live"], "cameras.left.id is not configured"),
        (["right", "--live"], "one new folder"),
        (["--live", "--stream", "board.mcap"], "give one of them"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(tmp_path: Path, more: list[str], told: str) -> None:
    result = run("calibrate", tmp_path / "board", *more, *GIVEN)
    assert result.exit_code == 2
    assert told in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_who_is_slow_gets_the_newest_pair() -> None:
    class Fast:
        def __init__(self) -> None:
            self.dropped: Mapping[DropReason, int] = {}

        def pairs(self, stop: Event) -> Iterator[StereoPair]:
            for number in range(5):
                if number == 1:
                    taken_one.wait(60)
                yield StereoPair(Frame(image_of(number), number), Frame(image_of(number), number), number)
            done.set()
            stop.wait(60)

    taken_one, done, stop = Event(), Event(), Event()
    taken = NewestPairs(Fast()).pairs(stop)
    assert next(taken).sequence == 0
    taken_one.set()
    assert done.wait(60)
    assert next(taken).sequence == 4
    stop.set()
    assert list(taken) == []
