"""Faults of the daemon, its cameras and its disk: each a small function that injects one and says what was seen."""

import errno
import os
import resource
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from benchmarks.faults.stage import Child, Stage, Watcher, ended, said_last, until
from benchmarks.faults.table import (
    NOTHING,
    Faults,
    NotHere,
    Seen,
    change,
    changes,
    counted,
    lost,
    require,
    short,
    silence,
)
from needletrack.capture.v4l2_abi import Request
from needletrack.daemon.run import ExitCode
from needletrack.recording.mcap_file import McapRecording, recover

FAULTS = Faults()
fault = FAULTS.row

# --- the daemon


@fault("daemon", "killed", "SIGKILL while it records; started anew at once")
def killed(stage: Stage) -> Seen:
    """Nothing of it runs on: neither its recorder, nor what audits its tracks, nor memory that they shared."""
    daemon, watcher = stage.running("--record", str(stage.folder))
    family, memory = daemon.family(), _shared_memory(daemon)
    require(len(memory) == 2 and daemon.recorder() != daemon.auditor(), "it has not both of its processes")
    at_s = daemon.signal(signal.SIGKILL)
    saw = change(watcher, at_s, "gone")
    ended(daemon)
    until(lambda: not any(_runs(process) for process in family), "the end of every process of the daemon", 5.0)
    saw += f"; none of its {len(family)} other processes after {time.monotonic() - at_s:.2f} s"
    until(lambda: not any(file.exists() for file in memory), "the end of its shared memory", 5.0)
    again_s = time.monotonic()
    stage.daemon("--record", str(stage.folder))
    healthy_s = watcher.fresh_after(again_s)
    return Seen(saw, healthy_s, "every pair until it ran again, of which most is starting Python")


@fault("daemon", "stopped", "SIGTERM; started anew at once")
def terminated(stage: Stage) -> Seen:
    """It ends in order."""
    daemon, watcher = stage.running()
    at_s = daemon.signal(signal.SIGTERM)
    code = ended(daemon)
    took_s = time.monotonic() - at_s
    saw = f"state stopping, {change(watcher, at_s, 'gone')}; exit code {code} after {took_s:.2f} s"
    watcher.heartbeat(at_s, lambda beat: beat["state"] == "stopping", "the last heartbeat")
    again_s = time.monotonic()
    stage.daemon()
    return Seen(saw, watcher.fresh_after(again_s), "every pair until it ran again, of which most is starting Python")


@fault("daemon", "hung", "SIGSTOP for 3 s, SIGCONT")
def hung(stage: Stage) -> Seen:
    """All its threads stand still, as on a machine that swaps."""
    daemon, watcher = stage.running()
    at_s = daemon.signal(signal.SIGSTOP)
    saw = f"{change(watcher, at_s, 'silent')}, {change(watcher, at_s, 'gone')}"
    time.sleep(max(at_s + 3 - time.monotonic(), 0))
    on_s = daemon.signal(signal.SIGCONT)
    healthy_s = watcher.fresh_after(on_s)
    return Seen(saw, healthy_s, f"the pairs of {silence(watcher, at_s):.1f} s; {lost(watcher, at_s)}")


@fault("daemon", "started twice", "a second daemon of the same rig")
def twice(stage: Stage) -> Seen:
    """The second is refused."""
    _, watcher = stage.running()
    at_s = time.monotonic()
    code = ended(stage.daemon())
    watcher.tracks(time.monotonic())
    require(code == ExitCode.ALREADY_RUNNING, f"the second ended with {code}")
    return Seen(f"{changes(watcher, at_s)}; the second ended with exit code {code}", 0.0, lost(watcher, at_s))


@fault("daemon", "the auditing process killed", "SIGKILL to it alone")
def auditor_killed(stage: Stage) -> Seen:
    """Tracking goes on without it, and starts another."""
    daemon, watcher = stage.running()
    at_s, pid = time.monotonic(), daemon.auditor()
    os.kill(pid, signal.SIGKILL)
    until(lambda: all(process.pid != pid for process in daemon.family()), "the end of the auditing process")
    require(daemon.auditor() != pid, "it is not another process")
    again_s = time.monotonic() - at_s
    watcher.tracks(time.monotonic(), 30)
    saw = f"{changes(watcher, at_s)}; another one after {again_s:.1f} s"
    return Seen(saw, 0.0, f"{lost(watcher, at_s)}; no track was audited meanwhile")


# --- cameras, behind the ioctl edge


