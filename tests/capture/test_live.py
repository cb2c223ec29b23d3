"""Two cameras as a source of pairs, against a fake at the ioctl edge; time is the fake's."""

import errno
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import pytest
from tests.capture.fake_kernel import MONOTONIC, FakeCamera, FakeKernel

from needletrack.capture.live import CameraState, LiveSource
from needletrack.capture.pairing import Trigger
from needletrack.capture.settings import CamerasSettings
from needletrack.capture.v4l2_abi import Request
from needletrack.errors import CaptureError
from needletrack.records import Clock, DropReason, StampPlace, StereoPair

PERIOD_US = 33_333


@dataclass
class Bench:
    """Two fake cameras, a script of what happens to them, and the source that looks at them."""

    left: FakeCamera = field(default_factory=lambda: FakeCamera("/dev/video0", "usb-1"))
    right: FakeCamera = field(default_factory=lambda: FakeCamera("/dev/video1", "usb-2"))
    values: dict[str, Any] = field(default_factory=dict)
    offset_us: float = 0.0

    def __post_init__(self) -> None:
        plain = {"size_px": (8, 4), "rate_hz": 30.0, "left": {"id": "usb-1"}, "right": {"id": "usb-2"}}
        self.settings = CamerasSettings.model_validate(plain | self.values)
        self.kernel = FakeKernel([self.left, self.right])
        self.source = LiveSource(
            self.settings, offset_us=self.offset_us, kernel=self.kernel, monotonic=self.kernel.monotonic
        )

    def run(self, script: Iterable[Callable[[], object]]) -> list[StereoPair]:
        self.kernel.script = iter(script)
        pairs = list(self.source.pairs(self.kernel.stop))
        assert (self.kernel.left_open, self.kernel.mapped) == (0, 0)
        return pairs

    def both(self, number: int, skew_us: int = 0) -> Callable[[], None]:
        def deliver() -> None:
            self.left.deliver(1_000_000 + number * PERIOD_US)
            self.right.deliver(1_000_000 + number * PERIOD_US + skew_us)

        return deliver

    def pulled(self, camera: FakeCamera) -> Callable[[], None]:
        return lambda: setattr(camera, "plugged", False)


def nothing() -> None:
    pass


def test_pairs_carry_the_drivers_stamps_and_are_numbered() -> None:
    bench = Bench(values={"exposure_us": 4000.0})
    pairs = bench.run([bench.both(n, 250) for n in range(5)])
    assert [pair.sequence for pair in pairs] == [0, 1, 2, 3, 4]
    assert [pair.captured_at_ns for pair in pairs] == [(1_000_000 + n * PERIOD_US) * 1000 for n in range(5)]
    assert {pair.skew_us for pair in pairs} == {250.0}
    assert {(pair.clock, pair.stamp_at, pair.exposure_ns) for pair in pairs} == {
        (Clock.MONOTONIC, StampPlace.START_OF_EXPOSURE, 4_000_000)
    }
    assert all(pair.left.image.shape == (4, 8) for pair in pairs)
    assert bench.source.dropped == {}
    health = bench.source.health["left"]
    assert (health.frames, health.rate_hz, health.exposure_us) == (5, 30.0, 4000.0)


def test_both_are_armed_before_either_starts() -> None:
    order: list[str] = []

    class Noting(list[str]):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def append(self, event: str) -> None:
            order.append(f"{self.name} {event}")

    bench = Bench()
    bench.left.events, bench.right.events = Noting("left"), Noting("right")
    bench.run([])
    assert order == ["left armed", "right armed", "left started", "right started"]


