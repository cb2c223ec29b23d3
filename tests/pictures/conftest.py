"""Tracks made from a recording's truth: pictures need no tracker."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from needletrack.geometry.spline import arc_length, curvature, resample, tangents
from needletrack.recording.asl import AslRecording
from needletrack.records import (
    BasePose,
    Centerline,
    Correspondences,
    Evidence,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Status,
    StereoPair,
    TipPose,
)

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"
POINTS = 121
SIGMA_MM = 0.05


@pytest.fixture(scope="session")
def steer() -> AslRecording:
    return AslRecording(RECORDINGS / "steer-b")


@pytest.fixture(scope="session")
def true_track(steer: AslRecording) -> Callable[[int], tuple[NeedleTrack, StereoPair]]:
    """An ok track that is the truth of a pair of steer-b, counted from 0 or from the end; and the pair."""
    frames = json.loads((steer.folder / "truth.json").read_text())["frames"]
    truth = {frame["t_ns"]: frame for frame in frames}

    def make(index: int) -> tuple[NeedleTrack, StereoPair]:
        pair = steer.read(index % len(steer))
        frame = truth[pair.captured_at_ns]
        visible = np.array(frame["visible"])
        outside = int(np.argmax(visible.any(axis=0)))
        axis_mm, seen = np.array(frame["centerline_mm"])[outside:], visible.sum(axis=0)[outside:]
        along_mm = arc_length(axis_mm)
        points_mm, at_mm = resample(axis_mm, POINTS), np.linspace(0, along_mm[-1], POINTS)
        first = np.gradient(points_mm, at_mm, axis=0)
        curve = NeedleCurve(
            points_mm=points_mm,
            sigma_mm=np.full(POINTS, SIGMA_MM),
            seen=seen[np.searchsorted(along_mm, at_mm).clip(max=len(seen) - 1)],
            curvature_per_mm=curvature(first, np.gradient(first, at_mm, axis=0)),
            length_mm=float(along_mm[-1]),
        )
        left_px, right_px = steer.rig.project(axis_mm)
        matched = Correspondences(steer.rig.left.undistort(left_px), steer.rig.right.undistort(right_px))
        width_px = np.full(len(axis_mm), 4.0)
        track = NeedleTrack(
            captured_at_ns=pair.captured_at_ns,
            status=Status.OK,
            reasons=(),
            curve=curve,
            tip=TipPose(
                position_mm=np.array(frame["tip_mm"]),
                direction=np.array(frame["tip_direction"]),
                orientation_xyzw=np.array([0.0, 0, 0, 1]),
                covariance_mm2=np.diag([0.03, 0.04, 0.08]) ** 2,
                velocity_mm_s=None,
                seen=2,
            ),
            base=BasePose(points_mm[0], tangents(points_mm)[0]),
            diameter_mm=2 * frame["radius_mm"],
            quality=Quality(reprojection_rms_px=0.14, epipolar_rms_px=0.2, coverage=1.0),
            evidence=Evidence(Centerline(left_px, width_px), Centerline(right_px, width_px), matched),
        )
        return track, pair

    return make