@fault("cameras", "dropped buffers", "5 sequence numbers of the left camera skipped")
def dropped_buffers(stage: Stage) -> Seen:
    """The driver had no buffer for them."""
    daemon, watcher = stage.running()
    before, at_s = watcher.drops(), time.monotonic()
    daemon.say("skip", 0, 5)
    until(lambda: watcher.drops().get("lost_by_driver", 0) >= before.get("lost_by_driver", 0) + 5, "5 lost frames")
    healthy_s = watcher.fresh_after(at_s)
    return Seen("no change of health", healthy_s, counted(watcher, before))


@fault("cameras", "buffers with the error flag", "5 buffers of the left camera flagged")
def flagged_buffers(stage: Stage) -> Seen:
    """They are no pictures."""
    daemon, watcher = stage.running()
    before, at_s = watcher.drops(), time.monotonic()
    daemon.say("flag", 0, 5)
    until(lambda: watcher.drops().get("buffer_error", 0) >= before.get("buffer_error", 0) + 5, "5 buffer errors")
    saw = changes(watcher, at_s)
    return Seen(saw, watcher.fresh_after(time.monotonic()), counted(watcher, before))


@fault("cameras", "QBUF fails", "VIDIOC_QBUF of the left camera refused 3 times with EINVAL")
def qbuf(stage: Stage) -> Seen:
    """A buffer is not taken back."""
    daemon, watcher = stage.running()
    before, at_s = watcher.drops(), time.monotonic()
    daemon.say("refuse", 0, Request.QBUF.value, errno.EINVAL, 3)
    beat = watcher.heartbeat(at_s, lambda b: b["cameras"]["left"]["queue_errors"] > 0, "a queue error")
    watcher.tracks(beat["at_s"], 30)
    errors = watcher.since(at_s, "heartbeat")[-1]["heartbeat"]["cameras"]["left"]["queue_errors"]
    return Seen(f"queue_errors {errors} in the status; {changes(watcher, at_s)}", 0.0, counted(watcher, before))


@fault("cameras", "STREAMON fails", "unplugged; VIDIOC_STREAMON refused 3 times with EIO after the return")
def streamon(stage: Stage) -> Seen:
    """The camera is there and does not start."""
    daemon, watcher = stage.running()
    daemon.say("unplug", 0)
    watcher.health(time.monotonic(), "silent")
    daemon.say("refuse", 0, Request.STREAMON.value, errno.EIO, 3)
    at_s = time.monotonic()
    daemon.say("plug", 0)
    healthy_s = watcher.fresh_after(at_s)
    errors = {b["heartbeat"]["last_error"] for b in watcher.since(at_s, "heartbeat")} - {None}
    return Seen(f"silent; last_error: {_first(errors)}", healthy_s, "the pairs until then")


@fault("cameras", "one camera stalls", "no frame of the right camera for 3 s")
def stalled(stage: Stage) -> Seen:
    """It is there and delivers nothing."""
    daemon, watcher = stage.running()
    before, at_s = watcher.drops(), time.monotonic()
    daemon.say("stall", 1)
    saw = change(watcher, at_s, "silent")
    beat = watcher.heartbeat(at_s, lambda b: b["cameras"]["right"]["state"] != "streaming", "a camera's state")
    state = beat["heartbeat"]["cameras"]["right"]["state"]
    time.sleep(max(at_s + 3 - time.monotonic(), 0))
    on_s = time.monotonic()
    daemon.say("resume", 1)
    healthy_s = watcher.fresh_after(on_s)
    told = f"{saw}; right camera {state} in the status after {beat['at_s'] - at_s:.2f} s"
    return Seen(told, healthy_s, f"the pairs of {silence(watcher, at_s):.1f} s; {counted(watcher, before)}")


@fault("cameras", "one camera unplugged", "the left camera gone for 2 s")
def unplugged(stage: Stage) -> Seen:
    """ENODEV from every request."""
    daemon, watcher = stage.running()
    at_s = time.monotonic()
    daemon.say("unplug", 0)
    saw = change(watcher, at_s, "silent")
    beat = watcher.heartbeat(at_s, lambda b: b["cameras"]["left"]["state"] == "absent", "the left camera absent")
    time.sleep(max(at_s + 2 - time.monotonic(), 0))
    on_s = time.monotonic()
    daemon.say("plug", 0)
    healthy_s = watcher.fresh_after(on_s)
    told = f"{saw}; left camera absent in the status after {beat['at_s'] - at_s:.2f} s"
    return Seen(told, healthy_s, f"the pairs of {silence(watcher, at_s):.1f} s")


