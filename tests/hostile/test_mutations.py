"""Whatever a file holds, it is read or refused in words: no other exception, no warning, no wait."""

import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.hostile.edges import EDGES, Edge
from tests.hostile.mutations import damaged

# The slowest takes 0.1 s here; this is a hang on a machine that is busy.
_HANGS_S = 10.0
_LONGEST_TOLD = 3000
PROFILE = settings(
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
)


def check(edge: Edge, content: bytes) -> None:
    began_s = time.monotonic()
    with edge.folder() as folder:
        told = edge.refusal(folder, content)
        assert time.monotonic() - began_s < _HANGS_S
        if told is not None:
            assert folder.name in told or edge.file.rsplit("/", maxsplit=1)[-1] in told
            assert len(told) < _LONGEST_TOLD


@pytest.mark.parametrize("edge", EDGES, ids=lambda edge: edge.name)
def test_the_valid_files_are_taken(edge: Edge) -> None:
    for content in edge.valid():
        with edge.folder() as folder:
            assert edge.refusal(folder, content) is None


@pytest.mark.parametrize("edge", EDGES, ids=lambda edge: edge.name)
def test_a_damaged_file_is_read_or_refused(edge: Edge) -> None:
    @settings(PROFILE, max_examples=15)
    @given(st.data())
    def run(data: st.DataObject) -> None:
        check(edge, data.draw(damaged(edge)))

    run()


@pytest.mark.slow
@pytest.mark.parametrize("edge", EDGES, ids=lambda edge: edge.name)
def test_a_thousand_damaged_files_are_read_or_refused(edge: Edge) -> None:
    @settings(PROFILE, max_examples=1000)
    @given(st.data())
    def run(data: st.DataObject) -> None:
        check(edge, data.draw(damaged(edge)))

    run()
