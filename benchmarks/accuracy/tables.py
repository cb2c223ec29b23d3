"""The results as one table a recording; docs/accuracy.md explains them."""

from os.path import relpath

from rich.console import Console

from benchmarks.accuracy.report import AccuracyReport, RecordingAccuracy, Row
from benchmarks.machine import ROOT
from benchmarks.tables import Titled, headed, markdown, print_titled

BEGIN, END = "<!-- accuracy:begin -->", "<!-- accuracy:end -->"

_HEADINGS = (
    "method", "frames", "ok", "degraded", "invalid", "tip p50", "tip p95", "direction p50", "rms p50", "worst p95",
    "cover p50", "in 2 sigma", "sigma p50", "degraded rms", "degraded cover", "FALSE OK", "if believed", "ms a pair",
)  # fmt: skip


def show(report: AccuracyReport, console: Console) -> None:
    """Print every table of a report; into a pipe or a file as Markdown."""
    for titled in _tables(report):
        print_titled(*titled, console)


def as_markdown(report: AccuracyReport) -> str:
    """Every table of a report, for a page."""
    parts = [f"### {title}\n\n{markdown(table)}\n\n{notes}".strip() for title, table, notes in _tables(report)]
    return "\n\n".join(parts)


def updated(page: str, tables: str) -> str:
    """A page with the tables between its markers; raises ValueError where it has not both, in order."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the page has not both markers, {BEGIN} before {END}")
    return f"{before}{BEGIN}\n\n{tables}\n\n{END}{after}"


def _tables(report: AccuracyReport) -> list[Titled]:
    tables = [_recording(found) for found in report.recordings]
    machine = report.machine
    table = headed("fact", "value")
    table.columns[1].justify = "left"
    commit = "none" if machine.commit is None else machine.commit + (" with changes" if machine.dirty else "")
    table.add_row("measured", f"{report.measured_at}, commit {commit}")
    table.add_row("machine", f"{machine.cpu}, one thread, Python {machine.python}")
    table.add_row("libraries", ", ".join(f"{name} {version}" for name, version in machine.libraries.items()))
    peers = ", ".join(f"{name} {version}" for name, version in report.peers.items())
    table.add_row("peers", peers or "not run (`make peers`, then `--peers`)")
    return [*tables, ("What was run", table, "")]


def _recording(found: RecordingAccuracy) -> Titled:
    table = headed(*_HEADINGS)
    for row in found.rows:
        table.add_row(*_cells(row))
    width, height = found.size_px
    kind = "a sequence" if found.sequence else "stills"
    pairs = "1 pair" if found.frames == 1 else f"{found.frames} pairs"
    title = f"{_named(found.recording)}: {pairs}, {width}×{height}, {kind}"
    failed = [
        f"{row.method}: {', '.join(f'{count} {what}' for what, count in row.failures.items())}"
        for row in found.rows
        if row.failures and not row.method.endswith(", all believed")
    ]
    return title, table, f"Without an answer: {'; '.join(failed)}." if failed else "Every method answered every pair."


def _named(folder: str) -> str:
    """The folder as seen from the project, wherever the command was run."""
    return relpath(folder, ROOT)


def _cells(row: Row) -> list[str]:
    return [
        row.method,
        str(row.frames),
        _count(row.ok),
        _count(row.degraded),
        str(row.invalid),
        _number(row.tip_mm, 2),
        _number(row.tip_p95_mm, 2),
        _number(row.direction_deg, 1),
        _number(row.rms_mm, 3),
        _number(row.worst_p95_mm, 2),
        _number(row.cover, 2),
        _number(row.within_two_sigma, 2),
        _number(row.sigma_mm, 3),
        _number(row.degraded_rms_mm, 2),
        _number(row.degraded_cover, 2),
        _count(row.false_ok),
        str(row.false_if_believed),
        _number(row.ms, 0),
    ]


def _count(value: int | None) -> str:
    return "" if value is None else str(value)


def _number(value: float | None, places: int) -> str:
    return "" if value is None else f"{value:,.{places}f}"
