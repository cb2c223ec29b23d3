"""Capture on the kernel's vivid cameras: what they deliver, and every way in which they break."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from tests.hardware.vivid import (
    LEFT,
    RIGHT,
    SIZE_PX,
    accounted_for,
    bind,
    control,
    node_of,
    running,
    settings,
    unbind,
    wait_for,
)

from needletrack.capture.camera import CameraUnavailable
from needletrack.capture.live import CameraState, LiveSource
from needletrack.errors import CaptureError
from needletrack.recording.mcap_file import About, McapRecording
from needletrack.recording.recorder import Recorder, RecorderSettings
from needletrack.records import Clock, Frame, StampPlace, StereoPair


@pytest.mark.parametrize("name", ["GREY", "YUYV", "Y16"])
def test_pairs_of_every_format(name: str) -> None:
    with running(format=name) as ran:
        ran.more(4)
    accounted_for(ran)
    assert [pair.sequence for pair in ran.pairs[:4]] == [0, 1, 2, 3]
    for pair in ran.pairs:
        assert pair.left.image.shape == pair.right.image.shape == SIZE_PX[::-1]
        # Colour bars, whatever the format.
        assert pair.left.image.std() > 20
        assert (pair.clock, pair.stamp_at) == (Clock.MONOTONIC, StampPlace.START_OF_EXPOSURE)
        assert abs(pair.skew_us) <= 50_000


def test_formats_show_the_same_picture() -> None:
    means = {}
    for name in ("GREY", "YUYV", "Y16"):
        with running(format=name) as ran:
            ran.more(1)
        # The upper left has no moving text.
        means[name] = ran.pairs[0].left.image[200:, :].mean()
    # Full range against video range.
    assert np.ptp(list(means.values())) < 15


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"format": "MJPG"}, "does not do MJPG 640x360.*GREY 320x180, 640x360"),
        ({"size_px": (641, 360)}, "does not do GREY 641x360"),
        ({"rate_hz": 200.0}, "does not do 200 frames a second"),
        ({"controls": {"gain": 10_000}}, "gain"),
        ({"controls": {"no_such": 1}}, "has no control no_such; it has .*brightness"),
    ],
)
def test_what_the_camera_does_not_do_is_told_with_what_it_does(values: dict[str, object], told: str) -> None:
    with pytest.raises(CaptureError, match=told) as error:
        list(LiveSource(settings(**values)).pairs(Event()))
    assert not isinstance(error.value, CameraUnavailable)


def test_controls_are_set() -> None:
    with running(controls={"brightness": 99}, right={"id": RIGHT, "controls": {"brightness": 55}}) as ran:
        ran.more(1)
        for bus, value in ((LEFT, "99"), (RIGHT, "55")):
            command = ["v4l2-ctl", "-d", node_of(bus), "-C", "brightness"]
            said = subprocess.run(command, capture_output=True, text=True, check=True)
            assert said.stdout.split()[-1] == value


def test_dropped_buffers_are_counted_exactly() -> None:
    with running() as ran:
        ran.more(2)
        control(LEFT, percentage_of_dropped_buffers=50)
        wait_for(lambda: ran.source.health["left"].lost_by_driver >= 3)
        control(LEFT, percentage_of_dropped_buffers=0)
        ran.more(3)
    accounted_for(ran)
    assert ran.source.health["right"].restarts == 0


def test_buffers_flagged_as_errors_are_no_pictures() -> None:
    with running() as ran:
        ran.more(2)
        control(LEFT, inject_v4l2_buf_flag_error=1)
        wait_for(lambda: ran.source.health["left"].buffer_errors >= 1)
        ran.more(3)
    accounted_for(ran)
    assert ran.source.health["right"].buffer_errors == 0


def test_an_error_of_streamon_is_tried_again() -> None:
    control(RIGHT, inject_vidioc_streamon_error=1)
    with running() as ran:
        ran.more(2)
    accounted_for(ran)
    assert "STREAMON failed" in str(ran.source.last_error)


def test_an_error_of_qbuf_costs_no_pair() -> None:
    with running() as ran:
        ran.more(2)
        control(LEFT, inject_vidioc_qbuf_error=1)
        wait_for(lambda: ran.kernel.refused_queues > 0)
        ran.more(3)
    accounted_for(ran)
    assert ran.source.health["left"].restarts == 0


@pytest.mark.parametrize("fault", ["inject_fatal_streaming_error", "disconnect"])
def test_a_stream_that_breaks_off_is_started_anew(fault: str) -> None:
    with running() as ran:
        ran.more(2)
        control(RIGHT, **{fault: 1})
        wait_for(lambda: ran.source.health["right"].restarts == 1)
        ran.more(3)
    accounted_for(ran)
    assert RIGHT in str(ran.source.last_error)


def test_unplugged_and_plugged_in_under_other_numbers() -> None:
    before = node_of(LEFT), node_of(RIGHT)
    with running() as ran:
        ran.more(2)
        # Somebody who holds the old node keeps its number from being free.
        held = os.open(before[0], os.O_RDWR)
        try:
            unbind()
            wait_for(lambda: ran.source.health["left"].state is CameraState.ABSENT)
            bind()
            ran.more(3)
        finally:
            os.close(held)
        after = ran.source.health["left"].node, ran.source.health["right"].node
    accounted_for(ran)
    assert after == (node_of(LEFT), node_of(RIGHT))
    assert after[0] == before[1], "left has right's old number"
    unbind()
    bind()
    assert (node_of(LEFT), node_of(RIGHT)) == before


def test_both_gone_at_the_start_are_waited_for() -> None:
    unbind()
    with running() as ran:
        wait_for(lambda: "is not connected" in str(ran.source.last_error))
        assert ran.pairs == []
        bind()
        ran.more(2)
    accounted_for(ran)


def test_a_stalled_camera_is_told_and_goes_on() -> None:
    with running(stall_s=1.0) as ran:
        ran.more(2)
        control(RIGHT, percentage_of_dropped_buffers=100)
        wait_for(lambda: ran.source.health["right"].state is CameraState.STALLED)
        assert ran.source.health["left"].state is CameraState.STREAMING
        control(RIGHT, percentage_of_dropped_buffers=0)
        ran.more(3)
    accounted_for(ran)
    assert (ran.source.health["right"].stalls, ran.source.health["left"].stalls) == (1, 0)


@contextmanager
def nobody() -> Iterator[None]:
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_user_who_may_not_open_the_cameras_is_told_how() -> None:
    for bus in (LEFT, RIGHT):
        Path(node_of(bus)).chmod(0o600)
    with nobody(), pytest.raises(CaptureError, match=r"may not be opened.*usermod -aG video"):
        list(LiveSource(settings()).pairs(Event()))


def test_a_disk_that_fills_and_one_that_is_read_only_pause_the_recording(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()

    def mount(*options: str) -> None:
        subprocess.run(["mount", *options, "disk", str(disk)], check=True)

    mount("-t", "tmpfs", "-o", "size=40m")
    noise = np.random.default_rng(0).integers(0, 256, SIZE_PX[::-1], dtype=np.uint8)
    settings_ = RecorderSettings(disk, buffer_mb=16, min_free_mb=0)
    number = 0

    def offer() -> None:
        nonlocal number
        number += 1
        frame = Frame(np.roll(noise, number), number)
        recorder.offer(StereoPair(frame, frame, number))

    try:
        with Recorder(settings_, About(None, "vivid"), SIZE_PX) as recorder:

            def says(text: str) -> bool:
                offer()
                return text in str(recorder.state.error)

            wait_for(lambda: says("No space left on device"))
            first = next(disk.glob("*.mcap"))
            recorded_before = recorder.recorded
            assert recorded_before > 0
            mount("-o", "remount,ro")
            wait_for(lambda: says("read-only"))
            mount("-o", "remount,rw,size=120m")
            wait_for(lambda: says("None") and recorder.recorded > recorded_before)
        assert recorder.offered == recorder.recorded + recorder.dropped == number
        second = next(path for path in disk.glob("*.mcap") if path != first)
        assert len(McapRecording(second, without_rig=True)) > 0
    finally:
        subprocess.run(["umount", str(disk)], check=False)
