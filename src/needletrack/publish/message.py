"""The wire, version 1: the messages themselves. docs/wire.md is their contract, this model its definition.

Readers ignore fields that they do not know and accept reason codes, drop reasons and stage names that
they do not know, so that these may grow within version 1. Everything else is checked on both sides.
"""

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from needletrack.errors import PublishError
from needletrack.publish.keys import checked_chunk
from needletrack.records import (
    BasePose,
    Clock,
    DropReason,
    NeedleTrack,
    Quality,
    Reason,
    StampPlace,
    Status,
    StereoPair,
    TipPose,
)

WIRE_VERSION = 1
# A track of 200 points has 30 kB; what is larger is not read.
MOST_MESSAGE_BYTES = 4_000_000

# Rounding keeps the JSON short; each is finer than what can be measured by a factor of a thousand or more.
MM_DIGITS = 6
UNIT_DIGITS = 9
CURVATURE_DIGITS = 9
COVARIANCE_DIGITS = 12
QUALITY_DIGITS = 6
MS_DIGITS = 3

UNIT_TOLERANCE = 1e-3

Vector3 = tuple[float, float, float]
NotNegative = Annotated[float, Field(ge=0)]
Cameras = Annotated[int, Field(ge=0, le=2)]
# What other languages' readers can hold; a larger one is no stamp, and no float either.
_MOST = 2**63 - 1
Count = Annotated[int, Field(ge=0, le=_MOST)]
Stamp = Annotated[int, Field(ge=-_MOST - 1, le=_MOST)]


class Source(StrEnum):
    """Where the pairs came from."""

    LIVE = "live"
    REPLAY = "replay"


class ServiceState(StrEnum):
    """Where the daemon is in its life."""

    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"


@dataclass(frozen=True, slots=True)
class RunContext:
    """What all messages of one run share.

    frame_id: the frame of all positions, `<rig>_left` where none is given. deterministic: the fields
    that hold this run's times and its run_id stay null. Raises PublishError for a rig name that cannot
    be part of a Zenoh key.
    """

    rig: str
    source: Source
    config_digest: str
    rig_digest: str
    frame_id: str = ""
    run_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    deterministic: bool = False

    def __post_init__(self) -> None:
        checked_chunk(self.rig, "rig name")
        object.__setattr__(self, "source", Source(self.source))
        object.__setattr__(self, "frame_id", self.frame_id or f"{self.rig}_left")


@dataclass(frozen=True, slots=True)
class Instant:
    """One moment on both clocks of this host: Unix time and time.monotonic_ns's clock."""

    unix_ns: int
    monotonic_ns: int

    @classmethod
    def now(cls) -> Self:
        """This moment."""
        return cls(time.time_ns(), time.monotonic_ns())


class WirePart(BaseModel):
    """A part of a message: frozen, finite numbers only, unknown fields ignored."""

    # A field that came within version 1 has a default, for readers of an older daemon; every daemon sends it.
    model_config = ConfigDict(
        frozen=True, extra="ignore", allow_inf_nan=False, json_schema_serialization_defaults_required=True
    )


class WireTip(WirePart):
    """The free end of the needle."""

    position_mm: Vector3 = Field(description="the apex, on the axis, in `frame_id`")
    direction: Vector3 = Field(description="unit vector out of the tip, along the needle")
    orientation_xyzw: tuple[float, float, float, float] = Field(
        description="unit quaternion; +z along the needle; the roll about it is a convention"
    )
    covariance_mm2: tuple[Vector3, Vector3, Vector3] = Field(description="of position_mm, 3 rows of 3")
    velocity_mm_s: Vector3 | None = Field(description="null if unknown")
    seen: Cameras = Field(description="number of cameras that saw the tip")

    @classmethod
    def from_pose(cls, tip: TipPose) -> Self:
        """The wire's form of a tip pose."""
        return cls(
            position_mm=_rounded(tip.position_mm, MM_DIGITS),
            direction=_rounded(tip.direction, UNIT_DIGITS),
            orientation_xyzw=_rounded(tip.orientation_xyzw, UNIT_DIGITS),
            covariance_mm2=_rounded(tip.covariance_mm2, COVARIANCE_DIGITS),
            velocity_mm_s=None if tip.velocity_mm_s is None else _rounded(tip.velocity_mm_s, MM_DIGITS),
            seen=tip.seen,
        )

    @model_validator(mode="after")
    def _has_unit_vectors(self) -> Self:
        _check_unit(self.direction, "direction")
        _check_unit(self.orientation_xyzw, "orientation_xyzw")
        if min(self.covariance_mm2[i][i] for i in range(3)) < 0:
            raise ValueError("covariance_mm2 has a negative variance")
        return self


