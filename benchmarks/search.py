"""What the search of whole images costs, stage by stage: `python -m benchmarks.search RECORDING [RECORDING ...]`.

Every pair of each recording (at most `--pairs`, spread over it) is searched `--rounds` times without memory, on one
thread, images in memory; refinement, which follows, is left out. Printed: medians of the thread's processor time and
the worst, milliseconds a pair, and how many candidates are left to refine. Without recordings: the bundled ones, and
drawn worlds of 1280x1024 and 2560x2048 with texture and vessels.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.frames import RECORDINGS, SEQUENCE, STILLS
from benchmarks.threads import one_thread
from needletrack.errors import NeedleNotFound
from needletrack.geometry.stereo import StereoRig
from needletrack.recording.asl import AslRecording
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import STEEL, World
from needletrack.tracking.adjust import Images
from needletrack.tracking.detect import detect
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.stopwatch import Stopwatch

STAGES = ("segment", "centerline", "match", "judge")
DRAWN_SIZES = ((1280, 1024), (2560, 2048))
_DRAWN_PAIRS = 3


class ThreadStopwatch(Stopwatch):
    """Milliseconds of this thread's processor time: what others take meanwhile does not count."""

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time until the block's end to the stage, also where it raises."""
        start = time.thread_time()
        try:
            yield
        finally:
            self.elapsed_ms[stage] = self.elapsed_ms.get(stage, 0.0) + (time.thread_time() - start) * 1e3


def searched(images: Images, rig: StereoRig) -> tuple[dict[str, float], int]:
    """Milliseconds by stage of one search, and how many candidates it leaves."""
    stopwatch = ThreadStopwatch()
    try:
        found = len(detect(images, rig, TrackingParameters(), stopwatch))
    except NeedleNotFound:
        found = 0
    return stopwatch.elapsed_ms, found


def drawn(size_px: tuple[int, int], pairs: int = _DRAWN_PAIRS) -> tuple[StereoRig, list[Images]]:
    """A needle of steel before texture and vessels, drawn in images of a size (width, height)."""
    rig = default_rig(size_px)
    needle = NeedleMotion((8.0, -34.0, 246.0), (0.12, 1.0, 0.12), Wave(68.0), bend_per_mm=Wave(0.004))
    worlds = [World(rig, needle, Background(contrast=12.0, vessels=10), STEEL, seed=seed) for seed in range(pairs)]
    taken = [world.pair(0.0)[0] for world in worlds]
    return rig, [(pair.left.image, pair.right.image) for pair in taken]


def recorded(folder: Path, pairs: int) -> tuple[StereoRig, list[Images]]:
    """At most so many pairs of a recording, spread over it."""
    recording = AslRecording(folder)
    chosen = np.unique(np.linspace(0, len(recording) - 1, pairs).round().astype(int)).tolist()
    taken = [recording.read(index) for index in chosen]
    return recording.rig, [(pair.left.image, pair.right.image) for pair in taken]


def row(name: str, rig: StereoRig, pairs: list[Images], rounds: int) -> str:
    """One line of the table."""
    for images in pairs:
        searched(images, rig)
    runs = [searched(images, rig) for _ in range(rounds) for images in pairs]
    whole = [sum(stages.values()) for stages, _ in runs]
    cells = [f"{np.median([stages.get(stage, 0.0) for stages, _ in runs]):10.2f}" for stage in STAGES]
    left = np.mean([found for _, found in runs])
    return f"{name:20}{''.join(cells)}{np.median(whole):10.2f}{max(whole):10.2f}{left:12.2f}"


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.search", description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path, metavar="RECORDING")
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with one_thread():
        print(f"{'ms a pair':20}{''.join(f'{s:>10}' for s in (*STAGES, 'whole', 'worst'))}{'candidates':>12}")
        for folder in arguments.recordings or [RECORDINGS / scene.name for scene in (STILLS, SEQUENCE)]:
            print(row(folder.name, *recorded(folder, arguments.pairs), arguments.rounds), flush=True)
        if not arguments.recordings:
            for size_px in DRAWN_SIZES:
                print(row(f"drawn {size_px[0]}x{size_px[1]}", *drawn(size_px), arguments.rounds), flush=True)


if __name__ == "__main__":
    main()
