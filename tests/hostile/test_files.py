"""A path that is no regular file is refused at once, and with its name: nothing waits for a FIFO or reads a device."""

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.hostile.edges import BY_NAME, EDGES, RECORDINGS, Edge
from tests.recording.small_recording import small_rig, write_recording
from typer.testing import CliRunner

from needletrack.cli import app
from needletrack.config import load_config
from needletrack.errors import CalibrationError, ConfigError
from needletrack.reading import MOST_DOCUMENT_BYTES, bytes_of
from needletrack.recording.asl import AslRecording, UnusablePair
from needletrack.recording.mcap_file import recover
from needletrack.rig import read_rig, write_rig

# What the edges of tests read themselves.
FILES = [edge for edge in EDGES if edge.name not in {"track", "status", "mjpg"}]
_AT_ONCE_S = 5.0


def _socket(path: Path) -> None:
    # The name of a socket has at most 107 bytes, and the test's folder is long.
    here = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as unix:
            unix.bind(path.name)
    finally:
        os.chdir(here)


def _sparse(path: Path) -> None:
    """Ten gigabytes that take no room: what follows the valid content is zeros."""
    os.truncate(path, 10_000_000_000)


KINDS: dict[str, Callable[[Path], object]] = {
    "FIFO": os.mkfifo,
    "folder": Path.mkdir,
    "socket": _socket,
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "symbolic link to itself": lambda path: path.symlink_to(path.name),
    "dangling symbolic link": lambda path: path.symlink_to("nowhere"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("edge", FILES, ids=lambda edge: edge.name)
def test_what_is_no_file_is_refused(edge: Edge, kind: str) -> None:
    with edge.folder() as folder:
        path = folder / edge.file
        path.unlink(missing_ok=True)
        KINDS[kind](path)
        began_s = time.monotonic()
        told = edge.refusal_of(path)
        assert time.monotonic() - began_s < _AT_ONCE_S
        assert told is not None
        assert folder.name in told


@pytest.mark.parametrize("edge", FILES, ids=lambda edge: edge.name)
def test_ten_gigabytes_are_not_read(edge: Edge, tmp_path: Path) -> None:
    # Not in memory, where the folder of an edge is: a file of zeros takes none on a disk.
    edge.beside(tmp_path)
    path = tmp_path / edge.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(edge.valid()[0])
    _sparse(path)
    began_s = time.monotonic()
    edge.refusal_of(path)
    assert time.monotonic() - began_s < _AT_ONCE_S


def test_an_image_that_is_a_fifo_costs_its_pair_and_no_more(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10_000_000, 20_000_000])
    image = folder / "cam0" / "data" / "20000000.png"
    image.unlink()
    os.mkfifo(image)
    recording = AslRecording(folder)
    assert recording.read(0).sequence == 0
    with pytest.raises(UnusablePair, match="it is a FIFO"):
        recording.read(1)


def test_a_name_that_no_file_can_have(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no name of a file"):
        bytes_of("a\0b")
    config = tmp_path / "config.toml"
    config.write_text('[rig]\npath = "~nobody-of-this-name/rig.yaml"\n[recording]\nfolder = "a\\u0000b"\n')
    effective = load_config(config)
    assert effective.rig.path is not None
    with pytest.raises(CalibrationError, match="nobody-of-this-name"):
        read_rig(effective.rig.path)
    assert effective.recording.folder is not None
    with pytest.raises(CalibrationError, match="no name of a file"):
        read_rig(effective.recording.folder)


def test_a_document_that_is_too_long_says_how_long_it_may_be(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(b"#" * (MOST_DOCUMENT_BYTES + 1))
    with pytest.raises(CalibrationError, match=r"rig\.yaml.*0\.3 MB, more than the 0\.3 MB"):
        read_rig(path)


def test_a_rig_is_not_written_through_a_link_to_itself(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.symlink_to(path.name)
    with pytest.raises(CalibrationError, match=r"rig\.yaml"):
        write_rig(small_rig(), path)


def test_a_number_of_thousands_of_digits_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(f"rig.max_age_days = {'9' * 5000}\n")
    with pytest.raises(ConfigError, match=r"config\.toml: not a TOML file"):
        load_config(path)


def test_the_zeros_after_a_power_cut_end_a_recovery(tmp_path: Path) -> None:
    path, whole = tmp_path / "cut.mcap", BY_NAME["mcap"].valid()[0]
    # The index is lost, and zeros stand where the file system had reserved room.
    at = whole.rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")
    path.write_bytes(whole[:at])
    os.truncate(path, 10_000_000_000)
    saved = recover(path, tmp_path / "saved.mcap")
    assert saved.pairs == 3
    assert saved.lost_bytes > 9_000_000_000


@pytest.mark.parametrize(
    "command",
    [
        ["replay", "{}"],
        ["rig", "show", "{}"],
        ["config", "check", "{}"],
        ["replay", str(RECORDINGS / "hard-a"), "--config", "{}"],
        ["replay", str(RECORDINGS / "hard-a"), "--rig", "{}"],
        ["recover", "{}", "{}.saved"],
        ["export", "{}", "{}.saved"],
    ],
    ids=" ".join,
)
def test_a_command_says_which_file_is_none_and_ends_with_2(command: list[str], tmp_path: Path) -> None:
    fifo = tmp_path / "fifo.mcap"
    os.mkfifo(fifo)
    result = CliRunner().invoke(app, [part.format(fifo) for part in command])
    assert result.exit_code == 2, result.output
    assert "fifo.mcap" in result.output


def test_what_a_bag_calls_its_types_does_not_matter(tmp_path: Path) -> None:
    """A definition in which a stamp's seconds are a text would multiply that text a billion times."""
    edge = BY_NAME["bag2"]
    content = edge.valid()[0]
    assert content.count(b"int32 sec") >= 1
    renamed = content.replace(b"int32 sec", b"string se")
    with edge.folder() as folder:
        told = edge.refusal(folder, renamed)
        assert told is None or "a.mcap" in told
