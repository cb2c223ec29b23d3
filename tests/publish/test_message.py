import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from needletrack.errors import PublishError
from needletrack.geometry.transform import orientation_along
from needletrack.publish.message import (
    Instant,
    RunContext,
    ServiceState,
    Source,
    StatusMessage,
    TrackMessage,
    WireRates,
)
from needletrack.publish.schema import example_messages, example_run, example_track
from needletrack.records import (
    BasePose,
    Clock,
    DropReason,
    Float,
    Frame,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    StereoPair,
    TipPose,
)

NOW = Instant(unix_ns=1_790_000_000_000_000_000, monotonic_ns=5_000_000_000)


def a_pair(captured_at_ns: int = 77, **fields: Any) -> StereoPair:
    image = np.zeros((2, 2), dtype=np.uint8)
    return StereoPair(Frame(image, captured_at_ns), Frame(image, captured_at_ns + 1500), sequence=4, **fields)


def an_invalid_track(captured_at_ns: int = 77) -> NeedleTrack:
    return NeedleTrack(captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))


def refuse_constant(text: str) -> None:
    raise AssertionError(f"{text} is no JSON")


millimetres = st.floats(-5e3, 5e3)
amounts = st.floats(0, 1e3)


@st.composite
def directions(draw: st.DrawFn) -> Float:
    vector = draw(arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1))
    return np.asarray(vector / np.linalg.norm(vector))


@st.composite
def tracks(draw: st.DrawFn) -> NeedleTrack:
    status = draw(st.sampled_from(Status))
    reasons = tuple(draw(st.sets(st.sampled_from(Reason), min_size=1)))
    timing_ms = draw(st.dictionaries(st.sampled_from(["segment", "match", "fit"]), amounts))
    quality = Quality(draw(st.none() | amounts), draw(st.none() | amounts), draw(st.none() | st.floats(0, 1)))
    if status is Status.INVALID:
        return NeedleTrack(77, status, reasons, quality=quality, timing_ms=timing_ms)
    n = draw(st.integers(2, 12))
    curve = NeedleCurve(
        points_mm=draw(arrays(np.float64, (n, 3), elements=millimetres)),
        sigma_mm=draw(arrays(np.float64, n, elements=amounts)),
        seen=draw(arrays(np.int64, n, elements=st.integers(0, 2))),
        curvature_per_mm=draw(arrays(np.float64, n, elements=st.floats(-1, 1))),
        length_mm=draw(amounts),
    )
    direction = draw(directions())
    root = draw(arrays(np.float64, (3, 3), elements=st.floats(-2, 2)))
    tip = TipPose(
        position_mm=curve.points_mm[-1],
        direction=direction,
        orientation_xyzw=orientation_along(direction),
        covariance_mm2=root @ root.T,
        velocity_mm_s=draw(st.none() | arrays(np.float64, 3, elements=millimetres)),
        seen=draw(st.integers(0, 2)),
    )
    base = draw(st.none() | st.just(BasePose(curve.points_mm[0], direction)))
    if status is Status.OK:
        return NeedleTrack(77, status, (), curve, tip, base, quality=quality, timing_ms=timing_ms)
    with_tip = draw(st.booleans())
    return NeedleTrack(
        77, status, reasons, curve, tip if with_tip else None, base, quality=quality, timing_ms=timing_ms
    )


@given(track=tracks(), dropped=st.dictionaries(st.sampled_from(DropReason), st.integers(0, 9)))
def test_a_message_survives_the_wire(track: NeedleTrack, dropped: dict[DropReason, int]) -> None:
    message = TrackMessage.from_track(track, a_pair(), example_run(), dropped=dropped, published=NOW)
    payload = message.to_json()
    assert TrackMessage.from_json(payload) == message
    assert b"\n" not in payload
    plain = json.loads(payload, parse_constant=refuse_constant)
    assert plain["status"] == track.status
    assert plain["reasons"] == list(track.reasons)
    assert plain["dropped"] == {reason: count for reason, count in dropped.items() if count}
    if track.curve is None:
        assert all(plain[field] is None for field in ("centerline_mm", "sigma_mm", "seen", "length_mm", "tip"))
        return
    np.testing.assert_allclose(plain["centerline_mm"], track.curve.points_mm, rtol=0, atol=0.51e-6)
    np.testing.assert_allclose(plain["sigma_mm"], track.curve.sigma_mm, rtol=0, atol=0.51e-6)
    np.testing.assert_allclose(plain["curvature_per_mm"], track.curve.curvature_per_mm, rtol=0, atol=0.51e-9)
    assert plain["seen"] == track.curve.seen.tolist()
    if track.tip is not None:
        np.testing.assert_allclose(plain["tip"]["covariance_mm2"], track.tip.covariance_mm2, rtol=0, atol=1e-12)
        np.testing.assert_allclose(plain["tip"]["direction"], track.tip.direction, rtol=0, atol=1e-9)


