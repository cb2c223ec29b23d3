"""Files that want more memory or depth than there is; read in a process whose memory is limited.

python -m tests.hostile.bombs: a JSON line a bomb, its name, what was said to it and how long that took.
"""

import bz2
import json
import resource
import struct
import sys
import time
import zlib
from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from tests.hostile.edges import BY_NAME
from tests.recording.small_recording import SIZE_PX

from needletrack.recording.mcap_file import typestore

# What is allocated beyond what the imports took.
ALLOWED_BYTES = 700_000_000
# Nearly a gigabyte, in steps.
_STEP, _STEPS = 1 << 24, 56
_DEEP = 100_000


@cache
def _zstd(*, size_is_said: bool) -> bytes:
    zeros = bytes(_STEP)
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=_STEPS * _STEP if size_is_said else -1)
    return b"".join(packer.compress(zeros) for _ in range(_STEPS)) + packer.flush()


@cache
def _lz4() -> bytes:
    packer, zeros = lz4.frame.LZ4FrameCompressor(), bytes(_STEP)
    return bytes(packer.begin() + b"".join(packer.compress(zeros) for _ in range(_STEPS)) + packer.flush())


def _bz2() -> bytes:
    packer, zeros = bz2.BZ2Compressor(1), bytes(_STEP)
    return b"".join(packer.compress(zeros) for _ in range(24)) + packer.flush()


def _deflated(steps: int = _STEPS) -> bytes:
    """The same step again and again, which is as good as a stream until its end."""
    packer = zlib.compressobj(9, wbits=-15)
    step = packer.compress(bytes(_STEP)) + packer.flush(zlib.Z_FULL_FLUSH)
    return b"\x78\xda" + step * steps


def _yaml_laughs(under: str) -> bytes:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    return ("\n".join(lines) + f"\n{under}: *a11\n").encode()


_COMPRESSIONS = {"": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}


def _mcap(compression: str, packed: bytes, says: int, profile: str = "ros2") -> bytes:
    """A file whose one chunk is a bomb, with an index that leads to it."""
    out = BytesIO()
    writer = Writer(out, compression=_COMPRESSIONS[compression])
    writer.start(profile)
    writer.add_metadata(
        "needletrack",
        {
            key: json.dumps(value)
            for key, value in {
                "version": 1,
                "name": "small",
                "run_id": "",
                "clock": "recorded",
                "exposure_ns": None,
                "stamp_at": None,
            }.items()
        },
    )
    definition, _ = typestore().generate_msgdef("sensor_msgs/msg/Image", ros_version=2)
    schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", definition.encode())
    for topic in ("/left/image_raw", "/right/image_raw"):
        writer.add_message(writer.register_channel(topic, "cdr", schema), 1, bytes(100), 1)
    writer.finish()  # type: ignore[no-untyped-call]
    whole = out.getvalue()
    # The chunk is exchanged for the bomb; the summary behind it keeps its content, and its places are moved.
    at = _chunk_at(whole)
    length = struct.unpack_from("<Q", whole, at + 1)[0]
    old = Chunk.read(ReadDataStream(BytesIO(whole[at + 9 : at + 9 + length])))
    body = struct.pack("<QQQI", old.message_start_time, old.message_end_time, says, 0)
    body += struct.pack("<I", len(compression)) + compression.encode() + struct.pack("<Q", len(packed)) + packed
    grown = len(body) - length
    changed = bytearray(whole[:at] + b"\x06" + struct.pack("<Q", len(body)) + body + whole[at + 9 + length :])
    _shift_summary(changed, grown, len(packed), says)
    return bytes(changed)


def _chunk_at(whole: bytes) -> int:
    at = 8
    while whole[at] != 6:
        at += 9 + int(struct.unpack_from("<Q", whole, at + 1)[0])
    return at


