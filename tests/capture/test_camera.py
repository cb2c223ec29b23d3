"""One camera against a fake at the ioctl edge: identity, settings read back, buffers, errors."""

import errno
from contextlib import closing
from typing import Any

import pytest
from tests.capture.fake_kernel import MONOTONIC, FakeCamera, FakeControl, FakeKernel, usual_controls

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.camera import Camera, CameraUnavailable, find_cameras
from needletrack.capture.settings import CamerasSettings
from needletrack.capture.v4l2_abi import Request
from needletrack.errors import CaptureError
from needletrack.records import Clock, StampPlace


def settings(**values: Any) -> CamerasSettings:
    plain = {"size_px": (8, 4), "rate_hz": 30.0, "left": {"id": "usb-1"}, "right": {"id": "usb-2"}}
    return CamerasSettings.model_validate(plain | values)


def opened(camera: FakeCamera, **values: Any) -> Camera:
    return Camera(FakeKernel([camera]), "left", settings(**values))


def refused(camera: FakeCamera, **values: Any) -> str:
    kernel = FakeKernel([camera])
    with pytest.raises(CaptureError) as told:
        Camera(kernel, "left", settings(**values))
    assert not isinstance(told.value, CameraUnavailable)
    assert kernel.left_open == 0
    return str(told.value)


def usb(**values: Any) -> FakeCamera:
    return FakeCamera("/dev/video0", "usb-1", **values)


def test_a_camera_is_its_place_or_its_serial_number_and_never_its_node() -> None:
    one, two = FakeCamera("/dev/video3", "usb-1", serial="A7"), FakeCamera("/dev/video0", "usb-2", serial="B9")
    for identity in ("usb-1", "A7"):
        with closing(Camera(FakeKernel([one, two]), "left", settings(left={"id": identity}))) as camera:
            assert camera.found.node.path == "/dev/video3"
    with pytest.raises(CameraUnavailable, match=r"/dev/video3 is not connected.*usb-2 \(Fake Camera, /dev/video0"):
        Camera(FakeKernel([one, two]), "left", settings(left={"id": "/dev/video3"}))


def test_nodes_that_do_not_capture_are_no_cameras() -> None:
    metadata = FakeCamera("/dev/video1", "usb-1", caps=abi.CAP_STREAMING, index=1)
    found, refusals = find_cameras(FakeKernel([usb(), metadata]))
    assert [camera.node.path for camera in found] == ["/dev/video0"]
    assert refusals == []


def test_two_nodes_of_one_device_are_told_apart_by_their_index() -> None:
    nodes = [FakeCamera(f"/dev/video{n}", "usb-1", index=n) for n in range(2)]
    with pytest.raises(CaptureError, match="usb-1#0 for the first"):
        Camera(FakeKernel(nodes), "left", settings())
    with closing(Camera(FakeKernel(nodes), "left", settings(left={"id": "usb-1#1"}))) as camera:
        assert camera.found.node.path == "/dev/video1"


def test_without_an_identity_the_cameras_that_are_there_are_listed() -> None:
    assert "cameras.left.id is not configured" in refused(usb(), left={"id": ""})
    assert "usb-1 (Fake Camera, /dev/video0)" in refused(usb(), left={"id": ""})


def test_a_node_that_may_not_be_opened_is_told_with_the_remedy() -> None:
    told = refused(usb(openable=False))
    assert "/dev/video0 may not be opened" in told
    assert "usermod -aG video" in told


def test_everything_configured_is_set_and_read_back() -> None:
    fake = usb()
    values = {"exposure_us": 4000.0, "gain": 33, "controls": {"trigger_mode": 0}}
    with closing(opened(fake, **values, left={"id": "usb-1", "controls": {"trigger_mode": 1}})) as camera:
        by_name = {control.name: control.value for control in fake.controls}
        assert by_name == {"Gain": 33, "Exposure, Auto": 1, "Exposure Time, Absolute": 40, "Trigger Mode": 1}
        assert camera.exposure_ns == 4_000_000
        assert (camera.layout.format, camera.layout.width, camera.layout.stride) == ("GREY", 8, 16)


def test_an_exposure_that_the_camera_sets_by_itself_is_unknown() -> None:
    with closing(opened(usb())) as camera:
        assert camera.exposure_ns is None


def test_a_format_that_it_does_not_have_is_told_with_what_it_has() -> None:
    formats = {"YUYV": [(640, 480)], "MJPG": [(8, 4), (1280, 1024)]}
    told = refused(usb(formats=formats))
    assert "does not do GREY 8x4" in told
    assert "YUYV 640x480; MJPG 8x4, 1280x1024" in told


def test_a_size_that_it_does_not_have_is_told() -> None:
    assert "does not do GREY 640x480, it would do GREY 8x4" in refused(usb(), size_px=(640, 480))


def test_a_rate_that_it_does_not_have_is_told_with_those_it_has() -> None:
    told = refused(usb(rates_hz=(15.0, 30.0)), rate_hz=60.0)
    assert "does not do 60 frames a second, it would do 30" in told
    assert "15, 30 a second" in told


