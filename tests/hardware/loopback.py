"""Feeding v4l2loopback devices with frames and stamps of our own, which their readers get unchanged."""

import mmap
import os
import select
from ctypes import Structure, c_int
from pathlib import Path
from types import TracebackType
from typing import Self

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.kernel import LinuxKernel
from needletrack.capture.v4l2_abi import Request

LEFT, RIGHT = "platform:v4l2loopback-000", "platform:v4l2loopback-001"
_OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT
_BUFFERS = 4


def loopback_nodes() -> list[str]:
    """The nodes of the loopback devices, in the order of their numbers."""
    names = Path("/sys/class/video4linux").glob("*/name")
    return sorted(f"/dev/{path.parent.name}" for path in names if path.read_text().startswith("loop-"))


class Feed:
    """The producer's side of one device: GREY frames of a size (width, height)."""

    def __init__(self, path: str, size_px: tuple[int, int]) -> None:
        self._kernel = LinuxKernel()
        self._descriptor = os.open(path, os.O_RDWR)
        request = abi.Format(type=_OUTPUT)
        pix = request.fmt.pix
        (pix.width, pix.height), pix.pixelformat, pix.field = size_px, abi.fourcc("GREY"), abi.FIELD_NONE
        pix.bytesperline, pix.sizeimage = size_px[0], size_px[0] * size_px[1]
        self._ask(Request.S_FMT, request)
        assert (pix.width, pix.height) == size_px
        self._ask(Request.REQBUFS, abi.RequestBuffers(count=_BUFFERS, type=_OUTPUT, memory=abi.MEMORY_MMAP))
        self._maps = []
        for index in range(_BUFFERS):
            buffer = self._buffer(index)
            self._ask(Request.QUERYBUF, buffer)
            self._maps.append(mmap.mmap(self._descriptor, buffer.length, mmap.MAP_SHARED, offset=buffer.m.offset))
        self._ask(Request.STREAMON, c_int(_OUTPUT))

    def put(self, data: bytes, stamp_us: int) -> None:
        """Hand a frame to the reader, with its stamp."""
        assert select.select([], [self._descriptor], [], 30)[1]
        buffer = self._buffer(0)
        self._ask(Request.DQBUF, buffer)
        self._maps[buffer.index][: len(data)] = data
        buffer.bytesused = len(data)
        buffer.timestamp.seconds, buffer.timestamp.microseconds = divmod(stamp_us, 1_000_000)
        self._ask(Request.QBUF, buffer)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for mapped in self._maps:
            mapped.close()
        os.close(self._descriptor)

    def _buffer(self, index: int) -> abi.Buffer:
        return abi.Buffer(index=index, type=_OUTPUT, memory=abi.MEMORY_MMAP)

    def _ask(self, request: Request, argument: Structure | c_int) -> None:
        self._kernel.ioctl(self._descriptor, request, argument)
