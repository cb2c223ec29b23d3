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
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing.connection import Connection, wait
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.recording.mcap_file import About, PairWriter
from needletrack.records import NeedleTrack, Pixels, StereoPair

_log = logging.getLogger(__name__)

# Tracks are small: so many may wait. Pairs wait as long as there is memory for them.
_MOST_WAITING = 1024
_STARTED_WITHIN_S = 60.0
_IDLE_S = 0.5
_SYNC_EVERY_S = 1.0
_LOOK_AT_DISK_EVERY_S = 1.0
_RETRY_AFTER_S, _RETRY_WITHIN_S = 5.0, 60.0
_STEADY_AFTER_S = 60.0
_LOOK_AT_START_EVERY_S = 0.1
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

    error: why it pauses, or None; is_open: whether the file is being written; files: how many were begun; kept: of the
    pairs, those that the kernel has: no end of the writing process takes them away.
    """

    file: str = ""
    pairs: int = 0
    megabytes: float = 0.0
    error: str | None = None
    is_open: bool = False
    files: int = 0
    kept: int = 0


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
    pass


@dataclass(frozen=True, slots=True)
class _Freed:
    slot: int
    recorded: bool
    state: RecorderState | None
    finished: int = 0


@dataclass(frozen=True, slots=True)
class _Memory:
    """Where pairs wait to be written: (slot, camera, row, column)."""

    name: str
    shape: tuple[int, int, int, int]
    dtype: str


_Command = _Pair | _Track | _Finish | _Stop


class _Writing:
    """The process that writes, and the pipes to it and back, which are its own: what it held when it was killed is held
    for ever. Raises OSError where it cannot be started.
    """

    def __init__(
        self,
        settings: RecorderSettings,
        about: About,
        memory: "_Memory",
        after: RecorderState | None,
    ) -> None:
        context = multiprocessing.get_context("spawn")
        commands, self._commands = context.Pipe(duplex=False)
        self._answers, answers = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_record,
            args=(settings, about, memory, commands, answers, after),
            name="needletrack-recorder",
            daemon=True,
        )
        self.started_s = time.monotonic()
        self._process.start()
        commands.close()
        answers.close()
        self._waiting: queue.SimpleQueue[_Command | None] = queue.SimpleQueue()
        threading.Thread(target=self._send, name="needletrack-recorder-feed", daemon=True).start()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def waiting(self) -> int:
        """How many commands it has not been given yet."""
        return self._waiting.qsize()

    @property
    def is_alive(self) -> bool:
        return self._process.is_alive()

    @property
    def failure(self) -> str | None:
        """How it ended, where that was not as it was told to."""
        code = self._process.exitcode
        if not code:
            return None
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def first_answer(self, unwanted: threading.Event) -> "_Freed | None":
        """Wait until it can write, or is not wanted any more; raises RecordingError where it does not come to that."""
        until_s = time.monotonic() + _STARTED_WITHIN_S
        while not self._answers.poll(_LOOK_AT_START_EVERY_S):
            if unwanted.is_set():
                return None
            if time.monotonic() > until_s:
                raise RecordingError("the recording process does not start: is the machine out of memory?")
        try:
            answer: _Freed = self._answers.recv()
        except EOFError:
            self.wait(1.0)
            raise RecordingError(f"the recording process {self.failure} as it started") from None
        return answer

    def put(self, command: _Command) -> None:
        """Give it something to do, in its turn."""
        self._waiting.put(command)

    def answers(self, wait_s: float = 0.0) -> "Iterator[_Freed]":
        """What it has said since; waits so long for the first."""
        with suppress(EOFError, OSError):
            while self._answers.poll(wait_s):
                wait_s = 0.0
                yield self._answers.recv()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for its end; whether that came."""
        return bool(wait([self._process.sentinel], timeout_s))

    def end(self) -> None:
        """Kill it where it still runs; its last answers can be had yet."""
        self._process.kill()
        self._process.join()
        self._waiting.put(None)

    def close(self) -> None:
        """End it and forget its answers."""
        self.end()
        self._answers.close()

    def _send(self) -> None:
        """Commands go into a pipe, which is full where it writes more slowly than they come."""
        with self._commands, suppress(OSError):  # it has ended
            while (command := self._waiting.get()) is not None:
                self._commands.send(command)


