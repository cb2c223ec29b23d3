"""The structures are the kernel's: numbers as a C program printed them that includes <linux/videodev2.h> on x86-64."""

import pytest

from needletrack.capture import v4l2_abi as abi
from needletrack.capture.v4l2_abi import Request

# The size of each structure is part of its request's number.
REQUESTS = {
    Request.QUERYCAP: 0x80685600,
    Request.ENUM_FMT: 0xC0405602,
    Request.G_FMT: 0xC0D05604,
    Request.S_FMT: 0xC0D05605,
    Request.REQBUFS: 0xC0145608,
    Request.QUERYBUF: 0xC0585609,
    Request.QBUF: 0xC058560F,
    Request.DQBUF: 0xC0585611,
    Request.STREAMON: 0x40045612,
    Request.STREAMOFF: 0x40045613,
    Request.G_PARM: 0xC0CC5615,
    Request.S_PARM: 0xC0CC5616,
    Request.G_CTRL: 0xC008561B,
    Request.S_CTRL: 0xC008561C,
    Request.QUERYCTRL: 0xC0445624,
    Request.QUERYMENU: 0xC02C5625,
    Request.ENUM_FRAMESIZES: 0xC02C564A,
    Request.ENUM_FRAMEINTERVALS: 0xC034564B,
}


def test_every_request_has_the_kernels_number() -> None:
    assert {request: int(request) for request in Request} == REQUESTS


@pytest.mark.parametrize(
    ("member", "offset"),
    [
        (abi.Format.fmt, 8),
        (abi.Buffer.timestamp, 24),
        (abi.Buffer.sequence, 56),
        (abi.Buffer.m, 64),
        (abi.Buffer.length, 72),
        (abi.StreamParameters.parm, 4),
    ],
)
def test_members_lie_where_the_kernel_has_them(member: object, offset: int) -> None:
    assert getattr(member, "offset") == offset  # noqa: B009  (ctypes' descriptors have no type)


@pytest.mark.parametrize("code", ["GREY", "Y16", "YUYV"])
def test_four_characters_and_their_number(code: str) -> None:
    assert abi.fourcc_text(abi.fourcc(code)).rstrip() == code


def test_y16_is_padded_with_a_blank() -> None:
    assert abi.fourcc("Y16") == 0x20363159