@fault("cameras", "both unplugged, back under other numbers", "both gone for 2 s, /dev/video0 and 1 exchanged")
def swapped(stage: Stage) -> Seen:
    """Left stays left: a camera is known by its socket."""
    daemon, watcher = stage.running()
    at_s = time.monotonic()
    for number in (0, 1):
        daemon.say("unplug", number)
    saw = change(watcher, at_s, "silent")
    daemon.say("swap")
    time.sleep(max(at_s + 2 - time.monotonic(), 0))
    on_s = time.monotonic()
    for number in (0, 1):
        daemon.say("plug", number)
    healthy_s = watcher.fresh_after(on_s)
    node = watcher.heartbeat(on_s, lambda b: b["cameras"]["left"]["state"] == "streaming", "streaming")
    where = node["heartbeat"]["cameras"]["left"]["node"]
    until(lambda: _any_ok(watcher, on_s), "an ok track: left and right are exchanged")
    return Seen(f"{saw}; the left camera now at {where}", healthy_s, f"the pairs of {silence(watcher, at_s):.1f} s")


@fault("cameras", "both gone at the start", "plugged in 2 s after the daemon was ready")
def absent_at_start(stage: Stage) -> Seen:
    """It waits for them."""
    daemon, watcher = stage.daemon("--absent"), stage.watcher()
    beat = watcher.heartbeat(0.0, lambda b: b["cameras"]["left"]["state"] == "absent", "absent cameras")
    saw = f"silent (no track yet); both cameras {beat['heartbeat']['cameras']['left']['state']} in the status"
    time.sleep(2)
    on_s = time.monotonic()
    for number in (0, 1):
        daemon.say("plug", number)
    return Seen(saw, watcher.fresh_after(on_s), NOTHING)


@fault("cameras", "may not be opened", "EACCES from open")
def forbidden(stage: Stage) -> Seen:
    """It does not start."""
    return _refused(stage, "--forbidden")


@fault("cameras", "not the configured format", "the cameras have YUYV, GREY is configured")
def other_format(stage: Stage) -> Seen:
    """It does not start."""
    return _refused(stage, "--other-format")


# --- the disk


@fault("disk", "a file may not grow", "RLIMIT_FSIZE of the recorder at 20 MB for 3 s: EFBIG")
def may_not_grow(stage: Stage) -> Seen:
    """A quota: recording pauses, tracking goes on."""
    daemon, watcher = stage.running("--record", str(stage.folder))
    at_s, recorder = time.monotonic(), daemon.recorder()
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (20_000_000, resource.RLIM_INFINITY))
    beat = watcher.heartbeat(at_s, lambda b: b["recording"]["error"], "an error of the recorder")
    time.sleep(3)
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return _recording_resumes(watcher, beat, time.monotonic())


@fault("disk", "full, then freed", "a tmpfs of 64 MB filled by another file, which is removed 2 s later")
def freed(stage: Stage) -> Seen:
    """ENOSPC."""
    with _mounted(stage.folder / "disk") as disk:
        daemon, watcher = stage.running("--record", str(disk))
        filler = disk / "filler"
        with suppress(OSError):
            filler.write_bytes(bytes(70_000_000))
        at_s = time.monotonic()
        beat = watcher.heartbeat(
            at_s - 5, lambda b: b["recording"] and b["recording"]["error"], "an error of the recorder"
        )
        time.sleep(2)
        for file in disk.iterdir():
            file.unlink()
        seen = _recording_resumes(watcher, beat, time.monotonic())
        _stop(daemon)
        return seen


@fault("disk", "read-only at the start", "recording.folder on a tmpfs that is mounted read-only")
def read_only(stage: Stage) -> Seen:
    """It does not start: what was asked for cannot be done."""
    with _mounted(stage.folder / "disk") as disk:
        _run("mount", "-o", "remount,ro", str(disk))
        return _refused(stage, "--record", str(disk))


@fault("disk", "the recording process killed", "SIGKILL to it alone; `needletrack recover` for its file")
def recorder_killed(stage: Stage) -> Seen:
    """Another one goes on in a new file; tracking does not depend on it."""
    daemon, watcher = stage.running("--record", str(stage.folder))
    watcher.heartbeat(0.0, lambda b: b["recording"]["pairs"] > 30, "a recording")
    recorder, (first,) = daemon.recorder(), stage.folder.glob("*.mcap")
    at_s = time.monotonic()
    os.kill(recorder, signal.SIGKILL)
    beat = watcher.heartbeat(at_s, lambda b: b["recording"]["error"], "an error of the recorder")
    pairs = beat["heartbeat"]["recording"]["pairs"]
    again = watcher.heartbeat(beat["at_s"], lambda b: b["recording"]["pairs"] > pairs, "a recording that goes on")
    watcher.tracks(again["at_s"], 20)
    require(daemon.recorder() != recorder, "the recording process is the one that was killed")
    saw = f"recording.error “{beat['heartbeat']['recording']['error']}” in the status; tracks: {changes(watcher, at_s)}"
    lost_tracks = lost(watcher, at_s)
    told = _stop(daemon)
    (second,) = (len(McapRecording(path)) for path in stage.folder.glob("*.mcap") if path != first)
    saved = recover(first, stage.folder / "saved.mcap").pairs
    require(saved + second >= int(str(told["recorded"])), f"{saved} and {second} pairs are there of {told}")
    unrecorded = f"recording: {told['unrecorded']} pairs, all counted"
    return Seen(saw, again["at_s"] - at_s, f"tracks: {lost_tracks}; {unrecorded}")


