"""What the daemon asks of the operating system: to be the only one, real-time scheduling, locked memory, processors."""

import ctypes
import gc
import logging
import os
import resource
import socket
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from needletrack.errors import NeedletrackError

_log = logging.getLogger(__name__)

# <sys/mman.h>; pages are locked as they are touched, not reserved stacks of idle threads.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


class AlreadyRunning(NeedletrackError):
    """Another daemon of the same rig runs on this machine."""


class OnlyInstance:
    """Held while a rig's daemon runs: an abstract socket, which the kernel frees however the process ends."""

    def __init__(self, rig: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(f"\0needletrack/{rig}")
        except OSError as error:
            self._socket.close()
            raise AlreadyRunning(
                f"a needletrack daemon of rig {rig} already runs on this machine: stop it first "
                "(systemctl stop needletrack, or see `pgrep -af needletrack`)"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()


def schedule_thread(name: str, priority: int, cpus: Sequence[int]) -> None:
    """Give the calling thread SCHED_FIFO and processors, where that is permitted; priority 0: leave it."""
    if cpus:
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            _log.warning("%s runs on any processor: daemon.cpus %s: %s", name, list(cpus), error.strerror)
    if priority > 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
        except OSError as error:
            _log.warning(
                "%s has no real-time scheduling (%s): set LimitRTPRIO=%d in the unit, or rtprio in limits.conf",
                name,
                error.strerror,
                priority,
            )


def may_lock_memory() -> bool:
    """Whether all memory may be locked: the limit is unlimited, or this is root."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return soft == resource.RLIM_INFINITY or os.geteuid() == 0


def may_schedule(priority: int) -> bool:
    """Whether SCHED_FIFO of a priority is permitted."""
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return os.geteuid() == 0 or soft == resource.RLIM_INFINITY or soft >= priority


def lock_memory() -> None:
    """Keep what this process touches resident, where that is permitted."""
    # With a small limit the lock itself succeeds, and the next allocation fails.
    if not may_lock_memory():
        _log.warning("memory is not locked: set LimitMEMLOCK=infinity in the unit, or memlock in limits.conf")
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        _log.warning("memory is not locked: %s", os.strerror(ctypes.get_errno()))


def load_without_collecting() -> None:
    """Leave garbage where it is until memory is settled: to look for it again and again while loading takes 0.15 s."""
    gc.disable()


def settle_memory() -> None:
    """Take what is loaded out of the garbage collector's sight: looking at all of it takes 0.2 s each time.

    Loading leaves a thousand objects of garbage: where nobody looked for it, it is not looked for here either.
    """
    if gc.isenabled():
        gc.collect()
    gc.freeze()
    gc.enable()
