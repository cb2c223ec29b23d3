import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from needletrack.errors import NeedletrackError
from needletrack.pictures.png import write_png
from needletrack.pictures.theme import Page


def picture() -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, :30], pixels[:20, 30:] = (255, 0, 0), (0, 10, 250)
    return pixels


def test_pixels_and_their_colors_are_kept(tmp_path: Path) -> None:
    path = write_png(picture(), tmp_path / "new" / "a.png")
    assert path == tmp_path / "new" / "a.png"
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert read is not None
    np.testing.assert_array_equal(read[..., ::-1], picture())


def test_a_figure_has_the_size_that_it_states(tmp_path: Path) -> None:
    read = cv2.imread(str(write_png(Page(321, 123), tmp_path / "a.png")))
    assert read is not None
    assert read.shape == (123, 321, 3)
    assert (read == (0x17, 0x11, 0x0D)).all()


def test_the_old_file_stays_whole_where_the_new_one_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_png(picture(), tmp_path / "a.png")
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(NeedletrackError, match=r"a\.png: cannot write the picture: No space left"):
        write_png(255 - picture(), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NeedletrackError, match=r"file/a\.png: cannot write the picture"):
        write_png(picture(), tmp_path / "file" / "a.png")
