"""The facts about machine, versions and load without which a time means nothing."""

import os
import platform
import re
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Self

import psutil
from pydantic import BaseModel, ConfigDict

from benchmarks.threads import thread_counts

LIBRARIES = (
    "needletrack", "numpy", "opencv-python-headless", "scipy", "scikit-image", "pydantic", "eclipse-zenoh",
)  # fmt: skip
ROOT = Path(__file__).parents[1]
HISTORY = ROOT / "build" / "bench"


class Machine(BaseModel):
    """Where and what was measured; commit: None outside a git work tree; dirty: the tree was changed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cpu: str
    cores: int
    cores_usable: int
    memory_mb: int
    system: str
    python: str
    libraries: Mapping[str, str]
    threads: Mapping[str, int]
    commit: str | None
    dirty: bool | None

    @classmethod
    def here(cls) -> Self:
        """This machine, as this process sees it now."""
        commit = _git("rev-parse", "--verify", "--quiet", "HEAD")
        changes = _git("status", "--porcelain")
        return cls(
            cpu=_cpu(),
            cores=psutil.cpu_count() or 1,
            cores_usable=len(os.sched_getaffinity(0)),
            memory_mb=round(psutil.virtual_memory().total / 1e6),
            system=_system(),
            python=platform.python_version(),
            libraries={name: version(name) for name in LIBRARIES},
            threads=thread_counts(),
            commit=commit,
            dirty=None if changes is None else bool(changes),
        )


class Load(BaseModel):
    """When it was measured, and what else ran: load averages over 1, 5 and 15 minutes at start and end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    started_at: str
    ended_at: str
    at_start: tuple[float, float, float]
    at_end: tuple[float, float, float]


def now() -> str:
    """This moment, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def stem(machine: Machine, started_at: str) -> str:
    """What a run's record is called: commit and time."""
    commit = (machine.commit or "uncommitted")[:12] + ("-changed" if machine.dirty else "")
    return f"{commit}-{started_at[:19].replace(':', '').replace('-', '')}"


def _system() -> str:
    """`Linux 6.18`: what follows in a kernel's release names its builder and the machine."""
    numbers = re.match(r"\d+(\.\d+)?", platform.release())
    return f"{platform.system()} {numbers[0] if numbers else ''}".strip()


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    if "model name" not in fields:
        return platform.machine()
    # Virtual machines shorten the name: family and model tell the generation.
    return f"{fields['model name']} (family {fields.get('cpu family', '?')}, model {fields.get('model', '?')})"


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
