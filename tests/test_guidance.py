"""Guidance while a board is held up: on a replayed stream, through the Protocol that cameras fulfil."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import Checkerboard
from needletrack.errors import RecordingError
from needletrack.geometry.transform import RigidTransform
from needletrack.guidance import Guidance, GuidanceShown, collect, drawn
from needletrack.recording.board import BoardRecorder, board_stream, open_board_pictures
from needletrack.records import DropReason, Frame, StereoPair
from needletrack.synthetic.board import checkerboard_texture, draw_board
from needletrack.synthetic.rig import default_rig

RIG = default_rig((640, 512))
BOARD = Checkerboard(9, 7, 6.0)
RECORDINGS = Path(__file__).parent / "data" / "recordings"


class Drawn:
    """A source that shows a drawn board at one place after another."""

    def __init__(self, places: list[tuple[float, float]], blur_px: float = 0.5) -> None:
        self._places, self._blur_px = places, blur_px

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        return {}

    def pairs(self, stop: Event) -> Iterator[StereoPair]:
        texture = checkerboard_texture((9, 7), 6.0)
        for index, (x, tilt_deg) in enumerate(self._places):
            turn = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()
            at = RigidTransform(turn, np.array([x, 0.0, 250.0]) - turn @ BOARD.points_mm.mean(axis=0))
            left, right = draw_board(RIG, texture, at, seed=index, blur_px=self._blur_px)
            stamp = 1_000_000_000 + 33_000_000 * index
            yield StereoPair(Frame(left, stamp), Frame(right, stamp + 1000), index)


def test_a_view_counts_when_the_board_stands_still_somewhere_new(tmp_path: Path) -> None:
    said: list[Guidance] = []
    source = Drawn([(30, 0), (30, 0), (30, 0), (40, 25), (40, 25), (-300, 0)])
    last = collect(source, BOARD, BoardRecorder(tmp_path / "new"), Event(), said.append)
    assert [guidance.said.split(":")[0] for guidance in said[:5]] == [
        "moving",
        "taken",
        "taken already",
        "moving",
        "taken",
    ]
    assert said[5].said.startswith("not in the left and the right picture")
    assert last is not None
    assert last.accepted == 2
    assert sum(last.covered.tilts[:2]) == 1
    assert not last.done
    recorded = open_board_pictures(tmp_path / "new")
    assert recorded.names == ("1033000000.png", "1132000000.png")
    assert recorded.size_px == (640, 512)


def test_blur_is_told_at_once(tmp_path: Path) -> None:
    said: list[Guidance] = []
    collect(Drawn([(30, 0), (30, 0)], blur_px=2.5), BOARD, BoardRecorder(tmp_path / "new"), Event(), said.append)
    assert {guidance.said.split(":")[0] for guidance in said} == {"blurred"}


def test_it_ends_when_it_is_told_to(tmp_path: Path) -> None:
    stop = Event()
    stop.set()
    last = collect(Drawn([(30, 0), (30, 0)]), BOARD, BoardRecorder(tmp_path / "new"), stop)
    assert last is not None
    assert last.sequence == 0


def test_a_replayed_recording_of_stills_is_told_to_hold_still(tmp_path: Path) -> None:
    # A bundled recording of stills: no board stands still in it, which guidance says.
    said: list[Guidance] = []
    collect(
        board_stream(RECORDINGS / "calib-b"),
        Checkerboard(12, 9, 10.0),
        BoardRecorder(tmp_path / "new"),
        Event(),
        said.append,
    )
    assert len(said) == len(open_board_pictures(RECORDINGS / "calib-b").names)
    assert {guidance.said.split(":")[0] for guidance in said} == {"moving"}


def test_a_recording_is_never_overwritten_but_an_empty_one_is_gone_on_with(tmp_path: Path) -> None:
    BoardRecorder(tmp_path / "new")
    BoardRecorder(tmp_path / "new").write(next(Drawn([(30, 0)]).pairs(Event())))
    with pytest.raises(RecordingError, match="name a new folder"):
        BoardRecorder(tmp_path / "new")


def test_the_terminal_shows_a_picture_and_a_pipe_shows_lines(tmp_path: Path) -> None:
    said: list[Guidance] = []
    collect(Drawn([(30, 0), (30, 0)]), BOARD, BoardRecorder(tmp_path / "new"), Event(), said.append)
    page = io.StringIO()
    Console(file=page, width=100).print(drawn(said[-1]))
    for expected in ("1 of 12 views", "left view", "· top nearer", "next: tilt the board by 30 degrees", "███"):
        assert expected in page.getvalue()
    lines = io.StringIO()
    with GuidanceShown(Console(file=lines, width=200)) as shown:
        for guidance in (*said, said[-1]):
            shown.take(guidance)
    # A line for each change.
    assert len(lines.getvalue().splitlines()) == 2
