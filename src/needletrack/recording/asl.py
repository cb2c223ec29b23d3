"""Recordings in the EuRoC / ASL layout: cam0 (left) and cam1 (right), each with data.csv and data/*.png.

A frame that cannot be part of a pair is lost with its reason, and its partner with unpaired_left or
unpaired_right: every listed frame is either in one pair or in one loss.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from needletrack.errors import RecordingError
from needletrack.reading import text_of
from needletrack.recording.pairing import in_order, pair_by_stamp
from needletrack.recording.png import UnusableImage, png_size, read_gray
from needletrack.records import Clock, DropReason, Frame, Pixels, StereoPair
from needletrack.rig import Rig, find_rig

LAYOUT = "EuRoC/ASL layout: cam0/data.csv and cam0/data/*.png for the left camera, cam1 for the right one"
_GREATEST_STAMP = 2**63 - 1
# Ten hours at 100 pairs/s take 150 MB.
_MOST_LISTING_BYTES = 1 << 29
_SHOWN = 80


@dataclass(frozen=True, slots=True)
class ListedFrame:
    """One line of a data.csv."""

    path: Path
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class ListedPair:
    """Two frames whose stamps belong together; the images are not read yet."""

    left: ListedFrame
    right: ListedFrame


@dataclass(frozen=True, slots=True)
class Loss:
    """A frame that is in no pair, why, and before which pair it lies (their number: after the last)."""

    reason: DropReason
    path: Path
    fault: str
    before: int


class UnusablePair(RecordingError):
    """A pair with an image that cannot be used; `losses` holds both frames with their reasons."""

    def __init__(self, losses: tuple[Loss, ...]) -> None:
        super().__init__("; ".join(f"{loss.path}: {loss.fault}" for loss in losses))
        self.losses = losses


class AslRecording:
    """The pairs of a recording in the order of their stamps; images are read one pair at a time.

    rig: the rig to use, or None for the one in the folder. tolerance_us: greatest difference of a pair's
    stamps. Raises RecordingError where the folder is no recording, holds no pair, has a malformed data.csv or
    only images that do not fit the rig; CalibrationError as `find_rig` does.
    """

    def __init__(self, folder: Path | str, rig: Rig | None = None, *, tolerance_us: float = 1000.0) -> None:
        self.folder = Path(folder)
        _require_layout(self.folder)
        left, right = _Camera("left", self.folder / "cam0"), _Camera("right", self.folder / "cam1")
        self.rig = find_rig(self.folder) if rig is None else rig
        left.require_images_of(self.rig)
        right.require_images_of(self.rig)
        near = pair_by_stamp(left.stamps_ns, right.stamps_ns, round(tolerance_us * 1000))
        if not near:
            raise RecordingError(_why_no_pair(self.folder, left, right, tolerance_us))
        paired = [
            ListedPair(left.ordered[i], right.ordered[j])
            for i, j in near
            if left.has(left.ordered[i]) and right.has(right.ordered[j])
        ]
        if not paired:
            raise RecordingError(f"{self.folder}: no pair of which both images are there")
        self.pairs = tuple(paired)
        losses = left.losses([pair.left for pair in paired]) + right.losses([pair.right for pair in paired])
        self.losses = tuple(sorted(losses, key=lambda loss: loss.before))

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def first_stamp_ns(self) -> int:
        """The left stamp of the first pair."""
        return self.pairs[0].left.stamp_ns

    @property
    def last_stamp_ns(self) -> int:
        """The left stamp of the last pair."""
        return self.pairs[-1].left.stamp_ns

    def read(self, index: int) -> StereoPair:
        """The pair at an index, which is its sequence number; raises UnusablePair."""
        listed = self.pairs[index]
        left = _image_or_fault(listed.left, self.rig.left.size_px)
        right = _image_or_fault(listed.right, self.rig.right.size_px)
        if isinstance(left, UnusableImage) or isinstance(right, UnusableImage):
            raise UnusablePair(
                (
                    _loss_in_pair(listed.left, left, DropReason.UNPAIRED_LEFT, index),
                    _loss_in_pair(listed.right, right, DropReason.UNPAIRED_RIGHT, index),
                )
            )
        frames = Frame.of(left, listed.left.stamp_ns), Frame.of(right, listed.right.stamp_ns)
        return StereoPair(*frames, sequence=index, clock=Clock.RECORDED)


class _Camera:
    """One camera's folder: the frames that data.csv lists and the images that are there."""

    def __init__(self, side: Literal["left", "right"], folder: Path) -> None:
        self.side = side
        self.data = folder / "data"
        self.listed = _read_listing(folder / "data.csv")
        self.ordered = [self.listed[index] for index in in_order([frame.stamp_ns for frame in self.listed])]
        self.stamps_ns = [frame.stamp_ns for frame in self.ordered]
        self._files = {entry.name for entry in self.data.iterdir()} if self.data.is_dir() else set()

    def has(self, frame: ListedFrame) -> bool:
        return frame.path.name in self._files

    def require_images_of(self, rig: Rig) -> None:
        """RecordingError where no image is there, or none has the size that the rig says."""
        there = [frame for frame in self.listed if self.has(frame)]
        if not there:
            raise RecordingError(f"{self.data}: none of the {len(self.listed)} images that data.csv lists is there")
        wanted = getattr(rig, self.side).size_px
        sizes: set[tuple[int, int]] = set()
        for frame in there:  # as a rule the first one fits, and no other is opened
            size = png_size(frame.path)
            if size == wanted:
                return
            if size is not None:
                sizes.add(size)
        if not sizes:
            raise RecordingError(f"{self.data}: none of the {len(there)} images is a PNG")
        found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise RecordingError(
            f"{self.data}: all images are {found}, but the {self.side} camera of rig {rig.name} has "
            f"{wanted[0]}x{wanted[1]}: the rig belongs to other cameras, or the images were scaled"
        )

    def losses(self, paired: list[ListedFrame]) -> list[Loss]:
        """The listed frames that are in no pair, in the order of data.csv."""
        in_a_pair, ordered = {id(frame) for frame in paired}, {id(frame) for frame in self.ordered}
        unpaired = DropReason.UNPAIRED_LEFT if self.side == "left" else DropReason.UNPAIRED_RIGHT
        losses: list[Loss] = []
        before = 0
        for frame in self.listed:
            if id(frame) in in_a_pair:
                before += 1
            elif id(frame) not in ordered:
                fault = f"the stamp {frame.stamp_ns} is out of order"
                losses.append(Loss(DropReason.STAMP_OUT_OF_ORDER, frame.path, fault, before))
            elif not self.has(frame):
                losses.append(Loss(DropReason.MISSING_IMAGE, frame.path, "there is no such image", before))
            else:
                losses.append(Loss(unpaired, frame.path, "the other camera has no frame of this instant", before))
        return losses