def _shift_summary(changed: bytearray, grown: int, packed: int, says: int) -> None:
    """Move the summary's places behind the chunk, and let its index state the bomb's sizes."""
    footer = len(changed) - 8 - 29
    summary, offsets = struct.unpack_from("<QQ", changed, footer + 9)
    struct.pack_into("<QQI", changed, footer + 9, summary + grown, offsets + grown if offsets else 0, 0)
    at = summary + grown
    while at < footer:
        kind, length = changed[at], struct.unpack_from("<Q", changed, at + 1)[0]
        if kind == 8:
            body = at + 9
            struct.pack_into("<Q", changed, body + 24, struct.unpack_from("<Q", changed, body + 24)[0] + grown)
            count = struct.unpack_from("<I", changed, body + 32)[0]
            for place in range(body + 36, body + 36 + count, 10):
                struct.pack_into("<Q", changed, place + 2, struct.unpack_from("<Q", changed, place + 2)[0] + grown)
            struct.pack_into("<QQ", changed, body + length - 16, packed, says)
        at += 9 + length


def _png(size: tuple[int, int], *parts: tuple[bytes, bytes]) -> bytes:
    header = struct.pack(">IIBBBBB", *size, 8, 0, 0, 0, 0)
    whole = b"\x89PNG\r\n\x1a\n"
    for kind, content in ((b"IHDR", header), *parts, (b"IEND", b"")):
        whole += struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    return whole


def _claiming(edge: str, old: bytes, new: bytes, number: int = 0) -> Callable[[], bytes]:
    def content() -> bytes:
        valid = BY_NAME[edge].valid()[number]
        assert old in valid
        return valid.replace(old, new, 1)

    return content


def _tiff(width: int, height: int, tile: int) -> bytes:
    """A little-endian TIFF of tiles; BigTIFF is none of ours."""
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 1), (277, 3, 1)]
    entries += [(322, 4, tile), (323, 4, tile), (324, 4, 8), (325, 4, 4_000_000_000)]
    packed = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + packed + bytes(4)


def _bag1(compression: bytes, packed: bytes) -> Callable[[], bytes]:
    def content() -> bytes:
        valid = BY_NAME["bag1"].valid()[1]
        # The first chunk: its header, then the length of its data.
        at = valid.index(b"compression=bz2")
        start = valid.index(b"size=", at) + 5 + 4 if b"size=" in valid[at : at + 60] else at + len(b"compression=bz2")
        while True:
            length = struct.unpack_from("<I", valid, start)[0]
            if valid[start + 4 : start + 7] == b"BZh":
                break
            start += 1
        changed = valid[:start] + struct.pack("<I", len(packed)) + packed + valid[start + 4 + length :]
        changed = changed.replace(b"compression=bz2", b"compression=" + compression)
        # The index behind the chunk has moved.
        moved = struct.unpack("<Q", valid[valid.index(b"index_pos=") + 10 :][:8])[0] + len(packed) - length
        index = changed.index(b"index_pos=") + 10
        return changed[:index] + struct.pack("<Q", moved) + changed[index + 8 :]

    return content


# As much as a file may have that claims 64 x 48 pixels.
_STEPS_OF_A_PNG = 30
_HUGE = (100_000, 100_000)

