"""A recording on disk: every listed frame ends in a pair or in a loss with its reason."""

import re
import struct
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.recording.small_recording import SIZE_PX, image_of, small_rig, write_recording

from needletrack.errors import CalibrationError, RecordingError
from needletrack.recording.asl import AslRecording, UnusablePair
from needletrack.records import Clock, DropReason
from needletrack.rig import import_camchain, write_rig

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"
MS = 1_000_000


def lost(recording: AslRecording) -> Counter[DropReason]:
    return Counter(loss.reason for loss in recording.losses)


def stamps(recording: AslRecording) -> list[int]:
    return [pair.left.stamp_ns for pair in recording.pairs]


def fault_of(recording: AslRecording, index: int = 0) -> str:
    with pytest.raises(UnusablePair) as caught:
        recording.read(index)
    return str(caught.value)


# Whole recordings


@pytest.mark.parametrize(
    ("name", "pairs", "size_px"),
    [
        ("lab-a", 5, (1280, 1024)),
        ("steel-a", 2, (1280, 1024)),
        ("tissue-a", 2, (1280, 1024)),
        ("hard-a", 2, (1280, 1024)),
        ("absent-a", 2, (1280, 1024)),
        ("steer-b", 16, (960, 768)),
    ],
)
def test_the_bundled_recordings_are_whole(name: str, pairs: int, size_px: tuple[int, int]) -> None:
    recording = AslRecording(RECORDINGS / name)
    assert (len(recording), recording.losses) == (pairs, ())
    assert recording.rig.digest == import_camchain(RECORDINGS / name / "camchain.yaml").digest
    for index in range(pairs):
        pair = recording.read(index)
        assert (pair.sequence, pair.clock, pair.released_at_ns) == (index, Clock.RECORDED, None)
        assert pair.left.image.shape == pair.right.image.shape == size_px[::-1]
        assert abs(pair.skew_us) <= 60


def test_frames_are_the_files_pixels_and_stamps() -> None:
    pair = AslRecording(RECORDINGS / "lab-a").read(1)
    assert (pair.left.captured_at_ns, pair.right.captured_at_ns) == (1_033_333_333, 1_033_355_211)
    for frame, file in ((pair.left, "cam0/data/1033333333.png"), (pair.right, "cam1/data/1033355211.png")):
        np.testing.assert_array_equal(frame.image, cv2.imread(str(RECORDINGS / "lab-a" / file), cv2.IMREAD_UNCHANGED))


def test_first_and_last_stamp_and_length_are_known_without_reading_images(tmp_path: Path) -> None:
    recording = AslRecording(write_recording(tmp_path, [10 * MS, 20 * MS, 30 * MS]))
    assert (recording.first_stamp_ns, recording.last_stamp_ns, len(recording)) == (10 * MS, 30 * MS, 3)


def test_a_given_rig_takes_the_place_of_the_folders_own(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [MS])
    (folder / "rig.yaml").unlink()
    rig = small_rig()
    assert AslRecording(folder, rig).rig is rig


def test_line_endings_comments_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [MS, 2 * MS])
    listing = folder / "cam0" / "data.csv"
    text = listing.read_text(encoding="utf-8").replace("\n", "\r\n").replace(",", " , ")
    listing.write_bytes(b"\xef\xbb\xbf" + text.encode() + b"# the end\r\n\r\n")
    assert stamps(AslRecording(folder)) == [MS, 2 * MS]


# Frames that find no partner


@pytest.mark.parametrize(
    ("left", "right", "pairs", "losses"),
    [
        ([10, 20, 30], [10, 30], [10, 30], {DropReason.UNPAIRED_LEFT: 1}),
        ([10, 30], [10, 20, 30], [10, 30], {DropReason.UNPAIRED_RIGHT: 1}),
        ([20, 30], [10, 20, 30], [20, 30], {DropReason.UNPAIRED_RIGHT: 1}),
        ([10, 20], [10, 20, 30], [10, 20], {DropReason.UNPAIRED_RIGHT: 1}),
        ([10, 20, 30], [10, 22, 30], [10, 30], {DropReason.UNPAIRED_LEFT: 1, DropReason.UNPAIRED_RIGHT: 1}),
        ([10, 20, 15, 30], [10, 20, 30], [10, 20, 30], {DropReason.STAMP_OUT_OF_ORDER: 1}),
        ([10, 20, 20, 30], [10, 20, 30], [10, 20, 30], {DropReason.STAMP_OUT_OF_ORDER: 1}),
        ([10, 900, 20, 30], [10, 20, 30], [10, 20, 30], {DropReason.STAMP_OUT_OF_ORDER: 1}),
        ([10, 20], [10, 5, 20], [10, 20], {DropReason.STAMP_OUT_OF_ORDER: 1}),
    ],
)
def test_a_frame_without_a_partner_is_lost_with_its_reason_and_costs_no_other_pair(
    tmp_path: Path, left: list[int], right: list[int], pairs: list[int], losses: dict[DropReason, int]
) -> None:
    recording = AslRecording(write_recording(tmp_path, [MS * t for t in left], [MS * t for t in right]))
    assert stamps(recording) == [MS * t for t in pairs]
    assert lost(recording) == losses


