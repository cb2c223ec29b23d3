"""Recordings as MCAP files: what is in them, writing one, reading its pairs, saving one that was cut off.

The profile is ROS 2's and every message CDR, so that `ros2 bag`, Foxglove and rosbags open the file as it is
(docs/decisions/recording-format.md). Log times are the cameras' own stamps.
"""

import json
import os
import struct
import time
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import IO, Any, cast

import lz4.frame
import mcap.writer
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from needletrack.errors import CalibrationError, RecordingError
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.reading import opened
from needletrack.recording.asl import ListedFrame, ListedPair, Loss, UnusablePair
from needletrack.records import Clock, DropReason, Frame, Image, Image16, Pixels, StampPlace, StereoPair
from needletrack.rig import Rig, rig_from_text, rig_text

PROFILE = "ros2"
ABOUT = "needletrack"
LEFT_TOPIC, RIGHT_TOPIC, TRACK_TOPIC = "/left/image_raw", "/right/image_raw", "/needletrack/track"
RIG_ATTACHMENT, CONFIG_ATTACHMENT = "rig.yaml", "config.json"
_IMAGE, _STRING = "sensor_msgs/msg/Image", "std_msgs/msg/String"

# One chunk is what a crash can cost: three pairs of 1280 x 1024. Smaller ones make the index grow.
_CHUNK_BYTES = 8 * 1024 * 1024
# The library compresses at zstd's level 3: 12 ms for an image of 1280 x 1024, for a tenth less than these 1.3 ms. Noise
# has no repetitions to look for: what is gained comes from coding the values by their frequency.
_ZSTD = zstandard.ZstdCompressionParameters(
    window_log=17,
    hash_log=12,
    chain_log=6,
    search_log=1,
    min_match=7,
    target_length=0,
    strategy=zstandard.STRATEGY_FAST,
    write_checksum=True,
)
_LIBRARY = f"needletrack {mcap.writer.LIBRARY_IDENTIFIER}"
# What `ros2 bag` wants to know; the usual sensor profile.
_QOS = """\
- history: 3
  depth: 0
  reliability: 1
  durability: 2
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


# The name of what is recorded before there is a rig.
UNCALIBRATED = "uncalibrated"
# What reading a file raises whose end is missing.
_CUT_OFF = (
    *(McapError, struct.error, ValueError, zstandard.ZstdError, KeyError),
    # Of one that lies about its lengths.
    *(OverflowError, MemoryError, RuntimeError, IndexError, TypeError, AttributeError),
)
# Of a chunk, once decompressed: a writer ends it after the picture that fills it.
_MOST_CHUNK_BYTES = 1 << 28
_GREATEST_STAMP = 2**63 - 1


@cache
def typestore() -> Typestore:
    """ROS 2's standard messages."""
    return get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True, slots=True)
class About:
    """What a file says of itself beside its frames; written once, at its beginning.

    config: the configuration as JSON, or "". clock, exposure_ns, stamp_at: of the first pair.
    """

    rig: Rig | None
    name: str
    run_id: str = ""
    config: str = ""
    clock: Clock = Clock.RECORDED
    exposure_ns: int | None = None
    stamp_at: StampPlace | None = None


