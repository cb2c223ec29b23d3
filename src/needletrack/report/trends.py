"""How the figures went over the pairs of a recording: one drawing, whose rows share the pairs' numbers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from needletrack.records import Float, Int, Status
from needletrack.report.figures import PairFigures, Truth
from needletrack.report.svg import Element, Panel, drawing, element, markup
from needletrack.tracking.gates import GateParameters

WIDTH_PX = 1180
_LEFT_PX, _RIGHT_PX = 116, 12
_ROW_PX, _GAP_PX, _LANE_PX = 92, 12, 17
_MOST_COLUMNS = 540
_STAGES = 6
_LEAST_MM = 1e-3


@dataclass(frozen=True, slots=True)
class _Series:
    """One value a pair (N,), NaN where it has none; kind is the class of its line; is_true: from the truth."""

    name: str
    kind: str
    values: Float
    is_true: bool = False


@dataclass(frozen=True, slots=True)
class _Columns:
    """The pairs in columns of the drawing: their numbers (K,), and which pairs (N,) are in which column."""

    sequence: Float
    column: Int
    pairs_each: int

    @classmethod
    def of(cls, rows: Sequence[PairFigures]) -> "_Columns":
        each = max(1, int(np.ceil(len(rows) / _MOST_COLUMNS)))
        column = np.arange(len(rows)) // each
        numbers = np.array([row.sequence for row in rows], dtype=np.float64)
        return cls(np.array([numbers[column == index].mean() for index in range(int(column[-1]) + 1)]), column, each)

    def spread(self, values: Float) -> tuple[Float, Float, Float]:
        """Least, median and greatest (K,) of each column; NaN where it has no value."""
        found = np.full((3, len(self.sequence)), np.nan)
        for index in range(len(self.sequence)):
            known = values[self.column == index]
            known = known[np.isfinite(known)]
            if len(known):
                found[:, index] = known.min(), np.median(known), known.max()
        return found[0], found[1], found[2]


def trends_figure(rows: Sequence[PairFigures], shown: Sequence[int], gates: GateParameters) -> Markup:
    """Status, sigmas, errors, residual, coverage, length, diameter and times over the pairs (one or more).

    shown: numbers of the pairs that the page shows in full; pointing at their column leads there. Where there are too
    many pairs, each column of the drawing is several: a line through their medians within the band of all.
    """
    columns = _Columns.of(rows)
    charts = _charts(rows, gates)
    has_truth = any(row.truth is not None for row in rows)
    lanes = [status.value for status in Status] + (["falsely ok"] if has_truth else [])
    top = 4 + len(lanes) * _LANE_PX + _GAP_PX
    bottom = top + len(charts) * (_ROW_PX + _GAP_PX) - _GAP_PX
    svg = drawing(WIDTH_PX, bottom + 44, "Figures over the pairs", class_="trends")
    first, last = rows[0].sequence, rows[-1].sequence
    x_range = (first - 0.5, last + 0.5)
    width = WIDTH_PX - _LEFT_PX - _RIGHT_PX
    _draw_lanes(Panel(svg, _LEFT_PX, 4, width, len(lanes) * _LANE_PX, x_range, (len(lanes), 0)), rows, columns, lanes)
    y = float(top)
    panel = None
    for chart in charts:
        panel = Panel(svg, _LEFT_PX, y, width, _ROW_PX, x_range, chart.range, chart.log)
        chart.draw(panel, columns)
        y += _ROW_PX + _GAP_PX
    if panel is not None:
        each = (
            f"; each column is {columns.pairs_each} pairs: median, least to greatest" if columns.pairs_each > 1 else ""
        )
        panel.x_axis(f"pair{each}", whole=True)
    _link(svg, rows, shown, x_range, bottom)
    return markup(svg)


@dataclass(frozen=True, slots=True)
class _Chart:
    """One row of the drawing."""

    label: str
    unit: str
    series: tuple[_Series, ...]
    log: bool = False
    gate: tuple[float, str] | None = None
    limits: tuple[float, float] | None = None
    from_zero: bool = True

    @property
    def range(self) -> tuple[float, float]:
        """Of the values and the gate, with some room above for the legend."""
        if self.limits is not None:
            return self.limits
        every = np.concatenate([series.values for series in self.series])
        every = every[np.isfinite(every)]
        if self.gate is not None:
            every = np.append(every, self.gate[0])
        if len(every) == 0:
            return (0.1, 1.0)
        if self.log:
            return max(_LEAST_MM, 0.7 * float(every.min())), 3.0 * max(float(every.max()), 2 * _LEAST_MM)
        if self.from_zero:
            return 0.0, 1.4 * max(float(every.max()), 1e-3)
        least, most = np.percentile(every, (1, 99)).tolist()
        room = max(0.2 * (most - least), 0.05 * abs(most), 1e-3)
        return least - room, most + room

    def draw(self, panel: Panel, columns: _Columns) -> None:
        """Its frame, lines and legend."""
        panel.frame(self.label, self.unit, 3)
        if self.gate is not None:
            panel.level(*self.gate)
        for series in self.series:
            into = panel.layer("truth") if series.is_true else panel
            low, middle, high = columns.spread(np.maximum(series.values, _LEAST_MM) if self.log else series.values)
            if columns.pairs_each > 1:
                into.band(columns.sequence, low, high, series.kind)
            into.line(columns.sequence, middle, series.kind)
            if len(columns.sequence) <= 120:
                into.dots(columns.sequence, middle, series.kind)
        panel.legend([(series.name, series.kind) for series in self.series if series.name])


def _charts(rows: Sequence[PairFigures], gates: GateParameters) -> list[_Chart]:
    def of(name: str, kind: str, value: Callable[[PairFigures], float | None]) -> _Series:
        return _Series(name, kind, np.array([value(row) for row in rows], dtype=np.float64))

    def true(name: str, kind: str, value: Callable[[Truth], float | None]) -> _Series:
        known = [None if row.truth is None else value(row.truth) for row in rows]
        return _Series(name, kind, np.array(known, dtype=np.float64), is_true=True)

    sigma_gate = (gates.max_sigma_mm, f"gate {gates.max_sigma_mm:g}")
    charts = [
        _Chart(
            "tip",
            "mm",
            (of("stated sigma", "sigma", lambda row: row.tip_sigma_mm), true("true error", "true", lambda t: t.tip_mm)),
            log=True,
            gate=sigma_gate,
        ),
        _Chart(
            "shape",
            "mm",
            (
                of("sigma, median", "sigma faint", lambda row: row.sigma_p50_mm),
                of("sigma, 95 %", "sigma", lambda row: row.sigma_p95_mm),
                true("true error, rms", "true faint", lambda t: t.rms_mm),
                true("true error, 95 %", "true", lambda t: t.worst_mm),
            ),
            log=True,
            gate=sigma_gate,
        ),
        _Chart(
            "points within\n2 sigma", "share", (true("", "true", lambda t: t.within_two_sigma),), limits=(-0.03, 1.12)
        ),
        _Chart(
            "reprojection",
            "px rms",
            (of("", "plain", lambda row: row.reprojection_rms_px),),
            gate=(gates.max_reprojection_rms_px, f"gate {gates.max_reprojection_rms_px:g}"),
        ),
        _Chart(
            "seen by both",
            "share",
            (of("", "plain", lambda row: row.coverage),),
            gate=(gates.min_coverage, f"gate {gates.min_coverage:g}"),
            limits=(-0.03, 1.12),
        ),
        _Chart("length", "mm", (of("", "plain", lambda row: row.length_mm),), from_zero=False),
        _Chart("diameter", "mm", (of("", "plain", lambda row: row.diameter_mm),), from_zero=False),
        _Chart("time", "ms", _times(rows)),
    ]
    known = []
    for chart in charts:
        series = tuple(each for each in chart.series if np.isfinite(each.values).any())
        if series:
            known.append(replace(chart, series=series))
    return known


def _times(rows: Sequence[PairFigures]) -> tuple[_Series, ...]:
    """All stages together, and each of those that take longest."""
    total = np.array([row.total_ms for row in rows], dtype=np.float64)
    names = {name for row in rows for name in row.timing_ms}
    stages = {name: np.array([row.timing_ms.get(name) for row in rows], dtype=np.float64) for name in sorted(names)}
    longest = sorted(stages, key=lambda name: -float(np.nansum(stages[name])))[:_STAGES]
    each = [_Series(name, f"stage-{index}", stages[name]) for index, name in enumerate(longest)]
    return (_Series("all", "plain", total), *each)


def _draw_lanes(panel: Panel, rows: Sequence[PairFigures], columns: _Columns, lanes: Sequence[str]) -> None:
    """One lane a status, so that no colour is needed to tell them apart; how dark says how many of a column."""
    element(panel.svg, "rect", x=panel.x, y=panel.y, width=panel.width, height=panel.height, class_="panel")
    half = columns.pairs_each / 2
    for lane, name in enumerate(lanes):
        middle = panel.y + (lane + 0.5) * _LANE_PX
        element(panel.svg, "text", name, x=panel.x - 6, y=middle + 4, class_="tick end")
        is_there = np.array([row.false_ok if name == "falsely ok" else row.status.value == name for row in rows])
        shares = columns.spread(is_there.astype(np.float64))
        mean = np.array([is_there[columns.column == index].mean() for index in range(len(columns.sequence))])
        for number, share, any_there in zip(columns.sequence, mean, shares[2], strict=True):
            if not any_there:
                continue
            left, right = panel.place([number - half, number + half], 0)[:, 0].tolist()
            gap = 1.0 if right - left > 6 else 0.0
            element(
                panel.svg,
                "rect",
                x=panel.x + left + gap / 2,
                y=panel.y + lane * _LANE_PX + 1.5,
                width=max(right - left - gap, 1.5),
                height=_LANE_PX - 3,
                class_=f"lane {name.replace(' ', '-')}",
                opacity=0.35 + 0.65 * float(share),
            )


def _link(
    svg: Element, rows: Sequence[PairFigures], shown: Sequence[int], x_range: tuple[float, float], bottom: float
) -> None:
    """Columns that lead to the pairs shown in full, and say their status when pointed at."""
    width = WIDTH_PX - _LEFT_PX - _RIGHT_PX
    by_number = {row.sequence: row for row in rows}
    step = width / (x_range[1] - x_range[0])
    for number in sorted(shown):
        row = by_number[number]
        wide = max(step, 3.0)
        left = _LEFT_PX + (number - x_range[0]) * step - wide / 2
        link = element(svg, "a", href=f"#pair-{number}")
        column = element(link, "rect", x=left, y=4, width=wide, height=bottom - 4, class_="column")
        reasons = ", ".join(reason.value for reason in row.reasons)
        element(column, "title", f"pair {number}: {row.status.value}{': ' if reasons else ''}{reasons}")
