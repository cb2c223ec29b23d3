"""Arguments in, tables and JSON out."""

import argparse
from pathlib import Path

from rich.console import Console

from benchmarks.machine import HISTORY, stem
from benchmarks.plan import FULL, SECTIONS, SMOKE
from benchmarks.run import run
from benchmarks.tables import show


def main() -> None:
    """Run the benchmark that the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="What needletrack costs.")
    parser.add_argument("--smoke", action="store_true", help="a few pairs: does everything still run?")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results here as well")
    parser.add_argument("--history", type=Path, metavar="FOLDER", default=HISTORY, help="where every run's results go")
    parser.add_argument("--only", choices=SECTIONS, action="append", help="this section alone; may be repeated")
    parser.add_argument("--pairs", type=int, metavar="N", help="pairs timed on each sequence")
    parser.add_argument("--searches", type=int, metavar="N", help="pairs searched without memory on each sequence")
    parser.add_argument("--memory-pairs", type=int, metavar="N", help="pairs over which memory is watched")
    arguments = parser.parse_args()
    if min(arguments.pairs or 2, arguments.searches or 2, arguments.memory_pairs or 2) < 2:
        parser.error("--pairs, --searches and --memory-pairs are 2 or more")
    plan = (SMOKE if arguments.smoke else FULL).changed(
        arguments.pairs, arguments.searches, arguments.memory_pairs, tuple(arguments.only or SECTIONS)
    )
    # Fails now, and not after a quarter of an hour.
    arguments.history.mkdir(parents=True, exist_ok=True)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.touch()
    report = run(plan, Console(stderr=True))
    show(report, Console())
    text = report.model_dump_json(indent=2) + "\n"
    record = arguments.history / f"{stem(report.machine, report.load.started_at)}.json"
    record.write_text(text, encoding="utf-8")
    Console(stderr=True).print(f"kept in {record}", highlight=False)
    if arguments.json is not None:
        arguments.json.write_text(text, encoding="utf-8")
