"""What a textbook and OpenCV give: crossings of epipolar lines, triangulated, and a smoothing spline through them.

Hartley & Zisserman, Multiple View Geometry, ch. 9 and 12. Each left point's epipolar line is cut with the right line;
of several crossings the next one along the line counts, so that the order holds.
"""

import cv2
import numpy as np
from scipy.interpolate import splev, splprep

from benchmarks.accuracy.lines import PairLines
from needletrack.geometry.spline import arc_length, resample
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float

# A crossing this far along the right line, beyond what the left one has moved on, belongs to something else.
_GREATEST_LEAP_PX = 20.0
# A line that is half a pixel off in each view smooths to this.
_NOISE_PX = 0.5
_LEAST_POINTS = 5
_SPACING_MM = 0.5


def reconstruct(lines: PairLines, rig: StereoRig) -> Float:
    """Points (N, 3) mm from the base on; raises ValueError where too few epipolar lines cross."""
    left_px, right_px = lines.left.undistorted_px, lines.right.undistorted_px
    epilines = cv2.computeCorrespondEpilines(left_px.reshape(-1, 1, 2), 1, rig.fundamental).reshape(-1, 3)
    left_at, right_at = arc_length(left_px), arc_length(right_px)
    pairs: list[tuple[Float, Float]] = []
    reached_left, reached_right = 0.0, 0.0
    for point, line, at in zip(left_px, epilines, left_at, strict=True):
        crossings = _crossings(right_px, np.asarray(line, dtype=np.float64))
        along = np.interp(crossings, np.arange(len(right_px)), right_at)
        leap_px = along - reached_right
        allowed = (leap_px >= -1.0) & (leap_px <= _GREATEST_LEAP_PX + 2 * (at - reached_left))
        if allowed.any():
            chosen = int(np.flatnonzero(allowed)[np.abs(leap_px[allowed]).argmin()])
            reached_left, reached_right = float(at), float(along[chosen])
            index = np.arange(len(right_px))
            pairs.append((point, np.array([np.interp(crossings[chosen], index, axis) for axis in right_px.T])))
    if len(pairs) < _LEAST_POINTS:
        raise ValueError("fewer than five epipolar lines cross")
    pose = rig.right_from_left
    projections = (
        rig.left.matrix @ np.eye(3, 4),
        rig.right.matrix @ np.column_stack([pose.rotation, pose.translation_mm]),
    )
    left, right = (np.array(side).T for side in zip(*pairs, strict=True))
    homogeneous = cv2.triangulatePoints(*projections, left, right)
    return _smoothed((homogeneous[:3] / homogeneous[3]).T, rig)


def _crossings(polyline: Float, line: Float) -> Float:
    """Where (fractional indices) a polyline (N, 2) crosses a line a x + b y + c = 0."""
    side = polyline @ line[:2] + line[2]
    before = np.flatnonzero((side[:-1] <= 0) != (side[1:] <= 0))
    return np.asarray(before + side[before] / (side[before] - side[before + 1]))


def _smoothed(points_mm: Float, rig: StereoRig) -> Float:
    # Equal neighbours have no place in a spline's parameter.
    points_mm = points_mm[np.append(True, np.any(np.diff(points_mm, axis=0), axis=1))]
    depth_mm = float(np.median(points_mm[:, 2]))
    noise_mm = _NOISE_PX * depth_mm**2 / (rig.left.focal_px * rig.baseline_mm)
    if len(points_mm) < _LEAST_POINTS or not np.isfinite(points_mm).all():
        raise ValueError("fewer than five points in space")
    curve, _ = splprep(points_mm.T, s=len(points_mm) * noise_mm**2)
    fine_mm = np.column_stack(splev(np.linspace(0, 1, 400), curve))
    return resample(fine_mm, int(np.clip(arc_length(fine_mm)[-1] / _SPACING_MM, 2, 4000)))