def _image_or_fault(frame: ListedFrame, size_px: tuple[int, int]) -> Pixels | UnusableImage:
    try:
        return read_gray(frame.path, size_px)
    except UnusableImage as error:
        return error


def _loss_in_pair(frame: ListedFrame, found: Pixels | UnusableImage, unpaired: DropReason, before: int) -> Loss:
    if isinstance(found, UnusableImage):
        return Loss(found.reason, frame.path, found.fault, before)
    return Loss(unpaired, frame.path, "its partner is lost", before)


def _require_layout(folder: Path) -> None:
    if not folder.exists():
        raise RecordingError(f"{folder}: there is no such recording")
    if not folder.is_dir():
        raise RecordingError(f"{folder}: a file, but a recording is a folder ({LAYOUT})")
    missing = [f"{camera}/data.csv" for camera in ("cam0", "cam1") if not (folder / camera / "data.csv").is_file()]
    if missing:
        raise RecordingError(f"{folder}: no recording: {' and '.join(missing)} missing ({LAYOUT})")


def _read_listing(path: Path) -> list[ListedFrame]:
    try:
        lines = text_of(path, _MOST_LISTING_BYTES, "utf-8-sig").splitlines()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a text file: {error}") from error
    frames = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp, _, name = (part.strip() for part in line.partition(","))
        shown = line[:_SHOWN]
        # Python refuses to read thousands of digits.
        if not (stamp.isascii() and stamp.isdecimal() and len(stamp) < 1000 and int(stamp) <= _GREATEST_STAMP):
            raise RecordingError(
                f"{path}, line {number}: {stamp[:_SHOWN]!r} is no stamp in whole nanoseconds: {shown!r}"
            )
        if not name or "," in name or "\0" in name or name != Path(name).name:
            raise RecordingError(f"{path}, line {number}: {name[:_SHOWN]!r} is no name of a file in data/: {shown!r}")
        frames.append(ListedFrame(path.parent / "data" / name, int(stamp)))
    if not frames:
        raise RecordingError(f"{path}: the recording is empty: no frame is listed")
    return frames


def _why_no_pair(folder: Path, left: _Camera, right: _Camera, tolerance_us: float) -> str:
    pairs = pair_by_stamp(left.stamps_ns, right.stamps_ns, _GREATEST_STAMP)
    nearest_us = min(abs(right.stamps_ns[j] - left.stamps_ns[i]) for i, j in pairs) / 1000
    return (
        f"{folder}: no left and right stamps are within {tolerance_us:g} us of each other (the nearest are "
        f"{nearest_us:g} us apart): the cameras' clocks differ, or pairing.tolerance_us is too small"
    )
