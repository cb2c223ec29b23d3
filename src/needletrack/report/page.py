"""The page: every pair tracked as a replay does, the figures of all, the worst ones in full, in one HTML file."""

import platform
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from threading import Event

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from needletrack import __version__
from needletrack.errors import RecordingError
from needletrack.publish.message import TrackMessage
from needletrack.records import REASON_MEANING, NeedleTrack, Reason, Status, StereoPair
from needletrack.replay import Replay
from needletrack.report.arc import arc_figure
from needletrack.report.figures import PairFigures, pair_figures
from needletrack.report.trends import trends_figure
from needletrack.report.views import ViewPictures, magnification, view_pictures
from needletrack.report.whole import WholeFile
from needletrack.report.worst import Worst
from needletrack.scoring import GREATEST_ERROR_MM, TrueShape, recorded_truth
from needletrack.service import RunSummary, Sink

TRUTH_FILE = "truth.json"
_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "matplotlib")


@dataclass(frozen=True, slots=True)
class Written:
    """A report that was written: what the run did, how many pairs are shown in full, and how large the file is."""

    run: RunSummary
    path: Path
    shown: int
    size_bytes: int


def write_report(
    replay: Replay,
    output: Path,
    stop: Event,
    *,
    most: int = 40,
    with_truth: bool = True,
    sinks: Sequence[Sink] = (),
) -> Written:
    """Track all that the replay plays (once), until `stop` is set, and write the page about it.

    most: so many pairs, the worst, are shown in full; the figures are of all. with_truth: compare with the recording's
    truth.json where there is one. Memory holds the figures of all pairs, and the tracks of few. The file appears whole
    or not at all. Raises RecordingError where it cannot be written, or the truth cannot be read.
    """
    truth = _truth(replay.recording.folder) if with_truth else None
    with WholeFile(output) as page:
        gathered = _Gathered(most, truth)
        summary = replay.run(stop, sinks=[gathered, *sinks])
        chosen = gathered.worst.chosen()
        for piece in _pieces(replay, summary, gathered.rows, chosen, truth):
            page.write(piece)
        size_bytes = page.finish()
    return Written(summary, output, len(chosen), size_bytes)


class _Gathered:
    """A sink that keeps the figures of every pair, and the tracks that may be shown in full."""

    def __init__(self, most: int, truth: Mapping[int, TrueShape] | None) -> None:
        self.rows: list[PairFigures] = []
        self.worst = Worst(most)
        self._truth = truth or {}

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        """One more pair."""
        figures = pair_figures(pair, track, self._truth.get(pair.captured_at_ns))
        self.rows.append(figures)
        self.worst.add(figures, track)


def _truth(folder: Path) -> dict[int, TrueShape] | None:
    if not (folder / TRUTH_FILE).exists():
        return None
    try:
        return recorded_truth(folder)
    except RecordingError as error:
        raise RecordingError(f"{error}; --no-truth leaves it out") from error


