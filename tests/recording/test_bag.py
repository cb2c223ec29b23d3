"""ROS bags: any recording becomes one, and one with two image topics becomes a recording."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from tests.recording.small_recording import image_of, small_rig, write_recording

from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording import bag as bags
from needletrack.recording.asl import AslRecording
from needletrack.recording.asl_writer import write_asl
from needletrack.recording.bag import BagRecording, write_bag
from needletrack.recording.mcap_file import McapRecording, typestore
from needletrack.recording.replay import StoredRecording
from needletrack.recording.stored import open_stored

MS = 1_000_000
STAMPS_NS = [1_000_000_000 + number * 10 * MS for number in range(4)]


@pytest.fixture
def recording(tmp_path: Path) -> AslRecording:
    return AslRecording(write_recording(tmp_path / "asl", STAMPS_NS, [stamp + 30_000 for stamp in STAMPS_NS]))


def same(one: StoredRecording, other: StoredRecording) -> bool:
    def content(recording: StoredRecording, index: int) -> list[object]:
        pair = recording.read(index)
        return [(f.captured_at_ns, f.image.tobytes(), f.image.shape) for f in (pair.left, pair.right)]

    return len(one) == len(other) and all(content(one, n) == content(other, n) for n in range(len(one)))


def test_once_around_every_kind(recording: AslRecording, tmp_path: Path) -> None:
    rig = recording.rig
    bag = write_bag(recording, tmp_path / "bag", tracks=[(STAMPS_NS[1], b"{}")])
    assert bag.pairs == 4
    assert same(open_stored(tmp_path / "bag", rig), recording)
    bags.write_recording(open_stored(tmp_path / "bag", rig), tmp_path / "ours.mcap", rig)
    ours = open_stored(tmp_path / "ours.mcap")
    assert isinstance(ours, McapRecording)
    assert same(ours, recording)
    write_asl(ours, tmp_path / "again")
    again = open_stored(tmp_path / "again")
    assert same(again, recording)
    assert again.rig.digest == rig.digest


def test_a_bag_has_what_ros_wants_of_a_camera(recording: AslRecording, tmp_path: Path) -> None:
    write_bag(recording, tmp_path / "bag")
    assert (tmp_path / "bag" / "metadata.yaml").is_file()
    with AnyReader([tmp_path / "bag"]) as reader:
        assert {each.topic: each.msgtype for each in reader.connections} == {
            "/left/image_raw": "sensor_msgs/msg/Image",
            "/right/image_raw": "sensor_msgs/msg/Image",
            "/left/camera_info": "sensor_msgs/msg/CameraInfo",
            "/right/camera_info": "sensor_msgs/msg/CameraInfo",
        }
        infos: list[Any] = [
            reader.deserialize(raw, each.msgtype)
            for each, _, raw in reader.messages()
            if each.topic == "/left/camera_info"
        ]
    info = infos[0]
    assert np.array_equal(info.k.reshape(3, 3), recording.rig.left.matrix)
    assert (info.width, info.height, info.distortion_model) == (64, 48, "plumb_bob")


def written_bag(path: Path, topics: dict[str, str], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """A bag with an image a stamp and topic, of an encoding; recorded 3 ms after its stamp."""
    types = typestore()
    with BagWriter(path, version=9, storage_plugin=storage) as bag:
        for topic, encoding in topics.items():
            compressed = encoding in ("png", "jpeg")
            kind = f"sensor_msgs/msg/{'CompressedImage' if compressed else 'Image'}"
            connection = bag.add_connection(topic, kind, typestore=types)
            for stamp in STAMPS_NS:
                header = types.types["std_msgs/msg/Header"](
                    stamp=types.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), frame_id="c"
                )
                image = image_of(stamp)
                if compressed:
                    data = np.asarray(cv2.imencode(f".{encoding}", image)[1]).reshape(-1)
                    message = types.types[kind](header=header, format=encoding, data=data)
                else:
                    rows = {
                        "mono8": image,
                        "mono16": (image.astype("<u2") << 8) + 7,
                        "rgb8": np.repeat(image[:, :, None], 3, axis=2),
                        "bayer_rggb8": image,
                    }[encoding]
                    raw = np.frombuffer(rows.tobytes(), np.uint8)
                    message = types.types[kind](header, 48, 64, encoding, 0, raw.size // 48, raw)
                bag.write(connection, stamp + 3 * MS, bytes(types.serialize_cdr(message, kind)))
    return path


@pytest.mark.parametrize(("left", "right"), [("mono8", "mono16"), ("rgb8", "png")])
@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_encodings_become_gray(tmp_path: Path, left: str, right: str, storage: StoragePlugin) -> None:
    path = written_bag(tmp_path / "bag", {"/cam0/image": left, "/cam1/image": right}, storage)
    recording = BagRecording(path, small_rig())
    for index in (2, 0):
        pair = recording.read(index)
        assert pair.captured_at_ns == STAMPS_NS[index]
        assert np.array_equal(pair.left.image, image_of(STAMPS_NS[index]))
        assert np.array_equal(pair.right.image, image_of(STAMPS_NS[index]))


def test_topics_that_names_do_not_tell_apart_are_asked_for(tmp_path: Path) -> None:
    path = written_bag(tmp_path / "bag", {"/a": "mono8", "/b": "mono8", "/c": "mono8"})
    with pytest.raises(RecordingError, match="--left and --right: its topics of images are /a, /b, /c"):
        BagRecording(path, small_rig())
    assert len(BagRecording(path, small_rig(), topics=("/c", "/a"))) == 4
    with pytest.raises(RecordingError, match="no two topics of images /c and /d"):
        BagRecording(path, small_rig(), topics=("/c", "/d"))


def test_an_encoding_that_is_not_gray_costs_its_pairs_with_the_reason(tmp_path: Path) -> None:
    path = written_bag(tmp_path / "bag", {"/left": "mono8", "/right": "bayer_rggb8"})
    copied = bags.write_recording(BagRecording(path, small_rig()), tmp_path / "ours.mcap", small_rig())
    assert copied.pairs == 0
    assert "the encoding 'bayer_rggb8' is none of" in copied.left_out[0]


def test_what_is_no_bag_or_lacks_a_rig_is_told(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="--rig"):
        BagRecording(tmp_path / "bag")
    broken = tmp_path / "broken.bag"
    broken.write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="cannot be read as a ROS bag"):
        BagRecording(broken, small_rig())


def test_nothing_is_overwritten(recording: AslRecording, tmp_path: Path) -> None:
    for write in (write_bag, write_asl):
        with pytest.raises(RecordingError, match="nothing is overwritten"):
            write(recording, tmp_path)