class WireBase(WirePart):
    """Where the needle leaves its sleeve or the image."""

    position_mm: Vector3 = Field(description="on the axis, in `frame_id`")
    direction: Vector3 = Field(description="unit vector along the needle, towards the tip")

    @classmethod
    def from_pose(cls, base: BasePose) -> Self:
        """The wire's form of a base pose."""
        return cls(position_mm=_rounded(base.position_mm, MM_DIGITS), direction=_rounded(base.direction, UNIT_DIGITS))

    @model_validator(mode="after")
    def _has_unit_vectors(self) -> Self:
        _check_unit(self.direction, "direction")
        return self


class WireQuality(WirePart):
    """How well the shape explains the images; null where there is nothing to measure."""

    reprojection_rms_px: NotNegative | None = Field(
        description="of the observations across the projected axis, both views"
    )
    epipolar_rms_px: NotNegative | None = Field(
        description="of the tip, found in each view alone, against its epipolar line"
    )
    coverage: Annotated[float, Field(ge=0, le=1)] | None = Field(
        description="share of the shape's length that both cameras see"
    )
    pair_skew_us: float = Field(description="right stamp minus left stamp, microseconds")

    @classmethod
    def from_quality(cls, quality: Quality, pair: StereoPair) -> Self:
        """The wire's form of a track's quality and its pair's skew."""
        return cls(
            reprojection_rms_px=_rounded_or_none(quality.reprojection_rms_px, QUALITY_DIGITS),
            epipolar_rms_px=_rounded_or_none(quality.epipolar_rms_px, QUALITY_DIGITS),
            coverage=_rounded_or_none(quality.coverage, QUALITY_DIGITS),
            pair_skew_us=pair.skew_us,
        )


