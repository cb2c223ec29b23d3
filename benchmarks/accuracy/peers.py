"""icpReconstructor in a process and an environment of its own (`make peers`): lines go in as JSON, points come back."""

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.lines import PairLines, visible_from
from benchmarks.machine import ROOT
from needletrack.errors import NeedletrackError
from needletrack.geometry.spline import arc_length, tangents
from needletrack.records import Float
from needletrack.rig import Rig
from needletrack.scoring import TrueShape

PYTHON = ROOT / "build" / "peers" / "bin" / "python"
WORKER = Path(__file__).with_name("icp_reconstructor.py")
PACKAGES = ("icpReconstructor", "casadi", "torch", "opencv-python")
# What is timed beside it runs on one thread, too.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
EPIPOLAR, ICP = "epipolar", "epipolar + ICP"


class PeerError(NeedletrackError):
    """A peer's environment is missing or its process ended without an answer."""


@dataclass(frozen=True, eq=False)
class PeerAnswer:
    """One stage's answer to one pair: points_mm (N, 3) from the base on, or None and what failed; ms: its time."""

    points_mm: Float | None
    ms: float
    failure: str | None


def peer_versions(python: Path) -> dict[str, str]:
    """Versions of what the peers' environment holds; raises PeerError where there is none."""
    if not python.is_file():
        raise PeerError(f"there is no {python}: run `make peers`")
    code = f"import importlib.metadata as m, json; print(json.dumps({{n: m.version(n) for n in {PACKAGES!r}}}))"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PeerError(f"{python}: {_last_line(done.stderr)}: run `make peers` again")
    return {name: str(found) for name, found in json.loads(done.stdout).items()}


def ask(python: Path, rig: Rig, lines: Sequence[PairLines], truths: Sequence[TrueShape]) -> dict[str, list[PeerAnswer]]:
    """What both of its stages make of the lines of each pair; raises PeerError where its process ends early.

    Where a needle is, truth tells it the base, with the needle's direction there, and the length: what its authors know
    from the robot that holds theirs. Where none is, its second stage is not asked, and it answers with its first.
    """
    if not lines:
        return {EPIPOLAR: [], ICP: []}
    job = {"cameras": _cameras(rig), "frames": [_frame(*each) for each in zip(lines, truths, strict=True)]}
    done = subprocess.run(
        [python, WORKER],
        input=json.dumps(job),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | _ONE_THREAD,
    )
    if done.returncode:
        raise PeerError(f"{WORKER.name}: {_last_line(done.stderr)}")
    answers = json.loads(done.stdout)
    return {stage: [_answer(each[stage]) for each in answers] for stage in (EPIPOLAR, ICP)}


def _cameras(rig: Rig) -> list[dict[str, Any]]:
    pose = rig.right_from_left
    extrinsics = np.eye(3, 4), np.column_stack([pose.rotation, pose.translation_mm / 1e3])
    return [
        {
            "A": camera.matrix.tolist(),
            "P": (camera.matrix @ extrinsic).tolist(),
            # It takes exactly k1 k2 p1 p2 k3.
            "dist": np.pad(camera.distortion, (0, max(5 - len(camera.distortion), 0)))[:5].tolist(),
        }
        for camera, extrinsic in zip((rig.left, rig.right), extrinsics, strict=True)
    ]


def _frame(lines: PairLines, truth: TrueShape) -> dict[str, Any]:
    frame: dict[str, Any] = {
        "undistorted_px": [lines.left.undistorted_px.tolist(), lines.right.undistorted_px.tolist()],
        "region_px": [lines.left.region_px.tolist(), lines.right.region_px.tolist()],
        "world_from_left_m": np.eye(4).tolist(),
        "length_m": None,
    }
    if len(truth.centerline_mm):
        base = visible_from(truth)
        needle_mm = truth.centerline_mm[base:]
        frame["world_from_left_m"] = _from_base(needle_mm[0], tangents(truth.centerline_mm)[base]).tolist()
        frame["length_m"] = float(arc_length(needle_mm)[-1]) / 1e3
    return frame


def _from_base(base_mm: Float, z: Float) -> Float:
    """The transform (4, 4) into its world, m: the base is the origin, and the needle leaves along +z."""
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ base_mm / 1e3
    return pose


def _answer(stage: Mapping[str, Any]) -> PeerAnswer:
    points = stage["points_mm"]
    return PeerAnswer(None if points is None else np.array(points, dtype=np.float64), stage["ms"], stage["failure"])


def _last_line(text: str) -> str:
    return next(reversed(text.strip().splitlines()), "it said nothing")