class PairWriter:
    """Writes pairs and tracks into one new MCAP file; a chunk is in the kernel's hands as soon as it is full.

    pairs: added so far; kept: of those, the ones that the kernel has. Raises RecordingError where the file exists or
    cannot be made; what writing raises later is an OSError, after which nothing but `abandon` makes sense.
    """

    def __init__(self, path: Path, about: About) -> None:
        self.path, self._about = path, about
        self.pairs = self.kept = self._in_whole_chunks = 0
        try:
            self._file: IO[bytes] = path.open("xb")
        except FileExistsError as error:
            raise RecordingError(f"{path} exists already: name another file, nothing is overwritten") from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._writer = _fast_writer(self._file)
        self._writer.start(PROFILE, library=_LIBRARY)
        now_ns = time.time_ns()
        self._writer.add_metadata(ABOUT, _as_metadata(about))
        if about.rig is not None:
            self._attach(now_ns, RIG_ATTACHMENT, "application/yaml", rig_text(about.rig))
        if about.config:
            self._attach(now_ns, CONFIG_ATTACHMENT, "application/json", about.config)
        self._types = {name: self._schema(name) for name in (_IMAGE, _STRING)}
        self._channels = {
            topic: self._writer.register_channel(
                topic, "cdr", self._types[kind], metadata={"offered_qos_profiles": _QOS}
            )
            for topic, kind in ((LEFT_TOPIC, _IMAGE), (RIGHT_TOPIC, _IMAGE), (TRACK_TOPIC, _STRING))
        }
        self._file.flush()

    @property
    def bytes_written(self) -> int:
        """Bytes that are in the file so far."""
        size: int = self._file.tell()
        return size

    @property
    def descriptor(self) -> int:
        """The file's descriptor, for syncing it to the disk."""
        return self._file.fileno()

    def add_pair(self, sequence: int, left: Pixels, left_ns: int, right: Pixels, right_ns: int) -> None:
        """Add a pair's images (rows, columns) with their stamps."""
        for topic, image, stamp_ns in ((LEFT_TOPIC, left, left_ns), (RIGHT_TOPIC, right, right_ns)):
            frame_id = f"{self._about.name}_{'left' if topic == LEFT_TOPIC else 'right'}"
            data = image_cdr(image, stamp_ns, frame_id)
            self._add(topic, stamp_ns, data, sequence, pairs=self.pairs + (topic == RIGHT_TOPIC))
        self.pairs += 1
        self._file.flush()
        self.kept = self._in_whole_chunks

    def add_track(self, sequence: int, captured_at_ns: int, message: bytes) -> None:
        """Add the published message of a pair, as it was published."""
        text = typestore().types[_STRING](data=message.decode())
        data = bytes(typestore().serialize_cdr(text, _STRING))
        self._add(TRACK_TOPIC, captured_at_ns, data, sequence, pairs=self.pairs)

    def _add(self, topic: str, stamp_ns: int, data: bytes, sequence: int, pairs: int) -> None:
        """Add a message, with which so many pairs are whole; one that ends a chunk gives it to the file."""
        before = self._file.tell()
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, sequence & 0xFFFFFFFF)
        if self._file.tell() > before:
            self._in_whole_chunks = pairs

    def flush(self) -> None:
        """Give the kernel what is in the unfinished chunk."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.flush()
        self.kept = self._in_whole_chunks = self.pairs

    def finish(self) -> None:
        """Write the index and close."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fdatasync(self._file.fileno())
        self._file.close()
        self.kept = self.pairs

    def abandon(self) -> None:
        """Close without an index, after an error: `recover` reads what is there."""
        with suppress(OSError):
            self._file.close()

    def _attach(self, now_ns: int, name: str, media_type: str, text: str) -> None:
        self._writer.add_attachment(now_ns, now_ns, name, media_type, text.encode())

    def _schema(self, name: str) -> int:
        definition, _ = typestore().generate_msgdef(name, ros_version=2)
        number: int = self._writer.register_schema(name, "ros2msg", definition.encode())
        return number


def image_cdr(image: Pixels, stamp_ns: int, frame_id: str) -> bytes:
    """A sensor_msgs/Image of a gray picture, serialized: mono8 or mono16."""
    types = typestore().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    height, width = image.shape
    message = types[_IMAGE](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds), frame_id=frame_id
        ),
        height=height,
        width=width,
        encoding="mono8" if image.dtype == np.uint8 else "mono16",
        is_bigendian=0,
        step=width * image.itemsize,
        data=np.ascontiguousarray(image).reshape(-1).view(np.uint8),
    )
    # A view, which to the library is as good as bytes: a copy less of the image.
    return cast(bytes, memoryview(typestore().serialize_cdr(message, _IMAGE)).cast("B"))