def test_the_run_and_the_pair_are_named() -> None:
    run = RunContext("lab", Source.REPLAY, config_digest="c", rig_digest="r")
    message = TrackMessage.from_track(an_invalid_track(), a_pair(), run, dropped={}, published=NOW)
    assert (message.rig, message.frame_id, message.source) == ("lab", "lab_left", Source.REPLAY)
    assert (message.config_digest, message.rig_digest, message.run_id) == ("c", "r", run.run_id)
    assert (message.sequence, message.captured_at_ns, message.quality.pair_skew_us) == (4, 77, 1.5)
    assert message.published_at_ns == NOW.unix_ns


def test_each_run_has_an_id_of_its_own() -> None:
    ids = {RunContext("lab", Source.LIVE, "c", "r").run_id for _ in range(2)}
    assert len(ids) == 2


@pytest.mark.parametrize(
    ("pair", "unix_ns", "latency_ms"),
    [
        (a_pair(NOW.unix_ns - 8_000_000, clock=Clock.REALTIME), NOW.unix_ns - 8_000_000, 8.0),
        (a_pair(NOW.monotonic_ns - 8_000_000, clock=Clock.MONOTONIC), NOW.unix_ns - 8_000_000, 8.0),
        (a_pair(77, clock=Clock.RECORDED, released_at_ns=NOW.monotonic_ns - 3_000_000), None, 3.0),
        (a_pair(77, clock=Clock.RECORDED), None, None),
    ],
    ids=["realtime", "monotonic", "paced replay", "unpaced replay"],
)
def test_unix_time_and_latency_follow_from_the_clock(
    pair: StereoPair, unix_ns: int | None, latency_ms: float | None
) -> None:
    track = an_invalid_track(pair.captured_at_ns)
    message = TrackMessage.from_track(track, pair, example_run(), dropped={}, published=NOW)
    assert message.captured_at_ns == pair.captured_at_ns
    assert message.captured_at_unix_ns == unix_ns
    assert message.latency_ms == latency_ms


def test_a_deterministic_run_has_the_same_bytes_each_time() -> None:
    track, _ = example_track()
    payloads = set()
    for number in range(2):
        run = RunContext("lab", Source.REPLAY, "c", "r", deterministic=True)
        timed = NeedleTrack(77, track.status, (), track.curve, track.tip, timing_ms={"fit": 1.0 + number})
        pair = a_pair(released_at_ns=number)
        published = Instant(unix_ns=NOW.unix_ns + number, monotonic_ns=NOW.monotonic_ns + number)
        message = TrackMessage.from_track(timed, pair, run, dropped={}, published=published)
        payloads.add(message.to_json())
    assert len(payloads) == 1
    plain = json.loads(payloads.pop())
    assert [plain[field] for field in ("run_id", "published_at_ns", "timing_ms", "latency_ms")] == [None] * 4


def test_the_order_of_the_drop_counts_does_not_matter() -> None:
    counts = {DropReason.WRONG_SIZE: 1, DropReason.OVERWRITTEN: 2}
    messages = [
        TrackMessage.from_track(an_invalid_track(), a_pair(), example_run(), dropped=dropped, published=NOW).to_json()
        for dropped in (counts, dict(reversed(counts.items())))
    ]
    assert messages[0] == messages[1]


def test_no_minus_zero_is_sent() -> None:
    track, pair = example_track()
    assert track.curve is not None
    points_mm = track.curve.points_mm * [1, 1, -0.0]
    curve = NeedleCurve(points_mm, track.curve.sigma_mm, track.curve.seen, track.curve.curvature_per_mm, 50.0)
    mirrored = NeedleTrack(pair.captured_at_ns, Status.OK, (), curve, track.tip)
    message = TrackMessage.from_track(mirrored, pair, example_run(), dropped={}, published=NOW)
    assert b"-0.0," not in message.to_json()
    assert b"-0.0]" not in message.to_json()


def test_a_track_of_another_pair_is_refused() -> None:
    with pytest.raises(ValueError, match="not of pair 78 ns"):
        TrackMessage.from_track(an_invalid_track(77), a_pair(78), example_run(), dropped={}, published=NOW)


def test_a_value_that_is_not_finite_never_reaches_the_wire() -> None:
    track, pair = example_track()
    assert track.curve is not None
    sigma_mm = track.curve.sigma_mm.copy()
    sigma_mm[2] = math.nan
    curve = NeedleCurve(track.curve.points_mm, sigma_mm, track.curve.seen, track.curve.curvature_per_mm, 50.0)
    broken = NeedleTrack(pair.captured_at_ns, Status.OK, (), curve, track.tip)
    with pytest.raises(ValidationError, match=r"sigma_mm\.2"):
        TrackMessage.from_track(broken, pair, example_run(), dropped={}, published=NOW)


