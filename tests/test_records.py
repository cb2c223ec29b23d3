"""Records never change, and refuse what contradicts itself."""

from collections.abc import Callable
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from needletrack.records import (
    REASON_MEANING,
    BasePose,
    Centerline,
    Clock,
    Correspondences,
    Evidence,
    Float,
    Frame,
    NeedleCurve,
    NeedleTrack,
    Reason,
    Status,
    StereoPair,
    TipPose,
    frozen_array,
)


def curve(**changes: Any) -> NeedleCurve:
    values: dict[str, Any] = {
        "points_mm": np.column_stack([np.zeros(5), np.linspace(0, 40, 5), np.full(5, 250.0)]),
        "sigma_mm": np.full(5, 0.1),
        "seen": np.full(5, 2),
        "curvature_per_mm": np.zeros(5),
        "length_mm": 40.0,
    }
    return NeedleCurve(**values | changes)


def tip(**changes: Any) -> TipPose:
    values: dict[str, Any] = {
        "position_mm": np.array([0.0, 40.0, 250.0]),
        "direction": np.array([0.0, 1.0, 0.0]),
        "orientation_xyzw": np.array([0.0, 0.0, 0.0, 1.0]),
        "covariance_mm2": 0.01 * np.eye(3),
        "velocity_mm_s": None,
        "seen": 2,
    }
    return TipPose(**values | changes)


def base() -> BasePose:
    return BasePose(np.array([0.0, 0.0, 250.0]), np.array([0.0, 1.0, 0.0]))


def frame(stamp_ns: int) -> Frame:
    return Frame(np.zeros((4, 6), dtype=np.uint8), stamp_ns)


class TestFrozenArray:
    def test_the_caller_s_array_stays_the_caller_s(self) -> None:
        mine = np.zeros(3)
        frozen = frozen_array(mine, (3,), "mine")
        mine[0] = 7.0
        assert frozen[0] == 0.0
        assert mine.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            frozen[0] = 1.0

    def test_a_view_of_a_buffer_that_somebody_writes_is_copied(self) -> None:
        buffer = bytearray(8)
        for view in (
            np.frombuffer(buffer, dtype=np.uint8).reshape(2, 4),
            np.frombuffer(memoryview(buffer).toreadonly(), dtype=np.uint8).reshape(2, 4),
        ):
            buffer[0] = 0
            taken = Frame(view, 0)
            buffer[0] = 99
            assert taken.image[0, 0] == 0

    def test_a_read_only_view_of_an_array_that_somebody_writes_is_copied(self) -> None:
        whole = np.zeros((4, 3))
        view = whole[1:]
        view.flags.writeable = False
        frozen = frozen_array(view, (None, 3), "view")
        whole[2] = 5.0
        assert (frozen == 0).all()

    def test_what_is_frozen_already_is_shared(self) -> None:
        frozen = frozen_array([[1.0, 2.0], [3.0, 4.0]], (None, 2), "points")
        assert frozen_array(frozen, (2, 2), "points") is frozen
        assert np.shares_memory(frozen_array(frozen[::-1], (2, 2), "points"), frozen)
        image = np.frombuffer(b"abcdef", dtype=np.uint8).reshape(2, 3)
        assert np.shares_memory(Frame(image, 0).image, image)

    @pytest.mark.parametrize("shape", [(2,), (2, 3, 1), (3, 3), (None, 2)])
    def test_another_shape_is_refused(self, shape: tuple[int | None, ...]) -> None:
        with pytest.raises(ValueError, match=r"points has shape \(2, 3\)"):
            frozen_array(np.zeros((2, 3)), shape, "points")

    def test_whole_numbers_become_real_ones(self) -> None:
        assert frozen_array(np.arange(3), (3,), "x").dtype == np.float64
        assert frozen_array(np.arange(3, dtype=np.float32), (3,), "x").dtype == np.float64

    @pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.float32, np.float64])
    def test_an_image_of_more_than_eight_bits_is_refused_and_not_wrapped(self, dtype: type[np.generic]) -> None:
        with pytest.raises(ValueError, match="image is an array of"):
            Frame(np.full((2, 2), 300, dtype=dtype), 0)

    def test_seen_counts_are_whole_numbers(self) -> None:
        with pytest.raises(ValueError, match="seen is an array of float64"):
            curve(seen=np.full(5, 1.5))


class TestPairs:
    def test_the_left_stamp_names_the_pair(self) -> None:
        pair = StereoPair(frame(1_000_000_000), frame(1_000_050_000), sequence=3)
        assert pair.captured_at_ns == 1_000_000_000
        assert pair.skew_us == 50.0
        assert pair.clock is Clock.RECORDED
        assert StereoPair(frame(20_000), frame(0), 0).skew_us == -20.0

    @pytest.mark.parametrize("shape", [(4,), (4, 6, 3)])
    def test_an_image_has_rows_and_columns(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match="image has shape"):
            Frame(np.zeros(shape, dtype=np.uint8), 0)