def gray16(rows: Image, message: Any) -> Image16:
    """The picture of a mono16 message, whose rows of bytes these are."""
    words = np.ascontiguousarray(rows[:, : 2 * message.width]).view(">u2" if message.is_bigendian else "<u2")
    return words.astype(np.uint16, copy=False)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a message lies: which chunk, at which byte of it once decompressed."""

    chunk: int
    offset: int
    stamp_ns: int


class McapRecording:
    """The pairs of a recording of ours, in the order of their stamps, read one at a time.

    rig: the rig to use, or None for the one in the file. without_rig: where there is none, go on with one that knows
    the images' size and nothing else (`has_rig` is then False). Raises RecordingError where the file is no whole
    recording of ours; CalibrationError where there is no rig.
    """

    _CHUNKS_KEPT = 3

    def __init__(self, path: Path | str, rig: Rig | None = None, *, without_rig: bool = False) -> None:
        self.folder = Path(path)
        self._lock = Lock()
        self._cached: OrderedDict[int, bytes] = OrderedDict()
        try:
            self._file = opened(self.folder)
        except OSError as error:
            raise RecordingError(f"{self.folder}: cannot be read: {error.strerror or error}") from error
        self._close_file = weakref.finalize(self, self._file.close)
        self.about, places, self._chunks = self._indexed()
        left, right = places[LEFT_TOPIC], places[RIGHT_TOPIC]
        if not left or not right:
            raise RecordingError(f"{self.folder}: the recording holds no pair")
        known = rig or self.about.rig
        self.has_rig = known is not None
        if known is None and not without_rig:
            raise CalibrationError(f"{self.folder}: the recording holds no rig: name one with --rig")
        self.rig = known or size_only_rig(self._size_px(left[0]), self.about.name)
        # Pairs are written whole, left before right: only the last can lack its right image.
        self._places = list(zip(left, right, strict=False))
        self.pairs = tuple(
            ListedPair(ListedFrame(self.folder, l.stamp_ns), ListedFrame(self.folder, r.stamp_ns))
            for l, r in self._places
        )
        self._tracks = places[TRACK_TOPIC]
        lost = len(left) - len(self._places)
        frame = Loss(DropReason.UNPAIRED_LEFT, self.folder, "the recording ends before its partner", len(self.pairs))
        self.losses = (frame,) * lost
        self._check_size()

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def first_stamp_ns(self) -> int:
        """The left stamp of the first pair."""
        return self.pairs[0].left.stamp_ns

    @property
    def last_stamp_ns(self) -> int:
        """The left stamp of the last pair."""
        return self.pairs[-1].left.stamp_ns

    def read(self, index: int) -> StereoPair:
        """The pair at an index, which is its sequence number; raises UnusablePair."""
        left, right = self._places[index]
        images = self._image(left, index), self._image(right, index)
        frames = Frame.of(images[0], left.stamp_ns), Frame.of(images[1], right.stamp_ns)
        about = self.about
        return StereoPair(
            *frames, sequence=index, clock=Clock.RECORDED, exposure_ns=about.exposure_ns, stamp_at=about.stamp_at
        )

    def tracks(self) -> list[tuple[int, bytes]]:
        """(stamp of the pair, ns; message) of all that was published while it was recorded, as it was."""
        found = []
        for place in self._tracks:
            message: Any = typestore().deserialize_cdr(self._message(place), _STRING)
            found.append((place.stamp_ns, str(message.data).encode()))
        return found

    def close(self) -> None:
        """Close the file; done by itself when nobody has the recording any more."""
        self._close_file()

    def _image(self, place: _Place, index: int) -> Pixels:
        try:
            message: Any = typestore().deserialize_cdr(self._message(place), _IMAGE)
            rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
            is_16 = message.encoding == "mono16"
            image: Pixels = gray16(rows, message) if is_16 else rows[:, : message.width]
        except _CUT_OFF as error:
            reasons = (DropReason.UNREADABLE_IMAGE, DropReason.UNPAIRED_LEFT)
            losses = tuple(Loss(reason, self.folder, f"pair {index}: {error}", index) for reason in reasons)
            raise UnusablePair(losses) from error
        image.flags.writeable = False
        return image

    def _message(self, place: _Place) -> bytes:
        data = self._chunk(place.chunk)
        length = int.from_bytes(data[place.offset + 1 : place.offset + 9], "little")
        # Channel, sequence and two times come before the payload.
        return data[place.offset + 9 + 22 : place.offset + 9 + length]

    def _chunk(self, number: int) -> bytes:
        with self._lock:  # read by a thread that decodes ahead
            if number in self._cached:
                self._cached.move_to_end(number)
                return self._cached[number]
            self._file.seek(self._chunks[number].chunk_start_offset + 9)
            chunk = Chunk.read(ReadDataStream(self._file))
            self._cached[number] = _content(chunk)
            while len(self._cached) > self._CHUNKS_KEPT:
                self._cached.popitem(last=False)
            return self._cached[number]

    def _indexed(self) -> tuple[About, dict[str, list[_Place]], list[ChunkIndex]]:
        try:
            reader = make_reader(self._file)
            summary = reader.get_summary()
            if summary is None:
                raise RecordingError(_cut_off(self.folder))
            abouts = [record.metadata for record in reader.iter_metadata() if record.name == ABOUT]
            attachments = {record.name: record.data for record in reader.iter_attachments()}
            topics = {channel_id: channel.topic for channel_id, channel in summary.channels.items()}
            chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
            places = self._places_in(chunks, topics)
        except (OSError, *_CUT_OFF) as error:
            if not self.folder.stat().st_size:
                raise RecordingError(f"{self.folder}: the file is empty") from error
            raise RecordingError(_cut_off(self.folder)) from error
        if not abouts:
            raise RecordingError(
                f"{self.folder}: an MCAP file, but no recording of needletrack's: `needletrack import`"
            )
        try:
            return _about(self.folder, abouts[0], attachments), places, chunks
        except (RecursionError, *_CUT_OFF) as error:
            raise RecordingError(
                f"{self.folder}: what the file says of itself cannot be read ({error}): record it anew, or "
                "`needletrack export` the pictures of another copy"
            ) from error

    def _places_in(self, chunks: list[ChunkIndex], topics: Mapping[int, str]) -> dict[str, list[_Place]]:
        places: dict[str, list[_Place]] = {LEFT_TOPIC: [], RIGHT_TOPIC: [], TRACK_TOPIC: []}
        for number, chunk in enumerate(chunks):
            for channel_id, offset in chunk.message_index_offsets.items():
                if topics[channel_id] not in places:
                    continue
                self._file.seek(offset + 9)
                entries = MessageIndex.read(ReadDataStream(self._file)).records
                if any(stamp > _GREATEST_STAMP for stamp, _ in entries):
                    raise ValueError("a stamp that no clock has")
                places[topics[channel_id]] += [_Place(number, at, stamp) for stamp, at in entries]
        return places

    def _check_size(self) -> None:
        width, height = self._size_px(self._places[0][0])
        if (width, height) != self.rig.left.size_px:
            wanted = "x".join(map(str, self.rig.left.size_px))
            raise RecordingError(
                f"{self.folder}: the images are {width}x{height}, rig {self.rig.name} has {wanted}: "
                "the rig belongs to other cameras"
            )

    def _size_px(self, place: _Place) -> tuple[int, int]:
        try:
            message: Any = typestore().deserialize_cdr(self._message(place), _IMAGE)
        except _CUT_OFF as error:
            raise RecordingError(f"{self.folder}: its first image cannot be read: {error}") from error
        return int(message.width), int(message.height)


@dataclass(frozen=True, slots=True)
class Recovered:
    """What `recover` saved: pairs and tracks; lost_bytes at the end of the old file that held nothing whole."""

    pairs: int
    tracks: int
    lost_bytes: int


def recover(damaged: Path, output: Path) -> Recovered:
    """Copy all that is whole of a recording that was cut off into a new file with an index.

    Raises RecordingError where the file is no MCAP file, holds no message, or the output exists.
    """
    if output.exists():
        raise RecordingError(f"{output} exists already: name another file, nothing is overwritten")
    try:
        source = opened(damaged)
    except OSError as error:
        raise RecordingError(f"{damaged}: cannot be read: {error.strerror or error}") from error
    with source, output.open("xb") as file:
        copy = _Copy(_fast_writer(file))
        whole_until = 0
        try:
            for record in _Records(source, emit_chunks=True, validate_crcs=True).records:
                copy.add(record)
                whole_until = source.tell()
            # The end's own mark.
            whole_until = source.tell()
        except _CUT_OFF:
            pass  # here it was
        copy.finish()
        lost = damaged.stat().st_size - whole_until
    if not copy.counts:
        output.unlink()
        raise RecordingError(f"{damaged}: nothing in it could be read: no MCAP file, or cut off before its first pair")
    pairs = min(copy.counts.get(LEFT_TOPIC, 0), copy.counts.get(RIGHT_TOPIC, 0))
    return Recovered(pairs, copy.counts.get(TRACK_TOPIC, 0), lost)


class _Records(StreamReader):
    """Records up to the first that was never written: a file system may leave zeros there after a power cut.

    The library takes nine zeros for a record of no kind and no length, and reads on: an hour for 10 GB.
    """

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == 0:
            raise McapError("zeros in place of a record")
        return super()._read_record(opcode, length)


class _Copy:
    """Hands the records of one file to the writer of another."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._started = False
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, tuple[int, str]] = {}
        self.counts: dict[str, int] = {}

    def add(self, record: object) -> None:
        if not self._started:
            self._writer.start(PROFILE, library=_LIBRARY)
            self._started = True
        if isinstance(record, Chunk):
            content = _content(record)
            stream = ReadDataStream(BytesIO(content))
            while stream.count < len(content):
                opcode, size = stream.read1(), stream.read8()
                self._add_inner(opcode, size, stream)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)

    def finish(self) -> None:
        if self._started:
            self._writer.finish()  # type: ignore[no-untyped-call]

    def _add_inner(self, opcode: int, size: int, stream: ReadDataStream) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            if schema.id not in self._schemas:
                self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            if channel.id not in self._channels:
                new = self._writer.register_channel(
                    channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
                )
                self._channels[channel.id] = new, channel.topic
        elif opcode == Opcode.MESSAGE:
            message = Message.read(stream, size)
            new, topic = self._channels[message.channel_id]
            self._writer.add_message(new, message.log_time, message.data, message.publish_time, message.sequence)
            self.counts[topic] = self.counts.get(topic, 0) + 1
        else:
            stream.read(size)