class TrackMessage(WirePart):
    """One stereo pair's answer, on key `<prefix>/<rig>/track`; sent for every pair, also when it is invalid.

    Shapes run base -> tip, in millimetres, in the frame `frame_id` (OpenCV axes: x right, y down, z forward).
    Raises ValidationError where status and content contradict each other.
    """

    version: Literal[1] = Field(description="an incompatible change becomes version 2 on a key of its own")
    rig: str = Field(description="name of the rig, as in the key")
    frame_id: str = Field(
        description="frame of all positions: `<rig>_left`, the left camera, unless registered to a robot"
    )
    run_id: str | None = Field(description="one per run of the daemon; null in a deterministic replay")
    source: Source = Field(description="cameras, or a recording")
    config_digest: str = Field(description="equal digests mean equal configurations")
    rig_digest: str = Field(description="equal digests mean equal calibrations")
    sequence: Count = Field(
        description="number of the stereo pair in its run; a gap is a pair dropped or a sample lost"
    )
    captured_at_ns: Stamp = Field(description="the left camera's stamp, unchanged, on `clock`")
    clock: Clock = Field(description="recorded: whatever the recording's clock was")
    captured_at_unix_ns: Stamp | None = Field(description="the same instant in Unix time; null if unknown")
    exposure_ns: Count | None = Field(description="length of the exposure; null if unknown")
    stamp_at: StampPlace | None = Field(
        description="where in the exposure the stamp was taken, by the driver; null if unknown"
    )
    published_at_ns: Stamp | None = Field(
        description="Unix time (CLOCK_REALTIME of the daemon's host); null in a deterministic replay"
    )
    status: Status = Field(description="only with ok may a controller act on it")
    reasons: tuple[str, ...] = Field(
        description="codes of docs/wire.md; empty when ok; the list may grow within version 1",
        examples=[[reason.value for reason in Reason]],
    )
    centerline_mm: tuple[Vector3, ...] | None = Field(description="base -> tip, evenly spaced along the arc")
    sigma_mm: tuple[NotNegative, ...] | None = Field(
        description="per point: square root of the larger eigenvalue of the covariance across the tangent; "
        "grows where one camera or none sees it; includes the calibration's share where that is known"
    )
    seen: tuple[Cameras, ...] | None = Field(description="per point: number of cameras that saw it")
    curvature_per_mm: tuple[float, ...] | None = Field(description="per point: 1 / radius of curvature")
    length_mm: NotNegative | None = Field(description="along the arc, base to tip")
    tip: WireTip | None = Field(description="the free end; never null when ok")
    base: WireBase | None = Field(description="where the needle leaves its sleeve or the image; null if unknown")
    quality: WireQuality = Field(description="how well the shape explains the images")
    searched_sequence: Count | None = Field(
        default=None,
        description="of the pair whose whole images were searched and from whose result this track goes on: its own, "
        "or one a little before it; null where it follows the track before alone",
    )
    timing_ms: Mapping[str, float] | None = Field(
        description="part of the latency, or stage of tracking: milliseconds (docs/latency.md); null in a "
        "deterministic replay"
    )
    latency_ms: float | None = Field(
        description="exposure (live) or release (replay) to publish; null if unknown or deterministic"
    )
    dropped: Mapping[str, Count] = Field(
        description="reason: frames or pairs dropped since the run began; zeros left out"
    )

    @classmethod
    def from_track(
        cls,
        track: NeedleTrack,
        pair: StereoPair,
        run: RunContext,
        *,
        dropped: Mapping[DropReason, int],
        published: Instant | None,
        parts_ms: Mapping[str, float] | None = None,
    ) -> Self:
        """The message for a track of a pair, published now; parts_ms: of the latency, beside the stages of tracking.

        dropped: the counts at the moment at which the pair was taken up, so that a gap in the sequence
        and its count stand in the same message. published: without effect in a deterministic run, which
        knows no time of its own. Raises ValueError for a track of another pair.
        """
        if track.captured_at_ns != pair.captured_at_ns:
            raise ValueError(f"track of {track.captured_at_ns} ns is not of pair {pair.captured_at_ns} ns")
        if run.deterministic:
            published = None
        curve = track.curve
        return cls(
            version=WIRE_VERSION,
            rig=run.rig,
            frame_id=run.frame_id,
            run_id=None if run.deterministic else run.run_id,
            source=run.source,
            config_digest=run.config_digest,
            rig_digest=run.rig_digest,
            sequence=pair.sequence,
            captured_at_ns=pair.captured_at_ns,
            clock=pair.clock,
            captured_at_unix_ns=_captured_at_unix_ns(pair, published),
            exposure_ns=pair.exposure_ns,
            stamp_at=pair.stamp_at,
            published_at_ns=None if published is None else published.unix_ns,
            status=track.status,
            reasons=tuple(reason.value for reason in track.reasons),
            centerline_mm=None if curve is None else _rounded(curve.points_mm, MM_DIGITS),
            sigma_mm=None if curve is None else _rounded(curve.sigma_mm, MM_DIGITS),
            seen=None if curve is None else curve.seen.tolist(),
            curvature_per_mm=None if curve is None else _rounded(curve.curvature_per_mm, CURVATURE_DIGITS),
            length_mm=None if curve is None else round(curve.length_mm, MM_DIGITS),
            tip=None if track.tip is None else WireTip.from_pose(track.tip),
            base=None if track.base is None else WireBase.from_pose(track.base),
            quality=WireQuality.from_quality(track.quality, pair),
            searched_sequence=track.searched_sequence,
            timing_ms=None
            if run.deterministic
            else {stage: round(ms, MS_DIGITS) for stage, ms in {**(parts_ms or {}), **track.timing_ms}.items()},
            latency_ms=_rounded_or_none(_latency_ms(pair, published), MS_DIGITS),
            dropped=_counted(dropped),
        )

    @classmethod
    def from_json(cls, data: bytes | str) -> "TrackMessage":
        """The message in a sample's payload; raises PublishError that says what is wrong with it."""
        return _decoded(TrackMessage, data, "track")

    def to_json(self) -> bytes:
        """UTF-8 JSON on one line; the same message gives the same bytes."""
        return _TRACK.dump_json(self)

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        shape = (self.sigma_mm, self.seen, self.curvature_per_mm)
        if self.centerline_mm is None:
            if any(part is not None for part in (*shape, self.length_mm, self.tip, self.base)):
                raise ValueError("without centerline_mm there is no shape, length, tip or base")
        elif len(self.centerline_mm) < 2:
            raise ValueError("centerline_mm has fewer than 2 points")
        elif self.length_mm is None or any(part is None or len(part) != len(self.centerline_mm) for part in shape):
            raise ValueError("sigma_mm, seen, curvature_per_mm and length_mm must go with centerline_mm, one per point")
        if self.status is Status.OK and (self.centerline_mm is None or self.tip is None or self.reasons):
            raise ValueError("an ok track has a shape, a tip and no reasons")
        if self.status is Status.DEGRADED and (self.centerline_mm is None or not self.reasons):
            raise ValueError("a degraded track has a shape and at least one reason")
        if self.status is Status.INVALID and (self.centerline_mm is not None or not self.reasons):
            raise ValueError("an invalid track has no shape and at least one reason")
        return self


