"""The floors of the house: imports point downwards, and the mathematics stays pure."""

import ast
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "needletrack"

# A file imports from lower floors or from its own room. A room is a module or package of src/needletrack.
FLOORS: dict[str, float] = {
    "errors": 0.0,
    "aside": 0.0,
    "records": 0.1,
    "kernels": 0.2,
    "geometry": 1.0,
    "tracking": 2.0,
    "calibration": 2.0,
    "synthetic": 2.0,
    "reading": 2.5,
    "validation": 3.0,
    "rig": 3.1,
    "formats": 3.15,
    "capture": 3.15,
    "config": 3.2,
    "publish": 3.4,
    "pictures": 3.4,
    "recording": 3.5,
    "client": 3.5,
    "authority": 3.5,
    "router": 3.5,
    "scoring": 3.5,
    "auditing": 3.6,
    "service": 4.0,
    "guidance": 4.1,
    "watch": 4.1,
    "table1": 4.1,
    "api": 5.0,
    "__init__": 5.1,
    "terminal": 5.2,
    "replay": 5.2,
    "daemon": 5.2,
    "doctor": 5.25,
    "demo": 5.3,
    "report": 5.3,
    "cli": 5.4,
    "__main__": 5.5,
}

PURE_ROOMS = ("geometry", "tracking", "calibration")
FILES = {"fcntl", "glob", "io", "mmap", "os", "pathlib", "pickle", "shutil", "tempfile", "yaml"}
CLOCKS = {"datetime", "time"}
THREADS = {"asyncio", "concurrent", "multiprocessing", "signal", "subprocess", "threading"}
OUTSIDE = {"logging", "random", "socket", "sys", "zenoh"}
IMPURE_MODULES = FILES | CLOCKS | THREADS | OUTSIDE
IMPURE_CALLS = {
    "open",
    "print",
    "input",
    "imread",
    "imwrite",
    "VideoCapture",
    "savefig",
    "tofile",
    "fromfile",
}
# A track says how long each stage took.
PURITY_EXCEPTIONS = {("tracking/stopwatch.py", "time")}

NAMES_THAT_SAY_NOTHING = {"util", "utils", "helper", "helpers", "common", "misc", "manager", "managers"}

SOURCES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))


def room_of(path: str) -> str:
    """`tracking` for tracking/track.py, `rig` for rig.py."""
    return path.split("/", maxsplit=1)[0].removesuffix(".py")


ROOMS = {room_of(path) for path in SOURCES} | FLOORS.keys()


def imports_of(path: str, source: str) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of everything that a file of the package imports, at any depth of the code."""
    parents = ["needletrack", *path.split("/")[:-1]]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(parents[: len(parents) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def rooms_entered(path: str, source: str) -> Iterator[tuple[int, str]]:
    """(line, room) of each import from needletrack itself."""
    for line, name in imports_of(path, source):
        parts = name.split(".")
        if parts[0] == "needletrack":
            # `from needletrack import track`: a name that is no room comes from __init__.py.
            yield line, parts[1] if len(parts) > 1 and parts[1] in ROOMS else "__init__"


def upward_imports(path: str, source: str) -> list[str]:
    """One sentence for each import from a room that is not below (or has no floor at all)."""
    room = room_of(path)
    return [
        f"{path}:{line} (floor {FLOORS[room]:g}) imports {target} (floor {FLOORS.get(target, math.nan):g})"
        for line, target in rooms_entered(path, source)
        if target != room and FLOORS.get(target, math.inf) >= FLOORS[room]
    ]


def impurities(path: str, source: str) -> list[str]:
    found = [
        f"{path}:{line} imports {name}"
        for line, name in imports_of(path, source)
        if (module := name.split(".")[0]) in IMPURE_MODULES and (path, module) not in PURITY_EXCEPTIONS
    ]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in IMPURE_CALLS:
                found.append(f"{path}:{node.lineno} calls {called}()")
    return found


def read(path: str) -> str:
    return (PACKAGE / path).read_text(encoding="utf-8")


def test_every_room_has_a_floor() -> None:
    rooms = {room_of(path) for path in SOURCES}
    homeless = sorted(ROOMS - FLOORS.keys())
    assert not homeless, f"give {', '.join(homeless)} a floor in FLOORS of tests/test_architecture.py"
    empty = sorted(FLOORS.keys() - rooms)
    assert not empty, f"FLOORS names {', '.join(empty)}, which src/needletrack does not have"


@pytest.mark.parametrize("path", [path for path in SOURCES if room_of(path) in FLOORS])
def test_imports_point_downwards(path: str) -> None:
    assert upward_imports(path, read(path)) == []


@pytest.mark.parametrize("path", [path for path in SOURCES if room_of(path) in PURE_ROOMS])
def test_the_mathematics_is_pure(path: str) -> None:
    assert impurities(path, read(path)) == []


def test_every_file_name_says_what_is_in_it() -> None:
    words = {path: set(re.split(r"[/_.]", path)) for path in SOURCES}
    assert [path for path, parts in words.items() if parts & NAMES_THAT_SAY_NOTHING] == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/camera.py", "from needletrack.tracking.track import track"),
        ("geometry/camera.py", "import needletrack.rig"),
        ("geometry/camera.py", "from needletrack import rig"),
        ("geometry/camera.py", "from needletrack import __version__"),
        ("geometry/camera.py", "from .. import service"),
        ("geometry/camera.py", "from ..tracking import track"),
        ("tracking/fit.py", "def f():\n    from needletrack.calibration.solve import solve"),
        ("rig.py", "from .config import Config"),
    ],
)
def test_an_upward_import_is_found(path: str, source: str) -> None:
    assert len(upward_imports(path, source)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/camera.py", "from needletrack.records import Frame"),
        ("geometry/camera.py", "from .transform import RigidTransform"),
        ("tracking/fit.py", "from ..geometry.spline import curvature"),
        ("config.py", "from needletrack.rig import Rig\nimport numpy"),
        ("cli.py", "from needletrack import __version__, demo"),
    ],
)
def test_a_downward_import_is_let_through(path: str, source: str) -> None:
    assert upward_imports(path, source) == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/camera.py", "import time"),
        ("tracking/track.py", "from logging import getLogger"),
        ("tracking/fit.py", "def f():\n    import time"),
        ("calibration/solve.py", "open('x')"),
        ("calibration/solve.py", "import cv2\ncv2.imread('x')"),
    ],
)
def test_an_impurity_is_found(path: str, source: str) -> None:
    assert len(impurities(path, source)) == 1


def test_the_stage_clock_is_let_through() -> None:
    assert impurities("tracking/stopwatch.py", "import time\ntime.perf_counter()") == []
