"""Pairs of points for a registration, from a CSV file."""

import csv
from dataclasses import dataclass, replace
from datetime import datetime
from io import StringIO
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.calibration.registration import RobotRegistration, register_points, register_poses
from needletrack.errors import CalibrationError
from needletrack.reading import text_of
from needletrack.records import Float
from needletrack.rig import Registration, Rig

RIG = ("rig_x_mm", "rig_y_mm", "rig_z_mm")
ROBOT = ("robot_x_mm", "robot_y_mm", "robot_z_mm")
QUATERNION = ("robot_qx", "robot_qy", "robot_qz", "robot_qw")
_UNIT = 1e-2
_MOST_BYTES = 50_000_000


@dataclass(frozen=True, slots=True)
class PointPairs:
    """The same points in the left camera's frame and the robot's, (N, 3) mm.

    rotations (N, 3, 3): of the robot's flange, where the robot's points are the flange's and not the tip's.
    """

    rig_mm: Float
    robot_mm: Float
    rotations: Float | None


def read_pairs(path: Path) -> PointPairs:
    """The pairs of a CSV file with a head; raises CalibrationError that names the line."""
    try:
        with StringIO(text_of(path, _MOST_BYTES, "utf-8-sig"), newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            head = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = head
            if missing := [name for name in RIG + ROBOT if name not in head]:
                raise CalibrationError(f"{path}: the column {missing[0]} is missing: {', '.join(RIG + ROBOT)}")
            poses = [name for name in QUATERNION if name in head]
            if poses and len(poses) < 4:
                raise CalibrationError(
                    f"{path}: of the flange's quaternion {', '.join(QUATERNION)} only {poses} is there"
                )
            rows = [
                [_number(path, reader.line_num, name, row[name]) for name in (*RIG, *ROBOT, *poses)] for row in reader
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: cannot be read: {error}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, 6 + len(poses))
    rotations = None
    if poses:
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(table[:, 6:], axis=1)
        if (wrong := np.flatnonzero(np.abs(lengths - 1) > _UNIT)).size:
            raise CalibrationError(f"{path}: the quaternion of pair {wrong[0] + 1} has length {lengths[wrong[0]]:.3f}")
        rotations = np.asarray(Rotation.from_quat(table[:, 6:]).as_matrix())
    return PointPairs(table[:, :3], table[:, 3:6], rotations)


def registered(rig: Rig, pairs: PointPairs, frame_id: str, registered_at: datetime) -> tuple[Rig, RobotRegistration]:
    """The rig with its place in the robot's frame, and how it was found; raises CalibrationError."""
    if pairs.rotations is None:
        found = register_points(pairs.rig_mm, pairs.robot_mm)
    else:
        found = register_poses(pairs.rig_mm, pairs.rotations, pairs.robot_mm)
    pose = found.robot_from_rig
    record = Registration(
        frame_id=frame_id,
        rotation=_rows(pose.rotation),
        translation_mm=_row(pose.translation_mm),
        covariance=tuple(tuple(float(f"{value:.8g}") for value in row) for row in found.covariance.tolist()),
        points_mm=tuple(_row(point) for point in pairs.rig_mm),
        rms_mm=float(f"{found.rms_mm:.4g}"),
        leave_one_out_mm=float(f"{found.leave_one_out_rms_mm:.4g}"),
        registered_at=registered_at,
        rig_digest=rig.geometry_digest,
    )
    return replace(rig, registration=record), found


def _row(values: Float) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _rows(
    matrix: Float,
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    return _row(matrix[0]), _row(matrix[1]), _row(matrix[2])


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise CalibrationError(f"{path}, line {line}: {name} is {text!r}, which is no number") from None
    if not np.isfinite(value):
        raise CalibrationError(f"{path}, line {line}: {name} is {text!r}, which is not finite")
    return value