def _fast_writer(file: IO[bytes]) -> Writer:
    # The library has no setting for the level. Its module is asked for nothing else.
    mcap.writer.zstandard = SimpleNamespace(  # type: ignore[attr-defined, assignment]
        compress=zstandard.ZstdCompressor(compression_params=_ZSTD).compress
    )
    # The compressed data carry a checksum of their own.
    return Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_crcs=False)


def unpacked_zstd(data: bytes) -> bytes:
    """What a zstd frame holds; ValueError where it claims more than a quarter of a gigabyte, or is damaged."""
    size = zstandard.frame_content_size(data)
    if size > _MOST_CHUNK_BYTES:
        raise ValueError(f"a part claims to hold {size / 1e9:.1f} GB")
    try:
        return unpacked_by(zstandard.ZstdDecompressor(), data) if size < 0 else zstandard.decompress(data)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def unpacked_by(decompressor: Any, data: bytes) -> bytes:
    """What a decompressor of bz2, lz4 or zstandard makes of data; ValueError above a quarter of a gigabyte."""
    if isinstance(decompressor, zstandard.ZstdDecompressor):
        with decompressor.stream_reader(data) as reader:
            content, whole = reader.read(_MOST_CHUNK_BYTES), not reader.read(1)
    else:
        content = decompressor.decompress(data, _MOST_CHUNK_BYTES)
        whole = decompressor.eof
    if not whole:
        raise ValueError(f"a part is cut off, or holds more than {_MOST_CHUNK_BYTES >> 20} MB")
    return bytes(content)


