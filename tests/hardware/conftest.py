"""Tests on the kernel's own test cameras: `make test-hardware` runs them in a guest (guest.sh); elsewhere they skip."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.hardware.vivid import LEFT, RIGHT, bind, control, unbound, vivid_nodes

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if len(vivid_nodes()) >= 2:
        return
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.skip(reason="no pair of vivid cameras here: run `make test-hardware`"))


@pytest.fixture(autouse=True)
def healthy_cameras() -> Iterator[None]:
    """Every test begins with both cameras there, and without what the one before it had broken."""
    if unbound():
        bind()
    for bus in (LEFT, RIGHT):
        control(bus, percentage_of_dropped_buffers=0)
        # Stamps of the start of the exposure are "now"; those of its end lie in the future.
        control(bus, timestamp_source=1)
    yield
    if unbound():
        bind()
