"""The rig: both cameras, the pose between them, how and when they were calibrated; read, written, imported.

The file holds the rotation as a 3 × 3 matrix: calibration tools print it so, it needs no convention of order
(xyzw or wxyz), and a mistyped digit shows, because the matrix is then no rotation any more.
"""

import hashlib
import json
import os
import re
import reprlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
import yaml
from annotated_types import Ge, Gt
from pydantic import (
    AllowInfNan,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform, orthonormalized
from needletrack.geometry.uncertainty import RigUncertainty, rigid_motions
from needletrack.reading import MOST_PIXELS, text_of, yaml_document
from needletrack.records import Float
from needletrack.tracking.needle import Workspace
from needletrack.validation import complaints

RIG_FILE = "rig.yaml"
CAMCHAIN_FILES = "*camchain*.yaml"

# Rounding to four decimals leaves R R^T off by up to 1.7e-4; a wrong digit is worse.
_NEAR_ROTATION = 2e-4
_EXACT_ROTATION = 1e-12
# Outside of these, metres and millimetres have been exchanged.
_BASELINE_MM = (1.0, 3000.0)
# Rounding of a written calibration moves a projection by micropixels, another calibration by more than this.
_SAME_PROJECTION_PX = 0.01
_HEADER = """\
# A needletrack rig. Pixel (0, 0) is the centre of the top-left one; axes x right, y down, z forward.
# docs/configuration.md explains every key.
"""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

Finite = Annotated[float, AllowInfNan(False)]
Size = tuple[Annotated[int, Gt(0)], Annotated[int, Gt(0)]]
Row3 = tuple[Finite, Finite, Finite]
Row4 = tuple[Finite, Finite, Finite, Finite]
Matrix = tuple[tuple[Finite, ...], ...]


class CalibrationUncertainty(BaseModel):
    """What a calibration is worth."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    corner_sigma_px: Annotated[Finite, Ge(0)] = Field(
        description="Standard deviation of one coordinate of a corner, from the residuals, px."
    )
    covariance: Matrix = Field(
        description="Lower triangle by rows, of fx fy cx cy and the distortion of the left camera, the same of the "
        "right one, a small turn (rad) and shift (mm) that follow right_from_left."
    )
    before_alignment_mm: Annotated[Finite, Ge(0)] | None = Field(
        None, description="Error to expect in the workspace, rms, in the left camera's frame, mm."
    )
    after_alignment_mm: Annotated[Finite, Ge(0)] | None = Field(
        None, description="The same after the best rigid alignment, such as a registration to a robot, mm."
    )
    held_out_epipolar_px: Annotated[Finite, Ge(0)] | None = Field(
        None, description="Rms distance from the epipolar line in views that were held out, px."
    )
    held_out_length_mm: Annotated[Finite, Ge(0)] | None = Field(
        None, description="Rms error of the board's lengths in views that were held out, mm."
    )

    @classmethod
    def rows(cls, covariance: Float) -> tuple[tuple[float, ...], ...]:
        """The lower triangle, with eight significant digits, of a covariance (P, P)."""
        return tuple(
            tuple(float(f"{value:.8g}") for value in row[: i + 1]) for i, row in enumerate(covariance.tolist())
        )

    @property
    def matrix(self) -> Float:
        """The covariance (P, P)."""
        size = len(self.covariance)
        full = np.zeros((size, size))
        for i, row in enumerate(self.covariance):
            full[i, : i + 1] = full[: i + 1, i] = row
        return full

    @model_validator(mode="after")
    def _is_triangle(self) -> Self:
        if any(len(row) != i + 1 for i, row in enumerate(self.covariance)):
            raise ValueError("covariance is not a lower triangle: row 1 has one number, row 2 two, and so on")
        return self


class CalibrationInfo(BaseModel):
    """How and when a rig was calibrated, as far as that is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: str = Field("unknown", description="What computed the calibration, e.g. kalibr.")
    calibrated_at: AwareDatetime | None = Field(
        None, description="When, with a time zone, e.g. 2026-05-01T12:00:00Z; null if unknown."
    )
    reprojection_rms_px: Annotated[Finite, Gt(0)] | None = Field(
        None, description="Root mean square reprojection error over all corners, px; null if unknown."
    )
    views: Annotated[int, Gt(0)] | None = Field(None, description="Board views used; null if unknown.")
    source: str = Field("", description="Where the numbers come from, in the owner's words.")
    uncertainty: CalibrationUncertainty | None = Field(
        None, description="How uncertain it is; null if unknown. `needletrack calibrate` states it."
    )


class Registration(BaseModel):
    """Where the rig stands in a robot's frame, from points that both know."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frame_id: Annotated[str, Field(min_length=1)] = Field(description="The robot's frame, e.g. robot_base.")
    rotation: tuple[Row3, Row3, Row3] = Field(description="robot_from_rig, 3 × 3 matrix, by rows.")
    translation_mm: Row3 = Field(description="The left camera's centre in the robot's frame, mm.")
    covariance: Matrix = Field(
        description="6 × 6, by rows: of a small turn (rad, about the robot's axes through the points' middle) and a "
        "shift (mm) that follow."
    )
    points_mm: Annotated[tuple[Row3, ...], Field(min_length=3)] = Field(
        description="The points in the left camera's frame, mm."
    )
    rms_mm: Annotated[Finite, Ge(0)] = Field(description="Root mean square distance that is left.")
    leave_one_out_mm: Annotated[Finite, Ge(0)] | None = Field(
        None, description="The same of each point by a registration from the others, mm."
    )
    registered_at: AwareDatetime | None = Field(None, description="When, with a time zone; null if unknown.")
    rig_digest: str = Field(description="Digest of the geometry that it was made with; another calibration voids it.")

    @property
    def robot_from_rig(self) -> RigidTransform:
        """Takes points of the left camera's frame to the robot's."""
        return RigidTransform(_rotation(self.rotation, "registration.rotation"), np.array(self.translation_mm))

    @property
    def middle_mm(self) -> Float:
        """The middle of the points, in the left camera's frame (3,)."""
        return np.asarray(np.mean(self.points_mm, axis=0))

    @model_validator(mode="after")
    def _has_shapes(self) -> Self:
        if np.shape(self.covariance) != (6, 6):
            raise ValueError("covariance is not 6 × 6")
        return self


@dataclass(frozen=True)
class Rig(StereoRig):
    """A named stereo rig with its calibration's record.

    Raises ValueError where the parts contradict each other: a name that cannot stand in a key, images of two
    sizes, a baseline, focal length, principal point or distortion that no such camera has, or views that do
    not overlap.
    """

    name: str
    calibration: CalibrationInfo = field(default_factory=CalibrationInfo)
    registration: Registration | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"the name {self.name!r} is not made of letters, digits, '.', '_' and '-' alone")
        if self.left.size_px != self.right.size_px:
            raise ValueError(
                f"the images differ in size: left {_size(self.left)}, right {_size(self.right)}: "
                "both cameras of a rig have one size"
            )
        _check_camera("left", self.left)
        _check_camera("right", self.right)
        low, high = _BASELINE_MM
        if not low <= self.baseline_mm <= high:
            raise ValueError(
                f"the baseline is {self.baseline_mm:g} mm, not within {low:g} to {high:g} mm: "
                "metres and millimetres may have been exchanged"
            )
        depths_mm = self.baseline_mm * np.geomspace(0.25, 256, 21)
        if not self.seen_by_both(_points_in_view(self.left, depths_mm)).any():
            raise ValueError(
                "the cameras share no view at any distance: right_from_left may be inverted (it takes points "
                "of the left camera's frame to the right one's), or a sign may be wrong"
            )

        self._require_consistent_records()

    def _require_consistent_records(self) -> None:
        stated, registered = self.calibration.uncertainty, self.registration
        if stated is not None:
            # Checks size and sign.
            RigUncertainty(self, stated.matrix)
        if registered is not None:
            if registered.rig_digest != self.geometry_digest:
                raise ValueError(
                    f"the registration to {registered.frame_id} was made with another calibration (digest "
                    f"{registered.rig_digest}, this is {self.geometry_digest}): register anew, or remove it"
                )
            _ = registered.robot_from_rig

    @cached_property
    def uncertainty(self) -> RigUncertainty | None:
        """How uncertain points are by the calibration; where the rig is registered, in the robot's frame.

        The registration takes the rigid part of the error with it.
        """
        if self.calibration.uncertainty is None:
            return None
        reference = None if self.registration is None else np.array(self.registration.points_mm)
        return RigUncertainty(self, self.calibration.uncertainty.matrix, reference)

    def calibration_covariance_mm2(self, points_mm: npt.ArrayLike) -> Float | None:
        """Covariance (N, 3, 3), axes of the left camera, that calibration and registration give points (N, 3) mm.

        It is about the frame in which tracks are published: the left camera's, or the robot's where registered.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        total = None if self.uncertainty is None else self.uncertainty.covariance_mm2(points)
        if self.registration is not None:
            rotation = self.registration.robot_from_rig.rotation
            motions = rigid_motions((points - self.registration.middle_mm) @ rotation.T)
            of_robot = motions @ np.array(self.registration.covariance) @ motions.swapaxes(1, 2)
            share = rotation.T @ of_robot @ rotation
            total = share if total is None else total + share
        return total

    @property
    def frame_id(self) -> str:
        """The frame in which tracks are published: the robot's where the rig is registered."""
        return f"{self.name}_left" if self.registration is None else self.registration.frame_id

    def age_warning(self, max_age_days: float, now: datetime) -> str | None:
        """A sentence where the calibration is older than that; None where it is not, or its date is unknown."""
        age = self.age_days(now)
        if age is None or age <= max_age_days:
            return None
        return (
            f"rig {self.name} was calibrated {age:.0f} days ago, more than {max_age_days:g} (rig.max_age_days): run "
            "`needletrack check` with a board, or calibrate anew"
        )

    def age_days(self, now: datetime) -> float | None:
        """Days since the calibration; None where its date is unknown."""
        at = self.calibration.calibrated_at
        return None if at is None else (now - at).total_seconds() / 86_400

    def seen_by_both(self, points_mm: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which points (N, 3) mm in the left camera's frame lie in both images; (N,) bool."""
        points = np.asarray(points_mm, dtype=np.float64)
        return _seen(self.left, points) & _seen(self.right, self.right_from_left.apply(points))

    def require_view_of(self, workspace: Workspace) -> None:
        """Raise CalibrationError where no part of the workspace is seen by both cameras."""
        ranges = {"x": workspace.x_mm, "y": workspace.y_mm, "z": workspace.z_mm}
        axes = [np.linspace(axis.min, axis.max, 13) for axis in ranges.values()]
        if not self.seen_by_both(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)).any():
            box = ", ".join(f"{name} {axis.min:g} to {axis.max:g} mm" for name, axis in ranges.items())
            raise CalibrationError(
                f"rig {self.name}: no part of the workspace ({box}) is seen by both cameras: correct "
                "tracking.workspace, or the rig's right_from_left (its translation is in millimetres)"
            )

    @cached_property
    def digest(self) -> str:
        """Twelve hexadecimal digits (SHA-256) of the geometry and, where they are known, uncertainty and registration.

        The geometry is rounded far below any accuracy.
        """
        stated, registered = self.calibration.uncertainty, self.registration
        if stated is None and registered is None:
            return self.geometry_digest
        parts = [self.geometry_digest] + [part.model_dump_json() for part in (stated, registered) if part is not None]
        return hashlib.sha256("".join(parts).encode()).hexdigest()[:12]

    @cached_property
    def geometry_digest(self) -> str:
        """The same of the geometry alone."""
        pose, content = self.right_from_left, []
        for camera in (self.left, self.right):
            # k3 = 0 and no k3 are the same lens.
            lens = np.trim_zeros(camera.distortion, "b")
            content += [[*camera.size_px], _rounded(camera.matrix, 6), _rounded(lens, 9)]
        content += [_rounded(pose.rotation, 9), _rounded(pose.translation_mm, 6)]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]