BOMBS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "config of a hundred thousand brackets": ("config", lambda: b"a = " + b"[" * _DEEP),
    "config of twenty thousand tables": ("config", lambda: b"[" + b".".join([b"a"] * 20_000) + b"]\n"),
    "config with a number of digits": ("config", lambda: b"rig.max_age_days = " + b"9" * 5000),
    "rig of a thousand brackets": ("rig", lambda: b"[" * 1000),
    "rig that laughs": ("rig", lambda: _yaml_laughs("format")),
    "rig that contains itself": ("rig", lambda: b"&a [*a, *a]"),
    "rig of 100,000 x 100,000 pixels": (
        "rig",
        lambda: BY_NAME["rig"].valid()[1].replace(b"[64, 48]", b"[100000, 100000]"),
    ),
    "camchain that laughs": ("kalibr", lambda: _yaml_laughs("cam0")),
    "camchain whose model laughs": (
        "kalibr",
        lambda: b"cam0:\n  " + _yaml_laughs("camera_model").strip().replace(b"\n", b"\n  ") + b"\ncam1: {}\n",
    ),
    "camera_info that laughs": ("ros", lambda: _yaml_laughs("camera_matrix") + b"projection_matrix: 1\n"),
    "camera model of brackets": ("mrcal", lambda: b"(" * _DEEP),
    "camera model of minus signs": ("mrcal", lambda: b"-" * _DEEP + b"1"),
    "FileStorage that laughs": ("opencv", lambda: b"%YAML:1.0\n---\n" + _yaml_laughs("M1") + b"x: opencv-matrix\n"),
    "FileStorage of JSON brackets": ("opencv", lambda: b'{"opencv-matrix":' + b"[" * _DEEP),
    "FileStorage of XML elements": ("opencv", lambda: b"<opencv_storage>" + b"<a>" * _DEEP),
    "FileStorage of XML entities": (
        "opencv",
        lambda: (
            b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]><opencv_storage>&b;</opencv_storage>'
        ),
    ),
    "FileStorage that claims 100,000 rows": ("opencv", _claiming("opencv", b"rows: 3", b"rows: 100000")),
    "MATLAB file of gigabytes, deflated": (
        "matlab",
        lambda: BY_NAME["matlab"].valid()[0][:128] + struct.pack("<II", 15, len(p := _deflated())) + p,
    ),
    "PNG of 100,000 x 100,000 pixels in a recording": ("png", lambda: _png(_HUGE, (b"IDAT", zlib.compress(b"\0")))),
    "PNG of 100,000 x 100,000 pixels": ("pictures", lambda: _png(_HUGE, (b"IDAT", zlib.compress(b"\0")))),
    "PNG of 30,000 x 30,000 pixels": ("pictures", lambda: _png((30_000, 30_000), (b"IDAT", zlib.compress(b"\0")))),
    "PNG whose chunk claims gigabytes": (
        "pictures",
        lambda: _png(SIZE_PX)[:33] + struct.pack(">I", 0xD5_00_00_00) + b"IDAT" + bytes(900),
    ),
    "PNG with a colour profile of gigabytes": (
        "png",
        lambda: _png(
            SIZE_PX, (b"iCCP", b"x\0\0" + _deflated(_STEPS_OF_A_PNG)), (b"IDAT", zlib.compress(bytes(65 * 48)))
        ),
    ),
    "PNG with a text of gigabytes": (
        "pictures",
        lambda: _png(
            SIZE_PX, (b"zTXt", b"x\0\0" + _deflated(_STEPS_OF_A_PNG)), (b"IDAT", zlib.compress(bytes(65 * 48)))
        ),
    ),
    "PNG with pixels for gigabytes": ("png", lambda: _png(SIZE_PX, (b"IDAT", _deflated(_STEPS_OF_A_PNG)))),
    "JPEG of 65,535 x 65,535 pixels": (
        "pictures",
        _claiming("pictures", struct.pack(">HH", SIZE_PX[1], SIZE_PX[0]), b"\xff\xff\xff\xff", 1),
    ),
    "BMP of 100,000 x 100,000 pixels": (
        "pictures",
        _claiming("pictures", struct.pack("<II", *SIZE_PX), struct.pack("<II", *_HUGE), 2),
    ),
    "PGM of 100,000 x 100,000 pixels": ("pictures", _claiming("pictures", b"64 48", b"100000 100000", 4)),
    "TIFF of 100,000 x 100,000 pixels": ("pictures", lambda: _tiff(*_HUGE, 256)),
    "TIFF of one giant tile": ("pictures", lambda: _tiff(*SIZE_PX, 1 << 23)),
    "camera's JPEG of 65,535 x 65,535 pixels": (
        "mjpg",
        _claiming("mjpg", struct.pack(">HH", SIZE_PX[1], SIZE_PX[0]), b"\xff\xff\xff\xff"),
    ),
    "recording whose chunk holds gigabytes and says so": (
        "mcap",
        lambda: _mcap("zstd", _zstd(size_is_said=True), _STEP * _STEPS),
    ),
    "recording whose chunk holds gigabytes and hides it": (
        "mcap",
        lambda: _mcap("zstd", _zstd(size_is_said=False), 1000),
    ),
    "recording whose chunk of lz4 holds gigabytes": ("mcap", lambda: _mcap("lz4", _lz4(), 1000)),
    "recording that claims a chunk of exabytes": ("mcap", lambda: _mcap("", b"x", (1 << 63) - 1)),
    "recording with an attachment of exabytes": (
        "mcap",
        lambda: BY_NAME["mcap"].valid()[0][:8] + b"\x09" + b"\xff" * 7 + b"\x7f" + BY_NAME["mcap"].valid()[0][8:],
    ),
    "recording with a record of gigabytes": (
        "mcap",
        lambda: BY_NAME["mcap"].valid()[0][:8] + b"\x0c" + struct.pack("<Q", 3 << 30) + BY_NAME["mcap"].valid()[0][8:],
    ),
    "bag whose chunk holds gigabytes and says so": (
        "bag2",
        lambda: _mcap("zstd", _zstd(size_is_said=True), _STEP * _STEPS).replace(b"needletrack", b"needlebrack"),
    ),
    "bag whose chunk holds gigabytes and hides it": (
        "bag2",
        lambda: _mcap("zstd", _zstd(size_is_said=False), 1000).replace(b"needletrack", b"needlebrack"),
    ),
    "bag whose chunk of lz4 holds gigabytes": (
        "bag2",
        lambda: _mcap("lz4", _lz4(), 1000).replace(b"needletrack", b"needlebrack"),
    ),
    "bag of ROS 1 whose chunk of bz2 holds a gigabyte": ("bag1", _bag1(b"bz2", _bz2())),
    "bag of ROS 1 whose chunk of lz4 holds gigabytes": ("bag1", _bag1(b"lz4", _lz4())),
    "metadata that laughs": ("bag2-metadata", lambda: _yaml_laughs("rosbag2_bagfile_information")),
    "truth of a million brackets": ("truth", lambda: b'{"frames":' + b"[" * 1_000_000),
    "track of a million brackets": ("track", lambda: b"[" * 1_000_000),
    "track of ten megabytes": ("track", lambda: b'{"version": 1, "x": "' + b"a" * 10_000_000 + b'"}'),
    "status with a number of digits": (
        "status",
        _claiming("status", b'"last_sequence":3', b'"last_sequence":' + b"9" * 5000),
    ),
    "status with an endless stamp": (
        "status",
        _claiming("status", b'"published_at_ns":1', b'"published_at_ns":1' + b"0" * 400),
    ),
    "stamp of a hundred thousand digits": ("asl", lambda: b"9" * 100_000 + b",a.png\n"),
}


def main() -> int:
    """Read every bomb that is there, or those named on the command line."""
    size_kb = int(
        next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmSize" in line).split()[1]
    )
    contents = {name: (edge, make()) for name, (edge, make) in BOMBS.items() if name in (sys.argv[1:] or BOMBS)}
    limit = size_kb * 1024 + ALLOWED_BYTES + sum(len(content) for _, content in contents.values())
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for name, (edge, content) in contents.items():
        with BY_NAME[edge].folder() as folder:
            began_s = time.monotonic()
            try:
                told = BY_NAME[edge].refusal(folder, content)
            except BaseException as error:
                told = f"!! {type(error).__name__}: {error}"
        answer = {"name": name, "told": told, "seconds": time.monotonic() - began_s}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