def points(count: int, columns: int = 2) -> Float:
    return np.zeros((count, columns))


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: Centerline(points(4, 3), np.ones(4)), "points_px"),
        (lambda: Centerline(points(4), np.ones(3)), "width_px"),
        (lambda: Correspondences(points(4), points(3)), "right_undistorted_px"),
        (lambda: Correspondences(points(4, 3), points(4)), "left_undistorted_px"),
        (lambda: curve(points_mm=points(5)), "points_mm"),
        (lambda: curve(sigma_mm=np.ones(4)), "sigma_mm"),
        (lambda: curve(seen=np.full(4, 2)), "seen"),
        (lambda: curve(curvature_per_mm=np.zeros((5, 1))), "curvature_per_mm"),
        (lambda: curve(velocity_mm_s=np.zeros((4, 2))), "velocity_mm_s"),
        (lambda: tip(position_mm=np.zeros(2)), "position_mm"),
        (lambda: tip(direction=np.zeros(4)), "direction"),
        (lambda: tip(orientation_xyzw=np.zeros(3)), "orientation_xyzw"),
        (lambda: tip(covariance_mm2=np.zeros(3)), "covariance_mm2"),
        (lambda: tip(velocity_mm_s=np.zeros(2)), "velocity_mm_s"),
        (lambda: BasePose(np.zeros(2), np.zeros(3)), "position_mm"),
        (lambda: BasePose(np.zeros(3), np.zeros(2)), "direction"),
        (lambda: Evidence(axis_residual_px=points(4)), "axis_residual_px"),
    ],
)
def test_wrong_shapes_are_refused_by_name(build: Callable[[], object], complaint: str) -> None:
    with pytest.raises(ValueError, match=f"^{complaint} has shape"):
        build()


@pytest.mark.parametrize(
    ("record", "field"),
    [
        (frame(0), "image"),
        (curve(), "points_mm"),
        (curve(velocity_mm_s=np.ones((5, 3))), "velocity_mm_s"),
        (tip(velocity_mm_s=np.ones(3)), "velocity_mm_s"),
        (Evidence(axis_residual_px=np.zeros((2, 5))), "axis_residual_px"),
    ],
)
def test_neither_fields_nor_arrays_change(record: object, field: str) -> None:
    with pytest.raises(FrozenInstanceError):
        setattr(record, field, None)
    with pytest.raises(ValueError, match="read-only"):
        getattr(record, field)[0] = 1


def test_a_centerline_can_be_traced_from_the_other_end() -> None:
    line = Centerline(np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]), np.array([7.0, 8.0, 9.0]))
    turned = line.reversed()
    np.testing.assert_array_equal(turned.points_px, [[4.0, 5.0], [2.0, 3.0], [0.0, 1.0]])
    np.testing.assert_array_equal(turned.width_px, [9.0, 8.0, 7.0])


WEAK, GONE = (Reason.LOW_COVERAGE,), (Reason.NO_CANDIDATE,)


@pytest.mark.parametrize(
    ("status", "reasons", "content"),
    [
        (Status.OK, (), {"curve": curve(), "tip": tip(), "base": base()}),
        (Status.DEGRADED, WEAK, {"curve": curve()}),
        (Status.DEGRADED, WEAK, {"curve": curve(), "tip": tip()}),
        (Status.INVALID, GONE, {}),
    ],
)
def test_what_agrees_is_a_track(status: Status, reasons: tuple[Reason, ...], content: dict[str, Any]) -> None:
    track = NeedleTrack(5, status, reasons, **content)
    assert (track.status, track.reasons) == (status, reasons)


@pytest.mark.parametrize(
    ("status", "reasons", "content", "complaint"),
    [
        (Status.OK, (), {"curve": curve()}, "an ok track"),
        (Status.OK, (), {"tip": tip()}, "an ok track"),
        (Status.OK, WEAK, {"curve": curve(), "tip": tip()}, "an ok track"),
        (Status.DEGRADED, (), {"curve": curve(), "tip": tip()}, "a degraded track"),
        (Status.DEGRADED, WEAK, {}, "a degraded track"),
        (Status.INVALID, (), {}, "an invalid track"),
        (Status.INVALID, GONE, {"curve": curve()}, "an invalid track"),
        (Status.INVALID, GONE, {"tip": tip()}, "an invalid track"),
        (Status.INVALID, GONE, {"base": base()}, "an invalid track"),
    ],
)
def test_status_and_content_may_not_contradict_each_other(
    status: Status, reasons: tuple[Reason, ...], content: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ValueError, match=f"^{complaint}"):
        NeedleTrack(5, status, reasons, **content)


def test_the_times_of_a_track_do_not_change() -> None:
    timing_ms = {"segment": 1.0}
    track = NeedleTrack(5, Status.INVALID, GONE, timing_ms=timing_ms)
    timing_ms["segment"] = 2.0
    assert track.timing_ms == {"segment": 1.0}
    with pytest.raises(TypeError):
        track.timing_ms["segment"] = 3.0  # type: ignore[index]


def test_every_reason_has_its_sentence() -> None:
    assert set(REASON_MEANING) == set(Reason)
    assert all(sentence.endswith(".") for sentence in REASON_MEANING.values())
