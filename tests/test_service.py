"""The live loop on recorded pairs: what is tracked, what is dropped, and how it ends."""

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from needletrack.calibration.drift import Motion
from needletrack.calibration.tips import DriftParameters
from needletrack.errors import CaptureError, RecordingError
from needletrack.publish.message import RunContext, ServiceState, Source, TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import DropReason, NeedleTrack, Reason, Status, StereoPair
from needletrack.service import Arrival, LatestSlot, Service, Tracker
from needletrack.tracking.track import track_pair

RECORDINGS = Path(__file__).parent / "data" / "recordings"
# Only a hang takes so long.
WAIT_S = 60.0


@pytest.fixture(scope="module")
def recording() -> AslRecording:
    return AslRecording(RECORDINGS / "steer-b")


@pytest.fixture(scope="module")
def pair(recording: AslRecording) -> StereoPair:
    return recording.read(0)


@dataclass
class Kept:
    """A sink that keeps what it is given."""

    pairs: list[StereoPair] = field(default_factory=list)
    tracks: list[NeedleTrack] = field(default_factory=list)
    messages: list[TrackMessage] = field(default_factory=list)

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self.pairs.append(pair)
        self.tracks.append(track)
        self.messages.append(message)

    @property
    def sequences(self) -> list[int]:
        return [message.sequence for message in self.messages]


class Scripted:
    """A source whose script says what comes, what is lost, and what is waited for."""

    def __init__(self, pair: StereoPair, script: Iterable[int | DropReason | Callable[[], object]]) -> None:
        self._pair, self._script = pair, script
        self.counts: dict[DropReason, int] = {}

    @property
    def dropped(self) -> Mapping[DropReason, int]:
        return dict(self.counts)

    def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
        for step in self._script:
            if isinstance(step, DropReason):
                self.counts[step] = self.counts.get(step, 0) + 1
            elif isinstance(step, int):
                yield replace(self._pair, sequence=step)
            else:
                step()


class Held:
    """A tracker that finds nothing, and holds each pair until it is let go."""

    def __init__(self) -> None:
        self.began = threading.Semaphore(0)
        self.let_go = threading.Semaphore(0)

    def __call__(self, pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        self.began.release()
        assert self.let_go.acquire(timeout=WAIT_S)
        return nothing(pair, previous)

    def wait(self) -> None:
        assert self.began.acquire(timeout=WAIT_S)


def nothing(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
    return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))


def context(recording: AslRecording) -> RunContext:
    rig = recording.rig
    return RunContext(rig.name, Source.REPLAY, config_digest="c" * 12, rig_digest=rig.digest)