def read_rig(path: Path | str) -> Rig:
    """The rig of a rig file (docs/configuration.md); CalibrationError names file, key and remedy."""
    path = Path(path)
    return _rig_in(path, _read_yaml(path))


def rig_from_text(text: str, path: Path) -> Rig:
    """The rig of a rig file's content; path: where it came from, for what CalibrationError says."""
    return _rig_in(path, _parsed_yaml(path, lambda: text))


def _rig_in(path: Path, document: Any) -> Rig:
    if not isinstance(document, dict) or document.get("format") != "needletrack-rig":
        raise CalibrationError(
            f"{path}: not a rig file: its first entry must be `format: needletrack-rig` "
            "(Kalibr's camchain is imported instead)"
        )
    return _built(path, _RigFile, lambda: _RigFile.model_validate(document).rig())


def write_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig file that reads back as the same rig; the old file stays whole until the new one is.

    Raises CalibrationError where the file cannot be written or cannot hold the lens model.
    """
    try:
        path = Path(path).resolve()
    except (OSError, RuntimeError) as error:  # a link to itself
        raise CalibrationError(f"{path}: cannot write the rig file: {error}") from error
    try:
        text = rig_text(rig)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise CalibrationError(f"{path}: cannot write the rig file: {error.strerror or error}") from error


def rig_text(rig: Rig) -> str:
    """The content of a rig file; raises CalibrationError where one cannot hold the lens model."""
    try:
        document = _RigFile.of(rig).model_dump(mode="json")
    except ValidationError as error:
        found = "; ".join(complaint.message for complaint in complaints(error, _CameraEntry))
        raise CalibrationError(f"a rig file cannot hold this rig: {found}") from error
    return _HEADER + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)


def import_camchain(path: Path | str, name: str | None = None) -> Rig:
    """The rig of a Kalibr camchain: cam0 is left, cam1 right; named after its folder unless a name is given.

    Only pinhole cameras with radtan distortion, or none, are taken. Kalibr's T_cn_cnm1 takes cam0's points to
    cam1, in metres. Raises CalibrationError.
    """
    path = Path(path)
    document = _read_yaml(path)
    if not isinstance(document, dict) or "cam0" not in document:
        raise CalibrationError(f"{path}: not a Kalibr camchain: it has no cam0")
    if document.keys() != {"cam0", "cam1"}:
        raise CalibrationError(
            f"{path}: holds {', '.join(map(str, document))}: a rig has cam0 (left) and cam1 (right), no more"
        )
    for key in ("cam0", "cam1"):
        _refuse_other_models(path, key, document[key])
    rig_name = name if name is not None else _name_after(path.resolve().parent)
    return _built(path, _Camchain, lambda: _Camchain.model_validate(document).rig(rig_name, path.name))


def find_rig(folder: Path | str) -> Rig:
    """The rig that lies in a recording's folder: rig.yaml, or a Kalibr camchain.

    Where both lie there they must agree, and the rig file is used. Raises CalibrationError where there is
    none, more than one camchain, or a contradiction.
    """
    folder = Path(folder)
    rig_path, chains = folder / RIG_FILE, sorted(folder.glob(CAMCHAIN_FILES))
    if len(chains) > 1:
        names = ", ".join(chain.name for chain in chains)
        raise CalibrationError(f"{folder}: more than one camchain ({names}): keep the one that is valid")
    if not rig_path.exists():
        if not chains:
            raise CalibrationError(
                f"{folder}: no rig: add {RIG_FILE} or Kalibr's camchain.yaml, or name a rig file in the "
                "command or in the configuration (rig.path)"
            )
        return import_camchain(chains[0])
    rig = read_rig(rig_path)
    if chains and (difference := _difference(rig, import_camchain(chains[0]))):
        raise CalibrationError(
            f"{folder}: {RIG_FILE} and {chains[0].name} contradict each other: {difference}; "
            "remove the one that is outdated"
        )
    return rig


class _Lens(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Literal["radtan", "rational"] = Field(
        description="radtan (k1 k2 p1 p2, or with k3) or rational (k1 k2 p1 p2 k3 k4 k5 k6)."
    )
    coefficients: tuple[Finite, ...] = Field(description="In OpenCV's order, without unit.")

    @model_validator(mode="after")
    def _has_its_terms(self) -> Self:
        allowed = {"radtan": (4, 5), "rational": (8,)}[self.model]
        if len(self.coefficients) not in allowed:
            terms = " or ".join(map(str, allowed))
            raise ValueError(f"{self.model} has {terms} coefficients, not {len(self.coefficients)}")
        return self


class _Matrix(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    fx: Annotated[Finite, Gt(0)] = Field(description="Focal length along the rows, px.")
    fy: Annotated[Finite, Gt(0)] = Field(description="Focal length along the columns, px.")
    cx: Finite = Field(description="Principal point, column, px.")
    cy: Finite = Field(description="Principal point, row, px.")
    skew: Finite = Field(0.0, description="Skew, px; zero for every usual sensor.")


class _CameraEntry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    size_px: Size = Field(description="Width and height, px.")
    camera_matrix: _Matrix = Field(description="K: fx, fy, cx, cy and skew, px.")
    distortion: _Lens = Field(description="Lens distortion.")

    def camera(self) -> Camera:
        k = self.camera_matrix
        matrix = np.array([[k.fx, k.skew, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
        return Camera(matrix, np.array(self.distortion.coefficients), self.size_px)

    @classmethod
    def of(cls, camera: Camera) -> Self:
        (fx, skew, cx), (_, fy, cy), _ = camera.matrix.tolist()
        lens = {
            "model": "radtan" if len(camera.distortion) <= 5 else "rational",
            "coefficients": camera.distortion.tolist(),
        }
        matrix = _Matrix(fx=fx, fy=fy, cx=cx, cy=cy, skew=skew)
        return cls.model_validate({"size_px": camera.size_px, "camera_matrix": matrix, "distortion": lens})


class _Cameras(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    left: _CameraEntry = Field(description="The left camera, whose frame is the rig's.")
    right: _CameraEntry = Field(description="The right camera.")


class _Pose(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    rotation: tuple[Row3, Row3, Row3] = Field(description="3 × 3 matrix, by rows, with five decimals or more.")
    translation_mm: Row3 = Field(description="The left camera's centre in the right camera's frame, mm.")


class _RigFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["needletrack-rig"] = Field(description="Always needletrack-rig.")
    version: Literal[1] = Field(description="Version of the file's layout.")
    name: str = Field(description="The rig's name on the wire: letters, digits, '.', '_' and '-'.")
    cameras: _Cameras = Field(description="Both cameras.")
    right_from_left: _Pose = Field(description="Takes points of the left camera's frame to the right one's.")
    calibration: CalibrationInfo = Field(CalibrationInfo(), description="How and when it was calibrated.")
    registration: Registration | None = Field(
        None, description="Where it stands in a robot's frame; null: not registered. `needletrack register` finds it."
    )

    def rig(self) -> Rig:
        rotation = _rotation(self.right_from_left.rotation, "right_from_left.rotation")
        pose = RigidTransform(rotation, np.array(self.right_from_left.translation_mm))
        left, right = self.cameras.left.camera(), self.cameras.right.camera()
        return Rig(left, right, pose, self.name, self.calibration, self.registration)

    @classmethod
    def of(cls, rig: Rig) -> Self:
        (first, second, third), translation = (
            rig.right_from_left.rotation.tolist(),
            rig.right_from_left.translation_mm,
        )
        return cls(
            format="needletrack-rig",
            version=1,
            name=rig.name,
            cameras=_Cameras(left=_CameraEntry.of(rig.left), right=_CameraEntry.of(rig.right)),
            right_from_left=_Pose(rotation=(first, second, third), translation_mm=translation.tolist()),
            calibration=rig.calibration,
            registration=rig.registration,
        )


class _CamchainCamera(BaseModel):
    # Kalibr adds keys (rostopic, cam_overlaps, T_cam_imu, ...) which say nothing about a stereo rig.
    model_config = ConfigDict(frozen=True, extra="ignore")

    intrinsics: Row4 = Field(description="fu fv pu pv, px.")
    distortion_model: Literal["radtan", "none"]
    distortion_coeffs: tuple[Finite, ...] = Field(description="k1 k2 p1 p2.")
    resolution: Size = Field(description="Width and height, px.")

    @model_validator(mode="after")
    def _has_its_terms(self) -> Self:
        terms = {"radtan": 4, "none": 0}[self.distortion_model]
        if len(self.distortion_coeffs) != terms:
            raise ValueError(f"{self.distortion_model} has {terms} coefficients, not {len(self.distortion_coeffs)}")
        return self

    def camera(self) -> Camera:
        fu, fv, pu, pv = self.intrinsics
        matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
        return Camera(matrix, np.array(self.distortion_coeffs or (0, 0, 0, 0)), self.resolution)


class _CamchainSecond(_CamchainCamera):
    T_cn_cnm1: tuple[Row4, Row4, Row4, Row4] = Field(description="4 × 4, cam0's points to cam1, metres.")


class _Camchain(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    cam0: _CamchainCamera
    cam1: _CamchainSecond

    def rig(self, name: str, file_name: str) -> Rig:
        transform = np.array(self.cam1.T_cn_cnm1)
        if not np.array_equal(transform[3], [0, 0, 0, 1]):
            raise ValueError("cam1.T_cn_cnm1: the last row is not 0 0 0 1")
        pose = RigidTransform(_rotation(transform[:3, :3], "cam1.T_cn_cnm1"), transform[:3, 3] * 1000)
        info = CalibrationInfo(method="kalibr", source=f"imported from {file_name}")
        return Rig(self.cam0.camera(), self.cam1.camera(), pose, name, info)


def _refuse_other_models(path: Path, key: str, entry: object) -> None:
    if not isinstance(entry, dict):
        raise CalibrationError(f"{path}: {key} is not a table of camera_model, intrinsics and so on")
    for part, allowed in (("camera_model", ("pinhole",)), ("distortion_model", ("radtan", "none"))):
        if entry.get(part) not in allowed:
            raise CalibrationError(
                f"{path}: {key}.{part} is {reprlib.repr(entry.get(part))}, which is not supported: "
                "calibrate with Kalibr's pinhole-radtan"
            )


def _read_yaml(path: Path) -> Any:
    return _parsed_yaml(path, lambda: text_of(path))


def _parsed_yaml(path: Path, text: Callable[[], str]) -> Any:
    try:
        return yaml_document(text())
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read the calibration: {error.strerror or error}") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: not a YAML file: {error}") from error


def _built(path: Path, model: type[BaseModel], build: Callable[[], Rig]) -> Rig:
    try:
        # What overflows on the way is no number of a rig, which the checks say better than NumPy's warnings.
        with np.errstate(all="ignore"):
            return build()
    except ValidationError as error:
        found = "; ".join(complaint.message for complaint in complaints(error, model))
        raise CalibrationError(f"{path}: {found}") from error
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _rotation(values: npt.ArrayLike, key: str) -> Float:
    """The rotation (3, 3) that was rounded when it was written; ValueError where it never was one."""
    matrix = np.asarray(values, dtype=np.float64)
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    determinant = np.linalg.det(matrix)
    if not error <= _NEAR_ROTATION or determinant < 0:
        raise ValueError(
            f"{key} is not a rotation (R R^T is off from the identity by {error:.1e}, its determinant is "
            f"{determinant:.4f}): a digit, a sign or the order is wrong, or it has fewer than five decimals"
        )
    # A matrix that is exact already stays as it is, so that a written rig reads back to the last bit.
    return orthonormalized(matrix) if error > _EXACT_ROTATION else matrix


def _check_camera(side: str, camera: Camera) -> None:
    if camera.size_px[0] * camera.size_px[1] > MOST_PIXELS:
        raise ValueError(f"{side} camera: images of {_size(camera)} are larger than {MOST_PIXELS >> 20} million pixels")
    size, focal, center = np.array(camera.size_px), np.diag(camera.matrix)[:2], camera.matrix[:2, 2]
    if (focal < 0.1 * size).any() or (focal > 200 * size).any() or not 0.5 < focal[0] / focal[1] < 2:
        raise ValueError(
            f"{side} camera: the focal lengths {focal[0]:g}, {focal[1]:g} do not fit {_size(camera)} images: "
            "they are in pixels, not in millimetres"
        )
    if (center < -0.5 * size).any() or (center > 1.5 * size).any():
        raise ValueError(
            f"{side} camera: the principal point ({center[0]:g}, {center[1]:g}) lies far outside the "
            f"{_size(camera)} image: cx and cy may be exchanged, or belong to another image size"
        )
    pixels = _pixel_grid(camera)
    with np.errstate(all="ignore"):
        error_px = np.abs(camera.distort(camera.undistort(pixels)) - pixels).max()
    if not error_px < 0.1:
        raise ValueError(
            f"{side} camera: the distortion has no inverse within the image: its coefficients may be in "
            "another order (OpenCV's is k1 k2 p1 p2 k3) or belong to another model"
        )


def _pixel_grid(camera: Camera) -> Float:
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 13))
    return np.column_stack([columns.ravel(), rows.ravel()])


def _points_in_view(camera: Camera, depths_mm: Float) -> Float:
    """Points (N, 3) mm in the camera's frame that cover its image at each depth."""
    rays = np.insert(camera.normalize(_pixel_grid(camera)), 2, 1.0, axis=1)
    return np.concatenate([rays * depth for depth in depths_mm])


