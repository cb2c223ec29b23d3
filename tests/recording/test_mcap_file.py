"""Recordings as MCAP files: pixels and stamps come back, other tools open them, a file cut off is saved."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from tests.recording.small_recording import SIZE_PX, image_of, small_rig

from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording.asl import UnusablePair
from needletrack.recording.mcap_file import (
    LEFT_TOPIC,
    RIGHT_TOPIC,
    TRACK_TOPIC,
    About,
    McapRecording,
    PairWriter,
    is_recording,
    recover,
)
from needletrack.records import Clock, DropReason, StampPlace

MS = 1_000_000
START_NS = 7_000_000_000
ABOUT = About(
    rig=small_rig(),
    name="small",
    run_id="r1",
    config='{"a": 1}',
    clock=Clock.MONOTONIC,
    exposure_ns=4 * MS,
    stamp_at=StampPlace.START_OF_EXPOSURE,
)


def written(path: Path, pairs: int, *, about: About = ABOUT, tracks: bool = False) -> PairWriter:
    """A file of noise that is not finished yet; the right frames are 20 us later."""
    writer = PairWriter(path, about)
    for n in range(pairs):
        stamp = START_NS + n * 10 * MS
        writer.add_pair(n, image_of(stamp), stamp, image_of(stamp + 1), stamp + 20_000)
        if tracks:
            writer.add_track(n, stamp, b'{"sequence": %d}' % n)
    return writer


def finished(path: Path, pairs: int, *, about: About = ABOUT, tracks: bool = False) -> Path:
    written(path, pairs, about=about, tracks=tracks).finish()
    return path


def test_pixels_stamps_rig_and_configuration_come_back(tmp_path: Path) -> None:
    recording = McapRecording(finished(tmp_path / "r.mcap", 5, tracks=True))
    assert len(recording) == 5
    assert recording.rig.digest == small_rig().digest
    assert recording.about.config == '{"a": 1}'
    assert (recording.about.clock, recording.about.run_id) == (Clock.MONOTONIC, "r1")
    for n in (3, 0, 4):
        pair = recording.read(n)
        stamp = START_NS + n * 10 * MS
        assert (pair.sequence, pair.captured_at_ns, pair.skew_us) == (n, stamp, 20.0)
        assert np.array_equal(pair.left.image, image_of(stamp))
        assert np.array_equal(pair.right.image, image_of(stamp + 1))
        assert (pair.clock, pair.exposure_ns) == (Clock.RECORDED, 4 * MS)
        assert pair.stamp_at is StampPlace.START_OF_EXPOSURE
    assert recording.tracks() == [(START_NS + n * 10 * MS, b'{"sequence": %d}' % n) for n in range(5)]


def test_chunks_are_read_in_any_order(tmp_path: Path) -> None:
    path, image = tmp_path / "r.mcap", np.random.default_rng(0).integers(0, 256, (1024, 1280), dtype=np.uint8)
    writer = PairWriter(path, replace(ABOUT, rig=None))
    for n in range(24):
        writer.add_pair(n, np.roll(image, n), n * MS, np.roll(image, -n), n * MS)
    writer.finish()
    recording = McapRecording(path, small_rig((1280, 1024)))
    for n in (23, 0, 12, 11, 23):
        pair = recording.read(n)
        assert np.array_equal(pair.left.image, np.roll(image, n))
        assert np.array_equal(pair.right.image, np.roll(image, -n))
    assert path.stat().st_size > 24 * 2 * image.size  # noise of all levels cannot be made smaller
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 24 // 4


def test_smooth_pictures_take_less_than_they_are(tmp_path: Path) -> None:
    picture = np.clip(np.random.default_rng(1).normal(120, 3, (1024, 1280)), 0, 255).astype(np.uint8)
    writer = PairWriter(tmp_path / "r.mcap", ABOUT)
    for n in range(8):
        writer.add_pair(n, picture, n * MS, picture, n * MS)
    writer.finish()
    # Noise of 3 grey levels has 3.6 bits of 8.
    assert (tmp_path / "r.mcap").stat().st_size < 0.55 * 16 * picture.size


def test_other_tools_open_it(tmp_path: Path) -> None:
    path = finished(tmp_path / "r.mcap", 3, tracks=True)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[])
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        assert {record.name for record in reader.iter_attachments()} == {"rig.yaml", "config.json"}
    assert {topic: topics.count(topic) for topic in topics} == {LEFT_TOPIC: 3, RIGHT_TOPIC: 3, TRACK_TOPIC: 3}
    with AnyReader([path]) as bag:
        for connection, at_ns, raw in bag.messages():
            message: Any = bag.deserialize(raw, connection.msgtype)
            if connection.topic == LEFT_TOPIC:
                assert message.encoding == "mono8"
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == at_ns
                assert np.array_equal(message.data.reshape(message.height, message.step), image_of(at_ns))


def test_a_recording_without_a_rig_needs_one(tmp_path: Path) -> None:
    path = finished(tmp_path / "r.mcap", 2, about=replace(ABOUT, rig=None))
    with pytest.raises(CalibrationError, match="--rig"):
        McapRecording(path)
    assert McapRecording(path, small_rig()).has_rig
    bare = McapRecording(path, without_rig=True)
    assert not bare.has_rig
    assert bare.rig.left.size_px == SIZE_PX


def test_a_rig_of_other_cameras_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the images are 64x48, rig small has 320x240"):
        McapRecording(finished(tmp_path / "r.mcap", 2), small_rig((320, 240)))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = finished(tmp_path / "r.mcap", 1)
    with pytest.raises(RecordingError, match="nothing is overwritten"):
        PairWriter(path, ABOUT)
    with pytest.raises(RecordingError, match="nothing is overwritten"):
        recover(path, path)


@pytest.mark.parametrize("lost", [1, 20, 300, 5000, 0.5])
def test_a_file_cut_off_is_told_and_saved(tmp_path: Path, lost: float) -> None:
    whole, cut, saved = (tmp_path / name for name in ("whole.mcap", "cut.mcap", "saved.mcap"))
    writer = PairWriter(whole, ABOUT)
    for n in range(8):
        stamp = START_NS + n * 10 * MS
        writer.add_pair(n, image_of(stamp), stamp, image_of(stamp + 1), stamp)
        writer.add_track(n, stamp, b"{}")
        writer.flush()
    ends = writer.bytes_written
    writer.finish()
    data = whole.read_bytes()
    kept = len(data) - round(lost if lost >= 1 else len(data) * lost)
    cut.write_bytes(data[:kept])
    with pytest.raises(RecordingError, match="needletrack recover"):
        McapRecording(cut)
    assert is_recording(cut)
    got = recover(cut, saved)
    recording = McapRecording(saved)
    assert len(recording) == got.pairs
    # A chunk a pair: one is lost where the cut goes through it.
    assert got.pairs >= min(8, kept * 8 // ends - 1)
    assert got.pairs == 8 or kept < ends
    assert got.tracks == got.pairs
    # Of what was saved, which is whole, nothing is lost.
    assert recover(saved, tmp_path / "again.mcap") == replace(got, lost_bytes=0)
    assert recording.rig.digest == small_rig().digest
    for n in range(got.pairs):
        assert np.array_equal(recording.read(n).left.image, image_of(START_NS + n * 10 * MS))


def test_damage_within_a_chunk_costs_its_pairs_and_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    writer = PairWriter(path, ABOUT)
    starts = []
    for n in range(3):
        starts.append(writer.bytes_written)
        writer.add_pair(n, image_of(n), n * MS, image_of(n), n * MS)
        writer.flush()
    writer.finish()
    data = bytearray(path.read_bytes())
    data[starts[1] + 800] ^= 0xFF
    path.write_bytes(data)
    recording = McapRecording(path)
    assert recording.read(2).sequence == 2
    with pytest.raises(UnusablePair) as error:
        recording.read(1)
    assert {loss.reason for loss in error.value.losses} == {DropReason.UNREADABLE_IMAGE, DropReason.UNPAIRED_LEFT}


@pytest.mark.parametrize("content", [b"", b"nothing", b"\x89MCAP0\r\n"])
def test_what_is_no_recording_cannot_be_saved(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(content)
    assert not is_recording(path)
    with pytest.raises(RecordingError):
        McapRecording(path, small_rig())
    with pytest.raises(RecordingError, match="nothing in it could be read"):
        recover(path, tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()
