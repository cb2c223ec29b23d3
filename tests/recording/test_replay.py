"""Playing a recording: which pairs, under which stamps, when, and what is counted on the way."""

import gc
import threading
import weakref
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.recording.small_recording import image_of, write_recording

from needletrack.capture.source import FrameSource
from needletrack.errors import RecordingError
from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import DropReason, Image, StereoPair

MS = 1_000_000
LEFT_NS = [10 * MS, 21 * MS, 30 * MS, 42 * MS]
RIGHT_NS = [10 * MS + 500, 21 * MS - 300, 30 * MS, 42 * MS + 100]
LONG_S = 30.0


@pytest.fixture
def recording(tmp_path: Path) -> AslRecording:
    return AslRecording(write_recording(tmp_path, LEFT_NS, RIGHT_NS))


def played(source: FrameSource) -> list[StereoPair]:
    return list(source.pairs(threading.Event()))


def which(pairs: list[StereoPair]) -> list[int]:
    """The index in the recording of each pair, by its left picture."""
    pictures = [image_of(stamp).tobytes() for stamp in LEFT_NS]
    return [pictures.index(pair.left.image.tobytes()) for pair in pairs]


def test_the_recorded_pairs_come_unchanged_and_in_order(recording: AslRecording) -> None:
    source = ReplaySource(recording)
    pairs = played(source)
    assert [pair.left.captured_at_ns for pair in pairs] == LEFT_NS
    assert [pair.right.captured_at_ns for pair in pairs] == RIGHT_NS
    assert [pair.sequence for pair in pairs] == [0, 1, 2, 3]
    assert [pair.released_at_ns for pair in pairs] == [None] * 4
    for pair in pairs:
        np.testing.assert_array_equal(pair.left.image, image_of(pair.left.captured_at_ns))
        np.testing.assert_array_equal(pair.right.image, image_of(pair.right.captured_at_ns))
    assert (len(source), source.dropped) == (4, {})


def test_of_some_pairs_the_others_are_counted(recording: AslRecording) -> None:
    source = ReplaySource(recording, only_ns={LEFT_NS[1], LEFT_NS[3]})
    dropped = []
    for pair in source.pairs(threading.Event()):
        assert pair.captured_at_ns == LEFT_NS[pair.sequence]
        dropped.append((pair.sequence, source.dropped))
    assert dropped == [(1, {DropReason.OVERWRITTEN: 1}), (3, {DropReason.OVERWRITTEN: 2})]