def _seen(camera: Camera, points_mm: Float) -> npt.NDArray[np.bool_]:
    seen = np.asarray(points_mm[:, 2] > 0)
    points = points_mm[seen]
    pixels = camera.project(points)
    inside = camera.contains(pixels)
    # Far off the axis a distortion polynomial folds back into the image, where the point is not seen.
    rays = points[inside, :2] / points[inside, 2:]
    inside[inside] = (np.abs(camera.normalize(pixels[inside]) - rays) < 1e-6).all(axis=1)
    seen[seen] = inside
    return seen


def _difference(rig: Rig, other: Rig) -> str | None:
    """What the images would notice if one rig took the other's place; None for rounding."""
    if rig.left.size_px != other.left.size_px:
        return f"images of {_size(rig.left)} and of {_size(other.left)}"
    depths = Workspace().z_mm
    points = _points_in_view(rig.left, np.linspace(depths.min, depths.max, 3))
    worst_px = np.abs(np.subtract(rig.project(points), other.project(points))).max()
    if not worst_px < _SAME_PROJECTION_PX:
        return f"they project the same points up to {worst_px:.3g} px apart"
    return None


def _name_after(folder: Path) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", folder.name).strip("-._") or "rig"


def _size(camera: Camera) -> str:
    return f"{camera.size_px[0]}x{camera.size_px[1]}"


def _rounded(values: Float, decimals: int) -> list[float]:
    # Adding zero makes -0.0 and 0.0 the same.
    return [float(value) for value in (np.round(values, decimals) + 0.0).ravel()]
