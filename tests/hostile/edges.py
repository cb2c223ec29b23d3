"""Every edge at which a file or message of somebody else comes in, with a valid one to begin from."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore
from tests.recording.small_recording import SIZE_PX, image_of, small_rig, write_recording

from needletrack.capture.pixels import Layout, decoded
from needletrack.client import StatusMessage, TrackMessage
from needletrack.config import load_config
from needletrack.errors import NeedletrackError, PublishError, RecordingError
from needletrack.formats.exchange import export_rig, import_rig
from needletrack.publish.message import RunContext, ServiceState, Source, WireCalibration
from needletrack.recording.bag import write_bag
from needletrack.recording.board import open_board_pictures
from needletrack.recording.mcap_file import About, PairWriter, recover
from needletrack.recording.png import read_gray
from needletrack.recording.registration import PointPairs, read_pairs, registered
from needletrack.recording.replay import StoredRecording
from needletrack.recording.stored import open_pictures, open_stored
from needletrack.records import Clock, Frame, StereoPair
from needletrack.replay import rig_at
from needletrack.rig import CalibrationInfo, CalibrationUncertainty, rig_text
from needletrack.scoring import recorded_truth

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT / "tests" / "data" / "recordings"
STAMPS_NS = (1_000_000_000, 1_020_000_000, 1_040_000_000)


@dataclass(frozen=True)
class Edge:
    """A kind of file: its name in a folder, the content of valid ones, and what opens it and reads it to its end.

    beside: makes what else the folder must hold. dictionary: words of the format that mean something.
    """

    name: str
    file: str
    made: Callable[[], tuple[bytes, ...]]
    read: Callable[[Path], object]
    beside: Callable[[Path], None] = lambda folder: None
    dictionary: tuple[bytes, ...] = ()

    def valid(self) -> tuple[bytes, ...]:
        """The contents of valid files, made once."""
        return _made_once(self)

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A folder with all but the file itself."""
        with TemporaryDirectory(prefix="needletrack-hostile-", dir=_memory()) as name:
            self.beside(Path(name))
            yield Path(name)

    def refusal(self, folder: Path, content: bytes) -> str | None:
        """What the edge says to a content; None where it takes it. Any other exception than ours is a defect."""
        path = folder / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return self.refusal_of(path)

    def refusal_of(self, path: Path) -> str | None:
        """The same of what lies there already."""
        try:
            self.read(path)
        except NeedletrackError as error:
            return str(error)
        return None


@cache
def _made_once(edge: Edge) -> tuple[bytes, ...]:
    return edge.made()


def _memory() -> str | None:
    """A folder in memory, where there is one: hundreds of files a second."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _made(write: Callable[[Path], object], *names: str) -> tuple[bytes, ...]:
    """The content of files that a function writes into a folder."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        return tuple((folder / each).read_bytes() for each in names)


@cache
def _rig_yaml() -> tuple[bytes, ...]:
    """A rig with all that its file can hold, and one with nothing but the cameras."""
    plain = small_rig()
    size = 2 * (4 + len(plain.left.distortion)) + 6
    stated = CalibrationUncertainty(
        corner_sigma_px=0.05, covariance=CalibrationUncertainty.rows(np.eye(size) * 1e-6), before_alignment_mm=0.1
    )
    certain = replace(plain, calibration=CalibrationInfo(method="test", views=3, uncertainty=stated))
    points = np.array([[0.0, 0, 300], [50, 0, 310], [0, 50, 320], [40, 40, 250]])
    full, _ = registered(
        certain, PointPairs(points, points + 5.0, None), "robot_base", datetime(2026, 5, 1, tzinfo=UTC)
    )
    return rig_text(full).encode(), rig_text(plain).encode()


@cache
def _exported(kind: Any, *names: str) -> tuple[bytes, ...]:
    return _made(lambda folder: export_rig(small_rig(), kind, folder / names[0] if len(names) == 1 else folder), *names)


def _left_only(kind: Any, names: tuple[str, str]) -> Callable[[Path], None]:
    def beside(folder: Path) -> None:
        (folder / names[1]).write_bytes(_exported(kind, *names)[1])

    return beside


def _asl_beside(folder: Path) -> None:
    write_recording(folder / "recording", STAMPS_NS)


