"""The fault table: python -m benchmarks.faults [--update docs/reliability.md | NAME ...]; `make faults`."""

import argparse
import os
import re
import sys
import time
import traceback
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.faults import commands, intruders, network, rows
from benchmarks.faults.stage import Stage
from benchmarks.faults.table import Fault, NotHere, Seen
from benchmarks.machine import Machine

BEGIN, END = "<!-- faults: begin -->", "<!-- faults: end -->"
FAULTS = (*rows.FAULTS, *network.FAULTS, *intruders.FAULTS, *commands.FAULTS)
_HEAD = "| fault | injected | the subscriber saw | healthy after | lost |\n|---|---|---|---|---|\n"


def line(fault: Fault, seen: Seen) -> str:
    """A row of the table."""
    healthy = "does not start" if seen.healthy_s is None else f"{seen.healthy_s:.2f} s"
    cells = (f"**{fault.group}**: {fault.name}", fault.injected, seen.saw, healthy, seen.lost)
    return f"| {' | '.join(cell.replace('|', '/').replace(chr(10), ' ') for cell in cells)} |"


def main(arguments: list[str] | None = None) -> int:
    """Run the rows, print the table; 1 where a fault was not survived as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("names", nargs="*", help="rows or groups; without any: all")
    parser.add_argument("--update", type=Path, help="write the table into this page, between its marks")
    asked = parser.parse_args(arguments)
    if asked.update is not None and asked.names:
        parser.error("--update writes the whole table: leave out the names")
    chosen = [each for each in FAULTS if not asked.names or each.group in asked.names or each.name in asked.names]
    lines, failed = [], []
    loads = [os.getloadavg()[0]]
    for each in chosen:
        began_s = time.monotonic()
        try:
            with Stage.set() as stage:
                lines.append(line(each, each.run(stage)))
        except NotHere as reason:
            lines.append(f"| **{each.group}**: {each.name} | {each.injected} | not injected here: {reason} | | |")
        except Exception as error:
            traceback.print_exc()
            failed.append(each.name)
            lines.append(f"| **{each.group}**: {each.name} | {each.injected} | **not survived**: {error} | | |")
        loads.append(os.getloadavg()[0])
        print(f"{lines[-1]}  ({time.monotonic() - began_s:.0f} s)", flush=True)
    if failed:
        print(f"FAILED: {', '.join(failed)}", file=sys.stderr)
    if asked.update is not None:
        update(asked.update, lines, loads)
    return 1 if failed else 0


def update(page: Path, lines: list[str], loads: list[float]) -> None:
    """Put the table between the marks of a page."""
    table = _HEAD + "\n".join(lines)
    here = Machine.here()
    when = f"{datetime.now(UTC):%Y-%m-%d} on {here.cores_usable} cores ({here.cpu}), {here.system}"
    when += f". A minute's load was {loads[0]:.1f} before and {max(loads):.1f} at most, the rows' own included"
    text = page.read_text(encoding="utf-8")
    inside = f"{BEGIN}\nMeasured {when}.\n\n{table}\n{END}"
    page.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: inside, text, flags=re.DOTALL), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
