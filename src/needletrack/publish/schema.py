"""Writes what docs/ says about the wire from the models: `python -m needletrack.publish.schema docs/wire`.

Into the folder: a JSON Schema and an example of each message. Into the page beside it (docs/wire.md):
the tables between the markers `<!-- generated: NAME -->` and `<!-- end -->`.
"""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from needletrack.capture.live import CameraState
from needletrack.capture.pairing import Trigger
from needletrack.errors import PublishError
from needletrack.geometry.transform import orientation_along
from needletrack.publish.clock import ClockMessage
from needletrack.publish.control import (
    CONTROL_CODE_MEANING,
    ControlReply,
    NeedleReply,
    NeedleRequest,
    RedetectReply,
    SnapshotReply,
    StartRecordingReply,
    StopRecordingReply,
)
from needletrack.publish.message import (
    Instant,
    RunContext,
    ServiceState,
    Source,
    StatusMessage,
    TrackMessage,
    WireBase,
    WireCalibration,
    WireCamera,
    WirePart,
    WireQuality,
    WireRates,
    WireRecording,
    WireSkew,
    WireTip,
)
from needletrack.records import (
    REASON_MEANING,
    BasePose,
    Clock,
    DropReason,
    Frame,
    NeedleCurve,
    NeedleTrack,
    Quality,
    StampPlace,
    Status,
    StereoPair,
    TipPose,
)

TABLES: dict[str, type[WirePart]] = {
    "track fields": TrackMessage,
    "tip fields": WireTip,
    "base fields": WireBase,
    "quality fields": WireQuality,
    "status fields": StatusMessage,
    "calibration fields": WireCalibration,
    "rates fields": WireRates,
    "camera fields": WireCamera,
    "skew fields": WireSkew,
    "recording fields": WireRecording,
    "clock fields": ClockMessage,
    "control request": NeedleRequest,
    "control answer": ControlReply,
}
# What each answer has beside what all of them have.
ANSWERS: dict[str, type[ControlReply]] = {
    "start recording answer": StartRecordingReply,
    "stop recording answer": StopRecordingReply,
    "snapshot answer": SnapshotReply,
    "redetect answer": RedetectReply,
    "needle answer": NeedleReply,
}
_GENERATED = re.compile(r"(?<=<!-- generated: )([a-z ]+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)

EXAMPLE_UNIX_NS = 1_780_000_000_000_000_000


def example_track(points: int = 5) -> tuple[NeedleTrack, StereoPair]:
    """An ok track of a needle bent to a circle of 200 mm radius, 50 mm long, and its pair of small images."""
    radius_mm, length_mm = 200.0, 50.0
    angle = np.linspace(0.0, length_mm / radius_mm, points)
    curve_mm = np.column_stack(
        [radius_mm * np.sin(angle) - 20, radius_mm * (1 - np.cos(angle)) + 3, np.full(points, 250.0)]
    )
    tangent = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(points)])
    image = np.zeros((2, 2), dtype=np.uint8)
    pair = StereoPair(
        left=Frame(image, EXAMPLE_UNIX_NS),
        right=Frame(image, EXAMPLE_UNIX_NS + 12_000),
        sequence=1207,
        clock=Clock.REALTIME,
        exposure_ns=4_000_000,
        stamp_at=StampPlace.START_OF_EXPOSURE,
    )
    track = NeedleTrack(
        captured_at_ns=pair.captured_at_ns,
        status=Status.OK,
        reasons=(),
        curve=NeedleCurve(
            points_mm=curve_mm,
            sigma_mm=np.linspace(0.02, 0.05, points),
            seen=np.full(points, 2),
            curvature_per_mm=np.full(points, 1 / radius_mm),
            length_mm=length_mm,
        ),
        tip=TipPose(
            position_mm=curve_mm[-1],
            direction=tangent[-1],
            orientation_xyzw=orientation_along(tangent[-1]),
            covariance_mm2=np.diag([0.0004, 0.0004, 0.0025]),
            velocity_mm_s=np.array([4.8, 1.2, 0.0]),
            seen=2,
        ),
        base=BasePose(position_mm=curve_mm[0], direction=tangent[0]),
        diameter_mm=0.9,
        quality=Quality(reprojection_rms_px=0.18, epipolar_rms_px=0.21, coverage=0.98),
        timing_ms={"segment": 1.2, "match": 0.3, "fit": 0.9},
    )
    return track, pair


def example_run() -> RunContext:
    """The run that the examples belong to."""
    return RunContext(
        rig="lab",
        source=Source.LIVE,
        config_digest="0f2b1c66a9d3",
        rig_digest="7c5e90d1b4a2",
        run_id="4f1d3c2b5a69788796a5b4c3d2e1f000",
    )


