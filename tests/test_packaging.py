"""What the package carries, and that the lock files are what a stranger's machine can install."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCKS = ("requirements/runtime.lock", "requirements/build.lock", "requirements/dev.lock")


def canonical(requirement: str) -> str:
    """PEP 503 name of a requirement: `PyYAML>=6` is pyyaml."""
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name is not None
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def pins(lock: str) -> dict[str, str]:
    """Requirement line by name; each is followed by its hashes, which are checked here."""
    found = {}
    for entry in re.split(r"\n(?=\S)", (ROOT / lock).read_text(encoding="utf-8").strip()):
        requirement = entry.split(" \\\n")[0]
        assert re.match(r"\S+==\S+", requirement), f"{lock}: {requirement} is not pinned"
        assert "--hash=sha256:" in entry, f"{lock}: {requirement} has no hash"
        found[canonical(requirement)] = requirement
    return found


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_names_no_index_and_no_host(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    assert not re.search(r"://|--(extra-)?index|--find-links|@ ", text)


def test_the_locks_cover_what_pyproject_asks_for() -> None:
    runtime, build, everything = (pins(lock) for lock in LOCKS)
    asked = {canonical(requirement) for requirement in PROJECT["project"]["dependencies"]}
    groups = PROJECT["dependency-groups"]
    asked_to_build = {canonical(requirement) for requirement in groups["build"]}
    asked_to_develop = {canonical(entry) for entry in groups["dev"] if isinstance(entry, str)}
    assert asked - runtime.keys() == set(), "run make lock"
    assert asked_to_build - build.keys() == set(), "run make lock"
    assert asked_to_develop - everything.keys() == set(), "run make lock"
    # What is tested is what the daemon runs.
    assert runtime.items() | build.items() <= everything.items(), "run make lock"


@pytest.mark.slow
def test_the_wheel_carries_the_typed_package_and_its_licence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        info = f"needletrack-{PROJECT['project']['version']}.dist-info"
        scripts = archive.read(f"{info}/entry_points.txt").decode()
        licence = archive.read(f"{info}/licenses/LICENSE").decode()
    assert "needletrack/py.typed" in names
    assert "needletrack/report/templates/page.html" in names
    assert {name.split("/")[0] for name in names} == {"needletrack", info}
    assert "needletrack = needletrack.cli:app" in scripts
    assert "Apache License" in licence
    assert "END OF TERMS AND CONDITIONS" in licence
