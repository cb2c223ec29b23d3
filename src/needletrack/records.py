"""The frozen records that cross from one stage to the next.

Arrays are checked for shape on construction and made read-only; a record never changes, and one that
holds arrays is equal to itself alone. Shapes are
base -> tip, lengths in millimetres in the left camera's frame, pixels raw (distorted) unless a name
says `undistorted`; see the package docstring for the conventions.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Image = npt.NDArray[np.uint8]
Image16 = npt.NDArray[np.uint16]
Pixels = Image | Image16


def frozen_array(
    value: npt.ArrayLike, shape: tuple[int | None, ...], name: str, dtype: npt.DTypeLike = np.float64
) -> npt.NDArray[Any]:
    """A read-only array of the wanted shape (None: any length), copied unless nobody can write to it.

    Raises ValueError where the shape differs, or where an array's values need not fit the wanted type.
    """
    if isinstance(value, np.ndarray) and not np.can_cast(value.dtype, dtype, "safe"):
        raise ValueError(f"{name} is an array of {value.dtype}, which does not fit {np.dtype(dtype)}")
    array = np.asarray(value, dtype=dtype)
    if array.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
    ):
        wanted = tuple("any" if n is None else n for n in shape)
        raise ValueError(f"{name} has shape {array.shape}, not {wanted}")
    if not _never_changes(array):
        array = array.copy() if array is value or array.base is not None else array
        array.flags.writeable = False
    return array


def _never_changes(array: npt.NDArray[Any]) -> bool:
    # A read-only view (of a driver's buffer, say) changes when somebody writes to what it looks at.
    owner: object = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)


class Clock(StrEnum):
    """The clock of a capture stamp."""

    REALTIME = "realtime"
    MONOTONIC = "monotonic"
    RECORDED = "recorded"


class StampPlace(StrEnum):
    """Where in the exposure a capture stamp was taken, by what the driver says."""

    START_OF_EXPOSURE = "start_of_exposure"
    END_OF_FRAME = "end_of_frame"


class Status(StrEnum):
    """What a controller may do with a track."""

    OK = "ok"
    DEGRADED = "degraded"
    INVALID = "invalid"


class Reason(StrEnum):
    """Why a track is not ok; the closed list of codes (docs/wire.md has a sentence for each)."""

    NO_CANDIDATE = "no_candidate"
    NO_STEREO_MATCH = "no_stereo_match"
    OUTSIDE_WORKSPACE = "outside_workspace"
    TOO_SHORT = "too_short"
    TOO_LONG = "too_long"
    WIDTH_OUT_OF_RANGE = "width_out_of_range"
    AMBIGUOUS_SHAPE = "ambiguous_shape"
    AMBIGUOUS_BASE = "ambiguous_base"
    LOW_COVERAGE = "low_coverage"
    ALONG_EPIPOLAR_LINES = "along_epipolar_lines"
    HIGH_RESIDUAL = "high_residual"
    HIGH_UNCERTAINTY = "high_uncertainty"
    TIP_NOT_SEEN = "tip_not_seen"
    TIP_DISAGREES = "tip_disagrees"
    JUMP = "jump"
    CALIBRATION_DRIFT = "calibration_drift"
    REFERENCE_METHOD = "reference_method"


REASON_MEANING: Mapping[Reason, str] = MappingProxyType(
    {
        Reason.NO_CANDIDATE: "No thin structure of the needle's width was found in one view or both.",
        Reason.NO_STEREO_MATCH: "Thin structures were found, but no left-right pair obeys the epipolar geometry.",
        Reason.OUTSIDE_WORKSPACE: "The best matching structure lies outside the configured workspace.",
        Reason.TOO_SHORT: "The shape is shorter than the shortest needle that can be told from clutter.",
        Reason.TOO_LONG: "The shape is longer than the configured greatest length.",
        Reason.WIDTH_OUT_OF_RANGE: "The width seen in the images does not fit the configured diameter range.",
        Reason.AMBIGUOUS_SHAPE: "Another shape explains the images almost as well, or nothing has confirmed this one.",
        Reason.AMBIGUOUS_BASE: "Which end is the base cannot be told; base and tip may be exchanged.",
        Reason.LOW_COVERAGE: "Too small a share of the shape is seen by both cameras.",
        Reason.ALONG_EPIPOLAR_LINES: "A long stretch runs along the epipolar lines, where two views fix no depth.",
        Reason.HIGH_RESIDUAL: "The fitted curve does not reproject onto what the images show.",
        Reason.HIGH_UNCERTAINTY: "The stated standard deviation exceeds what a controller may act on.",
        Reason.TIP_NOT_SEEN: "The free end was not found in both views, or something hides it: no tip is given.",
        Reason.TIP_DISAGREES: "The two views place the free end at different points.",
        Reason.JUMP: "The shape moved further since the last pair than a needle can.",
        Reason.CALIBRATION_DRIFT: "The tips of the last pairs lie off their epipolar lines: a camera has moved.",
        Reason.REFERENCE_METHOD: "Found by the 2017 reference method, which cannot tell whether it is right.",
    }
)


class DropReason(StrEnum):
    """Why a frame or a pair never became a track."""

    UNPAIRED_LEFT = "unpaired_left"
    UNPAIRED_RIGHT = "unpaired_right"
    STAMP_OUT_OF_ORDER = "stamp_out_of_order"
    MISSING_IMAGE = "missing_image"
    UNREADABLE_IMAGE = "unreadable_image"
    WRONG_SIZE = "wrong_size"
    LOST_BY_DRIVER = "lost_by_driver"
    BUFFER_ERROR = "buffer_error"
    OVERWRITTEN = "overwritten"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One camera's image (rows, columns) of uint8 and the driver's own stamp of it.

    image16: the same picture as uint16 where the camera gives more than eight bits, else None; its upper eight, of the
    full range, are `image`, which is tracked.
    """

    image: Image
    captured_at_ns: int
    image16: Image16 | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", frozen_array(self.image, (None, None), "image", np.uint8))
        if self.image16 is not None:
            object.__setattr__(self, "image16", frozen_array(self.image16, self.image.shape, "image16", np.uint16))

    @classmethod
    def of(cls, pixels: Pixels, captured_at_ns: int) -> "Frame":
        """The frame of a picture (rows, columns) of uint8, or of uint16 in the full range."""
        if pixels.dtype == np.uint16:
            upper: Image = (pixels >> 8).astype(np.uint8)
            upper.flags.writeable = False
            return cls(upper, captured_at_ns, cast(Image16, pixels))
        return cls(cast(Image, pixels), captured_at_ns)

    @property
    def pixels(self) -> Pixels:
        """All that the camera gave: what is recorded."""
        return self.image if self.image16 is None else self.image16


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """Two frames of one instant; the pair's stamp is the left camera's.

    exposure_ns: length of the exposure, None if unknown. stamp_at: where in it the stamps were taken, None if unknown.
    released_at_ns: when a paced replay let the pair go, on time.monotonic_ns's clock, from which its latency
    counts; None for live and for unpaced pairs. arrived_at_ns: when a live pair was complete, on the same clock.
    """

    left: Frame
    right: Frame
    sequence: int
    clock: Clock = Clock.RECORDED
    exposure_ns: int | None = None
    released_at_ns: int | None = None
    stamp_at: StampPlace | None = None
    arrived_at_ns: int | None = None

    @property
    def captured_at_ns(self) -> int:
        """The left camera's stamp, which names the pair."""
        return self.left.captured_at_ns

    @property
    def skew_us(self) -> float:
        """Right stamp minus left stamp, microseconds."""
        return (self.right.captured_at_ns - self.left.captured_at_ns) / 1000