def _pieces(
    replay: Replay,
    summary: RunSummary,
    rows: Sequence[PairFigures],
    chosen: Sequence[tuple[PairFigures, NeedleTrack]],
    truth: Mapping[int, TrueShape] | None,
) -> Iterator[str]:
    """The page's text, made pair by pair as it is written."""
    environment = Environment(
        loader=PackageLoader("needletrack.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"fixed": _fixed, "seconds": _seconds}
    gates = replay.config.tracking.gates
    has_truth = any(row.truth is not None for row in rows)
    limits = _Limits(gates.max_sigma_mm, gates.max_reprojection_rms_px, gates.min_coverage)
    trends = trends_figure(rows, [figures.sequence for figures, _ in chosen], gates) if rows else None
    yield from environment.get_template("page.html").generate(
        title=f"{replay.recording.folder.resolve().name}: {len(rows)} {'pair' if len(rows) == 1 else 'pairs'} tracked",
        facts=_facts(replay, summary, rows),
        statuses=[(status, summary.statuses.get(status, 0)) for status in Status],
        reasons=[
            (reason, summary.reasons[reason], REASON_MEANING[reason]) for reason in Reason if reason in summary.reasons
        ],
        pairs=len(rows),
        has_truth=has_truth,
        false_ok=[row.sequence for row in rows if row.false_ok],
        medians=_medians(rows, has_truth=has_truth),
        trends=trends,
        index=[_indexed(rank, figures, limits) for rank, (figures, _) in enumerate(chosen)],
        shown=sorted(figures.sequence for figures, _ in chosen),
        rows=rows,
        frames=_frames(replay, chosen, truth, limits),
        status=Status,
    )


# The head


def _facts(replay: Replay, summary: RunSummary, rows: Sequence[PairFigures]) -> list[tuple[str, str]]:
    rig, context = replay.recording.rig, replay.context
    span_s = (rows[-1].captured_at_ns - rows[0].captured_at_ns) / 1e9 if rows else 0.0
    dropped = ", ".join(f"{reason.value} {count}" for reason, count in summary.dropped.items()) or "none"
    rms_px = rig.calibration.reprojection_rms_px
    method = "that of 2017" if replay.method == "reference" else "one curve for both views"
    memory = "every pair without memory" if replay.independent else "each pair from the one before"
    libraries = ", ".join(f"{name.removesuffix('-python-headless')} {version(name)}" for name in _LIBRARIES)
    return [
        ("Recording", str(replay.recording.folder)),
        ("Pairs", f"{len(rows)} tracked of {len(replay.source)} played, {span_s:.2f} s; dropped: {dropped}"),
        ("Method", f"{method}; {memory}"),
        ("Rig", f"{rig.name}, digest {rig.digest}, baseline {rig.baseline_mm:.2f} mm"),
        ("Calibration", f"by {rig.calibration.method}" + ("" if rms_px is None else f", {rms_px:.3f} px rms")),
        ("Configuration", f"digest {context.config_digest}"),
        ("Versions", f"needletrack {__version__}, Python {platform.python_version()}, {libraries}"),
        ("Made", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, in {summary.duration_s:.1f} s of tracking"),
    ]


@dataclass(frozen=True, slots=True)
class _Median:
    name: str
    unit: str
    ok: float | None
    every: float | None
    decimals: int


def _medians(rows: Sequence[PairFigures], *, has_truth: bool) -> list[_Median]:
    """Medians over the ok tracks, and over all that have a shape."""
    wanted: list[tuple[str, str, int, Callable[[PairFigures], float | None]]] = [
        ("tip sigma", "mm", 3, lambda row: row.tip_sigma_mm),
        ("shape sigma, median", "mm", 3, lambda row: row.sigma_p50_mm),
        ("shape sigma, 95 %", "mm", 3, lambda row: row.sigma_p95_mm),
        ("reprojection rms", "px", 3, lambda row: row.reprojection_rms_px),
        ("seen by both", "%", 0, lambda row: None if row.coverage is None else 100 * row.coverage),
        ("length", "mm", 2, lambda row: row.length_mm),
        ("diameter", "mm", 3, lambda row: row.diameter_mm),
        ("time", "ms", 1, lambda row: row.total_ms),
    ]
    if has_truth:
        wanted += [
            ("true tip error", "mm", 3, lambda row: None if row.truth is None else row.truth.tip_mm),
            ("true shape error, rms", "mm", 3, lambda row: None if row.truth is None else row.truth.rms_mm),
            ("true shape error, 95 %", "mm", 3, lambda row: None if row.truth is None else row.truth.worst_mm),
            ("points within 2 sigma", "%", 0, _percent_within),
        ]
    shapes = [row for row in rows if row.status is not Status.INVALID]
    ok = [row for row in shapes if row.status is Status.OK]
    return [
        _Median(name, unit, _median(map(value, ok)), _median(map(value, shapes)), decimals)
        for name, unit, decimals, value in wanted
    ]


def _percent_within(row: PairFigures) -> float | None:
    share = None if row.truth is None else row.truth.within_two_sigma
    return None if share is None else 100 * share


def _median(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


# The index and the tables


@dataclass(frozen=True, slots=True)
class _Limits:
    """What the gates let pass."""

    sigma_mm: float
    rms_px: float
    coverage: float


@dataclass(frozen=True, slots=True)
class _Cell:
    """A number in a table; is_over: beyond its gate, or beyond what is right."""

    value: float | None
    decimals: int
    is_over: bool = False
    is_true: bool = False


@dataclass(frozen=True, slots=True)
class _Indexed:
    rank: int
    figures: PairFigures
    cells: tuple[_Cell, ...]


def _indexed(rank: int, row: PairFigures, limits: _Limits) -> _Indexed:
    tip_mm, rms_mm, worst_mm = (None, None, None)
    if row.truth is not None:
        tip_mm, rms_mm, worst_mm = row.truth.tip_mm, row.truth.rms_mm, row.truth.worst_mm
    cells = (
        _Cell(row.tip_sigma_mm, 3, _is_above(row.tip_sigma_mm, limits.sigma_mm)),
        _Cell(row.sigma_p95_mm, 3, _is_above(row.sigma_p95_mm, limits.sigma_mm)),
        _Cell(row.reprojection_rms_px, 3, _is_above(row.reprojection_rms_px, limits.rms_px)),
        _Cell(None if row.coverage is None else 100 * row.coverage, 0, _is_below(row.coverage, limits.coverage)),
        _Cell(tip_mm, 3, _is_above(tip_mm, GREATEST_ERROR_MM), is_true=True),
        _Cell(rms_mm, 3, is_true=True),
        _Cell(worst_mm, 3, _is_above(worst_mm, GREATEST_ERROR_MM), is_true=True),
        _Cell(_percent_within(row), 0, is_true=True),
    )
    return _Indexed(rank, row, cells)


def _is_above(value: float | None, limit: float) -> bool:
    return value is not None and value > limit


def _is_below(value: float | None, limit: float) -> bool:
    return value is not None and value < limit


@dataclass(frozen=True, slots=True)
class _Fact:
    """A line of a frame's table."""

    name: str
    value: str
    note: str = ""
    is_over: bool = False
    is_true: bool = False


@dataclass(frozen=True, slots=True)
class _Frame:
    """All that a page shows of one pair."""

    figures: PairFigures
    reasons: tuple[tuple[Reason, str], ...]
    views: tuple[ViewPictures, ...]
    magnification: int
    seen: tuple[int, ...]
    is_detected: bool
    arc: Markup | None
    tables: tuple[tuple[str, tuple[_Fact, ...]], ...]


def _frames(
    replay: Replay,
    chosen: Sequence[tuple[PairFigures, NeedleTrack]],
    truth: Mapping[int, TrueShape] | None,
    limits: _Limits,
) -> Iterator[_Frame]:
    """The pairs shown in full, in their own order, each read again as its turn comes."""
    rig = replay.recording.rig
    for figures, track in sorted(chosen, key=lambda entry: entry[0].sequence):
        pair = replay.recording.read(figures.sequence)
        true = (truth or {}).get(figures.captured_at_ns)
        times = magnification(track, pair, rig, true)
        yield _Frame(
            figures,
            tuple((reason, REASON_MEANING[reason]) for reason in figures.reasons),
            view_pictures(track, pair, rig, true, times),
            times,
            () if track.curve is None else tuple(sorted(Counter(track.curve.seen.tolist()), reverse=True)),
            track.evidence.left is not None or track.evidence.right is not None,
            None if track.curve is None else arc_figure(track, pair, rig, true, limits.sigma_mm),
            _tables(figures, track, limits),
        )


def _tables(row: PairFigures, track: NeedleTrack, limits: _Limits) -> tuple[tuple[str, tuple[_Fact, ...]], ...]:
    shape, tip = _shape_facts(row, limits), _tip_facts(row, track, limits)
    times = [_Fact(name, f"{ms:.1f} ms") for name, ms in row.timing_ms.items()]
    if row.total_ms is not None:
        times.append(_Fact("all", f"{row.total_ms:.1f} ms"))
    evidence = [_Fact("skew of the stamps", f"{row.skew_us:.1f} µs")]
    if track.curve is not None:
        evidence[:0] = _evidence_facts(row, limits)
    tables = [("Tip", tip), ("Shape", shape), ("Evidence", tuple(evidence)), ("Time", tuple(times))]
    return tuple((name, facts) for name, facts in tables if facts)


def _evidence_facts(row: PairFigures, limits: _Limits) -> list[_Fact]:
    return [
        _Fact(
            "reprojection",
            _fixed(row.reprojection_rms_px, 3, "px rms"),
            f"gate {limits.rms_px:g}",
            _is_above(row.reprojection_rms_px, limits.rms_px),
        ),
        _Fact("tip off its epipolar line", _fixed(row.epipolar_rms_px, 3, "px")),
        _Fact(
            "seen by both",
            _fixed(None if row.coverage is None else 100 * row.coverage, 0, "%"),
            f"gate {100 * limits.coverage:g}",
            _is_below(row.coverage, limits.coverage),
        ),
        _Fact("pairs since detection", str(row.since_detection)),
    ]


def _tip_facts(row: PairFigures, track: NeedleTrack, limits: _Limits) -> tuple[_Fact, ...]:
    tip, truth = track.tip, row.truth
    if tip is None:
        return (_Fact("tip", "none"),) if track.curve is not None else ()
    deviations_mm = np.sqrt(np.diagonal(tip.covariance_mm2))
    facts = [
        _Fact(axis, _fixed(float(value), 3, "mm"), f"± {sigma:.3f}")
        for axis, value, sigma in zip("xyz", tip.position_mm, deviations_mm, strict=True)
    ]
    is_over = _is_above(row.tip_sigma_mm, limits.sigma_mm)
    facts.append(_Fact("largest sigma", _fixed(row.tip_sigma_mm, 3, "mm"), f"gate {limits.sigma_mm:g}", is_over))
    facts.append(_Fact("direction", ", ".join(_fixed(float(value), 3) for value in tip.direction)))
    if tip.velocity_mm_s is not None:
        facts.append(_Fact("speed", _fixed(float(np.linalg.norm(tip.velocity_mm_s)), 1, "mm/s")))
    if truth is not None and truth.has_needle:
        off = _fixed(truth.tip_mm, 3, "mm") if truth.tip_mm is not None else "hidden from a view"
        facts.append(_Fact("true error", off, "", _is_above(truth.tip_mm, GREATEST_ERROR_MM), is_true=True))
        facts.append(_Fact("true turn", _fixed(truth.direction_deg, 2, "°"), is_true=True))
    return tuple(facts)


def _shape_facts(row: PairFigures, limits: _Limits) -> tuple[_Fact, ...]:
    truth = row.truth
    if row.length_mm is None:
        return ()
    facts = [
        _Fact("length", _fixed(row.length_mm, 2, "mm")),
        _Fact("diameter", _fixed(row.diameter_mm, 3, "mm")),
        _Fact("sigma, median", _fixed(row.sigma_p50_mm, 3, "mm")),
        _Fact(
            "sigma, 95 %",
            _fixed(row.sigma_p95_mm, 3, "mm"),
            f"gate {limits.sigma_mm:g}",
            _is_above(row.sigma_p95_mm, limits.sigma_mm),
        ),
        _Fact("sigma, largest", _fixed(row.sigma_max_mm, 3, "mm")),
    ]
    if truth is not None and truth.rms_mm is not None:
        share = _percent_within(row)
        facts += [
            _Fact("true error, rms", _fixed(truth.rms_mm, 3, "mm"), is_true=True),
            _Fact(
                "true error, 95 %",
                _fixed(truth.worst_mm, 3, "mm"),
                "",
                _is_above(truth.worst_mm, GREATEST_ERROR_MM),
                is_true=True,
            ),
            _Fact("points within 2 sigma", _fixed(share, 0, "%"), is_true=True),
            _Fact("of what is seen, covered", _fixed(100 * (truth.cover or 0.0), 0, "%"), is_true=True),
        ]
        if truth.turned:
            facts.append(_Fact("base and tip", "exchanged", "", is_over=True, is_true=True))
    return tuple(facts)


def _fixed(value: float | None, decimals: int, unit: str = "") -> str:
    """A number with a true minus sign and its unit; a dash for none."""
    if value is None:
        return "–"
    text = f"{value:.{decimals}f}" if abs(value) < 1e6 else f"{value:.1e}"
    return f"{text} {unit}".rstrip().replace("-", "−")


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:.3f} s"
