"""One setting for all tests: no display, the same examples on every run, and which of them share a process."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"

# A slow or busy machine must not fail a property, nor must chance.
settings.register_profile("needletrack", deadline=None, derandomize=True)
settings.load_profile("needletrack")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of a file share what it draws, so one process runs them all; daemons of one rig exclude one another."""
    tests = Path(__file__).parent
    for item in items:
        place = item.path.relative_to(tests)
        runs_daemons = place.parts[0] in {"daemon", "hostile"}
        item.add_marker(pytest.mark.xdist_group("daemons" if runs_daemons else str(place)))
