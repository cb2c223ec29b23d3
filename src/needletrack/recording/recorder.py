"""Recording while tracking: pairs go through shared memory to a process of its own, and never wait for the disk.

A thread would share Python's lock with tracking: writing holds it for about a millisecond an image.
"""

import ctypes
import errno
import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.recording.mcap_file import About, PairWriter
from needletrack.records import Image, NeedleTrack, StereoPair

_log = logging.getLogger(__name__)

# Tracks are small: so many may wait, whatever the pairs do.
_TRACKS_WAITING = 1024
_STARTED_WITHIN_S = 60.0
_IDLE_S = 0.5
_SYNC_EVERY_S = 1.0
_LOOK_AT_DISK_EVERY_S = 1.0
_RETRY_AFTER_S = 5.0
_WARN_EVERY_S = 5.0
_MB = 1_000_000
_NICE = -10
_TRACKS_FOLLOW_WITHIN_S = 0.3
_LOOK_EVERY_S = 0.01
# <malloc.h>
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """Where to and how much: a folder in which files are named by rig and time, or one file.

    buffer_mb: memory between the cameras and the disk; min_free_mb: less free space pauses the recording;
    max_file_mb: after so much a new file is begun.
    """

    folder: Path
    file: Path | None = None
    buffer_mb: int = 256
    min_free_mb: int = 1000
    max_file_mb: int = 8000


@dataclass(frozen=True, slots=True)
class RecorderState:
    """What was recorded so far, by the last that the writing process said.

    error: why it pauses, or None; is_open: whether the file is being written.
    """

    file: str = ""
    pairs: int = 0
    megabytes: float = 0.0
    error: str | None = None
    is_open: bool = False


@dataclass(frozen=True, slots=True)
class _Pair:
    slot: int
    sequence: int
    left_ns: int
    right_ns: int
    about: About | None


@dataclass(frozen=True, slots=True)
class _Track:
    sequence: int
    captured_at_ns: int
    message: bytes


@dataclass(frozen=True, slots=True)
class _Finish:
    number: int


@dataclass(frozen=True, slots=True)
class _Stop:
    at_s: float


@dataclass(frozen=True, slots=True)
class _Freed:
    slot: int
    recorded: bool
    state: RecorderState | None
    finished: int = 0