def test_a_loss_says_which_frame_why_and_before_which_pair(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS, 30 * MS], [10 * MS, 30 * MS, 40 * MS])
    first, second = AslRecording(folder).losses
    assert (first.reason, first.before) == (DropReason.UNPAIRED_LEFT, 1)
    assert first.path == folder / "cam0" / "data" / f"{20 * MS}.png"
    assert first.fault == "the other camera has no frame of this instant"
    assert (second.reason, second.before) == (DropReason.UNPAIRED_RIGHT, 2)


def test_the_tolerance_decides_which_stamps_are_one_instant(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS], [10 * MS + 500_000, 20 * MS + 500_001])
    assert stamps(AslRecording(folder, tolerance_us=500)) == [10 * MS]
    assert stamps(AslRecording(folder)) == [10 * MS, 20 * MS]


def test_clocks_that_never_agree_are_an_error_that_says_by_how_much(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS], [14 * MS, 23 * MS])
    message = r"within 1000 us of each other \(the nearest are 3000 us apart\): .*pairing\.tolerance_us"
    with pytest.raises(RecordingError, match=message):
        AslRecording(folder)


def test_every_listed_frame_is_in_one_pair_or_one_loss(tmp_path: Path) -> None:
    left = [10, 20, 30, 25, 40, 50, 50, 60]
    right = [10, 20, 35, 40, 50, 60, 70]
    folder = write_recording(tmp_path, [MS * t for t in left], [MS * t for t in right])
    (folder / "cam1" / "data" / f"{40 * MS}.png").unlink()
    recording = AslRecording(folder)
    for camera, listed in (("cam0", left), ("cam1", right)):
        losses = [loss for loss in recording.losses if loss.path.parts[-3] == camera]
        assert len(recording) + len(losses) == len(listed)
    assert [loss.before for loss in recording.losses] == sorted(loss.before for loss in recording.losses)


# Images that are not there, or not whole


def test_a_listed_image_that_is_missing_costs_its_pair(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS, 30 * MS])
    (folder / "cam0" / "data" / f"{20 * MS}.png").unlink()
    recording = AslRecording(folder)
    assert stamps(recording) == [10 * MS, 30 * MS]
    assert lost(recording) == {DropReason.MISSING_IMAGE: 1, DropReason.UNPAIRED_RIGHT: 1}


