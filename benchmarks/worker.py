"""What the live loop's worker does with a pair, timed: tracking beside a second process, and the message."""

from benchmarks.measure import Lap, Stopwatch
from needletrack.publish.message import Instant, RunContext, Source, TrackMessage
from needletrack.records import NeedleTrack, Status, StereoPair
from needletrack.rig import Rig
from needletrack.service import Tracker

SEARCHED = "searched in the whole images"
FOLLOWED = "followed from the pair before"
LOST = "lost"


def run_of(rig: Rig) -> RunContext:
    """The run that a benchmark's messages belong to."""
    return RunContext(rig.name, Source.REPLAY, config_digest="benchmark", rig_digest=rig.digest)


class Worker:
    """The tracker and the message's making up to its bytes; `track` is the last one, `statuses` those of all pairs."""

    def __init__(self, rig: Rig, tracker: Tracker) -> None:
        self.track: NeedleTrack | None = None
        self.statuses: list[Status] = []
        self._tracker, self._run = tracker, run_of(rig)

    def __call__(self, pair: StereoPair) -> Lap:
        """Track the pair and build its message."""
        message = Stopwatch()
        with Stopwatch() as whole:
            track = self._tracker(pair, self.track)
            with message:
                TrackMessage.from_track(track, pair, self._run, dropped={}, published=Instant.now()).to_json()
        self.track = track
        self.statuses.append(track.status)
        kind = LOST if track.curve is None else FOLLOWED if track.since_detection else SEARCHED
        return Lap(whole.wall_ms, whole.cpu_ms, {**track.timing_ms, "message": message.wall_ms}, kind)