class WireCalibration(WirePart):
    """How much the rig's calibration is to be believed; null where the rig file does not say."""

    calibrated_at: str | None = Field(description="ISO 8601 date or time, as in the rig file")
    age_days: float | None = Field(description="since then")
    reprojection_rms_px: NotNegative | None = Field(description="over all corners of the board views")
    warning: str | None = Field(description="a sentence where it is older than `rig.max_age_days` allows")


class WireRates(WirePart):
    """Per second, over the time since the last heartbeat."""

    pairs_per_s: NotNegative = Field(description="pairs that the source delivered")
    tracks_per_s: Mapping[str, NotNegative] = Field(description="status: tracks published")


class WireCamera(WirePart):
    """One camera; its counts are those since the daemon's start."""

    state: str = Field(description="absent, starting, streaming or stalled; the list may grow within version 1")
    node: str = Field(description="where it is now, e.g. /dev/video0")
    frames: Count = Field(description="frames that came, those with an error included")
    lost_by_driver: Count = Field(description="frames that the driver counted and did not deliver")
    buffer_errors: Count = Field(description="frames that were flagged as errors, short or undecodable")
    queue_errors: Count = Field(description="refusals of the driver to take a buffer back")
    stalls: Count = Field(description="times that nothing came for too long")
    restarts: Count = Field(description="times that it was started anew")
    rate_hz: NotNegative | None = Field(description="of the last frames, by their stamps; null if unknown")
    exposure_us: NotNegative | None = Field(description="null if unknown, or automatic")
    stamp_at: StampPlace | None = Field(description="as in the track message")


class WireSkew(WirePart):
    """Right stamps minus the nearest left ones over the last minute, paired or not; null where too little was seen."""

    offset_us: float | None = Field(description="the median")
    spread_us: NotNegative | None = Field(description="half the width that holds nine of ten, without the drift")
    drift_ppm: float | None = Field(description="how much faster the right stamps run, microseconds a second")
    drift_sigma_ppm: NotNegative | None = Field(description="standard deviation of the drift")
    looks: str = Field(description="hardware_triggered, free_running or unknown")


class WireRecording(WirePart):
    """The recording that runs beside tracking."""

    file: str = Field(description="being written now")
    pairs: Count = Field(description="recorded since the start")
    dropped: Count = Field(description="tracked or not, but not recorded: the disk was too slow, full or gone")
    megabytes: NotNegative = Field(description="written since the start")
    error: str | None = Field(description="why it pauses; null while it runs")


class StatusMessage(WirePart):
    """The daemon's heartbeat, on key `<prefix>/<rig>/status`, which answers queries with the newest one."""

    version: Literal[1] = Field(description="this and the next six as in the track message")
    rig: str
    frame_id: str
    run_id: str | None
    source: Source = Field(description="cameras, or a recording")
    config_digest: str = Field(description="equal digests mean equal configurations")
    rig_digest: str = Field(description="equal digests mean equal calibrations")
    published_at_ns: Stamp | None = Field(description="Unix time of the heartbeat; null in a deterministic replay")
    state: ServiceState = Field(description="stopping: a clean stop, the token goes next")
    uptime_s: NotNegative | None = Field(description="null in a deterministic replay")
    heartbeat_s: Annotated[float, Field(gt=0)] = Field(
        description="a heartbeat is sent this often; three missed ones mean trouble"
    )
    last_sequence: Count | None = Field(description="of the newest track published; null before the first")
    calibration: WireCalibration = Field(description="how much the calibration is to be believed")
    rates: WireRates = Field(description="since the last heartbeat")
    dropped: Mapping[str, Count] = Field(description="as in the track message")
    counters: Mapping[str, Count] = Field(description="whatever else the daemon counts since its start")
    last_error: str | None = Field(description="the newest error that the daemon survived; null if none")
    cameras: Mapping[str, WireCamera] | None = Field(description="left and right; null in a replay")
    skew: WireSkew | None = Field(description="what both cameras' stamps say of each other; null in a replay")
    recording: WireRecording | None = Field(description="null where nothing is recorded")
    needle: str | None = Field(
        None, description="type in use: `default` or one of `control.needles`; null in a replay, and where unknown"
    )

    @classmethod
    def from_run(
        cls,
        run: RunContext,
        *,
        state: ServiceState,
        heartbeat_s: float,
        published_at_ns: int | None = None,
        uptime_s: float | None = None,
        last_sequence: int | None = None,
        calibration: WireCalibration | None = None,
        rates: WireRates | None = None,
        dropped: Mapping[DropReason, int] | None = None,
        counters: Mapping[str, int] | None = None,
        last_error: str | None = None,
        cameras: Mapping[str, WireCamera] | None = None,
        skew: WireSkew | None = None,
        recording: WireRecording | None = None,
        needle: str | None = None,
    ) -> Self:
        """The heartbeat of a run; what is left out is null, zero or empty."""
        return cls(
            version=WIRE_VERSION,
            rig=run.rig,
            frame_id=run.frame_id,
            run_id=None if run.deterministic else run.run_id,
            source=run.source,
            config_digest=run.config_digest,
            rig_digest=run.rig_digest,
            published_at_ns=None if run.deterministic else published_at_ns,
            state=state,
            uptime_s=None if run.deterministic else _rounded_or_none(uptime_s, 3),
            heartbeat_s=heartbeat_s,
            last_sequence=last_sequence,
            calibration=calibration
            or WireCalibration(calibrated_at=None, age_days=None, reprojection_rms_px=None, warning=None),
            rates=rates or WireRates(pairs_per_s=0.0, tracks_per_s={}),
            dropped=_counted(dropped or {}),
            counters=dict(sorted((counters or {}).items())),
            last_error=last_error,
            cameras=cameras,
            skew=skew,
            recording=recording,
            needle=needle,
        )

    @classmethod
    def from_json(cls, data: bytes | str) -> "StatusMessage":
        """The heartbeat in a sample's payload; raises PublishError that says what is wrong with it."""
        return _decoded(StatusMessage, data, "status")

    def to_json(self) -> bytes:
        """UTF-8 JSON on one line."""
        return _STATUS.dump_json(self)


