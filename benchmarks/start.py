"""How long it takes from nothing to the first track: a fresh interpreter that starts as the daemon does."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.report import Spread, Start
from needletrack.records import StereoPair
from needletrack.rig import Rig, write_rig

_DONE_WITHIN_S = 60.0


def measure_start(pair: StereoPair, rig: Rig, runs: int) -> Start:
    """Seconds from the start of a fresh interpreter, once for each run; the files are in the cache by then."""
    results = []
    with tempfile.TemporaryDirectory() as folder:
        frames, rig_file = Path(folder, "frames.npy"), Path(folder, "rig.yaml")
        np.save(frames, np.stack([pair.left.image, pair.right.image]))
        write_rig(rig, rig_file)
        for _ in range(runs + 1):
            began_ns = time.monotonic_ns()
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.starting", str(frames), str(rig_file)],
                cwd=Path(__file__).parents[1],
                capture_output=True,
                text=True,
                check=True,
                timeout=_DONE_WITHIN_S,
            )
            moments: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
            results.append({name: (at_ns - began_ns) / 1e9 for name, at_ns in moments.items()})
    # The first one warmed the file cache.
    kept = results[1:]
    return Start(
        to_s={name: Spread.of(result[name] for result in kept) for name in kept[0]},
        import_s=Spread.of(result["imported"] - result["interpreter"] for result in kept),
    )
