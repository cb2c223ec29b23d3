"""The results as tables to be read; docs/performance.md explains them."""

from collections.abc import Iterator
from statistics import median

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.report import Delivery, Memory, MethodTimes, Report, SceneTimes, Spread, Throughput

# In a file, a row stays one line whatever it holds.
_FILE_WIDTH = 400

Titled = tuple[str, Table, str]


def show(report: Report, console: Console) -> None:
    """Print every table of a report; into a pipe or a file as Markdown."""
    tables = [_machine(report), *(_scene(scene) for scene in report.scenes)]
    if report.throughput is not None:
        tables.append(_throughput(report.throughput))
    if report.memory is not None:
        tables.append(_memory(report.memory))
    for titled in tables:
        print_titled(*titled, console)


def print_titled(title: str, table: Table, notes: str, console: Console) -> None:
    """Print one table with its title and notes; into a pipe or a file as Markdown."""
    if console.is_terminal:
        console.print(title, style="bold", highlight=False)
        console.print(table)
        console.print(f"{notes}\n", style="dim", highlight=False)
    else:
        print(f"### {title}\n\n{markdown(table)}\n\n{notes}\n", file=console.file)


def markdown(table: Table) -> str:
    """A table in Markdown, a line a row."""
    table.box = box.MARKDOWN
    for row in table.rows:
        row.end_section = False
    wide = Console(width=_FILE_WIDTH, color_system=None)
    with wide.capture() as written:
        wide.print(table)
    return "\n".join(line.rstrip() for line in written.get().strip().splitlines())


def headed(*headings: str) -> Table:
    """An empty table of figures, the first column of which is text."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(headings[0])
    for heading in headings[1:]:
        table.add_column(heading, justify="right")
    return table


def _machine(report: Report) -> Titled:
    machine, load = report.machine, report.load
    table = Table("fact", "value", box=box.SIMPLE_HEAD)
    table.add_row("processor", f"{machine.cpu}; {machine.cores} cores, {machine.cores_usable} usable")
    table.add_row("memory", f"{machine.memory_mb:,} MB")
    table.add_row("system", f"{machine.system}, Python {machine.python}")
    table.add_row("libraries", ", ".join(f"{name} {version}" for name, version in machine.libraries.items()))
    table.add_row("threads", ", ".join(f"{name}: {count}" for name, count in machine.threads.items()))
    commit = "none" if machine.commit is None else machine.commit + (" with changes" if machine.dirty else "")
    table.add_row("commit", commit)
    table.add_row("load average, start", f"{_loads(load.at_start)} ({load.started_at})")
    table.add_row("load average, end", f"{_loads(load.at_end)} ({load.ended_at})")
    smoke = "A smoke run: it shows that everything runs, and its figures mean nothing."
    return "Machine", table, smoke if report.smoke else "Load averages over 1, 5 and 15 minutes."


def _scene(times: SceneTimes) -> Titled:
    statuses = ", ".join(f"{count} {status}" for status, count in times.statuses.items())
    memory = "each pair without memory" if times.independent else "with memory"
    width, height = times.size_px
    table = headed("method and stage", "pairs", "median ms", "p99 ms", "least ms")
    for name, method in times.methods.items():
        for row in _method_rows(name, method):
            table.add_row(*row)
        table.add_section()
    for of_what, ratio in (("whole pair", times.speedup), ("processor time", times.cpu_speedup)):
        if ratio is not None:
            least = f"× {ratio.least:.2f}"
            name = f"reference / needletrack, {of_what}"
            table.add_row(name, str(ratio.count), f"× {ratio.median:.2f}", "", least)
    notes = (
        f"needletrack: {statuses}. {times.warmup_pairs} pairs of warm-up left out; methods interleaved pair by pair; "
        "stages over the pairs in which they ran; ◦ beside the whole, no part of it."
    )
    return f"Time a pair: {times.scene}, {width}×{height}, {memory}", table, notes


def _method_rows(name: str, method: MethodTimes) -> Iterator[tuple[str, ...]]:
    missed = f" (found nothing on {method.not_found})" if method.not_found else ""
    yield (f"{name}: whole pair{missed}", *_cells(method.whole_ms))
    yield ("– processor time of the same", *_cells(method.cpu_ms))
    if len(method.kinds_ms) > 1:
        for kind, spread in method.kinds_ms.items():
            yield (f"– whole pair, {kind}", *_cells(spread))
    for stage, spread in method.stages_ms.items():
        yield (f"– {stage}", *_cells(spread))
    for beside, spread in method.beside_ms.items():
        yield (f"◦ {beside}", *_cells(spread))


def _throughput(found: Throughput) -> Titled:
    table = headed("publishing", "pairs/s, median of runs", "each run")
    for name, rates in (("off", found.publishing_off), ("on", found.publishing_on)):
        table.add_row(name, f"{median(rates):.1f}", "  ".join(f"{rate:.1f}" for rate in rates))
    notes = (
        f"{found.pairs_per_run} pairs a run after {found.warmup_pairs} of warm-up; runs alternate. The subscriber, "
        f"another process on this machine, connected throughout: {_delivery(found.delivery)}."
    )
    return f"Throughput: every-frame replay of {found.scene} through the service, frames in memory", table, notes


def _memory(found: Memory) -> Titled:
    table = headed("resident memory", "MB")
    table.add_row("before the first pair", f"{found.started_mb:.1f}")
    table.add_row("settled", f"{found.settled_mb:.1f}")
    table.add_row("end", f"{found.end_mb:.1f}")
    table.add_row("peak", f"{found.peak_mb:.1f}")
    table.add_row(f"growth, settled to end: {_verdict(found.flat)}", f"{found.growth_mb:+.2f}")
    table.add_row("slope, 1,000 pairs", f"{found.slope_mb_per_1000:+.3f}")
    notes = (
        f"MB of 10⁶ bytes, {len(found.at_pair)} samples; settled: median of the second tenth; end: of the last; flat: "
        f"growth below {found.flat_below_mb:g} MB. {found.pairs_per_s:.1f} pairs/s, decoding and publishing included; "
        f"subscriber: {_delivery(found.delivery)}."
    )
    return f"Memory: {found.pairs:,} pairs of {found.scene}, looped, from PNG files through the service", table, notes


def _cells(spread: Spread) -> tuple[str, ...]:
    return str(spread.count), f"{spread.median:.3f}", f"{spread.p99:.3f}", f"{spread.least:.3f}"


def _verdict(flat: bool | None) -> str:
    if flat is None:
        return "too few pairs to tell"
    return "flat" if flat else "NOT FLAT"


def _delivery(delivery: Delivery) -> str:
    transit = delivery.transit_ms
    counts = f"{delivery.received} received, {delivery.lost} lost, {delivery.overflowed} overflowed"
    if transit is None:
        return counts
    return f"{counts}; publish to receive p50 {transit.median:.2f} ms, p99 {transit.p99:.2f} ms"


def _loads(averages: tuple[float, float, float]) -> str:
    return "  ".join(f"{average:.2f}" for average in averages)