_Message = TypeVar("_Message", TrackMessage, StatusMessage)
_TRACK = TypeAdapter(TrackMessage)
_STATUS = TypeAdapter(StatusMessage)


def _decoded(model: type[_Message], data: bytes | str, name: str) -> _Message:
    if len(data) > MOST_MESSAGE_BYTES:
        raise PublishError(f"not a needletrack.{name}.v{WIRE_VERSION} message: it has {len(data)} bytes")
    try:
        # Strict: a number in a string is a broken producer, not a number.
        return model.model_validate_json(data, strict=True)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        what = f"not a needletrack.{name}.v{WIRE_VERSION} message"
        for problem in problems:
            if problem["loc"] == ("version",) and problem["type"] == "literal_error":
                raise PublishError(
                    f"{what}: it says version {problem['input']!r}, this reader knows {WIRE_VERSION}: "
                    "use a needletrack of the daemon's version"
                ) from error
        told = "; ".join(f"{'.'.join(map(str, p['loc'])) or 'message'}: {p['msg']}" for p in problems[:3])
        more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
        raise PublishError(f"{what}: {told}{more}") from error


def _captured_at_unix_ns(pair: StereoPair, now: Instant | None) -> int | None:
    match pair.clock:
        case Clock.REALTIME:
            return pair.captured_at_ns
        case Clock.MONOTONIC if now is not None:
            return now.unix_ns - (now.monotonic_ns - pair.captured_at_ns)
        case _:
            return None


def _latency_ms(pair: StereoPair, now: Instant | None) -> float | None:
    """From the exposure, or in a paced replay from the release; None for a recorded stamp."""
    if now is None:
        return None
    if pair.released_at_ns is not None:
        return (now.monotonic_ns - pair.released_at_ns) / 1e6
    match pair.clock:
        case Clock.REALTIME:
            return (now.unix_ns - pair.captured_at_ns) / 1e6
        case Clock.MONOTONIC:
            return (now.monotonic_ns - pair.captured_at_ns) / 1e6
        case _:
            return None


def _rounded(values: npt.NDArray[np.float64], digits: int) -> Any:
    # Adding zero turns -0.0 into 0.0.
    return (np.round(values, digits) + 0.0).tolist()


def _rounded_or_none(value: float | None, digits: int) -> float | None:
    return None if value is None else round(float(value), digits)


def _counted(dropped: Mapping[DropReason, int]) -> dict[str, int]:
    return {reason.value: count for reason, count in sorted(dropped.items()) if count}


def _check_unit(vector: tuple[float, ...], name: str) -> None:
    if abs(sum(v * v for v in vector) - 1) > 2 * UNIT_TOLERANCE:
        raise ValueError(f"{name} is not of unit length")
