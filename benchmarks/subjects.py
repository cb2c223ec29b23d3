"""What is timed on each pair: needletrack, the method of 2017, and the floor below both."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.measure import Lap, Stopwatch
from benchmarks.worker import SEARCHED
from needletrack.errors import NeedleNotFound
from needletrack.recording.asl import AslRecording
from needletrack.records import Float, Image, Reason, Status, StereoPair
from needletrack.rig import Rig
from needletrack.tracking import reference
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.reference import ReferenceParameters
from needletrack.tracking.track import track_pair

# What stands beside the whole is timed once in so many pairs of a long run: the double loop takes 75 ms.
BESIDE_EVERY = 10

Data = npt.NDArray[np.uint8]


class Searching:
    """`track_pair` without memory; statuses: of every pair so far."""

    def __init__(self, rig: Rig) -> None:
        self.statuses: list[Status] = []
        self._rig, self._parameters = rig, TrackingParameters()

    def __call__(self, pair: StereoPair) -> Lap:
        """Track the pair; its stages are those that the track itself tells."""
        with Stopwatch() as whole:
            track = track_pair(pair, self._rig, self._parameters)
        self.statuses.append(track.status)
        return Lap(whole.wall_ms, whole.cpu_ms, track.timing_ms, SEARCHED)


class Reference:
    """The stages of the 2017 method, one after the other as `reference.reference_stages` runs them.

    The whole goes from the images to the points in space, matching by distance map. Beside it: matching by
    double loop, and the projection error, which judges and does not track. What `track_reference` adds to
    fill our records is left out, in the method's favour. points_mm: of the last pair.
    """

    def __init__(self, rig: Rig) -> None:
        self.points_mm: Float | None = None
        self._rig = rig
        self._parameters = ReferenceParameters()
        self._calls = 0

    def __call__(self, pair: StereoPair) -> Lap:
        """Run every stage; a pair on which the method finds nothing has no label and no times."""
        self._calls += 1
        try:
            return self._lap((pair.left.image, pair.right.image))
        except NeedleNotFound:
            return Lap(0.0, 0.0, {}, None)

    def _lap(self, images: tuple[Image, Image]) -> Lap:
        parameters, rig = self._parameters, self._rig
        segmentation, skeleton, matching, reconstruction = (Stopwatch() for _ in range(4))
        loop, judging = Stopwatch(), Stopwatch()
        with Stopwatch() as whole:
            with segmentation:
                regions = [reference.segment(image, parameters) for image in images]
            with skeleton:
                left_px, right_px = (
                    camera.undistort(reference.skeleton(region))
                    for camera, region in zip((rig.left, rig.right), regions, strict=True)
                )
                left_kept_px, right_kept_px = left_px[:: parameters.k], right_px[:: parameters.k]
            with matching:
                f = reference.fundamental_matrix(rig, parameters.fundamental_scale)
                residuals = reference.distance_map(f, left_kept_px, right_kept_px)
                pairs = reference.pairs_in_map(residuals, parameters.threshold)
            with reconstruction:
                points_mm = reference.reconstruct(
                    rig, left_kept_px[pairs[:, 0]], right_kept_px[pairs[:, 1]], parameters.triangulation
                )
                points_mm = points_mm[np.isfinite(points_mm).all(axis=1) & (points_mm[:, 2] != 0)]
        if len(points_mm) == 0:
            raise NeedleNotFound("match", Reason.NO_STEREO_MATCH)
        self.points_mm = points_mm
        beside_ms: dict[str, float] = {}
        if self._calls % BESIDE_EVERY == 1:
            with loop:
                reference.pairs_by_loop(f, left_kept_px, right_kept_px, parameters.threshold)
            with judging:
                reference.projection_error(rig, points_mm, left_px, right_px)
            beside_ms = {
                "matching by double loop": loop.wall_ms,
                "matching by double loop, and reconstruction": loop.wall_ms + reconstruction.wall_ms,
                "matching by map, and reconstruction": matching.wall_ms + reconstruction.wall_ms,
                "projection error": judging.wall_ms,
            }
        return Lap(
            whole.wall_ms,
            whole.cpu_ms,
            {
                "segmentation": segmentation.wall_ms,
                "skeleton": skeleton.wall_ms,
                "matching": matching.wall_ms,
                "reconstruction": reconstruction.wall_ms,
            },
            "",
            beside_ms,
        )


class Reading:
    """Both images read once from memory: the fastest pass there is, a sum.

    OpenCV's, since NumPy's widens every byte first and takes twenty times as long.
    """

    def __call__(self, pair: StereoPair) -> Lap:
        """Sum both images."""
        with Stopwatch() as whole:
            cv2.sumElems(pair.left.image)
            cv2.sumElems(pair.right.image)
        return Lap(whole.wall_ms, whole.cpu_ms, {}, "")


class Decoding:
    """Both PNGs of a pair decoded from bytes in memory; beside it, read from files as a replay does (read)."""

    def __init__(self, files: Sequence[Sequence[Data]], read: Callable[[int], object] | None = None) -> None:
        self._files, self._read = files, read
        self._next = 0

    @classmethod
    def of_recording(cls, recording: AslRecording) -> Self:
        """The PNGs of a recording."""
        files = [[np.fromfile(frame.path, np.uint8) for frame in (pair.left, pair.right)] for pair in recording.pairs]
        # A preloaded recording's own `read` decodes nothing.
        return cls(files, partial(AslRecording.read, recording))

    @classmethod
    def of_pairs(cls, pairs: Sequence[StereoPair]) -> Self:
        """Drawn pairs, written as PNGs to memory."""
        return cls([[cv2.imencode(".png", frame.image)[1] for frame in (pair.left, pair.right)] for pair in pairs])

    def __call__(self, pair: StereoPair) -> Lap:
        """Decode the next pair in its own order: every pair costs about the same."""
        index = self._next
        self._next = (index + 1) % len(self._files)
        with Stopwatch() as whole:
            for data in self._files[index]:
                cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if self._read is None:
            return Lap(whole.wall_ms, whole.cpu_ms, {}, "")
        with Stopwatch() as read:
            self._read(index)
        return Lap(whole.wall_ms, whole.cpu_ms, {}, "", {"read, check and decode both files": read.wall_ms})