class Recorder:
    """Records pairs and their tracks; `offer` returns at once whatever the disk does, and counts what it cannot take.

    Where the writing process ends by itself, another one goes on in a new file. size_px: of the images. about: what the
    file says of itself; clock, exposure and place of the stamp are those of the first pair. bits: of a pixel, as the
    cameras give them. begun: record from now on, else from `begin`. Raises RecordingError where the folder or file
    cannot be written.
    """

    def __init__(
        self,
        settings: RecorderSettings,
        about: About,
        size_px: tuple[int, int],
        *,
        bits: Literal[8, 16] = 8,
        begun: bool = True,
    ) -> None:
        _require_writable(settings)
        self._settings, self._about, self._shape = settings, about, (2, size_px[1], size_px[0])
        dtype = np.dtype(np.uint8 if bits == 8 else np.uint16)
        bytes_a_pair = 2 * size_px[0] * size_px[1] * dtype.itemsize
        slots = max(settings.buffer_mb * _MB // bytes_a_pair, 4)
        self._memory = SharedMemory(create=True, size=slots * bytes_a_pair)
        self._slots: Any = np.ndarray((slots, *self._shape), dtype, self._memory.buf)
        self._free = deque(range(slots))
        self._state, self._first, self._warned_s = RecorderState(), True, 0.0
        # Between who offers, who begins and ends, and who keeps the process; held for an image's copy at most.
        self._turn = threading.Lock()
        self._begun, self._ended, self._finished = begun, 0, 0
        # The pairs of this recording: tracks of others do not belong into its file.
        self._first_sequence: int | None = None
        self._last_sequence = self._last_track = -1
        self.offered = self.recorded = self.dropped = self.dropped_tracks = 0
        self._closed = threading.Event()
        self._writing: _Writing | None = None
        self._keeper = threading.Thread(target=self._keep, name="needletrack-recorder-keeper", daemon=True)
        try:
            self._start(None)
            if self._state.error is not None:
                raise RecordingError(self._state.error)
            self._keeper.start()
        except BaseException:
            self.close(0.0)
            raise

    @property
    def pid(self) -> int | None:
        """The writing process, while there is one."""
        return None if self._writing is None else self._writing.pid

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
            if self._begun or self._closed.is_set():
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
            if not self._begun or self._closed.is_set():
                return False
            self._begun = False
            last, offered, writing = self._last_sequence, self._first_sequence is not None, self._writing
        # The last pairs are still with the tracker.
        tracks_until_s = min(time.monotonic() + _TRACKS_FOLLOW_WITHIN_S, until_s)
        while offered and self._last_track < last and time.monotonic() < tracks_until_s:
            time.sleep(_LOOK_EVERY_S)
        with self._turn:
            self._ended += 1
            self._first_sequence = None
            wanted = self._ended
            self._finish(wanted)
        while time.monotonic() < until_s:
            with self._turn:
                if self._closed.is_set():
                    return True
                if writing is None or writing is not self._writing or not writing.is_alive:
                    raise RecordingError("the recording process has ended: `needletrack recover` saves the file")
                self._collect(writing)
                if self._finished >= wanted:
                    if self._state.error is not None:
                        raise RecordingError(self._state.error)
                    return True
            time.sleep(_LOOK_EVERY_S)
        raise RecordingError(self._state.error or "the disk is too slow: the file is not finished yet")

    def renew(self, about: About) -> None:
        """What files say of themselves from now on; the present one is finished, the next pair begins another.

        Tracks of the last pairs before, which are still with the tracker, are in neither. Raises RecordingError where
        the disk does not keep up.
        """
        with self._turn:
            self._about = about
            if self._begun and not self._closed.is_set():
                self._first, self._first_sequence = True, None
                self._ended += 1
                self._finish(self._ended)

    def _finish(self, number: int) -> None:
        if self._writing is None or self._closed.is_set():
            return
        if self._writing.waiting >= _MOST_WAITING:
            raise RecordingError("the disk is too slow: the file is not finished")
        self._writing.put(_Finish(number))

    def offer(self, pair: StereoPair) -> bool:
        """Take a pair, or count it as dropped: the memory is full, or recording pauses. One thread at a time."""
        with self._turn:
            if self._writing is not None and not self._closed.is_set():
                self._collect(self._writing)
            return self._begun and self._taken(pair)

    def _taken(self, pair: StereoPair) -> bool:
        self.offered += 1
        if self._first_sequence is None:
            self._first_sequence = pair.sequence
        self._last_sequence = pair.sequence
        left, right = pair.left.pixels, pair.right.pixels
        fits = left.shape == right.shape == self._shape[1:] and left.dtype == right.dtype == self._slots.dtype
        writing = self._writing if self._writing is not None and self._writing.is_alive else None
        if writing is None or self._closed.is_set() or not self._free or not fits:
            self.dropped += 1
            why = "the recording process has ended" if writing is None else "the disk is too slow"
            self._warn(self._state.error or why)
            return False
        slot = self._free.popleft()
        np.copyto(self._slots[slot, 0], left)
        np.copyto(self._slots[slot, 1], right)
        about = None
        if self._first:
            self._first = False
            about = replace(self._about, clock=pair.clock, exposure_ns=pair.exposure_ns, stamp_at=pair.stamp_at)
        stamps = pair.left.captured_at_ns, pair.right.captured_at_ns
        writing.put(_Pair(slot, pair.sequence, *stamps, about))
        return True

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """Record the message of a pair that was offered to this recording; counts it where there is no place."""
        first, writing = self._first_sequence, self._writing
        if first is None or not first <= message.sequence <= self._last_sequence:
            return
        self._last_track = message.sequence
        if writing is None or self._closed.is_set() or writing.waiting >= _MOST_WAITING:
            self.dropped_tracks += 1
            return
        writing.put(_Track(message.sequence, message.captured_at_ns, message.to_json()))

    def close(self, timeout_s: float = 0.7) -> None:
        """Write what waits for at most so long, count the rest as dropped, finish the file; may be called twice."""
        with self._turn:
            if self._closed.is_set():
                return
            self._closed.set()
            writing = self._writing
        if writing is not None:
            writing.put(_Stop())
            until_s = time.monotonic() + timeout_s + 0.2
            while not writing.wait(0.0) and time.monotonic() < until_s:
                # Its answers are taken meanwhile: a full pipe would hold it up.
                self._collect(writing, 0.02)
            self._settle(writing)
            if self._state.is_open:
                _log.warning(
                    "the recorder did not finish in time: `needletrack recover %s` saves the file", self._state.file
                )
        if self._keeper.ident is not None:
            self._keeper.join()
        self._slots = None
        self._memory.close()
        self._memory.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self, after: RecorderState | None) -> None:
        """Have a process write, once it can; none where the recorder is closed meanwhile.

        after: what the one before said last. Raises RecordingError, OSError.
        """
        memory = _Memory(self._memory.name, self._slots.shape, self._slots.dtype.str)
        writing = _Writing(self._settings, self._about, memory, after)
        try:
            answer = writing.first_answer(self._closed)
        except BaseException:
            writing.close()
            raise
        with self._turn:
            if answer is None or self._closed.is_set():
                writing.close()
                return
            self._writing, self._first, self._first_sequence = writing, True, None
            self._account(answer)

    def _keep(self) -> None:
        """Have another process go on where one has ended by itself, the later the more often that happens."""
        failures = 0
        while (writing := self._writing) is not None:
            writing.wait()
            with self._turn:
                if self._closed.is_set():
                    return
                failures = 1 if time.monotonic() - writing.started_s > _STEADY_AFTER_S else failures + 1
                self._say_ended(writing)
            while self._writing is None:
                after_s = min(_RETRY_AFTER_S * 2 ** (failures - 2), _RETRY_WITHIN_S) if failures > 1 else 0.0
                if self._closed.wait(after_s):
                    return
                try:
                    self._start(self._state)
                except (RecordingError, OSError) as error:
                    failures += 1
                    with self._turn:
                        self._say(replace(self._state, error=f"the recording process cannot be started: {error}"))

    def _say_ended(self, writing: _Writing) -> None:
        file = self._state.file if self._state.is_open else None
        self._settle(writing)
        why = f"the recording process {writing.failure or 'has ended'}: another one is started, with a new file"
        self._say(replace(self._state, error=why, is_open=False))
        if file is not None:
            _log.warning("what is whole of the file that it wrote is saved by `needletrack recover %s`", file)

    def _settle(self, writing: _Writing) -> None:
        """End a process and count what it takes along: pairs that it had in hand, and those that only it knew of."""
        writing.end()
        self._collect(writing)
        writing.close()
        state, in_hand = self._state, len(self._slots) - len(self._free)
        unwritten = state.pairs - state.kept if writing.failure else 0
        self.recorded -= unwritten
        self.dropped += in_hand + unwritten
        if in_hand + unwritten:
            _log.warning("%d pairs were not recorded any more", in_hand + unwritten)
        self._state = replace(state, pairs=state.pairs - unwritten)
        self._free, self._writing = deque(range(len(self._slots))), None

    def _collect(self, writing: _Writing, wait_s: float = 0.0) -> None:
        for answer in writing.answers(wait_s):
            self._account(answer)

    def _account(self, freed: "_Freed") -> None:
        if freed.slot >= 0:
            self._free.append(freed.slot)
            self.recorded += freed.recorded
            self.dropped += not freed.recorded
        if freed.state is not None:
            # An error of the disk takes along what was recorded, but not with the kernel yet.
            lost = self.recorded - freed.state.pairs
            self.recorded -= lost
            self.dropped += lost
            self._say(freed.state)
        self._finished = max(self._finished, freed.finished)

    def _say(self, state: RecorderState) -> None:
        if state.error != self._state.error:
            if state.error is not None:
                _log.warning("recording pauses: %s", state.error)
            else:
                _log.warning(
                    "recording goes on: %s", state.file if state.is_open else "the next pair begins a new file"
                )
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
    memory: _Memory,
    commands: Connection,
    answers: Connection,
    after: RecorderState | None,
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
    shared = SharedMemory(memory.name)
    slots: Any = np.ndarray(memory.shape, memory.dtype, shared.buf)
    files = _Files(settings, about, after)
    files.probe()
    told = files.state

    def tell(slot: int = -1, *, recorded: bool = False, finished: int = 0) -> None:
        nonlocal told
        state, told = files.state if files.state != told else None, files.state
        with suppress(BrokenPipeError):
            answers.send(_Freed(slot, recorded, state, finished))

    answers.send(_Freed(-1, recorded=False, state=files.state))
    try:
        while not isinstance(command := _next(commands), _Stop):
            if command is None:
                files.idle()
            elif isinstance(command, _Track):
                files.add_track(command)
            elif isinstance(command, _Finish):
                files.end()
                tell(finished=command.number)
            else:
                recorded = files.add_pair(command, slots[command.slot, 0], slots[command.slot, 1])
                tell(command.slot, recorded=recorded)
            if files.state.kept != told.kept:
                tell()
        files.finish()
        tell()
    finally:
        del slots
        with suppress(BufferError):
            shared.close()