def example_messages() -> tuple[TrackMessage, StatusMessage]:
    """The two examples of docs/wire/."""
    track, pair = example_track()
    dropped = {DropReason.OVERWRITTEN: 3}
    published = Instant(unix_ns=EXAMPLE_UNIX_NS + 7_250_000, monotonic_ns=0)
    message = TrackMessage.from_track(track, pair, example_run(), dropped=dropped, published=published)
    status = StatusMessage.from_run(
        example_run(),
        state=ServiceState.RUNNING,
        heartbeat_s=0.5,
        published_at_ns=EXAMPLE_UNIX_NS + 9_000_000,
        uptime_s=20.1,
        last_sequence=1207,
        calibration=WireCalibration(
            calibrated_at="2026-05-01T12:00:00Z", age_days=27.9, reprojection_rms_px=0.11, warning=None
        ),
        rates=WireRates(pairs_per_s=60.0, tracks_per_s={"ok": 59.4, "degraded": 0.4, "invalid": 0.2}),
        dropped=dropped,
        counters={"control_done": 1, "control_failed": 0, "control_refused": 0, "tracks_ok": 1196},
        cameras={side: _example_camera(number) for number, side in enumerate(("left", "right"))},
        skew=WireSkew(offset_us=12.0, spread_us=9.0, drift_ppm=0.1, drift_sigma_ppm=0.2, looks=Trigger.HARDWARE.value),
        recording=WireRecording(
            file="/data/lab-20260528T202640-0.mcap", pairs=1208, dropped=0, megabytes=1913.4, error=None
        ),
        needle="default",
    )
    return message, status


def _example_camera(number: int) -> WireCamera:
    return WireCamera(
        state=CameraState.STREAMING.value,
        node=f"/dev/video{2 * number}",
        frames=1211,
        lost_by_driver=0,
        buffer_errors=0,
        queue_errors=0,
        stalls=0,
        restarts=0,
        rate_hz=60.0,
        exposure_us=4000.0,
        stamp_at=StampPlace.START_OF_EXPOSURE,
    )


def documents(page: str) -> Iterator[tuple[str, str]]:
    """(name, text) of every generated file of the folder, and ("", text) of the page with fresh tables."""
    track, status = example_messages()
    examples: dict[str, TrackMessage | StatusMessage] = {"track": track, "status": status}
    for name, example in examples.items():
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **type(example).model_json_schema(mode="serialization"),
        }
        yield f"{name}.v1.schema.json", json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        yield f"{name}.v1.example.json", json.dumps(json.loads(example.to_json()), indent=2) + "\n"
    yield "", _GENERATED.sub(lambda match: f"{match[1]}{match[2]}{_table(match[1])}\n", page)


def write(folder: Path) -> None:
    """Bring the folder, and the page of the same name beside it, up to the models.

    Raises PublishError where there is no such page.
    """
    page = folder.with_suffix(".md")
    if not page.is_file():
        raise PublishError(f"there is no {page}: name the folder beside the page, docs/wire")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in documents(page.read_text(encoding="utf-8")):
        (folder / name if name else page).write_text(text, encoding="utf-8")


def _table(name: str) -> str:
    if name == "reasons":
        rows = [f"| `{reason.value}` | {meaning} |" for reason, meaning in REASON_MEANING.items()]
        return "\n".join(["| code | meaning |", "|---|---|", *rows])
    if name == "control codes":
        rows = [f"| `{code.value}` | {meaning} |" for code, meaning in CONTROL_CODE_MEANING.items()]
        return "\n".join(["| code | meaning |", "|---|---|", *rows])
    model = ANSWERS[name] if name in ANSWERS else TABLES[name]
    schema = model.model_json_schema(mode="serialization")
    rows = [
        f"| `{field}` | {_type_name(part, schema)} | {part.get('description', '')} |"
        for field, part in schema["properties"].items()
        if name not in ANSWERS or field not in ControlReply.model_fields
    ]
    return "\n".join(["| field | type | meaning |", "|---|---|---|", *rows])


def _type_name(part: dict[str, Any], schema: dict[str, Any]) -> str:
    """How a person would write a JSON Schema type."""
    if "anyOf" in part:
        return " or ".join(_type_name(option, schema) for option in part["anyOf"])
    if "const" in part:
        return json.dumps(part["const"])
    if "$ref" in part:
        name = part["$ref"].rsplit("/", maxsplit=1)[-1]
        if "enum" in schema["$defs"][name]:
            return " or ".join(f"`{value}`" for value in schema["$defs"][name]["enum"])
        heading = name.removeprefix("Wire").lower()
        return f"[{heading}](#{heading})"
    if part["type"] == "array":
        if "prefixItems" in part:
            return f"[{', '.join(_type_name(item, schema) for item in part['prefixItems'])}]"
        return f"[{_type_name(part['items'], schema)}, …]"
    if part["type"] == "object":
        return f"{{string: {_type_name(part['additionalProperties'], schema)}, …}}"
    return str(part["type"])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m needletrack.publish.schema docs/wire")
    write(Path(sys.argv[1]))