@dataclass(frozen=True, slots=True, eq=False)
class Centerline:
    """A thin structure in one image, traced in order: points_px (N, 2) raw pixels, width_px (N,)."""

    points_px: Float
    width_px: Float

    def __post_init__(self) -> None:
        points = frozen_array(self.points_px, (None, 2), "points_px")
        object.__setattr__(self, "points_px", points)
        object.__setattr__(self, "width_px", frozen_array(self.width_px, (len(points),), "width_px"))

    def reversed(self) -> "Centerline":
        """The same line, traced from the other end."""
        return Centerline(self.points_px[::-1], self.width_px[::-1])


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Matched points of both views, left_undistorted_px and right_undistorted_px (N, 2), in order along the needle."""

    left_undistorted_px: Float
    right_undistorted_px: Float

    def __post_init__(self) -> None:
        left = frozen_array(self.left_undistorted_px, (None, 2), "left_undistorted_px")
        right = frozen_array(self.right_undistorted_px, (len(left), 2), "right_undistorted_px")
        object.__setattr__(self, "left_undistorted_px", left)
        object.__setattr__(self, "right_undistorted_px", right)


@dataclass(frozen=True, slots=True, eq=False)
class NeedleCurve:
    """The needle's axis in space, base -> tip, evenly spaced along the arc.

    points_mm (N, 3); sigma_mm (N,) square root of the larger eigenvalue of the covariance across
    the tangent; seen (N,) number of cameras that saw the point; curvature_per_mm (N,); velocity_mm_s (N, 3) at which
    its points come aside, None where that is unknown.
    """

    points_mm: Float
    sigma_mm: Float
    seen: Int
    curvature_per_mm: Float
    length_mm: float
    velocity_mm_s: Float | None = None

    def __post_init__(self) -> None:
        points = frozen_array(self.points_mm, (None, 3), "points_mm")
        n = len(points)
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "sigma_mm", frozen_array(self.sigma_mm, (n,), "sigma_mm"))
        object.__setattr__(self, "seen", frozen_array(self.seen, (n,), "seen", np.int64))
        object.__setattr__(self, "curvature_per_mm", frozen_array(self.curvature_per_mm, (n,), "curvature_per_mm"))
        if self.velocity_mm_s is not None:
            object.__setattr__(self, "velocity_mm_s", frozen_array(self.velocity_mm_s, (n, 3), "velocity_mm_s"))


@dataclass(frozen=True, slots=True)
class Appearance:
    """What is the same all along a needle and in both views, as `tracking/evidence.py` numbers it.

    half_width, blur, inside: indices of its half width, of the blur of the lens, of how lively its inside is. taper_mm:
    length of the cone at its tip, 0 for a round end, None before it was looked at.
    """

    half_width: int
    blur: int
    inside: int
    taper_mm: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TipPose:
    """The free end: position_mm (3,), unit direction (3,) out of the tip, orientation_xyzw (4,).

    +z of the orientation runs along the needle; the roll about it is not observable and is set so
    that +x lies in the plane of +z and the left camera's x axis. covariance_mm2 (3, 3) of the
    position; velocity_mm_s (3,) or None where it is unknown; seen: number of cameras that saw it.
    """

    position_mm: Float
    direction: Float
    orientation_xyzw: Float
    covariance_mm2: Float
    velocity_mm_s: Float | None
    seen: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", frozen_array(self.position_mm, (3,), "position_mm"))
        object.__setattr__(self, "direction", frozen_array(self.direction, (3,), "direction"))
        object.__setattr__(self, "orientation_xyzw", frozen_array(self.orientation_xyzw, (4,), "orientation_xyzw"))
        object.__setattr__(self, "covariance_mm2", frozen_array(self.covariance_mm2, (3, 3), "covariance_mm2"))
        if self.velocity_mm_s is not None:
            object.__setattr__(self, "velocity_mm_s", frozen_array(self.velocity_mm_s, (3,), "velocity_mm_s"))


@dataclass(frozen=True, slots=True, eq=False)
class BasePose:
    """Where the needle leaves its sleeve or the image: position_mm (3,), unit direction (3,) along the needle."""

    position_mm: Float
    direction: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", frozen_array(self.position_mm, (3,), "position_mm"))
        object.__setattr__(self, "direction", frozen_array(self.direction, (3,), "direction"))


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the shape explains the images; None where there is nothing to measure.

    reprojection_rms_px: of the observations across the projected axis, both views.
    epipolar_rms_px: of the tip, found in each view alone, against its epipolar line. Points along the needle are
    matched by these lines and lie on them by construction: they say nothing about the calibration and do not count.
    coverage: share of the shape's length that both cameras see.
    """

    reprojection_rms_px: float | None = None
    epipolar_rms_px: float | None = None
    coverage: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the stages saw on the way, for pictures and reports; no part of the wire.

    axis_residual_px (2, N): how far the axis seen in the left and in the right view lies beside the projected curve,
    at each point of the track's curve; NaN where it was not seen. Positive to the right of the way from base to tip,
    in an image whose rows run down; undistorted px.
    tip_px (2, 2): the tip as the left and the right view alone place it, raw px; None where it was not found.
    """

    left: Centerline | None = None
    right: Centerline | None = None
    correspondences: Correspondences | None = None
    axis_residual_px: Float | None = None
    tip_px: Float | None = None

    def __post_init__(self) -> None:
        if self.axis_residual_px is not None:
            residual = frozen_array(self.axis_residual_px, (2, None), "axis_residual_px")
            object.__setattr__(self, "axis_residual_px", residual)
        if self.tip_px is not None:
            object.__setattr__(self, "tip_px", frozen_array(self.tip_px, (2, 2), "tip_px"))


@dataclass(frozen=True, slots=True, eq=False)
class NeedleTrack:
    """The answer for one stereo pair, also when it is `invalid` (then curve, tip and base are None).

    since_detection counts the pairs that were tracked from the one before since the whole images were last searched;
    doubts are those of the reasons that only such a search can find, or lift. searched_sequence: of the pair whose
    whole images were searched and from what was found there this track goes on: its own, or one a little before it;
    None where the track before was followed alone.

    Raises ValueError where status and content contradict each other: an `ok` track has a curve and
    a tip and no reasons; a `degraded` one has a curve and reasons; an `invalid` one has no shape.
    """

    captured_at_ns: int
    status: Status
    reasons: tuple[Reason, ...]
    curve: NeedleCurve | None = None
    tip: TipPose | None = None
    base: BasePose | None = None
    diameter_mm: float | None = None
    appearance: Appearance | None = None
    since_detection: int = 0
    quality: Quality = Quality()
    timing_ms: Mapping[str, float] = field(default_factory=dict)
    evidence: Evidence = Evidence()
    doubts: tuple[Reason, ...] = ()
    searched_sequence: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "timing_ms", MappingProxyType(dict(self.timing_ms)))
        if self.status is Status.OK and (self.curve is None or self.tip is None or self.reasons):
            raise ValueError("an ok track has a curve, a tip and no reasons")
        if self.status is Status.DEGRADED and (self.curve is None or not self.reasons):
            raise ValueError("a degraded track has a curve and at least one reason")
        if self.status is Status.INVALID and (
            self.curve is not None or self.tip is not None or self.base is not None or not self.reasons
        ):
            raise ValueError("an invalid track has no shape and at least one reason")
