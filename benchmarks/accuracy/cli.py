"""Arguments in, tables and JSON out."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.accuracy.peers import PYTHON, peer_versions
from benchmarks.accuracy.run import run, trackable
from benchmarks.accuracy.tables import as_markdown, show, updated
from benchmarks.frames import RECORDINGS
from needletrack.errors import NeedletrackError


def main(arguments: Sequence[str] | None = None) -> None:
    """Score the recordings that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description="How far off needletrack is.")
    parser.add_argument(
        "recordings",
        nargs="*",
        type=Path,
        metavar="RECORDING",
        help="folders with truth.json; default: the bundled ones",
    )
    parser.add_argument("--peers", action="store_true", help="the peers of build/peers as well (`make peers`)")
    parser.add_argument(
        "--sequence", action="append", metavar="NAME", help="track this one with memory; may be repeated"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="only the first N pairs of each recording")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure, and what the peers failed on")
    parser.add_argument("--update", type=Path, metavar="PAGE", help="put the tables between the markers of a page")
    chosen = parser.parse_args(arguments)
    if chosen.frames is not None and chosen.frames < 1:
        parser.error("--frames is 1 or more")
    try:
        # Fails now, and not after a quarter of an hour.
        versions = peer_versions(PYTHON) if chosen.peers else {}
        if chosen.update is not None:
            updated(chosen.update.read_text(encoding="utf-8"), "")
        folders = trackable(chosen.recordings or sorted(RECORDINGS.iterdir()))
        report = run(folders, chosen.sequence, versions, chosen.frames, Console(stderr=True))
    except (NeedletrackError, OSError, ValueError) as error:
        sys.exit(f"accuracy: {error}")
    show(report, Console())
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
    if chosen.update is not None:
        page = chosen.update.read_text(encoding="utf-8")
        chosen.update.write_text(updated(page, as_markdown(report)), encoding="utf-8")
