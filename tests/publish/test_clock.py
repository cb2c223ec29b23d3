"""The difference of two hosts' clocks, as the RFC has it: a bound that holds, and a clock that is set is seen."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from needletrack.errors import PublishError
from needletrack.publish.clock import ClockFilter, ClockMessage, Question

MS = 1_000_000
DAY_NS = 86_400 * 1_000_000_000


def asked(filter_: ClockFilter, at_ns: int, there_ns: int, held_ns: int, back_ns: int, ahead_ns: int) -> int:
    """One question at a moment of our clock to a daemon whose clock is so far ahead; when its answer came."""
    received_ns = at_ns + there_ns + ahead_ns
    answered_ns = at_ns + there_ns + held_ns + back_ns
    answer = ClockMessage.now(received_ns, received_ns + held_ns)
    # Our monotonic clock began an hour after the epoch of the other one.
    filter_.add(Question(at_ns, at_ns - 3_600_000 * MS), answer, answered_ns - 3_600_000 * MS)
    return answered_ns - 3_600_000 * MS


times = st.integers(0, 2_000 * MS)


@given(ahead_ns=st.integers(-DAY_NS, DAY_NS), ways=st.lists(st.tuples(times, times, times), min_size=1, max_size=12))
def test_the_truth_is_within_the_stated_uncertainty(ahead_ns: int, ways: list[tuple[int, int, int]]) -> None:
    clock, at_ns = ClockFilter(), DAY_NS * 20_000
    for there_ns, held_ns, back_ns in ways:
        answered_ns = asked(clock, at_ns, there_ns, held_ns, back_ns, ahead_ns)
        found = clock.at(answered_ns)
        assert found is not None
        assert abs(found.ours_minus_daemons_ms + ahead_ns / 1e6) <= found.uncertainty_ms + 1e-4
        at_ns += 5_000 * MS


def test_the_shortest_way_counts_and_ages() -> None:
    clock = ClockFilter()
    at_ns, answered_ns = DAY_NS, 0
    for way_ms in (40, 2, 90):
        answered_ns = asked(clock, at_ns, way_ms * MS, 0, 0, 7 * MS)
        at_ns += 1_000 * MS
    found, later = clock.at(answered_ns), clock.at(answered_ns + 100 * 1_000 * MS)
    assert found is not None
    assert later is not None
    assert found.uncertainty_ms == pytest.approx(1.0, abs=0.1)
    assert later.uncertainty_ms == pytest.approx(found.uncertainty_ms + 100 * 1000 * 30e-6)


def test_a_clock_that_was_set_is_believed_at_once() -> None:
    clock = ClockFilter()
    asked(clock, DAY_NS, MS, 0, MS, 0)
    answered_ns = asked(clock, DAY_NS + 1_000 * MS, 20 * MS, 0, 20 * MS, 500 * MS)
    found = clock.at(answered_ns)
    assert found is not None
    assert found.ours_minus_daemons_ms == pytest.approx(-500.0)
    assert str(found) == "ours is 500.00 ± 20.00 ms behind"


@pytest.mark.parametrize(("received_ns", "replied_ns"), [(10, 5), (0, 10_000 * MS)])
def test_an_answer_that_cannot_be_is_left_out(received_ns: int, replied_ns: int) -> None:
    clock = ClockFilter()
    clock.add(Question(0, 0), ClockMessage.now(received_ns, replied_ns), 5 * MS)
    assert clock.at(5 * MS) is None


def test_a_broken_answer_is_refused() -> None:
    with pytest.raises(PublishError, match=r"needletrack\.clock\.v1"):
        ClockMessage.from_json(b'{"version": 1, "received_at_ns": "now"}')