class Recorder:
    """Records pairs and their tracks; `offer` returns at once whatever the disk does, and counts what it cannot take.

    size_px: of the images. about: what the file says of itself; clock, exposure and place of the stamp are those of the
    first pair. begun: record from now on, else from `begin`. Raises RecordingError where the folder or file cannot be
    written.
    """

    def __init__(
        self, settings: RecorderSettings, about: About, size_px: tuple[int, int], *, begun: bool = True
    ) -> None:
        _require_writable(settings)
        self._about, self._shape = about, (2, size_px[1], size_px[0])
        bytes_a_pair = 2 * size_px[0] * size_px[1]
        slots = max(settings.buffer_mb * _MB // bytes_a_pair, 4)
        self._memory = SharedMemory(create=True, size=slots * bytes_a_pair)
        self._slots: Any = np.ndarray((slots, *self._shape), np.uint8, self._memory.buf)
        self._free = deque(range(slots))
        self._state, self._first, self._warned_s = RecorderState(), True, 0.0
        # Between the thread that offers and the one that begins and ends; held for an image's copy at most.
        self._turn = threading.Lock()
        self._begun, self._ended, self._finished = begun, 0, 0
        # The pairs of this recording: tracks of others do not belong into its file.
        self._first_sequence: int | None = None
        self._last_sequence = self._last_track = -1
        self.offered = self.recorded = self.dropped = self.dropped_tracks = 0
        context = multiprocessing.get_context("spawn")
        self._commands: multiprocessing.Queue[_Pair | _Track | _Finish | _Stop] = context.Queue(slots + _TRACKS_WAITING)
        self._returns, theirs = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_record,
            args=(settings, about, self._memory.name, (slots, *self._shape), self._commands, theirs),
            name="needletrack-recorder",
            daemon=True,
        )
        self._process.start()
        theirs.close()
        self._closed = False
        try:
            self._await_start()
        except BaseException:
            self.close(0.0)
            raise

    @property
    def pid(self) -> int | None:
        """The writing process."""
        return self._process.pid

    @property
    def state(self) -> RecorderState:
        """What was recorded so far."""
        return self._state

    @property
    def begun(self) -> bool:
        """Whether pairs are recorded now, or would be if the disk took them."""
        return self._begun

    def begin(self, about: About | None = None) -> bool:
        """Record from the next pair on, into a new file; False where it records already. about: of the file."""
        with self._turn:
            if self._begun or self._closed:
                return False
            self._about = about or self._about
            self._begun, self._first, self._first_sequence = True, True, None
            return True

    def end(self, timeout_s: float) -> bool:
        """Record no more, and wait at most so long until the file is finished; False where nothing was being recorded.

        Raises RecordingError where the disk does not let it be finished, or not in time: then it will be later.
        """
        until_s = time.monotonic() + timeout_s
        with self._turn:
            if not self._begun or self._closed:
                return False
            self._begun = False
            last, offered = self._last_sequence, self._first_sequence is not None
        # The last pairs are still with the tracker.
        tracks_until_s = min(time.monotonic() + _TRACKS_FOLLOW_WITHIN_S, until_s)
        while offered and self._last_track < last and time.monotonic() < tracks_until_s:
            time.sleep(_LOOK_EVERY_S)
        with self._turn:
            if self._closed:
                return True
            self._ended += 1
            self._first_sequence = None
            wanted = self._ended
            self._finish(wanted)
        while time.monotonic() < until_s:
            with self._turn:
                if self._closed:
                    return True
                self._collect()
                if self._finished >= wanted:
                    if self._state.error is not None:
                        raise RecordingError(self._state.error)
                    return True
                if not self._process.is_alive():
                    raise RecordingError("the recorder has ended: `needletrack recover` saves the file")
            time.sleep(_LOOK_EVERY_S)
        raise RecordingError(self._state.error or "the disk is too slow: the file is not finished yet")

    def renew(self, about: About) -> None:
        """What files say of themselves from now on; the present one is finished, the next pair begins another.

        Tracks of the last pairs before, which are still with the tracker, are in neither. Raises RecordingError where
        the disk does not keep up.
        """
        with self._turn:
            self._about = about
            if self._begun and not self._closed:
                self._first, self._first_sequence = True, None
                self._ended += 1
                self._finish(self._ended)

    def _finish(self, number: int) -> None:
        try:
            self._commands.put_nowait(_Finish(number))
        except queue.Full as full:
            raise RecordingError("the disk is too slow: the file is not finished") from full

    def offer(self, pair: StereoPair) -> bool:
        """Take a pair, or count it as dropped: the memory is full, or recording pauses. One thread at a time."""
        with self._turn:
            if not self._closed:
                self._collect()
            return self._begun and self._taken(pair)

    def _taken(self, pair: StereoPair) -> bool:
        self.offered += 1
        if self._first_sequence is None:
            self._first_sequence = pair.sequence
        self._last_sequence = pair.sequence
        fits = pair.left.image.shape == pair.right.image.shape == self._shape[1:]
        if self._closed or not self._free or not fits or not self._process.is_alive():
            self.dropped += 1
            alive = self._process.is_alive()
            self._warn((self._state.error or "the disk is too slow") if alive else "the recorder has ended")
            return False
        slot = self._free.popleft()
        np.copyto(self._slots[slot, 0], pair.left.image)
        np.copyto(self._slots[slot, 1], pair.right.image)
        about = None
        if self._first:
            self._first = False
            about = replace(self._about, clock=pair.clock, exposure_ns=pair.exposure_ns, stamp_at=pair.stamp_at)
        stamps = pair.left.captured_at_ns, pair.right.captured_at_ns
        # There is a place for every slot.
        self._commands.put_nowait(_Pair(slot, pair.sequence, *stamps, about))
        return True

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Record the message of a pair that was offered to this recording; counts it where there is no place."""
        first = self._first_sequence
        if first is None or not first <= message.sequence <= self._last_sequence:
            return
        self._last_track = message.sequence
        try:
            self._commands.put_nowait(_Track(message.sequence, message.captured_at_ns, message.to_json()))
        except (queue.Full, ValueError):
            self.dropped_tracks += 1

    def close(self, timeout_s: float = 0.7) -> None:
        """Write what waits for at most so long, count the rest as dropped, finish the file; may be called twice."""
        with self._turn:
            if self._closed:
                return
            self._closed = True
            with suppress(queue.Full):
                self._commands.put_nowait(_Stop(time.monotonic() + timeout_s))
            self._commands.close()
        until_s = time.monotonic() + timeout_s + 0.2
        while self._process.is_alive() and time.monotonic() < until_s:
            # Its answers are taken meanwhile: a full pipe would hold it up.
            self._collect(0.02)
        self._collect()
        if self._process.is_alive():
            _log.warning(
                "the recorder did not finish in time: `needletrack recover %s` saves the file", self._state.file
            )
            self._process.kill()
        self._commands.cancel_join_thread()
        self._process.join()
        self._collect()
        waiting = self.offered - self.recorded - self.dropped
        if waiting > 0:
            self.dropped += waiting
            _log.warning("%d pairs were not recorded any more", waiting)
        self._returns.close()
        del self._slots
        self._memory.close()
        self._memory.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _await_start(self) -> None:
        if not self._returns.poll(_STARTED_WITHIN_S):
            raise RecordingError("the recorder did not start: is the machine out of memory?")
        self._collect()
        if self._state.error is not None:
            raise RecordingError(self._state.error)

    def _collect(self, wait_s: float = 0.0) -> None:
        with suppress(EOFError, OSError):
            while self._returns.poll(wait_s):
                wait_s = 0.0
                freed: _Freed = self._returns.recv()
                if freed.state is not None:
                    self._say(freed.state)
                self._finished = max(self._finished, freed.finished)
                if freed.slot >= 0:
                    self._free.append(freed.slot)
                    self.recorded += freed.recorded
                    self.dropped += not freed.recorded

    def _say(self, state: RecorderState) -> None:
        if state.error != self._state.error:
            if state.error is not None:
                _log.warning("recording pauses: %s", state.error)
            else:
                _log.warning("recording goes on: %s", state.file)
        self._state = state

    def _warn(self, why: str) -> None:
        now_s = time.monotonic()
        if now_s - self._warned_s >= _WARN_EVERY_S:
            self._warned_s = now_s
            _log.warning("%d pairs of %d were not recorded: %s", self.dropped, self.offered, why)


def _require_writable(settings: RecorderSettings) -> None:
    if settings.file is not None:
        if settings.file.exists():
            raise RecordingError(f"{settings.file} exists already: name another file, nothing is overwritten")
        if not settings.file.parent.is_dir():
            raise RecordingError(f"{settings.file}: there is no folder {settings.file.parent}: make it first")
        return
    try:
        settings.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"{settings.folder}: cannot be made: {error.strerror}: name another in recording.folder"
        ) from error


def _record(
    settings: RecorderSettings,
    about: About,
    memory_name: str,
    shape: tuple[int, ...],
    commands: "multiprocessing.Queue[_Pair | _Track | _Finish | _Stop]",
    returns: Connection,
) -> None:
    """The writing process."""
    # Ctrl-C and a stop of the service reach it as well: it ends when it is told, or its parent is gone.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    # It needs little, and that at once: among others' jobs on a busy machine it lost half of the pairs.
    with suppress(OSError):
        os.nice(_NICE)
    _keep_freed_memory()
    memory = SharedMemory(memory_name)
    slots: Any = np.ndarray(shape, np.uint8, memory.buf)
    files = _Files(settings, about)
    files.probe()
    returns.send(_Freed(-1, recorded=False, state=files.state))
    parent = os.getppid()
    stop_at_s: float | None = None
    try:
        while stop_at_s is None or time.monotonic() < stop_at_s:
            try:
                command = commands.get(timeout=_IDLE_S if stop_at_s is None else 0.01)
            except queue.Empty:
                if stop_at_s is not None:
                    break
                files.idle()
                if os.getppid() != parent:
                    break  # killed: what came is finished
                continue
            if isinstance(command, _Stop):
                stop_at_s = command.at_s
            elif isinstance(command, _Track):
                files.add_track(command)
            elif isinstance(command, _Finish):
                files.end()
                with suppress(BrokenPipeError):
                    returns.send(_Freed(-1, recorded=False, state=files.state, finished=command.number))
            else:
                before = files.state
                recorded = files.add_pair(command, slots[command.slot, 0], slots[command.slot, 1])
                with suppress(BrokenPipeError):
                    returns.send(_Freed(command.slot, recorded, files.state if files.state != before else None))
        files.finish()
        with suppress(BrokenPipeError):
            returns.send(_Freed(-1, recorded=False, state=files.state))
    finally:
        del slots
        with suppress(BufferError):
            memory.close()


def _keep_freed_memory() -> None:
    """Chunks of one size come and go: getting them from the kernel anew each time took a third of the time."""
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        for option, value in ((_M_MMAP_THRESHOLD, 32 << 20), (_M_TRIM_THRESHOLD, 256 << 20), (_M_TOP_PAD, 16 << 20)):
            libc.mallopt(option, value)


class _Files:
    """One file after another; an error of the disk pauses the recording, which is tried again."""

    def __init__(self, settings: RecorderSettings, about: About) -> None:
        self._settings, self._about = settings, about
        self._writer: PairWriter | None = None
        self._number = 0
        self._retry_at_s = self._looked_at_s = self._synced_at_s = 0.0
        self._syncing: threading.Thread | None = None
        self._done = 0
        self._bytes_done = 0
        self.state = RecorderState()

    def probe(self) -> None:
        """Say in `state` what keeps the first file from being written; leaves nothing behind."""
        folder = self._folder()
        try:
            if self._free_mb() < self._settings.min_free_mb:
                self._pause(self._full())
                return
            probe = folder / f".needletrack-{os.getpid()}"
            probe.touch()
            probe.unlink()
        except OSError as error:
            self._pause(_unwritable(folder, error))

    def add_pair(self, command: _Pair, left: Image, right: Image) -> bool:
        if command.about is not None:
            self._about = command.about
        return self._attempt(
            lambda writer: writer.add_pair(command.sequence, left, command.left_ns, right, command.right_ns)
        )

    def add_track(self, command: _Track) -> None:
        if self._writer is not None:
            self._attempt(lambda writer: writer.add_track(command.sequence, command.captured_at_ns, command.message))

    def idle(self) -> None:
        """Nothing comes: what is in the unfinished chunk goes to the disk."""
        if self._writer is not None and self._writer.pairs:
            self._attempt(lambda writer: writer.flush())

    def finish(self) -> None:
        if self._writer is None:
            return
        try:
            self._writer.finish()
            self._count()
            self.state = replace(self.state, is_open=False)
        except OSError as error:
            self._writer.abandon()
            self._pause(_unwritable(self._writer.path, error))
        self._writer = None

    def end(self) -> None:
        """Finish, and forget what kept the disk from taking it: the next recording tries anew, and at once."""
        self._retry_at_s = self._looked_at_s = 0.0
        self.state = replace(self.state, error=None)
        self.finish()

    def _attempt(self, write: Callable[[PairWriter], None]) -> bool:
        now_s = time.monotonic()
        if self._writer is None and now_s < self._retry_at_s:
            return False
        path = self._folder()
        try:
            if now_s - self._looked_at_s > _LOOK_AT_DISK_EVERY_S:
                self._looked_at_s = now_s
                if self._free_mb() < self._settings.min_free_mb:
                    self.finish()
                    self._pause(self._full())
                    return False
            if self._writer is None:
                path = self._next_path()
                self._writer = PairWriter(path, self._about)
            path = self._writer.path
            write(self._writer)
            self._sync(now_s)
        except RecordingError as error:
            # The folder: a name that changes with every attempt would be told as news each time.
            cause = error.__cause__
            self._pause(_unwritable(self._folder(), cause) if isinstance(cause, OSError) else str(error))
            return False
        except OSError as error:
            if self._writer is not None:
                self._writer.abandon()
                self._writer = None
            self._pause(_unwritable(path, error))
            return False
        self._count()
        if self._writer.bytes_written > self._settings.max_file_mb * _MB:
            self.finish()
        return True

    def _count(self) -> None:
        assert self._writer is not None
        pairs, size = self._done + self._writer.pairs, self._bytes_done + self._writer_bytes()
        self.state = RecorderState(str(self._writer.path), pairs, round(size / _MB, 1), is_open=True)

    def _writer_bytes(self) -> int:
        assert self._writer is not None
        with suppress(ValueError):
            return self._writer.bytes_written
        return self._writer.path.stat().st_size

    def _pause(self, error: str) -> None:
        self._retry_at_s = time.monotonic() + _RETRY_AFTER_S
        self.state = replace(self.state, error=error, is_open=False)

    def _sync(self, now_s: float) -> None:
        """Have the disk keep what the kernel has, once a second, in a thread: it may take that long."""
        if now_s - self._synced_at_s < _SYNC_EVERY_S or (self._syncing is not None and self._syncing.is_alive()):
            return
        assert self._writer is not None
        self._synced_at_s = now_s
        descriptor = os.dup(self._writer.descriptor)
        self._syncing = threading.Thread(target=_synced, args=(descriptor,), daemon=True)
        self._syncing.start()

    def _next_path(self) -> Path:
        if self._writer is None and self._number:
            self._done, self._bytes_done = self.state.pairs, round(self.state.megabytes * _MB)
        number, self._number = self._number, self._number + 1
        if self._settings.file is not None:
            file = self._settings.file
            return file if number == 0 else file.with_name(f"{file.stem}-{number}{file.suffix}")
        now = datetime.now(UTC)
        return self._settings.folder / f"{self._about.name}-{now:%Y%m%dT%H%M%S}-{number}.mcap"

    def _folder(self) -> Path:
        return self._settings.folder if self._settings.file is None else self._settings.file.parent

    def _free_mb(self) -> float:
        disk = os.statvfs(self._folder())
        return disk.f_bavail * disk.f_frsize / _MB

    def _full(self) -> str:
        return (
            f"{self._folder()}: {self._free_mb():.0f} MB are free, recording.min_free_mb is "
            f"{self._settings.min_free_mb}: free some space"
        )


def _synced(descriptor: int) -> None:
    with suppress(OSError):
        os.fdatasync(descriptor)
    os.close(descriptor)


def _unwritable(path: Path, error: OSError) -> str:
    remedies = {
        errno.ENOSPC: "free some space",
        errno.EROFS: "the disk is mounted read-only: look at the kernel's log, mount it anew",
        errno.EACCES: "let this user write there",
    }
    remedy = remedies.get(error.errno or 0, "look at the disk")
    return f"{path}: cannot be written: {error.strerror or error}: {remedy}"
