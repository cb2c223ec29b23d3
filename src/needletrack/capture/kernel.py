"""The edge to the kernel: seven calls, so that a test can put a camera of its own making behind them."""

import fcntl
import mmap
import os
import select
from collections.abc import Mapping, Sequence
from contextlib import suppress
from ctypes import Structure, c_int
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from needletrack.capture.v4l2_abi import Request

_CLASS = Path("/sys/class/video4linux")
# A USB camera's serial number lies at most so many folders above its video node.
_SERIAL_WITHIN = 4


@dataclass(frozen=True, slots=True)
class Node:
    """A video node: its path, its place among those of its device, and the device's serial number ("": none)."""

    path: str
    index: int
    serial: str = ""


class Kernel(Protocol):
    """What of the operating system the cameras need; every call raises OSError as the kernel does."""

    def nodes(self) -> Sequence[Node]:
        """The video nodes that there are."""
        ...

    def open(self, path: str) -> int:
        """A non-blocking descriptor of a node."""
        ...

    def ioctl(self, descriptor: int, request: Request, argument: Structure | c_int) -> None:
        """One request; the argument is changed in place."""
        ...

    def map(self, descriptor: int, length: int, offset: int) -> memoryview:
        """A buffer of the driver's, read-only."""
        ...

    def unmap(self, buffer: memoryview) -> None:
        """Give a buffer back."""
        ...

    def poll(self, descriptors: Sequence[int], timeout_s: float) -> Mapping[int, int]:
        """Those of the descriptors on which something happened within the time, with select.POLL* of what."""
        ...

    def close(self, descriptor: int) -> None:
        """Close a descriptor."""
        ...


class LinuxKernel:
    """The kernel that this process runs on."""

    def nodes(self) -> list[Node]:
        """The video nodes of sysfs, in the order of their numbers."""
        names = sorted((entry.name for entry in _entries()), key=lambda name: (len(name), name))
        return [
            Node(f"/dev/{name}", int(_read(_CLASS / name / "index") or 0), _serial(_CLASS / name / "device"))
            for name in names
        ]

    def open(self, path: str) -> int:
        """A non-blocking descriptor of a node."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, descriptor: int, request: Request, argument: Structure | c_int) -> None:
        """One request; the argument is changed in place."""
        while True:
            with suppress(InterruptedError):
                fcntl.ioctl(descriptor, request, argument, True)
                return

    def map(self, descriptor: int, length: int, offset: int) -> memoryview:
        """A buffer of the driver's, read-only."""
        return memoryview(mmap.mmap(descriptor, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset))

    def unmap(self, buffer: memoryview) -> None:
        """Give a buffer back."""
        mapped = buffer.obj
        buffer.release()
        assert isinstance(mapped, mmap.mmap)
        mapped.close()

    def poll(self, descriptors: Sequence[int], timeout_s: float) -> dict[int, int]:
        """Those of the descriptors on which something happened within the time, with select.POLL* of what."""
        poller = select.poll()
        for descriptor in descriptors:
            poller.register(descriptor, select.POLLIN)
        return dict(poller.poll(timeout_s * 1000))

    def close(self, descriptor: int) -> None:
        """Close a descriptor."""
        os.close(descriptor)


def _entries() -> list[Path]:
    try:
        return [entry for entry in _CLASS.iterdir() if entry.name.startswith("video")]
    except OSError:
        return []


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _serial(device: Path) -> str:
    try:
        folder = device.resolve(strict=True)
    except OSError:
        return ""
    for parent in (folder, *list(folder.parents)[:_SERIAL_WITHIN]):
        if serial := _read(parent / "serial"):
            return serial
    return ""