@pytest.mark.parametrize(
    ("start", "end", "indices"),
    [(0, None, [0, 1, 2, 3]), (1, None, [1, 2, 3]), (0, 2, [0, 1]), (1, 3, [1, 2]), (2, 99, [2, 3])],
)
def test_start_and_end_cut_as_a_slice_does(
    recording: AslRecording, start: int, end: int | None, indices: list[int]
) -> None:
    source = ReplaySource(recording, start=start, end=end)
    pairs = played(source)
    assert [pair.sequence for pair in pairs] == which(pairs) == indices
    assert len(source) == len(indices)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": 4}, "no pair from 4 to the last: the recording has 4"),
        ({"start": 2, "end": 2}, "no pair from 2 to 2: the recording has 4"),
        ({"start": -1}, "start and end count from 0 and are not negative"),
        ({"end": -1}, "start and end count from 0 and are not negative"),
        ({"loop": 0}, "played once or more, not 0 times"),
        ({"start": 3, "loop": 2}, "a loop needs two pairs or more"),
    ],
)
def test_a_range_or_loop_that_plays_nothing_is_refused(
    recording: AslRecording, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        ReplaySource(recording, **arguments)


def test_a_loop_turns_at_both_ends_and_its_stamps_go_on_mirrored(recording: AslRecording) -> None:
    source = ReplaySource(recording, loop=3)
    pairs = played(source)
    assert which(pairs) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert len(source) == len(pairs)
    assert [pair.sequence for pair in pairs] == list(range(10))
    assert [pair.captured_at_ns for pair in pairs[:4]] == LEFT_NS
    intervals = [after.captured_at_ns - before.captured_at_ns for before, after in pairwise(pairs)]
    assert intervals == [11 * MS, 9 * MS, 12 * MS, 12 * MS, 9 * MS, 11 * MS, 11 * MS, 9 * MS, 12 * MS]
    skews = [pair.skew_us for pair in pairs]
    assert skews == [[0.5, -0.3, 0.0, 0.1][index] for index in which(pairs)]


def test_a_part_is_looped_within_its_ends(recording: AslRecording) -> None:
    pairs = played(ReplaySource(recording, start=1, end=3, loop=4))
    assert which(pairs) == [1, 2, 1, 2, 1]
    assert [pair.sequence for pair in pairs] == [1, 2, 3, 4, 5]


def test_two_plays_are_alike_to_the_last_byte(recording: AslRecording) -> None:
    def content(pair: StereoPair) -> tuple[Any, ...]:
        return (
            pair.sequence,
            pair.captured_at_ns,
            pair.skew_us,
            pair.left.image.tobytes(),
            pair.right.image.tobytes(),
        )

    first, second = (played(ReplaySource(recording, loop=2)) for _ in range(2))
    assert [content(pair) for pair in first] == [content(pair) for pair in second]


def test_a_long_loop_holds_three_pairs_at_most(recording: AslRecording) -> None:
    """The one in the consumer's hand, the next one, and the one that is being decoded."""
    alive: set[int] = set()
    most = 0

    def watch(image: Image) -> None:
        alive.add(id(image))
        weakref.finalize(image, alive.discard, id(image))

    for pair in ReplaySource(recording, loop=100).pairs(threading.Event()):
        watch(pair.left.image)
        gc.collect(0)
        most = max(most, len(alive))
    assert most <= 3


# Losses


@pytest.fixture
def damaged(tmp_path: Path) -> AslRecording:
    """A lone right frame before the first pair, a lone left one after pair 1, a lone right one at the end.

    And pair 2 cannot be read.
    """
    folder = write_recording(
        tmp_path,
        [20 * MS, 30 * MS, 40 * MS, 50 * MS, 60 * MS],
        [10 * MS, 20 * MS, 30 * MS, 50 * MS, 60 * MS, 70 * MS],
    )
    (folder / "cam1" / "data" / f"{50 * MS}.png").write_bytes(b"")
    return AslRecording(folder)


UNREADABLE = {DropReason.UNREADABLE_IMAGE: 1, DropReason.UNPAIRED_LEFT: 1}


def test_losses_are_counted_as_they_are_passed(damaged: AslRecording) -> None:
    source = ReplaySource(damaged)
    assert source.dropped == {}
    counted = [(pair.sequence, source.dropped) for pair in source.pairs(threading.Event())]
    assert counted == [
        (0, {DropReason.UNPAIRED_RIGHT: 1}),
        (1, {DropReason.UNPAIRED_RIGHT: 1}),
        (3, {DropReason.UNPAIRED_RIGHT: 2, DropReason.UNPAIRED_LEFT: 2, DropReason.UNREADABLE_IMAGE: 1}),
    ]


@pytest.mark.parametrize(
    ("start", "end", "dropped"),
    [
        (0, 2, {DropReason.UNPAIRED_RIGHT: 1}),
        (1, 2, {}),
        (2, 4, UNREADABLE | {DropReason.UNPAIRED_RIGHT: 1}),
        (1, 3, UNREADABLE | {DropReason.UNPAIRED_LEFT: 2}),
    ],
)
def test_only_losses_within_the_played_part_are_counted(
    damaged: AslRecording, start: int, end: int, dropped: dict[DropReason, int]
) -> None:
    source = ReplaySource(damaged, start=start, end=end)
    played(source)
    assert source.dropped == dropped


def test_every_pass_counts_what_it_passes(damaged: AslRecording) -> None:
    source = ReplaySource(damaged, start=1, end=4, loop=3)
    assert [pair.sequence for pair in played(source)] == [1, 3, 5, 7]
    assert source.dropped == {
        DropReason.UNPAIRED_LEFT: 6,
        DropReason.UNREADABLE_IMAGE: 3,
        DropReason.UNPAIRED_RIGHT: 1,
    }


def test_all_frames_of_a_recording_are_played_or_counted(damaged: AslRecording) -> None:
    source = ReplaySource(damaged)
    pairs = played(source)
    assert 2 * len(pairs) + sum(source.dropped.values()) == 5 + 6


def test_an_unusable_pair_is_named_once(damaged: AslRecording, caplog: pytest.LogCaptureFixture) -> None:
    played(ReplaySource(damaged, loop=3))
    (record,) = caplog.records
    assert "pair 2 is left out" in record.getMessage()
    assert f"cam1/data/{50 * MS}.png: no PNG" in record.getMessage()


# Pace


def test_paced_pairs_are_the_same_and_are_released_no_sooner_than_recorded(recording: AslRecording) -> None:
    pairs = played(ReplaySource(recording, paced=True, loop=2))
    free = played(ReplaySource(recording, loop=2))
    assert [(p.sequence, p.captured_at_ns, p.skew_us) for p in pairs] == [
        (p.sequence, p.captured_at_ns, p.skew_us) for p in free
    ]
    released = [pair.released_at_ns for pair in pairs if pair.released_at_ns is not None]
    assert len(released) == len(pairs)
    since_first = [
        (at - released[0], pair.captured_at_ns - LEFT_NS[0]) for at, pair in zip(released, pairs, strict=True)
    ]
    assert all(real_ns >= recorded_ns for real_ns, recorded_ns in since_first)


def test_a_consumer_that_is_always_late_gets_every_pair(tmp_path: Path) -> None:
    # A nanosecond apart: no consumer keeps up.
    recording = AslRecording(write_recording(tmp_path, range(MS, MS + 50)))
    source = ReplaySource(recording, paced=True)
    assert [pair.sequence for pair in played(source)] == list(range(50))
    assert source.dropped == {}


class Watched(AslRecording):
    """Says which pairs have been decoded."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.decoded = [threading.Event() for _ in range(len(self))]

    def read(self, index: int) -> StereoPair:
        try:
            return super().read(index)
        finally:
            self.decoded[index].set()


@pytest.mark.parametrize("paced", [True, False])
def test_the_next_pair_is_decoded_while_the_consumer_is_busy(tmp_path: Path, paced: bool) -> None:
    watched = Watched(write_recording(tmp_path, LEFT_NS))
    pairs = ReplaySource(watched, paced=paced).pairs(threading.Event())
    next(pairs)
    assert watched.decoded[1].wait(LONG_S)
    assert not watched.decoded[2].is_set()


# Stopping


def test_nothing_comes_after_stop(recording: AslRecording) -> None:
    stop = threading.Event()
    pairs = ReplaySource(recording).pairs(stop)
    next(pairs)
    stop.set()
    assert list(pairs) == []
    assert list(ReplaySource(recording).pairs(stop)) == []


def test_stop_ends_the_wait_for_the_next_release(tmp_path: Path) -> None:
    hour_ns = 3600 * 1000 * MS
    recording = AslRecording(write_recording(tmp_path, [MS, MS + hour_ns]))
    stop, first_came, got = threading.Event(), threading.Event(), []

    def consume() -> None:
        for pair in ReplaySource(recording, paced=True).pairs(stop):
            got.append(pair)
            first_came.set()

    consumer = threading.Thread(target=consume)
    consumer.start()
    assert first_came.wait(LONG_S)
    stop.set()
    consumer.join(LONG_S)
    assert not consumer.is_alive()
    assert len(got) == 1


def test_leaving_early_leaves_no_thread_behind(recording: AslRecording) -> None:
    pairs = ReplaySource(recording).pairs(threading.Event())
    next(pairs)
    assert any(thread.name.startswith("needletrack-decode") for thread in threading.enumerate())
    pairs.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("needletrack-decode") for thread in threading.enumerate())


def test_an_unforeseen_error_of_decoding_is_not_swallowed(tmp_path: Path) -> None:
    class Broken(AslRecording):
        def read(self, index: int) -> StereoPair:
            raise MemoryError(index)

    with pytest.raises(MemoryError):
        played(ReplaySource(Broken(write_recording(tmp_path, LEFT_NS))))