def test_an_image_that_vanishes_later_costs_its_pair(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    recording = AslRecording(folder)
    (folder / "cam1" / "data" / f"{20 * MS}.png").unlink()
    with pytest.raises(UnusablePair, match="there is no such image") as caught:
        recording.read(1)
    assert [loss.reason for loss in caught.value.losses] == [
        DropReason.UNPAIRED_LEFT,
        DropReason.MISSING_IMAGE,
    ]
    assert {loss.before for loss in caught.value.losses} == {1}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(size_px: tuple[int, int], pixels: bytes, depth: int = 8, colour: int = 0, *before: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size_px, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(before) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def rows(values: npt.NDArray[Any]) -> bytes:
    """Image rows as a PNG's IDAT holds them, big-endian, without prediction."""
    big_endian = values.astype(values.dtype.newbyteorder(">"))
    return zlib.compress(b"".join(b"\0" + row.tobytes() for row in big_endian))


GRAY = rows(image_of(1))


def with_byte_changed(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda _: b"", "no PNG, or not even its header is whole"),
        (lambda _: b"P5 64 48 255\n" + bytes(64 * 48), "no PNG"),
        (lambda data: data[:20], "no PNG, or not even its header is whole"),
        (lambda data: data[:33], "truncated: it ends within a part, after 33 bytes"),
        (lambda data: data[:40], "truncated"),
        (lambda data: data[: len(data) // 2], "truncated"),
        (lambda data: data[:-17], "truncated"),
        (lambda data: data[:-12], "truncated"),
        (lambda data: data[:-1], "truncated"),
        (lambda data: with_byte_changed(data, 18), "no PNG, or not even its header is whole"),
        (
            lambda data: with_byte_changed(data, len(data) // 2),
            "corrupt: wrong checksum of the part at byte 33",
        ),
        (lambda data: with_byte_changed(data, 35), "truncated"),
        (lambda _: png(SIZE_PX, zlib.compress(bytes(65 * 20))), "its pixels cannot be decoded"),
        (lambda _: png(SIZE_PX, GRAY[:-40]), "its pixels cannot be decoded"),
        (lambda _: png(SIZE_PX, b"no deflate stream"), "its pixels cannot be decoded"),
    ],
)
def test_an_image_that_is_not_whole_is_never_half_a_picture(
    tmp_path: Path, damage: Callable[[bytes], bytes], fault: str
) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    path = folder / "cam0" / "data" / f"{20 * MS}.png"
    path.write_bytes(damage(path.read_bytes()))
    recording = AslRecording(folder)
    with pytest.raises(UnusablePair, match=re.escape(f"{path}: {fault}")) as caught:
        recording.read(1)
    left, right = caught.value.losses
    assert (left.reason, right.reason) == (DropReason.UNREADABLE_IMAGE, DropReason.UNPAIRED_RIGHT)
    np.testing.assert_array_equal(recording.read(0).left.image, image_of(10 * MS))


def test_both_images_of_a_pair_may_be_bad_each_in_its_way(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    (folder / "cam0" / "data" / f"{20 * MS}.png").write_bytes(png((65, 48), GRAY))
    (folder / "cam1" / "data" / f"{20 * MS}.png").write_bytes(b"nothing")
    with pytest.raises(UnusablePair) as caught:
        AslRecording(folder).read(1)
    assert [loss.reason for loss in caught.value.losses] == [
        DropReason.WRONG_SIZE,
        DropReason.UNREADABLE_IMAGE,
    ]


def test_a_folder_in_place_of_an_image_is_unreadable(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    (folder / "cam0" / "data" / f"{20 * MS}.png").unlink()
    (folder / "cam0" / "data" / f"{20 * MS}.png").mkdir()
    assert "Is a directory" in fault_of(AslRecording(folder), 1)


def test_a_file_far_longer_than_its_image_is_not_read_to_its_end(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    padding = chunk(b"juNk", bytes(3 << 20))
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png(SIZE_PX, GRAY, 8, 0, padding))
    assert "the file is too long for a 64x48 image" in fault_of(AslRecording(folder))


# Sizes


def test_one_image_of_another_size_is_lost(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    (folder / "cam1" / "data" / f"{10 * MS}.png").write_bytes(png((32, 24), rows(np.zeros((24, 32), np.uint8))))
    recording = AslRecording(folder)
    with pytest.raises(UnusablePair, match="the image is 32x24, the rig says 64x48") as caught:
        recording.read(0)
    assert [loss.reason for loss in caught.value.losses] == [DropReason.UNPAIRED_LEFT, DropReason.WRONG_SIZE]
    assert recording.read(1).sequence == 1


def test_a_claim_of_an_absurd_size_costs_no_memory(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png((2**31 - 1, 2**31 - 1), GRAY))
    recording = AslRecording(folder)
    tracemalloc.start()
    try:
        assert "the image is 2147483647x2147483647, the rig says 64x48" in fault_of(recording)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_recording_of_other_cameras_is_refused_as_a_whole(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    write_rig(small_rig((60, 48)), folder / "rig.yaml")
    message = "cam0/data: all images are 64x48, but the left camera of rig small has 60x48: the rig belongs to"
    with pytest.raises(RecordingError, match=message):
        AslRecording(folder)


def test_one_cameras_images_of_another_size_name_that_camera(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    for stamp, size in ((10 * MS, (32, 24)), (20 * MS, (64, 47))):
        path = folder / "cam1" / "data" / f"{stamp}.png"
        path.write_bytes(png(size, rows(np.zeros(size[::-1], np.uint8))))
    with pytest.raises(RecordingError, match="cam1/data: all images are 32x24, 64x47, but the right camera"):
        AslRecording(folder)


# Depths and colours


def test_sixteen_bits_keep_their_upper_eight(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    deep = np.random.default_rng(1).integers(0, 1 << 16, SIZE_PX[::-1], dtype=np.uint16)
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png(SIZE_PX, rows(deep), depth=16))
    np.testing.assert_array_equal(AslRecording(folder).read(0).left.image, deep // 256)


@pytest.mark.parametrize(("channels", "colour"), [(3, 2), (4, 6)])
@pytest.mark.parametrize("depth", [8, 16])
def test_colour_becomes_luma(tmp_path: Path, channels: int, colour: int, depth: int) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    dtype = np.uint8 if depth == 8 else np.uint16
    pixels = np.random.default_rng(2).integers(0, 1 << depth, (*SIZE_PX[::-1], channels), dtype=dtype)
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png(SIZE_PX, rows(pixels), depth, colour))
    luma = pixels[..., :3] @ np.array([0.299, 0.587, 0.114]) / (1 if depth == 8 else 256)
    # OpenCV rounds to the nearest level of the depth; the upper eight of sixteen bits round down.
    error = AslRecording(folder).read(0).left.image - luma
    low, high = (-0.51, 0.51) if depth == 8 else (-1.01, 0.01)
    assert low <= error.min()
    assert error.max() <= high


def test_gray_with_alpha_keeps_the_gray(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    pixels = np.dstack([image_of(3), image_of(4)])
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png(SIZE_PX, rows(pixels), 8, 4))
    np.testing.assert_array_equal(AslRecording(folder).read(0).left.image, image_of(3))


def test_palette_images_are_colour(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    palette = chunk(b"PLTE", bytes(value for level in range(256) for value in (255 - level,) * 3))
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(png(SIZE_PX, rows(image_of(5)), 8, 3, palette))
    np.testing.assert_array_equal(AslRecording(folder).read(0).left.image, 255 - image_of(5))


# What is no recording


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("20000000", "'' is no name of a file in data/"),
        ("20000000,", "'' is no name of a file in data/"),
        ("soon,20000000.png", "'soon' is no stamp in whole nanoseconds"),
        ("-5,20000000.png", "'-5' is no stamp in whole nanoseconds"),
        ("2e7,20000000.png", "'2e7' is no stamp in whole nanoseconds"),
        ("²,20000000.png", "'²' is no stamp in whole nanoseconds"),
        ("9223372036854775808,a.png", "'9223372036854775808' is no stamp in whole nanoseconds"),
        ("20000000,../../secret.png", "'../../secret.png' is no name of a file in data/"),
        ("20000000,20000000.png,extra", "'20000000.png,extra' is no name of a file in data/"),
    ],
)
def test_a_malformed_line_is_named_by_file_and_number(tmp_path: Path, line: str, fault: str) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    listing = folder / "cam1" / "data.csv"
    listing.write_text(listing.read_text(encoding="utf-8") + line + "\n", encoding="utf-8")
    with pytest.raises(RecordingError, match=re.escape(f"{listing}, line 3: {fault}")):
        AslRecording(folder)


def test_a_listing_that_is_no_text_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    (folder / "cam0" / "data.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match=r"cam0/data\.csv: not a text file"):
        AslRecording(folder)


@pytest.mark.parametrize("camera", ["cam0", "cam1"])
def test_an_empty_recording_is_refused(tmp_path: Path, camera: str) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    (folder / camera / "data.csv").write_text("#timestamp [ns],filename\n", encoding="utf-8")
    with pytest.raises(RecordingError, match=rf"{camera}/data\.csv: the recording is empty: no frame is listed"):
        AslRecording(folder)


def test_a_recording_without_its_images_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    for path in (folder / "cam1" / "data").iterdir():
        path.unlink()
    with pytest.raises(RecordingError, match=r"cam1/data: none of the 2 images that data\.csv lists is there"):
        AslRecording(folder)
    (folder / "cam1" / "data").rmdir()
    with pytest.raises(RecordingError, match=r"cam1/data: none of the 2 images that data\.csv lists is there"):
        AslRecording(folder)


def test_a_recording_without_one_whole_pair_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS, 20 * MS])
    (folder / "cam0" / "data" / f"{10 * MS}.png").unlink()
    (folder / "cam1" / "data" / f"{20 * MS}.png").unlink()
    with pytest.raises(RecordingError, match="no pair of which both images are there"):
        AslRecording(folder)


def test_a_recording_of_other_files_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    (folder / "cam0" / "data" / f"{10 * MS}.png").write_bytes(b"P5 64 48 255\n" + bytes(64 * 48))
    with pytest.raises(RecordingError, match="cam0/data: none of the 1 images is a PNG"):
        AslRecording(folder)


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recording: cam0/data\.csv and cam1/data\.csv missing \(EuRoC"):
        AslRecording(tmp_path)
    folder = write_recording(tmp_path, [10 * MS])
    (folder / "cam1" / "data.csv").unlink()
    with pytest.raises(RecordingError, match=r"no recording: cam1/data\.csv missing \(EuRoC"):
        AslRecording(folder)
    with pytest.raises(RecordingError, match="there is no such recording"):
        AslRecording(tmp_path / "absent")
    with pytest.raises(RecordingError, match="a file, but a recording is a folder"):
        AslRecording(folder / "rig.yaml")


def test_a_recording_without_a_rig_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    (folder / "rig.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"no rig: add rig\.yaml or Kalibr's camchain\.yaml"):
        AslRecording(folder)


def test_a_recording_with_two_rigs_that_contradict_each_other_is_refused(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, [10 * MS])
    (folder / "camchain.yaml").write_bytes((RECORDINGS / "lab-a" / "camchain.yaml").read_bytes())
    with pytest.raises(CalibrationError, match="contradict each other"):
        AslRecording(folder)