def test_a_triggered_camera_sets_no_rate() -> None:
    assert "leave cameras.rate_hz empty" in refused(usb(rates_hz=()))
    opened(usb(rates_hz=()), rate_hz="").close()


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"gain": 101}, r"control gain = 101 is refused .*: it takes 0 to 100 in steps of 1"),
        ({"controls": {"triggermode": 1}}, r"has no control triggermode; it has exposure_auto, .*trigger_mode"),
        ({"controls": {"exposure_auto": 9}}, r"exposure_auto = 9 is refused .*\(0 Auto, 1 Manual\)"),
    ],
)
def test_a_control_that_is_refused_is_told_with_what_it_takes(values: dict[str, Any], told: str) -> None:
    with pytest.raises(CaptureError, match=told):
        opened(usb(), **values)


def test_a_control_that_is_rounded_without_a_word_is_an_error() -> None:
    rounding = FakeControl(abi.CID_GAIN, "Gain", 0, 100, 0, becomes=lambda value: value // 10 * 10)
    assert "control gain became 30 in place of 33" in refused(usb(controls=[rounding]), gain=33)


def test_a_camera_without_what_is_asked_says_which_key_to_leave_empty() -> None:
    assert "leave cameras.exposure_us empty" in refused(usb(controls=[]), exposure_us=4000.0)
    assert "leave cameras.gain empty" in refused(usb(controls=usual_controls()[1:]), gain=1)


def streaming(fake: FakeCamera, **values: Any) -> Camera:
    camera = opened(fake, **values)
    camera.arm()
    camera.start()
    return camera


def test_stamp_clock_place_and_sequence_are_the_buffers_own() -> None:
    fake = usb()
    with closing(streaming(fake)) as camera:
        assert camera.take() is None
        fake.deliver(5_000_001, skip=3)
        grab = camera.take()
        assert grab is not None
        assert (grab.stamp_ns, grab.sequence) == (5_000_001_000, 3)
        assert (grab.clock, grab.stamp_at) == (Clock.MONOTONIC, StampPlace.START_OF_EXPOSURE)
        fake.flags = MONOTONIC
        fake.deliver(5_100_000)
        ended = camera.take()
        assert ended is not None
        assert ended.stamp_at is StampPlace.END_OF_FRAME
        fake.flags = 0
        fake.deliver(5_200_000)
        unknown = camera.take()
        assert unknown is not None
        assert unknown.clock is None


def test_flagged_and_short_buffers_are_no_pictures() -> None:
    fake = usb()
    with closing(streaming(fake)) as camera:
        fake.deliver(1, error=True)
        fake.deliver(2, used=63)
        fake.deliver(3)
        faults = [grab.fault for grab in iter(camera.take, None)]
        assert faults == ["the driver flags it as an error", "63 bytes in place of 64", ""]


def test_the_drivers_count_of_buffers_is_the_one_that_counts() -> None:
    fake = usb(most_buffers=2)
    with closing(streaming(fake, buffers=8)) as camera:
        for stamp in range(1, 20):
            fake.deliver(stamp)
            assert camera.take() is not None
    with pytest.raises(CameraUnavailable, match="two are the least"):
        streaming(usb(most_buffers=1))


def test_a_buffer_that_is_not_taken_back_is_offered_again() -> None:
    fake = usb(most_buffers=2)
    with closing(streaming(fake)) as camera:
        fake.faults[Request.QBUF] = [errno.EINVAL]
        fake.deliver(1)
        assert camera.take() is not None
        assert camera.refused_buffers == 1
        fake.deliver(2)
        assert camera.take() is not None
        assert camera.refused_buffers == 0
        fake.deliver(3)
        fake.deliver(4)
        assert [grab.sequence for grab in iter(camera.take, None)] == [2, 3]


@pytest.mark.parametrize("request_", [Request.REQBUFS, Request.QUERYBUF, Request.STREAMON, Request.DQBUF])
def test_what_fails_while_starting_or_running_may_pass(request_: Request) -> None:
    fake = usb(faults={request_: [errno.EIO]})
    kernel = FakeKernel([fake])
    camera = Camera(kernel, "left", settings())

    def started() -> None:
        camera.arm()
        camera.start()
        camera.take()

    with pytest.raises(CameraUnavailable, match="left camera usb-1"):
        started()
    camera.close()
    assert (kernel.left_open, kernel.mapped) == (0, 0)
    with closing(Camera(kernel, "left", settings())) as again:
        again.arm()
        again.start()


def test_an_unplugged_camera_closes_without_a_word() -> None:
    fake = usb()
    kernel = FakeKernel([fake])
    camera = Camera(kernel, "left", settings())
    camera.arm()
    camera.start()
    fake.plugged = False
    with pytest.raises(CameraUnavailable, match="it was unplugged"):
        camera.take()
    camera.close()
    camera.close()
    assert (kernel.left_open, kernel.mapped) == (0, 0)


def test_a_camera_in_use_may_be_free_in_a_moment() -> None:
    with pytest.raises(CameraUnavailable, match="another program streams from it"):
        opened(usb(faults={Request.S_FMT: [errno.EBUSY]}))