def _every_pair(recording: StoredRecording) -> None:
    """Read every pair; one that cannot be used is an error of ours, after which the next ones are read all the same."""
    refused: NeedletrackError | None = None
    for index in range(len(recording)):
        try:
            pair = recording.read(index)
            assert pair.left.image.shape == pair.right.image.shape
        except NeedletrackError as error:
            refused = error
    if refused is not None:
        raise refused


def _read_recording(path: Path) -> None:
    _every_pair(open_stored(path, small_rig()))


def _read_recording_as_it_is(path: Path) -> None:
    """With the rig that is in it, its tracks, its pictures without a rig, and what can be saved of it."""
    refused: list[str] = []
    saved = path.with_name("saved.mcap")

    def tracks() -> None:
        stored: Any = open_stored(path)
        if hasattr(stored, "tracks"):
            stored.tracks()

    for read in (
        lambda: _every_pair(open_stored(path)),
        tracks,
        lambda: _every_pair(open_pictures(path)),
        lambda: recover(path, saved),
    ):
        try:
            read()
        except NeedletrackError as error:
            refused.append(str(error))
        finally:
            saved.unlink(missing_ok=True)
    if refused:
        raise RecordingError("; ".join(refused))


def _mcap() -> tuple[bytes, ...]:
    def write(folder: Path) -> None:
        writer = PairWriter(folder / "a.mcap", About(small_rig(), "small", "run", "{}", Clock.MONOTONIC, 5_000_000))
        for number, stamp in enumerate(STAMPS_NS):
            writer.add_pair(number, image_of(stamp), stamp, image_of(stamp + 1), stamp + 1)
            writer.add_track(number, stamp, _track_json())
        writer.finish()

    return _made(write, "a.mcap")


class _Pairs:
    """Three pairs in memory."""

    folder = Path("memory")
    rig = small_rig()
    pairs = ()
    losses = ()

    def __len__(self) -> int:
        return len(STAMPS_NS)

    def read(self, index: int) -> StereoPair:
        stamp = STAMPS_NS[index]
        return StereoPair(Frame(image_of(stamp), stamp), Frame(image_of(stamp + 1), stamp + 1), index)


def _bag2_mcap() -> tuple[bytes, ...]:
    return _made(lambda folder: write_bag(_Pairs(), folder / "bag"), "bag/bag.mcap")


def _bag2_sqlite(folder: Path) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE)
    from needletrack.recording.mcap_file import image_cdr

    with Bag2Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics = [
            bag.add_connection(f"/{side}/image_raw", "sensor_msgs/msg/Image", typestore=types)
            for side in ("left", "right")
        ]
        for stamp in STAMPS_NS:
            for number, topic in enumerate(topics):
                bag.write(topic, stamp + number, bytes(image_cdr(image_of(stamp + number), stamp + number, "f")))


def _bag1() -> tuple[bytes, ...]:
    """One bag for each compression that a ROS 1 bag can have, with raw and compressed pictures."""

    def write(folder: Path) -> None:
        types = get_typestore(Stores.ROS1_NOETIC)
        t = types.types
        for name, compression in (("none", None), ("bz2", Bag1Writer.CompressionFormat.BZ2)):
            bag = Bag1Writer(folder / f"{name}.bag")
            if compression is not None:
                bag.set_compression(compression)
            kind = "sensor_msgs/msg/CompressedImage"
            with bag:
                topics = [bag.add_connection(f"/{side}/image", kind, typestore=types) for side in ("left", "right")]
                for number, stamp in enumerate(STAMPS_NS):
                    for topic in topics:
                        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
                        header = t["std_msgs/msg/Header"](
                            seq=number,
                            stamp=t["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds),
                            frame_id="f",
                        )
                        image = cv2.imencode(".png", image_of(stamp))[1].reshape(-1)
                        message = t[kind](header=header, format="png", data=image)
                        bag.write(topic, stamp, types.serialize_ros1(message, kind))

    return _made(write, "none.bag", "bz2.bag")


def _png_read(path: Path) -> None:
    read_gray(path, SIZE_PX)


def _pngs() -> tuple[bytes, ...]:
    gray = image_of(1)
    pictures = (gray, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGRA), gray.astype(np.uint16) * 257)
    return tuple(cv2.imencode(".png", picture)[1].tobytes() for picture in pictures)


