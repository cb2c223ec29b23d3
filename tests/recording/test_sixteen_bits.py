"""Pictures of more than eight bits: recorded, exported, imported and read without losing one."""

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import config_for
from tests.recording.small_recording import SIZE_PX, image_of, small_rig

from needletrack.daemon.record import record
from needletrack.recording.asl import AslRecording
from needletrack.recording.bag import BagRecording
from needletrack.recording.mcap_file import About, McapRecording, recover
from needletrack.recording.recorder import Recorder, RecorderSettings
from needletrack.recording.replay import StoredRecording
from needletrack.recording.stored import export, import_recording
from needletrack.records import Frame, Image16, StereoPair

PAIRS = 3


def words_of(number: int, bits: int) -> Image16:
    """What a camera delivers that fills so many of sixteen bits."""
    return np.random.default_rng(number).integers(0, 1 << bits, SIZE_PX[::-1], dtype=np.uint16)


def bits_of(file: Path) -> np.dtype[Any]:
    """As any other reader sees them."""
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)).dtype


@pytest.mark.parametrize(("pixels", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 14), ("Y16", 16)])
def test_every_copy_of_a_recording_has_all_bits(tmp_path: Path, pixels: str, bits: int) -> None:
    rig = small_rig()
    kernel = RunningKernel(
        two_cameras(SIZE_PX, pixels=pixels),
        lambda number: (words_of(number, bits).tobytes(), words_of(number + 100, bits).tobytes()),
    )
    config = config_for(rig, cameras={"format": pixels, "significant_bits": bits})
    file = tmp_path / "r.mcap"
    done = record(config, file, threading.Event(), rig=rig, pairs=PAIRS, kernel=kernel)
    assert (done.pairs, done.unrecorded) == (PAIRS, 0)

    def is_whole(recording: StoredRecording) -> None:
        assert len(recording) == PAIRS
        for number in range(PAIRS):
            pair = recording.read(number)
            for frame, delivered in ((pair.left, number), (pair.right, number + 100)):
                assert np.array_equal(frame.pixels >> (16 - bits), words_of(delivered, bits))
                assert np.array_equal(frame.image, words_of(delivered, bits) >> (bits - 8))

    is_whole(McapRecording(file))
    export(file, tmp_path / "asl", "asl")
    is_whole(AslRecording(tmp_path / "asl"))
    (first, *_) = sorted((tmp_path / "asl" / "cam0" / "data").glob("*.png"))
    assert bits_of(first) == np.uint16
    export(file, tmp_path / "bag", "ros2")
    is_whole(BagRecording(tmp_path / "bag", rig))
    for kind in ("asl", "bag"):
        import_recording(tmp_path / kind, tmp_path / f"of-{kind}.mcap", rig)
        is_whole(McapRecording(tmp_path / f"of-{kind}.mcap"))
    recover(file, tmp_path / "saved.mcap")
    is_whole(McapRecording(tmp_path / "saved.mcap"))


def test_pictures_of_eight_bits_take_eight(tmp_path: Path) -> None:
    rig, file = small_rig(), tmp_path / "r.mcap"
    kernel = RunningKernel(two_cameras(SIZE_PX), lambda number: (image_of(number).tobytes(),) * 2)
    record(config_for(rig), file, threading.Event(), rig=rig, pairs=PAIRS, kernel=kernel)
    frame = McapRecording(file).read(0).left
    assert frame.image16 is None
    assert frame.pixels is frame.image
    export(file, tmp_path / "asl", "asl")
    (first, *_) = (tmp_path / "asl" / "cam0" / "data").glob("*.png")
    assert bits_of(first) == np.uint8


def test_a_frame_of_other_bits_than_the_recorder_s_is_counted(tmp_path: Path) -> None:
    eight, sixteen = Frame(image_of(1), 1), Frame.of(words_of(1, 16), 1)
    with Recorder(RecorderSettings(tmp_path), About(small_rig(), "small"), SIZE_PX, bits=16) as recorder:
        assert not recorder.offer(StereoPair(eight, eight, 0))
        assert recorder.offer(StereoPair(sixteen, sixteen, 1))
    assert (recorder.recorded, recorder.dropped) == (1, 1)


def test_a_frame_s_sixteen_bits_have_its_shape() -> None:
    with pytest.raises(ValueError, match="image16 has shape"):
        Frame(image_of(1), 1, words_of(1, 16)[1:])
