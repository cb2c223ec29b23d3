"""The results as tables to be read; docs/performance.md explains them."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.report import (
    Bar,
    Delivery,
    Handover,
    Memory,
    MethodTimes,
    Report,
    SceneTimes,
    Searches,
    Spread,
    Start,
    Steady,
    Throughput,
)

# In a file, a row stays one line whatever it holds.
_FILE_WIDTH = 400

Titled = tuple[str, Table, str]


def show(report: Report, console: Console) -> None:
    """Print every table of a report; into a pipe or a file as Markdown."""
    tables = [_machine(report)]
    if report.steady is not None:
        tables.append(_steady(report.steady))
    if report.searches is not None:
        tables.extend(_searches(report.searches))
    tables.extend(_scene(scene) for scene in report.scenes)
    if report.throughput is not None:
        tables.append(_throughput(report.throughput))
    if report.handover is not None:
        tables.append(_handover(report.handover))
    if report.memory is not None:
        tables.append(_memory(report.memory))
    if report.start is not None:
        tables.append(_start(report.start))
    if report.bars:
        tables.append(_bars(report.bars))
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


def _steady(found: Steady) -> Titled:
    table = headed("sequence", "pairs", "median ms", "p99 ms", "least ms")
    for sequence in found.sequences:
        table.add_row(f"{sequence.name}: worker, wall", *_cells(sequence.wall_ms))
        table.add_row("– processor time of the same", *_cells(sequence.cpu_ms))
        if sequence.followed_ms is not None:
            table.add_row("– of the pairs that were followed", *_cells(sequence.followed_ms))
        for stage, spread in sequence.stages_ms.items():
            table.add_row(f"– {stage}", *_cells(spread))
        table.add_row("◦ read both images once, processor time", *_cells(sequence.reading_ms))
        if sequence.audit_ms is not None:
            table.add_row("◦ an audit, in the other process, processor time", *_cells(sequence.audit_ms))
        table.add_section()
    table.add_row("2560×2048 / 1280×1024, processor", "", f"× {found.size_ratio:.2f}", "", "")
    table.add_row("2560×2048 / 1280×1024, wall", "", f"× {found.size_ratio_wall:.2f}", "", "")
    told = "; ".join(f"{each.name}: {_counts(each.kinds)} ({_counts(each.statuses)})" for each in found.sequences)
    notes = (
        f"Worker: tracking beside the process that audits, and the message to its bytes. Sequences in turn, 100 pairs "
        f"each; {found.warmup_pairs} pairs of warm-up left out. {told}. ◦ no part of the worker's time."
    )
    return "Steady state: the worker's time a pair", table, notes


def _searches(found: Searches) -> Iterator[Titled]:
    table = headed("sequence", "pairs", "median ms", "p99 ms", "least ms")
    for times in found.times:
        table.add_row(f"{times.name}: search, wall ({times.found} found)", *_cells(times.wall_ms))
        table.add_row("– processor time of the same", *_cells(times.cpu_ms))
    yield "First detection: a search of whole images", table, "Each pair without memory; sequences in turn."
    again = headed("the needle comes back", "pairs/s", "losses", "median", "p99", "most", "never")
    for each in found.found_again:
        spread = each.after_pairs
        where = "25 mm aside" if each.moved else "where it went on to"
        where += ", beside a rod" if each.rod else ", no rod"
        again.add_row(
            where, f"{each.rate_hz:g}", str(spread.count), f"{spread.median:g}", f"{spread.p99:g}", str(each.most),
            str(each.never),
        )  # fmt: skip
    notes = (
        "Hidden for 12 pairs after 24; pairs from the first that shows it again to the first right track (within 1 mm "
        "of the truth), 1: that pair itself; through the tracker with its second process, paced."
    )
    yield "After a loss: pairs until found again", again, notes


def _handover(found: Handover) -> Titled:
    table = headed("pairs", "count")
    table.add_row("handed over", f"{found.released:,}")
    table.add_row("tracked", f"{found.tracked:,}")
    table.add_row("dropped", _counts(found.dropped) if found.dropped else "0")
    table.add_row("received", f"{found.received:,}")
    table.add_row("frame in memory → decoded track, p50 ms", f"{found.age_ms.median:.2f}")
    table.add_row("frame in memory → decoded track, p99 ms", f"{found.age_ms.p99:.2f}")
    notes = f"{found.rate_hz:g} pairs/s for {found.seconds:g} s; one clock for all processes of the machine."
    return f"Handed over to decoded in another process: {found.sequence}", table, notes


def _start(found: Start) -> Titled:
    table = headed("s after the interpreter was asked for", "starts", "median", "p99", "least")
    names = {
        "interpreter": "the interpreter runs",
        "imported": "everything is imported",
        "configured": "configuration and rig are read",
        "built": "tracker, service, publisher and metrics are there",
        "warm": "warm; the second process comes up meanwhile",
        "tracked": "the first track is published",
    }
    for name, title in names.items():
        table.add_row(title, *_cells(found.to_s[name]))
    share = found.import_s.median / found.to_s["tracked"].median
    notes = f"File cache warm; cameras, recorder and control left out. Imports: {100 * share:.0f} % of the whole."
    return "Start of the daemon to the first track", table, notes


def _bars(bars: Sequence[Bar]) -> Titled:
    table = headed("figure", "bar", "measured", "")
    for bar in bars:
        table.add_row(bar.name, bar.bar, f"{bar.measured:g}", "met" if bar.met else "MISSED")
    return "Bars", table, f"{sum(bar.met for bar in bars)} of {len(bars)} met."


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


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
        f"another process on this machine, connected throughout: {_delivery(found.delivery)}. Tracks: "
        f"{_counts(found.statuses)}."
    )
    return f"Throughput: every-frame replay of {found.scene} through the service, frames in memory", table, notes


def _memory(found: Memory) -> Titled:
    table = headed("resident memory", "MB")
    table.add_row("before the first pair", f"{found.started_mb:.1f}")
    table.add_row("settled", f"{found.settled_mb:.1f}")
    table.add_row("end", f"{found.end_mb:.1f}")
    table.add_row("peak", f"{found.peak_mb:.1f}")
    table.add_row("of these, frames that the benchmark keeps", f"{found.frames_mb:.1f}")
    table.add_row("audit process, end", f"{found.audit_process_mb:.1f}")
    table.add_row(f"growth, settled to end: {_verdict(found.flat)}", f"{found.growth_mb:+.2f}")
    table.add_row("slope, 1,000 pairs", f"{found.slope_mb_per_1000:+.3f}")
    table.add_row("growth of Python's allocated blocks, count", f"{found.allocated_blocks_growth:+d}")
    notes = (
        f"MB of 10⁶ bytes, {len(found.at_pair)} samples; settled: median of the second tenth; end: of the last; flat: "
        f"growth below {found.flat_below_mb:g} MB. {found.pairs_per_s:.1f} pairs/s, publishing included; "
        f"subscriber: {_delivery(found.delivery)}."
    )
    return f"Memory: {found.pairs:,} pairs of {found.scene}, looped, from memory through the service", table, notes


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