def _pictures() -> tuple[bytes, ...]:
    """One picture of each format that a folder of the board may hold."""
    colour = cv2.cvtColor(image_of(1), cv2.COLOR_GRAY2BGR)
    formats = (".png", ".jpg", ".bmp", ".tiff", ".pgm", ".ppm")
    return tuple(cv2.imencode(ending, image_of(1) if ending == ".pgm" else colour)[1].tobytes() for ending in formats)


def _read_pictures(path: Path) -> None:
    pictures = open_board_pictures(path.parent)
    for index in range(len(pictures.names)):
        pictures.read(index)


def _right_picture(folder: Path) -> None:
    (folder / "right01.png").write_bytes(_pngs()[0])


def _track_json() -> bytes:
    example = ROOT / "docs" / "wire" / "track.v1.example.json"
    return json.dumps(json.loads(example.read_text(encoding="utf-8"))).encode()


def _status_json() -> bytes:
    return StatusMessage.from_run(
        RunContext("bench", Source.LIVE, "0" * 12, "1" * 12),
        state=ServiceState.RUNNING,
        heartbeat_s=0.5,
        published_at_ns=1,
        uptime_s=2.0,
        last_sequence=3,
        calibration=WireCalibration(calibrated_at=None, age_days=None, reprojection_rms_px=None, warning=None),
        last_error="a cable",
    ).to_json()


def _read_tracks(path: Path) -> None:
    for line in path.read_bytes().splitlines():
        try:
            TrackMessage.from_json(line)
        except PublishError as error:
            raise PublishError(f"{path.name}: {error}") from error  # a message has no file that could be named


def _read_status(path: Path) -> None:
    try:
        StatusMessage.from_json(path.read_bytes())
    except PublishError as error:
        raise PublishError(f"{path.name}: {error}") from error


def _read_jpeg(path: Path) -> None:
    try:
        decoded(path.read_bytes(), Layout("MJPG", *SIZE_PX, SIZE_PX[0]))
    except ValueError as error:  # what the capture thread counts as a bad buffer
        raise NeedletrackError(f"{path}: {error}") from error


_CONFIG = (ROOT / "config" / "default.toml").read_bytes
_YAML_WORDS = (
    b"&a ",
    b"*a",
    b"<<: ",
    b"!!int ",
    b"!!float ",
    b"!!binary ",
    b"!!timestamp ",
    b"!!set ",
    b".nan",
    b".inf",
)
_YAML_MORE = (b"1:1:1:1:1", b"2026-13-45", b"[", b"{", b"? ", b"- ", b"|\n", b"%YAML 1.2\n---\n", b"1" * 5000)
_JSON_WORDS = (
    b"NaN",
    b"Infinity",
    b"-Infinity",
    b"1e999",
    b"[" * 50,
    b'{"":',
    b"null",
    b"true",
    b"1" * 5000,
    b"\\ud800",
)
_TOML_WORDS = (
    b"nan",
    b"inf",
    b"-inf",
    b"[[a]]\n",
    b"a.b.c = 1\n",
    b'"~nobody/x"',
    b'"a\\u0000b"',
    b"[" * 50,
    b"1" * 5000,
)
_MCAP_WORDS = (b"\x89MCAP0\r\n", b"zstd", b"lz4", b"\xff" * 8, b"\xff" * 4, b"\x00" * 8, b"\x06", b"needletrack")
_PNG_WORDS = (b"IHDR", b"IDAT", b"IEND", b"acTL", b"fcTL", b"iCCP", b"eXIf", b"\x7f\xff\xff\xff", b"\x00\x01\x86\xa0")

_POINTS = b"""\
rig_x_mm,rig_y_mm,rig_z_mm,robot_x_mm,robot_y_mm,robot_z_mm,robot_qx,robot_qy,robot_qz,robot_qw
1,2,300,4,5,6,0,0,0,1
2,3,310,5,6,7,0,0,0,1
9,9,320,8,8,8,0,0,1,0
"""