@pytest.mark.parametrize("rig", ["", "a/b", "a*", "$lab", "lab#1", "lab?", "my lab", "@lab"])
def test_a_rig_name_that_is_no_key_is_refused(rig: str) -> None:
    with pytest.raises(PublishError, match="rig name"):
        RunContext(rig, Source.LIVE, "c", "r")


def changed(**fields: Any) -> str:
    """The example message with other fields; `tip__seen` is the field `seen` of `tip`."""
    plain = json.loads(example_messages()[0].to_json())
    for name, value in fields.items():
        *path, last = name.split("__")
        part = plain
        for step in path:
            part = part[step]
        if value is ...:
            del part[last]
        else:
            part[last] = value
    return json.dumps(plain)


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        ("", "message: Invalid JSON"),
        (changed()[:-20], "message: Invalid JSON"),
        ("[]", "message: Input should be an object"),
        (changed(version=2), "version 2, this reader knows 1"),
        (changed(status="splendid"), "status: Input should be 'ok', 'degraded' or 'invalid'"),
        (changed(status=...), "status: Field required"),
        (changed(length_mm="50"), "length_mm: Input should be a valid number"),
        (changed(length_mm=math.nan), "length_mm: Input should be a finite number"),
        (changed(tip__position_mm=[1, 2, math.inf]), "tip.position_mm.2: Input should be a finite number"),
        (changed(tip__position_mm=[1, 2]), "tip.position_mm.2: Field required"),
        (changed(tip__direction=[1, 1, 0]), "direction is not of unit length"),
        (changed(tip__orientation_xyzw=[0, 0, 0, 0]), "orientation_xyzw is not of unit length"),
        (changed(tip__covariance_mm2=[[1, 0, 0], [0, -1, 0], [0, 0, 1]]), "negative variance"),
        (changed(sequence=-1), "sequence: Input should be greater than or equal to 0"),
        (changed(sigma_mm=[0.1, 0.1]), "one per point"),
        (changed(sigma_mm=None), "one per point"),
        (changed(sigma_mm=[-0.1] * 5), "sigma_mm.0: Input should be greater than or equal to 0"),
        (changed(seen=[3] * 5), "seen.0: Input should be less than or equal to 2"),
        (changed(centerline_mm=None), "without centerline_mm there is no shape"),
        (changed(centerline_mm=[]), "fewer than 2 points"),
        (changed(tip=None), "an ok track has a shape, a tip and no reasons"),
        (changed(reasons=["jump"]), "an ok track has a shape, a tip and no reasons"),
        (changed(status="degraded"), "a degraded track has a shape and at least one reason"),
        (changed(status="invalid", reasons=["jump"]), "an invalid track has no shape"),
    ],
)
def test_a_broken_message_is_refused_with_the_reason(payload: str, said: str) -> None:
    with pytest.raises(PublishError) as refused:
        TrackMessage.from_json(payload)
    assert said in str(refused.value)
    assert "needletrack.track.v1" in str(refused.value)


def test_an_old_reader_takes_what_a_newer_producer_adds() -> None:
    payload = changed(
        status="degraded",
        reasons=["bent_by_magic"],
        dropped={"eaten_by_the_dog": 3},
        colour="blue",
        tip__temperature_c=36.6,
        timing_ms={"think": 0.5},
    )
    message = TrackMessage.from_json(payload)
    assert message.reasons == ("bent_by_magic",)
    assert message.dropped == {"eaten_by_the_dog": 3}


def test_a_status_message_survives_the_wire() -> None:
    for run in (example_run(), RunContext("lab", Source.REPLAY, "c", "r", deterministic=True)):
        message = StatusMessage.from_run(
            run,
            state=ServiceState.STOPPING,
            heartbeat_s=0.5,
            published_at_ns=NOW.unix_ns,
            uptime_s=12.5,
            rates=WireRates(pairs_per_s=59.9, tracks_per_s={"ok": 59.9}),
            dropped={DropReason.OVERWRITTEN: 1, DropReason.WRONG_SIZE: 0},
            counters={"pairs": 3},
            last_error="camera left: unplugged",
        )
        assert StatusMessage.from_json(message.to_json()) == message
        assert message.dropped == {"overwritten": 1}
        assert (message.published_at_ns is None) == run.deterministic
        assert (message.uptime_s is None) == run.deterministic


def test_a_broken_status_message_is_refused_with_the_reason() -> None:
    plain = json.loads(example_messages()[1].to_json()) | {"heartbeat_s": 0, "version": 1}
    with pytest.raises(PublishError, match=r"needletrack.status.v1 message: heartbeat_s: .* greater than 0"):
        StatusMessage.from_json(json.dumps(plain))
