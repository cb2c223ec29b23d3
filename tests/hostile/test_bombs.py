"""A file that claims or unpacks to gigabytes is refused with little memory and at once."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.hostile.bombs import BOMBS

ROOT = Path(__file__).parents[2]
# The slowest takes 1.3 s here: a hang on a machine that is busy.
_HANGS_S = 20.0


@pytest.fixture(scope="module")
def answers() -> dict[str, dict[str, object]]:
    """What a process of limited memory said to each; none for those after one that ended it."""
    done = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-m", "tests.hostile.bombs"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return {line["name"]: line for line in lines} | {"": {"error": done.stderr[-2000:]}}


@pytest.mark.parametrize("name", BOMBS)
def test_it_is_refused(name: str, answers: dict[str, dict[str, object]]) -> None:
    assert name in answers, f"the process ended before or at it: {answers['']['error']}"
    answer = answers[name]
    # An error that is not ours is told with its name.
    assert isinstance(answer["told"], str)
    assert not answer["told"].startswith("!!")
    assert isinstance(answer["seconds"], float)
    assert answer["seconds"] < _HANGS_S