@fault("disk", "power cut while recording", "SIGKILL to the daemon and its recorder; `needletrack recover`")
def cut_off(stage: Stage) -> Seen:
    """What is in the kernel's hands is saved."""
    daemon, watcher = stage.running("--record", str(stage.folder))
    watcher.heartbeat(0.0, lambda b: b["recording"]["pairs"] > 60, "a recording")
    os.kill(daemon.recorder(), signal.SIGKILL)
    recorded = watcher.since(0.0, "heartbeat")[-1]["heartbeat"]["recording"]["pairs"]
    daemon.signal(signal.SIGKILL)
    ended(daemon)
    damaged = next(stage.folder.glob("*.mcap"))
    began_s = time.monotonic()
    saved = recover(damaged, stage.folder / "saved.mcap")
    took_s = time.monotonic() - began_s
    require(len(McapRecording(stage.folder / "saved.mcap")) == saved.pairs, "what was saved is not whole")
    told = f"{saved.pairs} pairs saved of {recorded} that the last heartbeat called recorded"
    return Seen("gone", took_s, f"{told}; {saved.lost_bytes} bytes at the end were not whole")


def _runs(process: psutil.Process) -> bool:
    """Whether it has not ended; one that nobody has waited for has."""
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _shared_memory(child: Child) -> set[Path]:
    """The files of the memory that it shares with its own processes; others of this machine may share some, too."""
    mapped = Path(f"/proc/{child.process.pid}/maps").read_text(encoding="utf-8").split()
    return {Path(word) for word in mapped if word.startswith("/dev/shm/psm_")}


def _any_ok(watcher: Watcher, since_s: float) -> bool:
    return any(seen["status"] == "ok" for seen in watcher.since(since_s, "track"))


def _first(errors: set[str]) -> str:
    return f"“{sorted(errors)[0]}”" if errors else "none"


def _refused(stage: Stage, *options: str) -> Seen:
    watcher = stage.watcher()
    daemon = stage.daemon(*options)
    code = ended(daemon)
    state = watcher.since(0.0, "health")[-1]["health"]
    told = daemon.stderr().strip().splitlines()[-1].removeprefix("needletrack: ")
    return Seen(f"{state}; the daemon ends with exit code {code}: “{short(told, stage)}”", None, NOTHING)


def _recording_resumes(watcher: Watcher, beat: dict[str, object], gone_s: float | None = None) -> Seen:
    """What a paused recording cost, and when it went on; gone_s: when the cause was gone."""
    at_s = float(str(beat["at_s"]))
    again = watcher.heartbeat(
        gone_s or at_s,
        lambda b: b["recording"]["error"] is None and b["recording"]["pairs"],
        "a recording that goes on",
    )
    error = beat["heartbeat"]["recording"]["error"]  # type: ignore[index]
    watcher.tracks(again["at_s"], 5)
    unrecorded = watcher.since(0.0, "heartbeat")[-1]["heartbeat"]["recording"]["dropped"]
    saw = f"recording.error “{str(error).rsplit('/', maxsplit=1)[-1]}” in the status; tracks: {changes(watcher, at_s)}"
    cost = f"tracks: {lost(watcher, at_s)}; recording: {unrecorded} pairs"
    return Seen(saw, again["at_s"] - (gone_s or at_s), cost)


def _stop(daemon: Child) -> dict[str, object]:
    daemon.signal(signal.SIGTERM)
    ended(daemon)
    return said_last(daemon.process.stdout)


@contextmanager
def _mounted(at: Path) -> Iterator[Path]:
    """A tmpfs of 64 MB."""
    at.mkdir()
    _run("mount", "-t", "tmpfs", "-o", "size=64m", "needletrack", str(at))
    try:
        yield at
    finally:
        _run("umount", "-l", str(at))


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotHere(f"{' '.join(command[:2])}: {done.stderr.strip()}")
