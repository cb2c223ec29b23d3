import csv
import math
from pathlib import Path

import pytest

from needletrack.errors import RecordingError
from needletrack.publish.message import Instant, TrackMessage
from needletrack.publish.schema import EXAMPLE_UNIX_NS, example_run, example_track
from needletrack.recording.tracks import TrackFile
from needletrack.records import DropReason, NeedleTrack, Reason, Status

TRACK, PAIR = example_track()
LOST = NeedleTrack(PAIR.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE, Reason.JUMP))


def message(track: NeedleTrack) -> TrackMessage:
    published = Instant(unix_ns=EXAMPLE_UNIX_NS + 7_250_000, monotonic_ns=0)
    dropped = {DropReason.OVERWRITTEN: 3, DropReason.UNPAIRED_LEFT: 1}
    return TrackMessage.from_track(track, PAIR, example_run(), dropped=dropped, published=published)


def write(path: Path, *tracks: NeedleTrack) -> list[TrackMessage]:
    messages = [message(track) for track in tracks]
    with TrackFile(path) as file:
        for track, each in zip(tracks, messages, strict=True):
            file.take(PAIR, track, each)
    return messages


def test_jsonl_holds_the_messages_of_the_wire(tmp_path: Path) -> None:
    path = tmp_path / "tracks.jsonl"
    messages = write(path, TRACK, LOST)
    assert [TrackMessage.from_json(line) for line in path.read_bytes().splitlines()] == messages


def test_a_line_is_in_the_file_before_the_next_pair(tmp_path: Path) -> None:
    path = tmp_path / "tracks.jsonl"
    with TrackFile(path) as file:
        for number in (1, 2):
            file.take(PAIR, TRACK, message(TRACK))
            assert path.read_bytes().count(b"\n") == number == file.lines
            assert path.read_bytes().endswith(b"\n")


def test_an_older_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "tracks.JSONL"
    write(path, TRACK, TRACK)
    write(path, LOST)
    assert path.read_bytes().count(b"\n") == 1


def test_csv_has_a_row_for_each_message(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    ok, _ = write(path, TRACK, LOST)
    with path.open(encoding="utf-8", newline="") as file:
        first, second = csv.DictReader(file)
    assert ok.tip is not None
    assert ok.base is not None
    assert ok.length_mm is not None
    assert first["status"] == "ok"
    assert first["reasons"] == ""
    assert int(first["sequence"]) == PAIR.sequence
    assert int(first["captured_at_ns"]) == PAIR.captured_at_ns
    assert first["clock"] == "realtime"
    assert float(first["length_mm"]) == ok.length_mm
    for i, axis in enumerate("xyz"):
        assert float(first[f"tip_{axis}_mm"]) == ok.tip.position_mm[i]
        assert float(first[f"tip_direction_{axis}"]) == ok.tip.direction[i]
        assert float(first[f"tip_sigma_{axis}_mm"]) == math.sqrt(ok.tip.covariance_mm2[i][i])
        assert float(first[f"base_{axis}_mm"]) == ok.base.position_mm[i]
        assert float(first[f"base_direction_{axis}"]) == ok.base.direction[i]
    assert float(first["pair_skew_us"]) == PAIR.skew_us
    assert int(first["dropped"]) == 4
    assert second["status"] == "invalid"
    assert second["reasons"] == "no_candidate jump"
    assert {second[name] for name in first if name.startswith(("tip_", "base_", "length"))} == {""}
    assert None not in first  # more cells than columns
    assert None not in second.values()  # fewer


def test_csv_without_a_track_still_names_its_columns(tmp_path: Path) -> None:
    write(tmp_path / "tracks.csv")
    assert (tmp_path / "tracks.csv").read_text().startswith("sequence,captured_at_ns,")


@pytest.mark.parametrize("name", ["tracks", "tracks.txt", "tracks.json"])
def test_another_ending_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError, match=rf"{name}: .*\.jsonl or \.csv"):
        TrackFile(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere/tracks\.csv: .*make the folder .*nowhere"):
        TrackFile(tmp_path / "nowhere" / "tracks.csv")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "tracks.jsonl").mkdir()
    with pytest.raises(RecordingError, match=r"tracks\.jsonl: .*directory.*name a file"):
        TrackFile(tmp_path / "tracks.jsonl")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_full_disk_is_told_with_what_is_safe(tmp_path: Path) -> None:
    path = tmp_path / "tracks.jsonl"
    path.symlink_to("/dev/full")
    with TrackFile(path) as file, pytest.raises(RecordingError, match=r"tracks\.jsonl: .*space.*0 tracks"):
        file.take(PAIR, TRACK, message(TRACK))
    path.unlink()
    path.with_suffix(".csv").symlink_to("/dev/full")
    with pytest.raises(RecordingError, match=r"tracks\.csv: .*space"):
        TrackFile(path.with_suffix(".csv"))


def test_a_file_that_is_closed_twice(tmp_path: Path) -> None:
    file = TrackFile(tmp_path / "tracks.jsonl")
    file.close()
    file.close()
    assert file.path.read_bytes() == b""
