"""Where the rig stands in a robot's frame, from points that both know.

The rotation is Kabsch's (DOI 10.1107/S0567739476001873). Where the robot states its flange and not the tool's tip, the
tip's place in the flange is solved for as well.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.geometry.uncertainty import rigid_motions
from needletrack.records import Float

MIN_POINTS = 4
_MIN_POSES = 6
# Points whose spread across their line is less than this, mm, or this share of that along it, are on a line.
_THIN_MM, _THIN_SHARE = 5.0, 0.05
_LEAST_TURN_DEG = 15.0


@dataclass(frozen=True, slots=True)
class RobotRegistration:
    """robot_from_rig, and how well it is known.

    covariance (6, 6): of a small turn (rad, about the robot's axes through the points' middle) and a shift (mm) that
    follow. residual_mm, leave_one_out_mm (N,): distance of each point, by all points and by all the others.
    tool_mm (3,): the tip in the flange's frame, where it was solved for.
    """

    robot_from_rig: RigidTransform
    covariance: Float
    residual_mm: Float
    leave_one_out_mm: Float
    tool_mm: Float | None = None

    @property
    def turn_sigma_deg(self) -> Float:
        """Standard deviation (3,) of the turn about each of the robot's axes."""
        return np.asarray(np.degrees(np.sqrt(np.diag(self.covariance)[:3])))

    @property
    def shift_sigma_mm(self) -> Float:
        """The same (3,) of the points' middle."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt((self.residual_mm**2).mean()))

    @property
    def leave_one_out_rms_mm(self) -> float:
        """Root mean square of what the others leave at each point."""
        return float(np.sqrt((self.leave_one_out_mm**2).mean()))


def register_points(rig_mm: Float, robot_mm: Float) -> RobotRegistration:
    """The motion that takes points (N, 3) of the left camera's frame nearest to the robot's (N, 3).

    Raises CalibrationError for fewer than MIN_POINTS, and for points on a line, which leave the turn about it open.
    """
    _require_points(rig_mm, MIN_POINTS)
    robot_from_rig = _fitted(rig_mm, robot_mm)
    off = robot_mm - robot_from_rig.apply(rig_mm)
    without = [
        np.linalg.norm(robot_mm[i] - _fitted(np.delete(rig_mm, i, 0), np.delete(robot_mm, i, 0)).apply(rig_mm[i]))
        for i in range(len(rig_mm))
    ]
    variance = float((off**2).sum()) / (3 * len(rig_mm) - 6)
    motions = rigid_motions((rig_mm - rig_mm.mean(axis=0)) @ robot_from_rig.rotation.T).reshape(-1, 6)
    covariance: Float = np.asarray(variance * np.linalg.inv(motions.T @ motions), dtype=np.float64)
    return RobotRegistration(robot_from_rig, covariance, np.linalg.norm(off, axis=1), np.array(without))


def register_poses(rig_mm: Float, flange_rotations: Float, flange_mm: Float) -> RobotRegistration:
    """The same from poses of the robot's flange, rotations (N, 3, 3) and places (N, 3): flange to robot.

    The tool's tip, which the rig saw at rig_mm (N, 3), is fixed in the flange at a place that is found as well. Raises
    CalibrationError for fewer than six poses, points on a line, and flanges that are hardly turned against each other.
    """
    _require_points(rig_mm, _MIN_POSES)
    turns = Rotation.from_matrix(flange_rotations)
    apart_deg = np.degrees(max((turn * turns[0].inv()).magnitude() for turn in turns))
    if apart_deg < _LEAST_TURN_DEG:
        raise CalibrationError(
            f"the flange's poses differ by {apart_deg:.0f} degrees at most, which leaves the tool's tip open: "
            f"turn it by {_LEAST_TURN_DEG:g} degrees and more about two axes, or give the tip's own positions"
        )
    start = _linear(rig_mm, flange_rotations, flange_mm)
    solved = _solve(start, rig_mm, flange_rotations, flange_mm)
    without = []
    for i in range(len(rig_mm)):
        others = [np.delete(values, i, 0) for values in (rig_mm, flange_rotations, flange_mm)]
        fewer = _solve(solved.x, *others)
        without.append(np.linalg.norm(_pose_residual(fewer.x, rig_mm[[i]], flange_rotations[[i]], flange_mm[[i]])))
    off = solved.fun.reshape(-1, 3)
    pose, tool_mm = _unpacked(solved.x)
    variance = float((off**2).sum()) / (3 * len(rig_mm) - 9)
    motions = rigid_motions((rig_mm - rig_mm.mean(axis=0)) @ pose.rotation.T).reshape(-1, 6)
    by_all = np.column_stack([motions, -flange_rotations.reshape(-1, 3)])
    information = by_all.T @ by_all
    if np.linalg.cond(information) > 1e14:
        raise CalibrationError("the poses leave the tool's tip open: turn the flange about two axes")
    covariance: Float = np.asarray(variance * np.linalg.inv(information)[:6, :6], dtype=np.float64)
    return RobotRegistration(pose, covariance, np.linalg.norm(off, axis=1), np.array(without), tool_mm)


def _require_points(rig_mm: Float, least: int) -> None:
    if len(rig_mm) < least:
        raise CalibrationError(f"{len(rig_mm)} points are fewer than {least}: a registration needs as many, all over")
    spread = np.linalg.svd(rig_mm - rig_mm.mean(axis=0), compute_uv=False) / np.sqrt(len(rig_mm))
    if spread[1] < max(_THIN_MM, _THIN_SHARE * spread[0]):
        raise CalibrationError(
            f"the points lie on a line (they spread by {spread[1]:.1f} mm across it), which leaves the turn about it "
            "open: add points beside it"
        )


def _fitted(rig_mm: Float, robot_mm: Float) -> RigidTransform:
    rig_middle, robot_middle = rig_mm.mean(axis=0), robot_mm.mean(axis=0)
    rotation = orthonormalized((robot_mm - robot_middle).T @ (rig_mm - rig_middle))
    return RigidTransform(rotation, robot_middle - rotation @ rig_middle)


def _linear(rig_mm: Float, rotations: Float, flange_mm: Float) -> Float:
    """A first solution: a free 3 × 3 matrix in place of the rotation, then the nearest rotation."""
    count = len(rig_mm)
    design = np.zeros((count, 3, 15))
    for axis in range(3):
        design[:, axis, 3 * axis : 3 * axis + 3] = rig_mm
        design[:, axis, 9 + axis] = 1
    design[:, :, 12:] = -rotations
    solution = np.linalg.lstsq(design.reshape(-1, 15), flange_mm.ravel(), rcond=None)[0]
    turn = Rotation.from_matrix(orthonormalized(solution[:9].reshape(3, 3))).as_rotvec()
    return np.concatenate([turn, solution[9:]])


def _solve(start: Float, rig_mm: Float, rotations: Float, flange_mm: Float) -> Any:
    return least_squares(_pose_residual, start, args=(rig_mm, rotations, flange_mm), x_scale="jac")


def _pose_residual(x: Float, rig_mm: Float, rotations: Float, flange_mm: Float) -> Float:
    pose, tool_mm = _unpacked(x)
    return np.asarray((pose.apply(rig_mm) - rotations @ tool_mm - flange_mm).ravel())


def _unpacked(x: Float) -> tuple[RigidTransform, Float]:
    return RigidTransform(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]), np.asarray(x[6:])
