"""The kernel's V4L2 interface, as <linux/videodev2.h> of a 64-bit machine lays it out: structures and request numbers.

Only what single-planar, memory-mapped capture needs. https://docs.kernel.org/userspace-api/media/v4l/v4l2.html
"""

from ctypes import Structure, Union, c_char, c_int32, c_int64, c_long, c_uint8, c_uint32, c_uint64, sizeof
from enum import IntEnum

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
CAPTURE_MPLANE = 9
MEMORY_MMAP = 1

CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_STREAMING = 0x04000000
CAP_TIMEPERFRAME = 0x1000
CAP_DEVICE_CAPS = 0x80000000

FIELD_NONE = 1

BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000
BUF_FLAG_TSTAMP_SRC_MASK = 0x70000
BUF_FLAG_TSTAMP_SRC_SOE = 0x10000

FRAME_DISCRETE = 1

CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_READ_ONLY = 0x4
CTRL_FLAG_NEXT_CTRL = 0x80000000

CID_GAIN = 0x00980913
CID_AUTOGAIN = 0x00980912
CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
CID_ANALOGUE_GAIN = 0x009E0903
EXPOSURE_MANUAL = 1
# V4L2_CID_EXPOSURE_ABSOLUTE counts in these.
EXPOSURE_UNIT_US = 100


class ControlType(IntEnum):
    """Those types of control that hold one number, or none."""

    INTEGER = 1
    BOOLEAN = 2
    MENU = 3
    BUTTON = 4
    BITMASK = 8
    INTEGER_MENU = 9


class Capability(Structure):
    """struct v4l2_capability."""

    _fields_ = [
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class PixFormat(Structure):
    """struct v4l2_pix_format."""

    _fields_ = [
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    ]


class _FormatUnion(Union):
    # The window member of the kernel's union holds pointers, which align it to 8 bytes.
    _fields_ = [("pix", PixFormat), ("raw_data", c_uint8 * 200), ("_align", c_uint64)]


class Format(Structure):
    """struct v4l2_format."""

    _fields_ = [("type", c_uint32), ("fmt", _FormatUnion)]


class FormatDescription(Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class Fraction(Structure):
    """struct v4l2_fract."""

    _fields_ = [("numerator", c_uint32), ("denominator", c_uint32)]


class FrameSize(Structure):
    """struct v4l2_frmsizeenum; values: width, height (discrete), or min, max, step of each (stepwise)."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("values", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]


class FrameInterval(Structure):
    """struct v4l2_frmivalenum; values: one interval (discrete), or min, max, step (stepwise)."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("values", Fraction * 3),
        ("reserved", c_uint32 * 2),
    ]


class CaptureParameters(Structure):
    """struct v4l2_captureparm."""

    _fields_ = [
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    ]


class _StreamUnion(Union):
    _fields_ = [("capture", CaptureParameters), ("raw_data", c_uint8 * 200)]


class StreamParameters(Structure):
    """struct v4l2_streamparm."""

    _fields_ = [("type", c_uint32), ("parm", _StreamUnion)]


class RequestBuffers(Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = [
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    ]


class Timeval(Structure):
    """struct timeval."""

    _fields_ = [("seconds", c_long), ("microseconds", c_long)]


class _Memory(Union):
    _fields_ = [("offset", c_uint32), ("userptr", c_uint64), ("fd", c_int32)]


class Buffer(Structure):
    """struct v4l2_buffer."""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", Timeval),
        ("timecode", c_uint32 * 4),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _Memory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    ]


class QueryControl(Structure):
    """struct v4l2_queryctrl."""

    _fields_ = [
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    ]


class _MenuName(Union):
    _pack_ = 1
    _fields_ = [("name", c_char * 32), ("value", c_int64)]


class QueryMenu(Structure):
    """struct v4l2_querymenu."""

    _pack_ = 1
    _fields_ = [("id", c_uint32), ("index", c_uint32), ("u", _MenuName), ("reserved", c_uint32)]


class Control(Structure):
    """struct v4l2_control."""

    _fields_ = [("id", c_uint32), ("value", c_int32)]


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


_READ, _WRITE, _BOTH = 2, 1, 3


class Request(IntEnum):
    """The ioctl requests, by the names of the header without VIDIOC_."""

    QUERYCAP = _request(_READ, 0, sizeof(Capability))
    ENUM_FMT = _request(_BOTH, 2, sizeof(FormatDescription))
    G_FMT = _request(_BOTH, 4, sizeof(Format))
    S_FMT = _request(_BOTH, 5, sizeof(Format))
    REQBUFS = _request(_BOTH, 8, sizeof(RequestBuffers))
    QUERYBUF = _request(_BOTH, 9, sizeof(Buffer))
    QBUF = _request(_BOTH, 15, sizeof(Buffer))
    DQBUF = _request(_BOTH, 17, sizeof(Buffer))
    STREAMON = _request(_WRITE, 18, 4)
    STREAMOFF = _request(_WRITE, 19, 4)
    G_PARM = _request(_BOTH, 21, sizeof(StreamParameters))
    S_PARM = _request(_BOTH, 22, sizeof(StreamParameters))
    G_CTRL = _request(_BOTH, 27, sizeof(Control))
    S_CTRL = _request(_BOTH, 28, sizeof(Control))
    QUERYCTRL = _request(_BOTH, 36, sizeof(QueryControl))
    QUERYMENU = _request(_BOTH, 37, sizeof(QueryMenu))
    ENUM_FRAMESIZES = _request(_BOTH, 74, sizeof(FrameSize))
    ENUM_FRAMEINTERVALS = _request(_BOTH, 75, sizeof(FrameInterval))


def fourcc(text: str) -> int:
    """The number of a four-character code, such as GREY."""
    return int.from_bytes(text.ljust(4).encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """The four-character code of a number; what cannot be printed becomes '?'."""
    text = number.to_bytes(4, "little").decode("ascii", "replace")
    return "".join(char if char.isprintable() and char.isascii() else "?" for char in text)
