"""What a camera that was bumped does to tracks, and whether tracking notices: the table of docs/calibration.md.

    python -m benchmarks.drift RECORDING [RECORDING ...]

For each motion of the right camera, needles are tracked with the rig as it was before it, from the recordings' own rig
turned back. Stills start every pair anew; a sequence (more than ten pairs a second) goes on from the pair before.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from needletrack.calibration.drift import Motion, effect
from needletrack.calibration.tips import DriftParameters, DriftState
from needletrack.calibration.worth import space_grid_mm
from needletrack.recording.asl import AslRecording
from needletrack.records import NeedleTrack, Status
from needletrack.rig import find_rig
from needletrack.tracking.track import track_pair

X_MM, Y_MM, Z_MM = (-60.0, 70.0), (-55.0, 55.0), (210.0, 295.0)
_AXES = np.eye(3)
MOTIONS = {
    "none": Motion(),
    "pitch 0.1°": Motion(turn_deg=0.1 * _AXES[0]),
    "roll 0.1°": Motion(turn_deg=0.1 * _AXES[2]),
    "yaw 0.1°": Motion(turn_deg=0.1 * _AXES[1]),
    "0.1 mm along the baseline (x)": Motion(shift_mm=0.1 * _AXES[0]),
    "0.1 mm across it (y)": Motion(shift_mm=0.1 * _AXES[1]),
    "0.1 mm towards the scene (z)": Motion(shift_mm=0.1 * _AXES[2]),
}


@dataclass(frozen=True)
class Watched:
    """How tracking with a moved camera went over some pairs."""

    pairs: int
    ok: int
    tips: int
    offset_px: float
    noticed_after: int | None


def watched(recordings: list[AslRecording], motion: Motion) -> Watched:
    """Track all pairs with the rig from before the motion; noticed_after: pairs until the drift is noticed."""
    parameters, state = DriftParameters(), DriftState()
    pairs, ok, noticed = 0, 0, None
    for recording in recordings:
        back = Motion(-motion.turn_deg, -motion.shift_mm)
        rig = back.applied_to(recording.rig)
        seconds = (recording.last_stamp_ns - recording.first_stamp_ns) / 1e9
        sequence = len(recording) > 10 * max(seconds, 1e-3) and len(recording) > 10
        previous: NeedleTrack | None = None
        for index in range(len(recording)):
            track = track_pair(recording.read(index), rig, None, previous if sequence else None)
            previous, pairs, ok = track, pairs + 1, ok + (track.status is Status.OK)
            state = state.after(track, rig, parameters)
            if noticed is None and state.has_moved:
                noticed = pairs
    offsets = np.array(state.offsets_px)
    return Watched(pairs, ok, len(offsets), float(np.median(offsets)) if len(offsets) else float("nan"), noticed)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    recordings = [AslRecording(folder) for folder in parser.parse_args().recordings]
    rig = find_rig(recordings[0].folder)
    points_mm = space_grid_mm(rig, X_MM, Y_MM, Z_MM)
    print(
        "| motion of the right camera | mm rms | aligned | off epipolar lines, px | tips' median, px | ok | noticed |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, motion in MOTIONS.items():
        caused, seen = effect(rig, motion, points_mm), watched(recordings, motion)
        when = "no" if seen.noticed_after is None else f"after {seen.noticed_after} pairs"
        print(
            f"| {name} | {caused.error.before_mm:.2f} | {caused.error.after_mm:.2f} | {caused.offset_px:+.2f} "
            f"(rms {caused.offset_rms_px:.2f}) | {seen.offset_px:+.2f} of {seen.tips} | {seen.ok} of {seen.pairs} | "
            f"{when} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
