"""Buffers to pictures: rows with padding, two bytes a pixel, and what is broken."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from needletrack.capture.pixels import Layout, decoded
from needletrack.records import Frame, Image

WIDTH, HEIGHT = 10, 6
PICTURE = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def padded(rows: npt.NDArray[Any], stride: int) -> bytes:
    """The rows, each followed by bytes that are no part of the picture."""
    raw = rows.view(np.uint8).reshape(HEIGHT, -1)
    out = np.full((HEIGHT, stride), 0xEE, np.uint8)
    out[:, : raw.shape[1]] = raw
    return out.tobytes()


@pytest.mark.parametrize("stride", [10, 16])
def test_grey_as_it_is(stride: int) -> None:
    got = decoded(memoryview(padded(PICTURE, stride)), Layout("GREY", WIDTH, HEIGHT, stride))
    assert np.array_equal(got, PICTURE)


@pytest.mark.parametrize(("name", "luminance"), [("YUYV", 0), ("UYVY", 1)])
def test_the_luminance_of_packed_colour(name: str, luminance: int) -> None:
    packed = np.full((HEIGHT, 2 * WIDTH), 128, np.uint8)
    packed[:, luminance::2] = PICTURE
    assert np.array_equal(decoded(padded(packed, 32), Layout(name, WIDTH, HEIGHT, 32)), PICTURE)


@pytest.mark.parametrize(("name", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 16), ("Y16", 12)])
def test_all_bits_in_use_in_the_full_range_whose_upper_eight_are_the_picture(name: str, bits: int) -> None:
    rest = np.random.default_rng(2).integers(0, 1 << (bits - 8), PICTURE.shape)
    words = ((PICTURE.astype(np.uint16) << (bits - 8)) + rest).astype("<u2")
    got = decoded(padded(words, 24), Layout(name, WIDTH, HEIGHT, 24, bits))
    assert got.dtype == np.uint16
    assert np.array_equal(got >> (16 - bits), words)
    frame = Frame.of(got, 0)
    assert np.array_equal(frame.image, PICTURE)
    assert np.array_equal(frame.pixels, got)


def test_more_than_the_bits_in_use_is_white() -> None:
    words = np.full((HEIGHT, WIDTH), 0xFFFF, "<u2")
    assert (Frame.of(decoded(padded(words, 20), Layout("Y16", WIDTH, HEIGHT, 20, 12)), 0).image == 255).all()


def smooth() -> Image:
    return np.add.outer(np.arange(64), np.arange(96)).astype(np.uint8)


def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", smooth(), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


def test_a_jpeg_with_what_follows_it_in_the_buffer() -> None:
    got = decoded(jpeg() + bytes(20), Layout("MJPG", 96, 64, 0))
    # Eight bits of a smooth picture at quality 95.
    assert np.abs(got.astype(int) - smooth()).max() <= 4


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (jpeg()[: len(jpeg()) // 2], "no end"),
        (b"nothing\xff\xd9", "no JPEG"),
        (cv2.imencode(".jpg", smooth()[:32])[1].tobytes(), "96x32"),
    ],
)
def test_half_a_jpeg_is_none(data: bytes, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        decoded(data, Layout("MJPG", 96, 64, 0))


def test_a_short_buffer_is_none() -> None:
    with pytest.raises(ValueError, match="59 bytes in place of 60"):
        decoded(bytes(59), Layout("GREY", WIDTH, HEIGHT, 10))


@pytest.mark.parametrize(("name", "stride"), [("GREY", 10), ("YUYV", 20), ("Y16", 20)])
def test_a_picture_keeps_nothing_of_the_drivers_buffer(name: str, stride: int) -> None:
    buffer = bytearray(stride * HEIGHT)
    got = decoded(memoryview(buffer), Layout(name, WIDTH, HEIGHT, stride))
    buffer[:] = b"\xff" * len(buffer)
    assert not got.any()
    assert not got.flags.writeable
