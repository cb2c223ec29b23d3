"""What a fault needs around it: the processes, the link between them, and what the subscriber wrote."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Self

import psutil
from tests.publish.relay import Relay

from benchmarks.loopback import free_endpoint
from needletrack.authority import init_security
from needletrack.publish.tls import TlsFiles

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "tests" / "data" / "recordings" / "steer-b"
# Only a defect takes so long.
WAIT_S = 60.0
_STARTS_WITHIN_S = 90.0
_FRESH_FOR_S = 0.25
_NICE = -10


class Missed(AssertionError):
    """What should have happened did not."""


def until(condition: Callable[[], Any], what: str, timeout_s: float = WAIT_S) -> Any:
    """The condition's first true value; raises Missed."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if value := condition():
            return value
        time.sleep(0.005)
    raise Missed(f"{what}: not within {timeout_s:g} s")


class Child:
    """A Python module in a process of its own, ended with the stage."""

    def __init__(self, module: str, *arguments: str) -> None:
        self.errors = tempfile.TemporaryFile("w+")  # noqa: SIM115
        env = {
            **os.environ,
            "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            cwd=ROOT,
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
        )

        # Other jobs of a busy machine are not the fault that is looked at.
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, self.process.pid, _NICE)

    def say(self, *command: object) -> None:
        """A command to the daemon's cameras."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def signal(self, number: int) -> float:
        """Send a signal; when."""
        self.process.send_signal(number)
        return time.monotonic()

    def recorder(self) -> int:
        """The process that a daemon writes its recording with."""
        return self._spawned(_writes_a_recording, "a recording process")

    def auditor(self) -> int:
        """The process that a daemon audits its tracks with."""
        return self._spawned(lambda child: not _writes_a_recording(child), "an auditing process")

    def _spawned(self, condition: Callable[[psutil.Process], bool], what: str) -> int:
        def found() -> int | None:
            spawned = [child for child in self.family() if "spawn_main" in " ".join(child.cmdline())]
            return next((child.pid for child in spawned if condition(child)), None)

        return int(until(found, what))

    def family(self) -> list[psutil.Process]:
        """The processes that it started and that still run."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def stderr(self) -> str:
        """What it wrote to stderr so far."""
        self.errors.seek(0)
        return self.errors.read()

    def close(self) -> None:
        """Kill what still runs."""
        with suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.errors):
            with suppress(OSError, ValueError):
                assert pipe is not None
                pipe.close()


def _writes_a_recording(process: psutil.Process) -> bool:
    return any(file.path.endswith(".mcap") for file in process.open_files())


