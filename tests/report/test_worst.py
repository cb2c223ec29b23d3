"""Which pairs a report shows in full: the worst, of every kind, and no more than were asked for."""

from needletrack.records import NeedleTrack, Reason, Status
from needletrack.report.figures import PairFigures, Truth
from needletrack.report.worst import Worst

REASONS = {
    Status.OK: (),
    Status.DEGRADED: (Reason.HIGH_UNCERTAINTY,),
    Status.INVALID: (Reason.NO_CANDIDATE,),
}


def figures(number: int, status: Status, sigma_mm: float | None = None, truth: Truth | None = None) -> PairFigures:
    return PairFigures(number, number, 0.0, status, REASONS[status], 0, {}, tip_sigma_mm=sigma_mm, truth=truth)


def chosen(rows: list[PairFigures], most: int) -> list[int]:
    # What is chosen depends on the figures alone.
    track = NeedleTrack(0, Status.INVALID, (Reason.NO_CANDIDATE,))
    worst = Worst(most)
    for row in rows:
        worst.add(row, track)
    return [row.sequence for row, _ in worst.chosen()]


def test_all_are_ranked_where_there_is_room() -> None:
    rows = [
        figures(0, Status.OK, 0.1),
        figures(1, Status.INVALID, truth=Truth(has_needle=False, false_ok=False)),
        figures(2, Status.DEGRADED, 0.5),
        figures(3, Status.INVALID),
        figures(4, Status.DEGRADED, 0.9),
        figures(5, Status.OK, 0.1, Truth(has_needle=True, false_ok=True, tip_mm=3.0)),
        figures(6, Status.OK, 0.2),
    ]
    assert chosen(rows, 10) == [5, 3, 4, 2, 6, 0, 1]


def test_every_status_has_its_places() -> None:
    rows = [figures(number, Status.INVALID) for number in range(100)]
    rows += [figures(number, Status.DEGRADED, number / 100) for number in range(100, 200)]
    rows += [figures(number, Status.OK, number / 1000) for number in range(200, 300)]
    assert chosen(rows, 6) == [0, 1, 199, 198, 299, 298]
    assert chosen(rows[:101], 4) == [0, 1, 2, 100]
    assert chosen(rows, 0) == []


def test_what_was_falsely_ok_comes_before_all_else() -> None:
    bad = Truth(has_needle=True, false_ok=True, worst_mm=2.0)
    rows = [figures(0, Status.INVALID), *(figures(number, Status.OK, 0.1, bad) for number in range(1, 5))]
    assert chosen(rows, 3) == [1, 2, 3]


def test_true_errors_count_before_stated_ones() -> None:
    rows = [
        figures(0, Status.DEGRADED, 9.0, Truth(has_needle=True, false_ok=False, worst_mm=0.1)),
        figures(1, Status.DEGRADED, 0.1, Truth(has_needle=True, false_ok=False, worst_mm=0.2, tip_mm=4.0)),
    ]
    assert chosen(rows, 1) == [1]


def test_of_many_without_a_shape_those_that_lost_one_come_first() -> None:
    rows = [figures(number, Status.DEGRADED if number == 50 else Status.INVALID, 1.0) for number in range(100)]
    assert chosen(rows, 4) == [0, 51, 1, 50]