EDGES = (
    Edge("config", "config.toml", lambda: (_CONFIG(),), load_config, dictionary=_TOML_WORDS),
    Edge("rig", "rig.yaml", _rig_yaml, rig_at, dictionary=_YAML_WORDS + _YAML_MORE),
    Edge(
        "kalibr",
        "camchain.yaml",
        lambda: _exported("kalibr", "camchain.yaml"),
        rig_at,
        dictionary=_YAML_WORDS + _YAML_MORE,
    ),
    Edge(
        "ros",
        "left.yaml",
        lambda: _exported("ros", "left.yaml", "right.yaml")[:1],
        lambda path: import_rig([path, path.with_name("right.yaml")], "imported"),
        _left_only("ros", ("left.yaml", "right.yaml")),
        _YAML_WORDS + _YAML_MORE,
    ),
    Edge(
        "mrcal",
        "left.cameramodel",
        lambda: _exported("mrcal", "left.cameramodel", "right.cameramodel")[:1],
        lambda path: import_rig([path, path.with_name("right.cameramodel")], "imported"),
        _left_only("mrcal", ("left.cameramodel", "right.cameramodel")),
        (b"(" * 50, b"-" * 50, b"1e999", b"1j", b"b'x'", b"{1,2}", b"None", b"'\\x00'", b"9" * 5000, b"..."),
    ),
    Edge(
        "opencv",
        "stereo.yaml",
        lambda: _exported("opencv", "stereo.yaml"),
        lambda path: import_rig([path], "imported"),
        dictionary=(*_YAML_WORDS, b"!!opencv-matrix", b"rows: 100000", b"dt: d", b"dt: 4u", b"data: ["),
    ),
    Edge(
        "matlab",
        "stereo.mat",
        lambda: _exported("matlab", "stereo.mat"),
        lambda path: import_rig([path], "imported"),
        dictionary=(b"\x0e\x00\x00\x00", b"\x0f\x00\x00\x00", b"\xff" * 4, b"\x00\x00\x00\x80", b"MATLAB 7.3", b"MI"),
    ),
    Edge(
        "asl",
        "recording/cam0/data.csv",
        lambda: _made(lambda folder: write_recording(folder / "r", STAMPS_NS), "r/cam0/data.csv"),
        lambda path: _every_pair(open_stored(path.parents[1])),
        _asl_beside,
        (b"\x00", b"9" * 5000, b"9223372036854775807", b"..", b"/etc/passwd", b"nan", b"\r", b"\xef\xbb\xbf"),
    ),
    Edge("png", "1.png", _pngs, _png_read, dictionary=_PNG_WORDS),
    Edge("pictures", "left01.png", _pictures, _read_pictures, _right_picture, _PNG_WORDS),
    Edge("mcap", "a.mcap", _mcap, _read_recording_as_it_is, dictionary=_MCAP_WORDS),
    Edge("bag2", "a.mcap", _bag2_mcap, _read_recording, dictionary=_MCAP_WORDS),
    Edge(
        "bag2-metadata",
        "bag/metadata.yaml",
        lambda: _made(_bag2_sqlite, "bag/metadata.yaml"),
        lambda path: _read_recording(path.parent),
        _bag2_sqlite,
        (*_YAML_WORDS, b"compression_format: zstd", b"../../x", b"/dev/zero"),
    ),
    Edge(
        "bag2-sqlite",
        "bag/bag.db3",
        lambda: _made(_bag2_sqlite, "bag/bag.db3"),
        lambda path: _read_recording(path.parent),
        _bag2_sqlite,
        (b"SQLite format 3\x00", b"topics", b"messages", b"sensor_msgs/msg/Image", b"cdr"),
    ),
    Edge("bag1", "a.bag", _bag1, _read_recording, dictionary=(b"#ROSBAG V2.0\n", b"op=\x05", b"compression=lz4", b"=")),
    Edge(
        "truth",
        "truth.json",
        lambda: ((RECORDINGS / "hard-a" / "truth.json").read_bytes(),),
        lambda path: recorded_truth(path.parent),
        dictionary=_JSON_WORDS,
    ),
    Edge(
        "points",
        "points.csv",
        lambda: (_POINTS,),
        read_pairs,
        dictionary=(b"nan", b"inf", b"1e999", b'"', b"\x00", b",,,,", b"\r"),
    ),
    Edge("track", "tracks.jsonl", lambda: (_track_json() + b"\n",), _read_tracks, dictionary=_JSON_WORDS),
    Edge("status", "status.json", lambda: (_status_json(),), _read_status, dictionary=_JSON_WORDS),
    Edge(
        "mjpg",
        "frame.jpg",
        lambda: (cv2.imencode(".jpg", image_of(1))[1].tobytes(),),
        _read_jpeg,
        dictionary=(b"\xff\xd9", b"\xff\xd8", b"\xff\xc0", b"\xff\xc4", b"\xff\xda", b"\xff\xff"),
    ),
)
BY_NAME = {edge.name: edge for edge in EDGES}