class Watcher(Child):
    """The subscriber, and what it wrote so far."""

    def __init__(self, rig: str, *endpoints: str, options: Sequence[str] = ()) -> None:
        super().__init__("benchmarks.faults.watcher", rig, *endpoints, *options)
        self.seen: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        """Take its lines until it ends, which it does on its own only by a defect."""
        assert self.process.stdout is not None
        with suppress(ValueError):
            for line in self.process.stdout:
                self.seen.append(json.loads(line))

    def since(self, at_s: float, key: str) -> list[dict[str, Any]]:
        """What it saw of a kind from a moment on."""
        return [seen for seen in list(self.seen) if key in seen and seen["at_s"] >= at_s]

    def tracks(self, at_s: float, count: int = 10) -> None:
        """Wait for so many tracks that came after a moment."""
        until(lambda: len(self.since(at_s, "track")) >= count, f"{count} tracks")

    def health(self, at_s: float, *states: str) -> dict[str, Any]:
        """The first change of health after a moment to one of these."""
        found: dict[str, Any] = until(
            lambda: next((seen for seen in self.since(at_s, "health") if seen["health"] in states), None),
            " or ".join(states),
        )
        return found

    def fresh_after(self, at_s: float) -> float:
        """Seconds until it called the track fresh again, and kept to it for a moment."""

        def fresh() -> float | None:
            changes = [seen for seen in list(self.seen) if "health" in seen]
            tracks = self.since(at_s, "track")
            if not changes or changes[-1]["health"] != "fresh" or not tracks:
                return None
            began_s = max(changes[-1]["at_s"], tracks[0]["at_s"])
            return began_s - at_s if time.monotonic() - began_s > _FRESH_FOR_S else None

        return float(until(fresh, "a fresh track"))

    def missed(self, since_s: float) -> tuple[int, int, int]:
        """(dropped by the daemon, lost on the way, overflowed here), of all tracks since a moment."""
        rows = [seen["missed"] for seen in self.since(since_s, "track")]
        dropped, lost, overflowed = (sum(row[i] for row in rows) for i in range(3))
        return dropped, lost, overflowed

    def heartbeat(self, at_s: float, condition: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        """The first heartbeat after a moment for which the condition holds, with `at_s`."""

        def found() -> dict[str, Any] | None:
            return next((s for s in self.since(at_s, "heartbeat") if condition(s["heartbeat"])), None)

        seen: dict[str, Any] = until(found, what)
        return seen

    def drops(self) -> dict[str, int]:
        """The daemon's counts in the newest track."""
        newest = self.since(0.0, "track")[-1]
        return dict(newest["dropped"])


@dataclass
class Stage:
    """One fault's surroundings; everything on it ends with it."""

    folder: Path
    opened: ExitStack = field(default_factory=ExitStack)
    rig: str = field(default_factory=lambda: f"faults-{os.getpid()}")
    endpoint: str = field(default_factory=free_endpoint)
    pki: Path | None = None

    @classmethod
    @contextmanager
    def set(cls) -> Iterator[Self]:
        """A stage with an empty folder."""
        with tempfile.TemporaryDirectory(prefix="needletrack-faults-") as name:
            stage = cls(Path(name))
            with stage.opened:
                yield stage

    def secure(self) -> Path:
        """An authority and certificates for the rig, which daemon and subscriber show from now on; their folder."""
        self.pki = self.folder / "pki"
        self.endpoint = secured(self.endpoint)
        init_security(self.pki, self.rig)
        return self.pki

    def files(self, role: str, rig: str | None = None) -> TlsFiles:
        """What a role of a rig, without any this one, shows."""
        assert self.pki is not None
        folder = self.pki / (rig or self.rig) / role
        return TlsFiles(folder / "authority.pem", folder / "certificate.pem", folder / "key.pem")

    def daemon(self, *arguments: str, listen: bool = True) -> Child:
        """A daemon, started and not waited for."""
        here = ["--listen", self.endpoint] if listen else []
        command = [str(RECORDING), "--name", self.rig, *here, *self._shown("publisher"), *arguments]
        return self._child(Child("benchmarks.faults.daemon", *command))

    def watcher(self, *endpoints: str, mode: str = "peer", options: Sequence[str] = ()) -> Watcher:
        """A subscriber, started and not waited for; mode: client of a router, or peer; options: of watcher.py."""
        options = ["--mode", mode, *self._shown("controller"), *options]
        watcher = Watcher(self.rig, *(endpoints or (self.endpoint,)), options=options)
        self.opened.callback(watcher.close)
        return watcher

    def bystanders(self, role: str, count: int, *options: str) -> None:
        """Other subscribers of the tracks (benchmarks/fanout.py), there as this returns."""
        command = ["--role", role, "--rig", self.rig, *options, self.endpoint, self.endpoint]
        for child in [self._child(Child("benchmarks.fanout", *command)) for _ in range(count)]:
            assert child.process.stdout is not None
            if child.process.stdout.readline() != "ready\n":
                raise Missed(f"another subscriber did not start: {child.stderr()[-500:]}")

    def router(self) -> Child:
        """A router at the stage's endpoint."""
        return self._child(Child("benchmarks.faults.router", self.endpoint))

    def link(self) -> Relay:
        """A link to the stage's endpoint."""
        return self.opened.enter_context(Relay(int(self.endpoint.rsplit(":", 1)[1])))

    def running(self, *arguments: str) -> tuple[Child, Watcher]:
        """A daemon and a subscriber that calls its tracks fresh."""
        daemon, watcher = self.daemon(*arguments), self.watcher()
        fresh(watcher)
        return daemon, watcher

    def _shown(self, role: str) -> list[str]:
        return [] if self.pki is None else ["--tls", str(self.pki / self.rig / role)]

    def _child(self, child: Child) -> Child:
        self.opened.callback(child.close)
        return child


def secured(endpoint: str) -> str:
    """The same place, over TLS."""
    return endpoint.replace("tcp/", "tls/")


def fresh(watcher: Watcher) -> None:
    """Wait for the first tracks of a stage, and for the rate to be known."""

    def enough() -> bool:
        if watcher.process.poll() is not None:
            raise Missed(f"the subscriber ended: {watcher.stderr()[-500:]}")
        return len(watcher.since(0.0, "track")) >= 20

    until(enough, "the first tracks", _STARTS_WITHIN_S)
    watcher.fresh_after(time.monotonic())


def routing(router: Child) -> float:
    """Wait until a router takes connections; when it did."""
    assert router.process.stdout is not None
    if router.process.stdout.readline() != "routing\n":
        raise Missed(f"the router ended: {router.stderr()[-500:]}")
    return time.monotonic()


def ended(child: Child, timeout_s: float = WAIT_S) -> int:
    """A child's exit code, once it has ended."""
    return child.process.wait(timeout_s)


def said_last(file: IO[str] | None) -> dict[str, Any]:
    """The last line that a daemon wrote to stdout."""
    assert file is not None
    summary: dict[str, Any] = json.loads(file.read().splitlines()[-1])
    return summary
