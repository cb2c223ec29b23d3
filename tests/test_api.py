"""What `import needletrack` offers, and what it costs."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import needletrack
from needletrack import NeedleTrack, Rig, Status, find_rig, track
from needletrack.recording.asl import AslRecording

ROOT = Path(__file__).parents[1]


def test_one_call_serves_a_notebook() -> None:
    folder = ROOT / "tests" / "data" / "recordings" / "lab-a"
    pair = AslRecording(folder).read(0)
    rig = find_rig(folder)
    assert isinstance(rig, Rig)
    found = track(pair.left.image, pair.right.image, rig)
    assert isinstance(found, NeedleTrack)
    assert found.status in Status
    assert found.curve is not None


def test_every_public_name_is_there() -> None:
    from needletrack import api

    for name in api.__all__:
        assert getattr(needletrack, name) is getattr(api, name)


def test_any_other_name_is_not() -> None:
    with pytest.raises(AttributeError, match="module 'needletrack' has no attribute 'nonsense'"):
        _ = needletrack.nonsense  # type: ignore[attr-defined]


def test_the_command_line_starts_without_what_is_slow_to_load() -> None:
    code = "import sys, needletrack.cli; sys.exit(bool({'numpy', 'cv2', 'matplotlib'} & sys.modules.keys()))"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_version_is_that_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert needletrack.__version__ == project["version"]
