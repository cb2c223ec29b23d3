"""ROS bags with two image topics: read as a recording, made one of ours, and written from one."""

import bz2
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import Any

import cv2
import lz4.frame
import numpy as np
import rosbags.rosbag1.reader
import rosbags.rosbag2.reader
import rosbags.rosbag2.storage_mcap
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from needletrack.errors import CalibrationError, NeedletrackError, RecordingError
from needletrack.reading import opened, picture, text_of, yaml_document
from needletrack.recording.asl import ListedFrame, ListedPair, Loss, UnusablePair
from needletrack.recording.mcap_file import (
    LEFT_TOPIC,
    RIGHT_TOPIC,
    UNCALIBRATED,
    About,
    PairWriter,
    gray16,
    image_cdr,
    size_only_rig,
    typestore,
    unpacked_by,
    unpacked_zstd,
)
from needletrack.recording.pairing import in_order, pair_by_stamp
from needletrack.recording.png import as_gray
from needletrack.recording.replay import Copied, StoredRecording
from needletrack.records import Clock, DropReason, Frame, Pixels, StereoPair
from needletrack.rig import Rig

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_WORDS = (("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("infra1", "infra2"))
_BITS_16 = {"mono16", "16UC1"}
_TO_GRAY = {
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgr8": cv2.COLOR_BGR2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
}
_GRAY = {"mono8", "8UC1"}
_GREATEST_STAMP = 2**63 - 1
_METADATA = "metadata.yaml"


@dataclass(frozen=True, slots=True)
class _Stored:
    """An image of the bag: its header's stamp, and when it was recorded, by which it is found."""

    stamp_ns: int
    recorded_ns: int


class BagRecording:
    """The pairs of a ROS 1 or ROS 2 bag with two topics of images (raw or compressed), by their headers' stamps.

    topics: left and right; None where the names tell them apart. without_rig: where none is named, go on with one that
    knows the images' size and nothing else. The whole bag is read once for its stamps. Raises
    RecordingError where it is no bag, or its topics are not two; CalibrationError without a rig.
    """

    def __init__(
        self,
        path: Path | str,
        rig: Rig | None = None,
        *,
        tolerance_us: float = 1000.0,
        topics: tuple[str, str] | None = None,
        without_rig: bool = False,
    ) -> None:
        self.folder = Path(path)
        if rig is None and not without_rig:
            raise CalibrationError(f"{self.folder}: a bag holds no rig: name one with --rig")
        # Board pictures are read by several threads; the reader is one file with one place in it.
        self._lock = Lock()
        with _refused(self.folder):
            self._reader = _opened(self.folder)
            self._close_reader = weakref.finalize(self, self._reader.close)
            self._topics = _two_topics(self.folder, self._reader, topics)
            stored = [self._stamps(connection) for connection in self._topics]
        ordered = [[frames[i] for i in in_order([frame.stamp_ns for frame in frames])] for frames in stored]
        left, right = ([frame.stamp_ns for frame in frames] for frames in ordered)
        near = pair_by_stamp(left, right, round(tolerance_us * 1000))
        if not near:
            raise RecordingError(
                f"{self.folder}: no image of {self._topics[0].topic} has one of {self._topics[1].topic} within "
                f"{tolerance_us:g} us: see pairing.tolerance_us"
            )
        self._stored = [(ordered[0][i], ordered[1][j]) for i, j in near]
        self.rig = rig or size_only_rig(self._first_size_px(), UNCALIBRATED)
        self.pairs: Sequence[ListedPair] = tuple(
            ListedPair(ListedFrame(self.folder, l.stamp_ns), ListedFrame(self.folder, r.stamp_ns))
            for l, r in self._stored
        )
        self.losses: Sequence[Loss] = [
            Loss(reason, self.folder, "it is in no pair", len(self.pairs))
            for reason, frames in zip((DropReason.UNPAIRED_LEFT, DropReason.UNPAIRED_RIGHT), stored, strict=True)
            for _ in range(len(frames) - len(near))
        ]

    def __len__(self) -> int:
        return len(self.pairs)

    def read(self, index: int) -> StereoPair:
        """The pair at an index, which is its sequence number; raises UnusablePair."""
        images: list[Pixels] = []
        losses: list[Loss] = []
        size_px = self.rig.left.size_px
        sides = zip(
            self._topics, self._stored[index], (DropReason.UNPAIRED_LEFT, DropReason.UNPAIRED_RIGHT), strict=True
        )
        for connection, stored, unpaired in sides:
            try:
                with _refused(self.folder):
                    image = _gray(self._message(connection, stored))
            except RecordingError as error:
                losses.append(Loss(DropReason.UNREADABLE_IMAGE, self.folder, f"pair {index}: {error.__cause__}", index))
                continue
            if image.shape != size_px[::-1]:
                fault = f"pair {index}: the image is {image.shape[1]}x{image.shape[0]}, the rig says {size_px}"
                losses.append(Loss(DropReason.WRONG_SIZE, self.folder, fault, index))
                continue
            losses.append(Loss(unpaired, self.folder, "its partner is lost", index))
            images.append(image)
        if len(images) < 2:
            raise UnusablePair(tuple(losses))
        left, right = self._stored[index]
        frames = Frame.of(images[0], left.stamp_ns), Frame.of(images[1], right.stamp_ns)
        return StereoPair(*frames, sequence=index, clock=Clock.RECORDED)

    def close(self) -> None:
        """Close the bag; done by itself when nobody has the recording any more."""
        self._close_reader()

    def _stamps(self, connection: Connection) -> list[_Stored]:
        found = []
        for _, recorded_ns, raw in self._reader.messages([connection]):
            stamp_ns = _stamp_ns(self._deserialized(connection, raw))
            if not 0 <= stamp_ns <= _GREATEST_STAMP:
                raise ValueError(f"a stamp of {stamp_ns} ns in {connection.topic}")
            found.append(_Stored(stamp_ns, recorded_ns))
        return found

    def _first_size_px(self) -> tuple[int, int]:
        try:
            with _refused(self.folder):
                height, width = _gray(self._message(self._topics[0], self._stored[0][0])).shape
        except RecordingError as error:
            raise RecordingError(f"{self.folder}: its first image cannot be read: {error.__cause__}") from error
        return width, height

    def _message(self, connection: Connection, stored: _Stored) -> Any:
        at = stored.recorded_ns
        with self._lock:
            for _, _, raw in self._reader.messages([connection], start=at, stop=at + 1):
                message = self._deserialized(connection, raw)
                if _stamp_ns(message) == stored.stamp_ns:
                    return message
        raise ValueError("the image is not there any more")

    def _deserialized(self, connection: Connection, raw: bytes) -> Any:
        # By ROS's own definition of the type, not by the one in the bag, which may call a stamp's seconds a text.
        if self._reader.is2:
            return typestore().deserialize_cdr(raw, connection.msgtype)
        return _ros1().deserialize_ros1(raw, connection.msgtype)


@cache
def _ros1() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Whatever a damaged bag makes its reader say becomes a RecordingError, whose cause it is."""
    try:
        yield
    except NeedletrackError:
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise RecordingError(f"{path}: cannot be read as a ROS bag: {told}") from error


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS bag: a ROS 1 file, a ROS 2 folder or file."""
    return path.suffix in (".bag", ".db3", ".mcap") or (path / _METADATA).is_file()


def write_recording(
    recording: StoredRecording, output: Path, rig: Rig | None, progress: Callable[[int], None] = lambda done: None
) -> Copied:
    """Any recording as one of ours, stamps unchanged; raises RecordingError where it cannot be written."""
    name = (rig or recording.rig).name
    about = About(rig=rig, name=name, clock=Clock.RECORDED)
    writer = PairWriter(output, about)
    left_out = []
    try:
        for index in range(len(recording)):
            try:
                pair = recording.read(index)
            except UnusablePair as error:
                left_out.append(str(error))
                continue
            stamps = pair.left.captured_at_ns, pair.right.captured_at_ns
            writer.add_pair(index, pair.left.pixels, stamps[0], pair.right.pixels, stamps[1])
            progress(index + 1)
        writer.finish()
    except OSError as error:
        writer.abandon()
        raise RecordingError(f"{output}: cannot be written: {error.strerror or error}") from error
    return Copied(output, writer.pairs, tuple(left_out))


def write_bag(
    recording: StoredRecording, output: Path, *, with_rig: bool = True, tracks: Sequence[tuple[int, bytes]] = ()
) -> Copied:
    """A ROS 2 bag (a folder, MCAP inside) with /left and /right image_raw and camera_info, and the tracks as strings.

    tracks: (stamp ns, message) each. Raises RecordingError where it exists or cannot be written.
    """
    if output.exists():
        raise RecordingError(f"{output} exists already: name another folder, nothing is overwritten")
    types, left_out, count = typestore(), [], 0
    rig = recording.rig
    try:
        with BagWriter(output, version=9, storage_plugin=StoragePlugin.MCAP) as bag:

            def topic(name: str, kind: str) -> Connection:
                return bag.add_connection(name, kind, typestore=types)

            images = topic(LEFT_TOPIC, _IMAGES[0]), topic(RIGHT_TOPIC, _IMAGES[0])
            infos = [topic(f"/{side}/camera_info", _CAMERA_INFO) for side in ("left", "right") if with_rig]
            for index in range(len(recording)):
                try:
                    pair = recording.read(index)
                except UnusablePair as error:
                    left_out.append(str(error))
                    continue
                for number, frame in enumerate((pair.left, pair.right)):
                    frame_id = f"{rig.name}_{('left', 'right')[number]}"
                    at = frame.captured_at_ns
                    bag.write(images[number], at, bytes(image_cdr(frame.pixels, at, frame_id)))
                    if with_rig:
                        bag.write(infos[number], at, _camera_info(rig, number, at, frame_id))
                count += 1
            if tracks:
                strings = topic("/needletrack/track", "std_msgs/msg/String")
                for at, message in tracks:
                    text = types.types["std_msgs/msg/String"](data=message.decode())
                    bag.write(strings, at, bytes(types.serialize_cdr(text, "std_msgs/msg/String")))
    except OSError as error:
        raise RecordingError(f"{output}: cannot be written: {error.strerror or error}") from error
    return Copied(output, count, tuple(left_out))


def _camera_info(rig: Rig, number: int, stamp_ns: int, frame_id: str) -> bytes:
    types = typestore()
    camera = (rig.left, rig.right)[number]
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    # Unrectified images: R is the identity, P holds the intrinsics alone.
    projection = np.column_stack([camera.matrix, np.zeros(3)])
    info = types.types[_CAMERA_INFO](
        header=types.types["std_msgs/msg/Header"](
            stamp=types.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds), frame_id=frame_id
        ),
        height=camera.size_px[1],
        width=camera.size_px[0],
        distortion_model="rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob",
        d=np.asarray(camera.distortion, np.float64),
        k=camera.matrix.reshape(-1).astype(np.float64),
        r=np.eye(3).reshape(-1),
        p=projection.reshape(-1).astype(np.float64),
        binning_x=0,
        binning_y=0,
        roi=types.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )
    return bytes(types.serialize_cdr(info, _CAMERA_INFO))


def _opened(path: Path) -> AnyReader:
    if not path.exists():
        raise RecordingError(f"{path}: there is no such recording")
    _require_plain(path)
    reader = AnyReader([path], default_typestore=typestore())
    reader.open()
    return reader


def _require_plain(path: Path) -> None:
    """Refuse what would make the reader wait (a FIFO) or multiply (aliases in metadata.yaml)."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        try:
            if not file.is_dir():
                opened(file).close()
            if file.name == _METADATA:
                yaml_document(text_of(file))
        except OSError as error:
            raise RecordingError(f"{file}: cannot be read: {error.strerror or error}") from error
        except ValueError as error:
            raise RecordingError(f"{file}: not the metadata of a bag: {error}") from error


def _bound_decompression() -> None:
    """Let no chunk or message of a bag grow beyond what a few pictures take: the library sets no limit."""

    def unpacked_lz4(data: bytes) -> bytes:
        return unpacked_by(lz4.frame.LZ4FrameDecompressor(), data)

    mcap_formats = rosbags.rosbag2.storage_mcap.DECOMPRESSORS
    mcap_formats["zstd"] = lambda data, size: unpacked_zstd(data)
    mcap_formats["lz4"] = lambda data, size: unpacked_lz4(data)
    bag1_formats = rosbags.rosbag1.reader.decompressors
    bag1_formats["bz2"] = lambda data: unpacked_by(bz2.BZ2Decompressor(), data)
    bag1_formats["lz4"] = unpacked_lz4
    # A bag that is compressed as a whole goes to a temporary file, not to memory.
    whole_files = rosbags.rosbag2.reader.zstd.open  # type: ignore[attr-defined]
    rosbags.rosbag2.reader.zstd = SimpleNamespace(  # type: ignore[attr-defined, assignment]
        decompress=unpacked_zstd, open=whole_files
    )


_bound_decompression()


def _two_topics(path: Path, reader: AnyReader, topics: tuple[str, str] | None) -> tuple[Connection, Connection]:
    images = {each.topic: each for each in reader.connections if each.msgtype in _IMAGES}
    here = f"its topics of images are {', '.join(sorted(images)) or 'none'}"
    if topics is not None:
        missing = [topic for topic in topics if topic not in images]
        if missing or topics[0] == topics[1]:
            raise RecordingError(f"{path}: no two topics of images {' and '.join(topics)}: {here}")
        return images[topics[0]], images[topics[1]]
    raw = [name for name, each in images.items() if each.msgtype == _IMAGES[0]]
    for names in (raw, list(images)):
        for left_word, right_word in _WORDS:
            left = [name for name in names if left_word in name]
            right = [name for name in names if right_word in name]
            if len(left) == len(right) == 1 and left != right:
                return images[left[0]], images[right[0]]
    raise RecordingError(f"{path}: which topics are left and right? Say it with --left and --right: {here}")


def _gray(message: Any) -> Pixels:
    """The picture of a message as gray (rows, columns), read-only; ValueError where it cannot be decoded."""
    if not hasattr(message, "encoding"):
        return as_gray(picture(message.data))
    pixels = _raw(message)
    if message.encoding in _TO_GRAY:
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels), _TO_GRAY[message.encoding])
    image: Pixels = np.array(pixels)
    image.flags.writeable = False
    return image


def _raw(message: Any) -> Any:
    encoding = message.encoding
    if encoding not in _GRAY | _BITS_16 | _TO_GRAY.keys():
        raise ValueError(
            f"the encoding {encoding!r} is none of {', '.join(sorted(_GRAY | _BITS_16 | _TO_GRAY.keys()))}"
        )
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    if encoding in _GRAY:
        return rows[:, : message.width]
    if encoding in _BITS_16:
        return gray16(rows, message)
    channels = 4 if "a8" in encoding else 3
    return rows[:, : channels * message.width].reshape(message.height, message.width, channels)