def _content(chunk: Chunk) -> bytes:
    """What a chunk holds, its checksum compared; raises one of _CUT_OFF."""
    if chunk.uncompressed_size > _MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk claims to hold {chunk.uncompressed_size / 1e9:.1f} GB")
    if chunk.compression == "zstd":
        data = unpacked_zstd(chunk.data)
    elif chunk.compression == "lz4":
        data = unpacked_by(lz4.frame.LZ4FrameDecompressor(), chunk.data)
    else:
        data = chunk.data
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk holds {len(data)} bytes and claims {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def is_recording(path: Path) -> bool:
    """Whether a file is a recording of ours, whole or cut off; by its beginning."""
    try:
        with opened(path) as file:
            for number, record in enumerate(StreamReader(BytesIO(file.read(1 << 20)), emit_chunks=True).records):
                if isinstance(record, Metadata):
                    return record.name == ABOUT
                if number > 1:
                    return False
    except (OSError, *_CUT_OFF):
        return False  # not even that much of an MCAP file
    return False


def _cut_off(path: Path) -> str:
    return (
        f"{path}: the file has no end: it was cut off, or is still being written; "
        f"`needletrack recover {path} {path.stem}-recovered.mcap` saves what is in it"
    )


def _as_metadata(about: About) -> dict[str, str]:
    values = {
        "version": 1,
        "name": about.name,
        "run_id": about.run_id,
        "clock": about.clock.value,
        "exposure_ns": about.exposure_ns,
        "stamp_at": None if about.stamp_at is None else about.stamp_at.value,
    }
    return {key: json.dumps(value) for key, value in values.items()}


def _about(path: Path, metadata: Mapping[str, str], attachments: Mapping[str, bytes]) -> About:
    values = {key: json.loads(value) for key, value in metadata.items()}
    rig = attachments.get(RIG_ATTACHMENT)
    exposure_ns = values["exposure_ns"]
    return About(
        rig=None if rig is None else rig_from_text(rig.decode(), path / RIG_ATTACHMENT),
        name=str(values["name"]),
        run_id=str(values["run_id"]),
        config=attachments.get(CONFIG_ATTACHMENT, b"").decode(),
        clock=Clock(values["clock"]),
        exposure_ns=None if exposure_ns is None else int(exposure_ns),
        stamp_at=None if values["stamp_at"] is None else StampPlace(values["stamp_at"]),
    )


def size_only_rig(size_px: tuple[int, int], name: str) -> Rig:
    """A rig that knows its images' size (width, height), for what is recorded before there is a calibration."""
    width, height = size_px
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    camera = Camera(matrix, np.zeros(4), size_px)
    return Rig(camera, camera, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])), name)