def test_every_frame_tracks_each_pair_in_order_from_the_one_before(recording: AslRecording) -> None:
    given: list[NeedleTrack | None] = []

    def tracker(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        given.append(previous)
        return track_pair(pair, recording.rig, None, previous)

    source, kept = ReplaySource(recording, start=2, end=6), Kept()
    service = Service(source, tracker, recording.rig, context(recording), every_frame=True)
    summary = service.run([kept], threading.Event())
    assert kept.sequences == [2, 3, 4, 5]
    assert [id(previous) for previous in given] == [id(None), *map(id, kept.tracks[:-1])]
    assert [message.captured_at_ns for message in kept.messages] == [
        listed.left.stamp_ns for listed in recording.pairs[2:6]
    ]
    # The bundled sequence shows a needle in every pair.
    assert all(message.centerline_mm for message in kept.messages)
    assert summary.pairs == 4
    assert len(summary.tracking_ms) == 4
    assert summary.dropped == {}


def test_independent_pairs_know_nothing_of_each_other(recording: AslRecording) -> None:
    given: list[NeedleTrack | None] = []

    def tracker(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        given.append(previous)
        return nothing(pair, previous)

    source = ReplaySource(recording, end=3)
    service = Service(source, tracker, recording.rig, context(recording), every_frame=True, independent=True)
    service.run([], threading.Event())
    assert given == [None, None, None]


def test_pairs_that_come_while_one_is_tracked_are_overwritten_and_counted(recording: AslRecording) -> None:
    tracker, kept = Held(), Kept()
    played = ReplaySource(recording)
    total = len(played)

    class OneAndThenAll:
        """Delivers the first pair, and all others while it is being tracked."""

        dropped: Mapping[DropReason, int] = {}

        def pairs(self, stop: threading.Event) -> Iterator[StereoPair]:
            pairs = played.pairs(stop)
            yield next(pairs)
            tracker.wait()
            yield from pairs
            tracker.let_go.release(2)

    service = Service(OneAndThenAll(), tracker, recording.rig, context(recording))
    summary = service.run([kept], threading.Event())
    assert kept.sequences == [0, total - 1]
    assert summary.dropped == {DropReason.OVERWRITTEN: total - 2}
    assert summary.pairs + summary.dropped[DropReason.OVERWRITTEN] == total
    assert kept.messages[0].dropped == {}
    assert kept.messages[1].dropped == {"overwritten": total - 2}


def test_a_gap_and_its_count_stand_in_the_same_message(recording: AslRecording, pair: StereoPair) -> None:
    tracker, kept = Held(), Kept()
    lost = DropReason.UNREADABLE_IMAGE
    # While pair 0 is held, pair 1 waits in the slot, and pair 2 is lost behind it.
    source = Scripted(
        pair,
        [
            0,
            tracker.wait,
            1,
            lost,
            tracker.let_go.release,
            tracker.wait,
            3,
            lambda: tracker.let_go.release(2),
        ],
    )
    Service(source, tracker, recording.rig, context(recording)).run([kept], threading.Event())
    assert kept.sequences == [0, 1, 3]
    assert [message.dropped for message in kept.messages] == [{}, {}, {"unreadable_image": 1}]


def test_what_the_source_loses_and_what_is_overwritten_add_up(recording: AslRecording, pair: StereoPair) -> None:
    tracker, kept = Held(), Kept()
    lost = DropReason.UNPAIRED_LEFT
    source = Scripted(pair, [lost, 0, tracker.wait, 1, 2, lost, 3, lambda: tracker.let_go.release(2)])
    service = Service(source, tracker, recording.rig, context(recording))
    summary = service.run([kept], threading.Event())
    assert kept.sequences == [0, 3]
    assert summary.dropped == {DropReason.UNPAIRED_LEFT: 2, DropReason.OVERWRITTEN: 2}
    assert kept.messages[-1].dropped == {"unpaired_left": 2, "overwritten": 2}
    assert service.dropped == summary.dropped
    assert summary.statuses == {Status.INVALID: 2}
    assert summary.reasons == {Reason.NO_CANDIDATE: 2}


def test_a_slot_gives_the_newest_pair_once(pair: StereoPair) -> None:
    slot = LatestSlot()
    for number in range(3):
        slot.put(Arrival(replace(pair, sequence=number), {}))
    slot.close()
    newest = slot.take()
    assert newest is not None
    assert newest.pair.sequence == 2
    assert newest.dropped == {DropReason.OVERWRITTEN: 2}
    assert slot.take() is None


@pytest.mark.parametrize("every_frame", [True, False])
def test_what_a_source_raises_ends_the_run(recording: AslRecording, pair: StereoPair, every_frame: bool) -> None:
    def unplugged() -> None:
        raise CaptureError("left camera unplugged")

    kept = Kept()
    service = Service(
        Scripted(pair, [0, unplugged]), nothing, recording.rig, context(recording), every_frame=every_frame
    )
    with pytest.raises(CaptureError, match="left camera unplugged"):
        service.run([kept], threading.Event())
    assert kept.sequences == [0]
    assert service.status().state is ServiceState.STOPPING


@pytest.mark.parametrize("every_frame", [True, False])
@pytest.mark.parametrize("failing", ["tracker", "sink"])
def test_what_tracker_or_sink_raises_ends_the_run_and_the_capture(
    recording: AslRecording, pair: StereoPair, every_frame: bool, failing: str
) -> None:
    def full(pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        raise RecordingError("disk full")

    def broken(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        raise RecordingError("disk full")

    class Full:
        take = staticmethod(full)

    stop = threading.Event()

    def endless() -> Iterator[int]:
        number = 0
        while not stop.is_set():
            yield number
            number += 1

    tracker = broken if failing == "tracker" else nothing
    service = Service(Scripted(pair, endless()), tracker, recording.rig, context(recording), every_frame=every_frame)
    with pytest.raises(RecordingError, match="disk full"):
        service.run([Full()], stop)
    assert "needletrack-capture" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize("every_frame", [True, False])
def test_the_stop_event_ends_a_replay_with_its_summary(recording: AslRecording, every_frame: bool) -> None:
    stop, kept = threading.Event(), Kept()

    class StopAfterTwo:
        def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
            if len(kept.messages) == 2:
                stop.set()

    # So many passes would take longer than a test may.
    source = ReplaySource(recording, loop=100_000)
    service = Service(source, nothing, recording.rig, context(recording), every_frame=every_frame)
    summary = service.run([kept, StopAfterTwo()], stop)
    # One more pair may have been waiting in the slot.
    assert summary.pairs == len(kept.messages)
    assert summary.pairs == 2 if every_frame else summary.pairs in (2, 3)


def test_a_stop_reaches_a_paced_replay_that_waits_for_the_next_pair(recording: AslRecording) -> None:
    stop = threading.Event()

    class StopAtOnce:
        def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
            stop.set()

    source = ReplaySource(recording, paced=True, loop=100_000)
    summary = Service(source, nothing, recording.rig, context(recording)).run([StopAtOnce()], stop)
    assert 1 <= summary.pairs <= 2


def test_the_status_counts_and_gives_rates_since_the_last_one(recording: AslRecording) -> None:
    source = ReplaySource(recording, end=4)
    service = Service(source, nothing, recording.rig, context(recording), every_frame=True, heartbeat_s=0.25)
    before = service.status()
    assert before.state is ServiceState.STARTING
    assert before.last_sequence is None
    assert before.rates.pairs_per_s == 0
    running: list[ServiceState] = []

    class Ask:
        def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
            if pair.sequence == 0:
                running.append(service.status().state)

    service.run([Ask()], threading.Event())
    after, later = service.status(), service.status()
    assert running == [ServiceState.RUNNING]
    assert after.state is ServiceState.STOPPING
    assert after.last_sequence == 3
    assert after.counters == {"tracks_ok": 0, "tracks_degraded": 0, "tracks_invalid": 4}
    assert after.rates.tracks_per_s["invalid"] == after.rates.pairs_per_s > 0
    assert after.rates.tracks_per_s["ok"] == 0
    assert later.rates.pairs_per_s == 0
    assert after.heartbeat_s == 0.25
    assert (after.rig, after.rig_digest) == (recording.rig.name, recording.rig.digest)


def test_a_pitched_camera_is_noticed_and_said_and_tracking_goes_on_from_its_own_track(recording: AslRecording) -> None:
    # As if the right camera had been turned by 0.1 degrees since the calibration.
    rig = recording.rig
    bumped = Motion(turn_deg=np.array([-0.1, 0.0, 0.0])).applied_to(rig)
    before = replace(rig, right_from_left=bumped.right_from_left)
    given: list[NeedleTrack | None] = []

    def tracker(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
        given.append(previous)
        return track_pair(pair, before, None, previous)

    kept = Kept()
    source = ReplaySource(AslRecording(recording.folder, before))
    drift = DriftParameters(least_pairs=5)
    service = Service(source, tracker, before, context(recording), every_frame=True, drift=drift)
    service.run([kept], threading.Event())
    told = [Reason.CALIBRATION_DRIFT in track.reasons for track in kept.tracks]
    # Not before there are tips enough to tell, and then for good.
    first = told.index(True)
    assert 4 <= first <= 10
    assert all(told[first:])
    assert all(track.status is not Status.OK for track in kept.tracks[first:])
    assert "calibration_drift" in kept.messages[first].reasons
    assert all(previous is None or Reason.CALIBRATION_DRIFT not in previous.reasons for previous in given)
    # The rig as it is has no such thing.
    kept = Kept()
    Service(
        ReplaySource(recording),
        lambda pair, previous: track_pair(pair, rig, None, previous),
        rig,
        context(recording),
        every_frame=True,
        drift=drift,
    ).run([kept], threading.Event())
    assert not any(Reason.CALIBRATION_DRIFT in track.reasons for track in kept.tracks)


def test_what_is_ordered_holds_from_the_next_pair_on(recording: AslRecording, pair: StereoPair) -> None:
    given: list[tuple[str, NeedleTrack | None]] = []

    def tracker(name: str) -> Tracker:
        def tracked(pair: StereoPair, previous: NeedleTrack | None) -> NeedleTrack:
            given.append((name, previous))
            if name == "orders while it tracks":
                ordered.append(service.use(tracker("second"), "d" * 12))
            return nothing(pair, previous)

        return tracked

    ordered: list[int | None] = []
    script: list[int | Callable[[], object]] = [
        lambda: ordered.append(service.forget()),
        3,
        4,
        lambda: ordered.append(service.forget()),
        5,
        6,
        lambda: service.use(tracker("orders while it tracks"), "e" * 12),
        7,
        8,
        9,
    ]
    kept = Kept()
    service = Service(Scripted(pair, script), tracker("first"), recording.rig, context(recording), every_frame=True)
    service.run([kept], threading.Event())
    assert ordered == [None, 4, 7]
    assert [name for name, _ in given] == ["first"] * 4 + ["orders while it tracks"] + ["second"] * 2
    tracks = kept.tracks
    remembered = [None, tracks[0], None, tracks[2], None, None, tracks[5]]
    assert [previous for _, previous in given] == remembered
    # A pair that was taken up before an order is published as what it was tracked as.
    digests = [message.config_digest[0] for message in kept.messages]
    assert digests == ["c", "c", "c", "c", "e", "d", "d"]
    assert service.status().config_digest == "d" * 12
    assert len({message.run_id for message in kept.messages}) == 1
