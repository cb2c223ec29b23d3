"""Two commits compared in one invocation: `make bench-compare BASE=<commit>`.

BASE is checked out into a work tree under build/, with its kernels built where it has some, and nothing installed. The
core measurements (`benchmarks/core.py`) then run on the same frames in fresh processes, A B A B, A being this tree.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.machine import HISTORY, ROOT, Machine, stem
from benchmarks.tables import headed, print_titled
from benchmarks.worlds import LARGE_PX, SMALL_PX, Sequence, drawn, recorded

_TREES = ROOT / "build" / "compared"
_BUILD = """
import sys
sys.path.insert(0, ".")
from hatch_build import KernelBuildHook
KernelBuildHook(".", {}, None, None, "", "wheel").initialize("editable", {"artifacts": []})
"""
Results = Mapping[str, Mapping[str, float]]


def checked_out(base: str) -> Path:
    """A work tree of a commit or ref, with its kernels; raises SystemExit where git does not know it."""
    found = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{base}^{{commit}}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if found.returncode:
        raise SystemExit(f"git knows no commit {base!r}: name one, e.g. BASE=HEAD~3")
    commit = found.stdout.strip()
    tree = _TREES / commit[:12]
    if not tree.is_dir():
        subprocess.run(["git", "worktree", "prune"], cwd=ROOT, check=True)
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], cwd=ROOT, check=True)
    if (tree / "hatch_build.py").is_file():
        subprocess.run([sys.executable, "-c", _BUILD], cwd=tree, check=True)
    return tree


def plain(sequence: Sequence, folder: Path) -> dict[str, Any]:
    """A sequence as a job holds it; its frames go into a file that both commits read."""
    frames = folder / f"{sequence.rig.name}-{sequence.rig.left.size_px[0]}.npy"
    np.save(frames, np.stack([[pair.left.image, pair.right.image] for pair in sequence.pairs]))
    rig = sequence.rig
    views = {
        side: {
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "size_px": list(camera.size_px),
        }
        for side, camera in (("left", rig.left), ("right", rig.right))
    }
    pose = rig.right_from_left
    return {
        "name": sequence.name,
        "frames": str(frames),
        "rate_hz": sequence.rate_hz,
        "rig": views | {"rotation": pose.rotation.tolist(), "translation_mm": pose.translation_mm.tolist()},
    }


def measured(tree: Path, job: Path) -> Results:
    """What one fresh process with a tree's package measured."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "core.py"), str(job)],
        env={**os.environ, **threads, "PYTHONPATH": str(tree / "src")},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    answer = json.loads(done.stdout.splitlines()[-1])
    if not Path(answer["package"]).is_relative_to(tree):
        raise SystemExit(f"{answer['package']} was measured, and not the package in {tree}")
    results: Results = answer["results"]
    return results


def main(arguments: list[str] | None = None) -> None:
    """Compare this tree with the commit that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__)
    parser.add_argument("base", metavar="BASE", help="commit or ref to compare with")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="A B, so many times")
    parser.add_argument("--pairs", type=int, default=200, metavar="N", help="of each sequence in each process")
    parser.add_argument("--searches", type=int, default=20, metavar="N", help="of each sequence in each process")
    parser.add_argument("--smoke", action="store_true", help="a few pairs of steer-b: does everything still run?")
    parser.add_argument("--history", type=Path, metavar="FOLDER", default=HISTORY)
    asked = parser.parse_args(arguments)
    if asked.smoke:
        asked.rounds, asked.pairs, asked.searches = 1, 3, 1
    if min(asked.rounds, asked.pairs, asked.searches) < 1:
        parser.error("--rounds, --pairs and --searches are 1 or more")
    tree = checked_out(asked.base)
    sequences = [recorded()] if asked.smoke else [recorded(), drawn(SMALL_PX, 20), drawn(LARGE_PX, 20)]
    rounds: list[dict[str, Results]] = []
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder, "job.json")
        plains = [plain(sequence, Path(folder)) for sequence in sequences]
        warmup = 1 if asked.smoke else 10
        job.write_text(
            json.dumps({"sequences": plains, "pairs": asked.pairs, "searches": asked.searches, "warmup": warmup}),
            encoding="utf-8",
        )
        rounds.extend({"this": measured(ROOT, job), "base": measured(tree, job)} for _ in range(asked.rounds))
    show(asked.base, rounds, Console())
    machine = Machine.here()
    now = datetime.now(UTC).isoformat(timespec="seconds")
    asked.history.mkdir(parents=True, exist_ok=True)
    record = asked.history / f"compare-{stem(machine, now)}.json"
    record.write_text(
        json.dumps({"machine": machine.model_dump(), "at": now, "base": tree.name, "rounds": rounds}, indent=2) + "\n",
        encoding="utf-8",
    )
    Console(stderr=True).print(f"kept in {record}", highlight=False)


def show(base: str, rounds: list[dict[str, Results]], console: Console) -> None:
    """Print medians of the rounds, and the ratio base / this of each round: its median, least and most."""
    table = headed("sequence and measurement", "this, ms", f"{base}, ms", "base / this", "least", "most")
    for name, measurements in rounds[0]["this"].items():
        for what in measurements:
            this, other = ([each[side][name][what] for each in rounds] for side in ("this", "base"))
            ratios = [b / a for a, b in zip(this, other, strict=True)]
            table.add_row(
                f"{name}: {what}",
                f"{np.median(this):.3f}",
                f"{np.median(other):.3f}",
                f"× {np.median(ratios):.2f}",
                f"× {min(ratios):.2f}",
                f"× {max(ratios):.2f}",
            )
    notes = (
        f"{len(rounds)} rounds A B A B in fresh processes; medians of the thread's processor time; above 1, this tree "
        "is faster. worker: follow alone, where the commit has none, track_pair."
    )
    print_titled(f"This tree and {base}", table, notes, console)


if __name__ == "__main__":
    main()
