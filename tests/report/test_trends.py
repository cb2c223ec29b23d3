"""The figures over the pairs: all of them for a few, columns of several for many."""

import re

import numpy as np
from tests.report.html_page import Node, parsed

from needletrack.records import Reason, Status
from needletrack.report.figures import PairFigures, Truth
from needletrack.report.trends import trends_figure
from needletrack.tracking.gates import GateParameters

MOST_BYTES = 400_000


def rows(count: int) -> list[PairFigures]:
    random = np.random.default_rng(7)
    made = []
    for number in range(count):
        status = (Status.OK, Status.DEGRADED, Status.INVALID)[int(random.choice(3, p=[0.8, 0.15, 0.05]))]
        found = status is not Status.INVALID
        made.append(
            PairFigures(
                number,
                number * 33_333_333,
                1.0,
                status,
                () if status is Status.OK else (Reason.JUMP,),
                0,
                {"refine": 30.0 + random.normal()},
                tip_sigma_mm=float(random.lognormal(-2)) if found else None,
                length_mm=80.0 + number / count if found else None,
                truth=Truth(has_needle=True, false_ok=number == 7, tip_mm=0.2 if found else None),
            )
        )
    return made


def drawn(count: int, shown: tuple[int, ...] = ()) -> tuple[str, Node]:
    text = str(trends_figure(rows(count), shown, GateParameters()))
    return text, parsed(text)


def test_each_pair_has_its_lane_and_interrupts_the_lines_where_it_has_nothing() -> None:
    every = rows(50)
    text, svg = drawn(50, (3, 7))
    for status in Status:
        assert len(svg.all("rect", "lane", status.value)) == sum(row.status is status for row in every)
    assert len(svg.all("rect", "lane", "falsely-ok")) == 1
    sigma = svg.one("path", "line", "sigma").attributes["d"]
    known = [row.tip_sigma_mm is not None for row in every]
    starts = sum(now and not before for now, before in zip(known, [False, *known], strict=False))
    assert sigma.count("M") == starts
    assert len(re.findall("[ML]", sigma)) == sum(known)
    links = [link.attributes["href"] for link in svg.all("a")]
    assert links == ["#pair-3", "#pair-7"]
    assert "pair 7: " in svg.text
    assert "falsely ok" in text


def test_a_long_recording_is_drawn_in_columns_and_stays_small() -> None:
    text, svg = drawn(18_000, (123,))
    assert len(text) < MOST_BYTES
    assert "each column is 34 pairs" in svg.text
    # One false ok of eighteen thousand is still to be seen.
    assert len(svg.all("rect", "lane", "falsely-ok")) == 1
    assert svg.all("path", "band", "sigma")


def test_what_no_pair_has_is_left_out() -> None:
    _, svg = drawn(20)
    labels = {node.text for node in svg.all("text", "label")}
    assert {"tip", "length", "time"} <= labels
    assert not {"diameter", "shape", "reprojection"} & labels


def test_one_pair_is_drawn_too() -> None:
    _, svg = drawn(1)
    assert len([rect for rect in svg.all("rect", "lane") if "falsely-ok" not in rect.classes]) == 1