def test_every_loss_is_counted_with_its_reason_and_costs_one_pair() -> None:
    bench = Bench()

    def left_lost_in_driver() -> None:
        bench.left.sequence += 1
        bench.right.deliver(1_000_000 + PERIOD_US)

    def right_flagged() -> None:
        bench.left.deliver(1_000_000 + 2 * PERIOD_US)
        bench.right.deliver(1_000_000 + 2 * PERIOD_US, error=True)

    pairs = bench.run([bench.both(0), left_lost_in_driver, right_flagged, *(bench.both(n) for n in range(3, 6))])
    assert len(pairs) == 4
    assert bench.source.dropped == {
        DropReason.LOST_BY_DRIVER: 1,
        DropReason.UNPAIRED_RIGHT: 1,
        DropReason.BUFFER_ERROR: 1,
        DropReason.UNPAIRED_LEFT: 1,
    }
    health = bench.source.health
    assert (health["left"].lost_by_driver, health["left"].buffer_errors) == (1, 0)
    assert (health["right"].lost_by_driver, health["right"].buffer_errors) == (0, 1)
    # Every frame that came is in a pair or in a count.
    assert health["left"].frames + health["right"].frames == 2 * len(pairs) + 3


def test_unplugged_and_plugged_in_again_under_each_others_numbers(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()

    def replugged() -> None:
        bench.left.node, bench.right.node = "/dev/video1", "/dev/video0"
        bench.left.plugged = bench.right.plugged = True
        bench.left.sequence = bench.right.sequence = 0

    script = [bench.both(0), bench.both(1), bench.pulled(bench.left), nothing, bench.pulled(bench.right), nothing]
    script += [replugged, bench.both(100), bench.both(101)]
    with caplog.at_level(logging.WARNING):
        pairs = bench.run(script)
    assert [pair.sequence for pair in pairs] == [0, 1, 2, 3]
    health = bench.source.health
    assert (health["left"].node, health["right"].node) == ("/dev/video1", "/dev/video0")
    assert (health["left"].restarts, health["left"].frames) == (1, 4)
    assert "left camera usb-1 (/dev/video0): it was unplugged" in caplog.text
    assert "both cameras stream again" in caplog.text
    # Each state is said once, however often it was tried.
    assert caplog.text.count("is not connected (cameras.left.id); cameras here: usb-2") == 1
    assert bench.source.last_error is not None
    assert bench.source.dropped == {}


def test_a_camera_that_returns_delivers_within_two_seconds() -> None:
    bench = Bench()
    back_at_s: list[float] = []
    started_at_s: list[float] = []

    def back() -> None:
        bench.left.plugged = True
        back_at_s.append(bench.kernel.now_s)

    def look() -> None:
        if bench.left.streaming and not started_at_s:
            started_at_s.append(bench.kernel.now_s)

    bench.run([bench.both(0), bench.pulled(bench.left), nothing, nothing, back, *[look] * 20])
    assert started_at_s[0] - back_at_s[0] < 2


def test_both_gone_at_the_start_are_waited_for() -> None:
    bench = Bench()
    bench.left.plugged = bench.right.plugged = False

    def plugged() -> None:
        bench.left.plugged = bench.right.plugged = True

    seen: list[CameraState] = []
    pairs = bench.run(
        [nothing, lambda: seen.append(bench.source.health["left"].state), plugged, bench.both(0), bench.both(1)]
    )
    assert seen == [CameraState.ABSENT]
    assert len(pairs) == 2


@pytest.mark.parametrize(
    ("break_it", "told"),
    [
        (lambda bench: setattr(bench.left, "openable", False), "usermod -aG video"),
        (lambda bench: setattr(bench.left, "formats", {"YUYV": [(8, 4)]}), "does not do GREY"),
        (lambda bench: setattr(bench.right, "bus", "usb-1"), "add the node's index"),
    ],
)
def test_what_waiting_cannot_mend_ends_the_start(break_it: Callable[[Bench], None], told: str) -> None:
    bench = Bench()
    break_it(bench)
    with pytest.raises(CaptureError, match=told):
        bench.run([nothing] * 5)


def test_one_camera_named_twice() -> None:
    with pytest.raises(CaptureError, match="name two cameras"):
        Bench(values={"right": {"id": "usb-1"}}).run([])


def test_another_camera_in_the_same_socket_is_told_and_waited_out() -> None:
    bench = Bench()
    usual = dict(bench.left.formats)

    def other() -> None:
        bench.left.plugged, bench.left.formats = True, {"YUYV": [(8, 4)]}

    def right_one() -> None:
        bench.left.formats = usual

    told: list[str | None] = []
    script = [bench.both(0), bench.pulled(bench.left), other, nothing, lambda: told.append(bench.source.last_error)]
    pairs = bench.run([*script, right_one, bench.both(1)])
    assert "does not do GREY" in str(told[0])
    assert len(pairs) == 2


def test_a_stalled_camera_is_told_and_goes_on() -> None:
    bench = Bench()
    states: list[CameraState] = []

    def right_only(number: int) -> Callable[[], None]:
        return lambda: bench.right.deliver(1_000_000 + number * PERIOD_US)

    silent = [right_only(n) for n in range(1, 10)]
    pairs = bench.run(
        [
            bench.both(0),
            *silent,
            lambda: states.append(bench.source.health["left"].state),
            bench.both(10),
            bench.both(11),
        ]
    )
    assert states == [CameraState.STALLED]
    assert bench.source.health["left"].state is CameraState.STREAMING
    assert (bench.source.health["left"].stalls, bench.source.health["left"].restarts) == (1, 0)
    assert [pair.sequence for pair in pairs] == [0, 1, 2]
    assert bench.source.dropped == {DropReason.UNPAIRED_RIGHT: 9}


def test_a_camera_that_stays_stalled_is_started_anew() -> None:
    bench = Bench()
    bench.run([bench.both(0), *[nothing] * 40, bench.both(1)])
    assert bench.source.health["left"].restarts == 1


@pytest.mark.parametrize("request_", [Request.STREAMON, Request.REQBUFS, Request.DQBUF])
def test_a_passing_error_of_the_driver_is_survived(request_: Request) -> None:
    bench = Bench()
    bench.right.faults[request_] = [errno.EIO]
    pairs = bench.run([bench.both(0), nothing, bench.both(1), bench.both(2)])
    assert len(pairs) >= 2
    assert request_.name in str(bench.source.last_error) or "driver says" in str(bench.source.last_error)


def test_a_buffer_refused_once_is_counted_and_no_pair_is_lost() -> None:
    bench = Bench()

    def refuse() -> None:
        bench.left.faults[Request.QBUF] = [errno.EINVAL]
        bench.both(1)()

    pairs = bench.run([bench.both(0), refuse, bench.both(2)])
    assert len(pairs) == 3
    assert bench.source.health["left"].queue_errors == 1


def test_a_constant_offset_is_found_and_told_with_the_key_to_set() -> None:
    bench = Bench()
    pairs = bench.run([bench.both(n, 4200) for n in range(100)])
    assert pairs == []
    assert bench.source.skew.offset_us == 4200
    assert "pairing.offset_us = 4200" in str(bench.source.last_error)
    again = Bench(offset_us=4200.0)
    assert len(again.run([again.both(n, 4200) for n in range(10)])) == 10


def test_free_running_cameras_are_called_so() -> None:
    bench = Bench()
    bench.run([bench.both(n, n * 30) for n in range(300)])
    assert bench.source.skew.looks is Trigger.FREE_RUNNING


def test_a_clock_that_the_driver_does_not_name_must_be_configured() -> None:
    bench = Bench()
    bench.left.flags = bench.right.flags = 0
    with pytest.raises(CaptureError, match=r"set cameras\.clock"):
        bench.run([bench.both(0)])
    bench = Bench(values={"clock": "realtime"})
    bench.left.flags = bench.right.flags = 0
    (pair,) = bench.run([bench.both(0)])
    assert pair.clock is Clock.REALTIME
    assert pair.stamp_at is StampPlace.END_OF_FRAME


def test_stamps_at_different_places_of_the_exposure_are_called_unknown() -> None:
    bench = Bench()
    bench.right.flags = MONOTONIC
    (pair,) = bench.run([bench.both(0)])
    assert pair.stamp_at is None