def _next(commands: Connection) -> _Command | None:
    """What is to be done next, in the order in which it was given; None where nothing has come for a while."""
    try:
        if not commands.poll(_IDLE_S):
            return None
        command: _Command = commands.recv()
    except (EOFError, OSError):
        return _Stop()  # the daemon was killed: what came is finished
    return command


def _keep_freed_memory() -> None:
    """Chunks of one size come and go: getting them from the kernel anew each time took a third of the time."""
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        for option, value in ((_M_MMAP_THRESHOLD, 32 << 20), (_M_TRIM_THRESHOLD, 256 << 20), (_M_TOP_PAD, 16 << 20)):
            libc.mallopt(option, value)


class _Files:
    """One file after another; an error of the disk pauses the recording, which is tried again."""

    def __init__(self, settings: RecorderSettings, about: About, after: RecorderState | None = None) -> None:
        self._settings, self._about = settings, about
        self._writer: PairWriter | None = None
        self._is_first = after is None
        self.state = RecorderState() if after is None else replace(after, error=None, is_open=False)
        self._number = self.state.files
        self._retry_at_s = self._looked_at_s = self._synced_at_s = 0.0
        self._syncing: threading.Thread | None = None
        self._done = self._bytes_done = 0

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

    def add_pair(self, command: _Pair, left: Pixels, right: Pixels) -> bool:
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
            self._abandon(self._writer, error)
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
                self._abandon(self._writer, error)
                self._writer = None
            else:
                self._pause(_unwritable(path, error))
            return False
        self._count()
        if self._writer.bytes_written > self._settings.max_file_mb * _MB:
            self.finish()
        return True

    def _abandon(self, writer: PairWriter, error: OSError) -> None:
        """What the kernel has not got is lost."""
        writer.abandon()
        kept = self._done + writer.kept
        self.state = replace(self.state, pairs=kept, kept=kept)
        self._pause(_unwritable(writer.path, error))

    def _count(self) -> None:
        assert self._writer is not None
        writer, size = self._writer, self._bytes_done + self._writer_bytes()
        self.state = RecorderState(
            str(writer.path),
            self._done + writer.pairs,
            round(size / _MB, 1),
            is_open=True,
            files=self._number,
            kept=self._done + writer.kept,
        )

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
        while True:
            number, self._number = self._number, self._number + 1
            path = self._path(number)
            # One that was killed may have begun another file and not have said so.
            if self._is_first or not path.exists():
                return path

    def _path(self, number: int) -> Path:
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
