"""One stereo pair, and the track before it, to one needle track: every stage in order.

detect (segment -> centerline -> match, triangulating) -> refine (axis, fit, ends) -> gates. With a previous track,
detection is skipped as long as refinement from where the needle was holds.
"""

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import distance_from_curve, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Evidence, Frame, Image, NeedleTrack, Reason, Status, StereoPair
from needletrack.tracking.adjust import Images
from needletrack.tracking.detect import detect
from needletrack.tracking.fit import initial_curve
from needletrack.tracking.match import Candidate
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import RefineModels, refine
from needletrack.tracking.shape import Shape, as_track, differ, judged
from needletrack.tracking.stopwatch import Stopwatch

# Candidates this close to the best one in score are examined as well: two that hold make the shape ambiguous.
_RIVAL_SHARE = 0.4
# A weak track is searched for anew once in so many pairs, sooner where its shape is in doubt; one that holds is not.
_PAIRS_PER_SEARCH = 15
_PAIRS_PER_SEARCH_IN_DOUBT = 5
# What is detected so near to a tip, not behind it, and so long may be more of the needle: the far side of a hook.
_GOES_ON_WITHIN_MM, _GOES_ON_COSINE, _GOES_ON_MM = 40.0, -0.3, 4.0
_APART_PX = 8.0
_IN_DOUBT = {Reason.AMBIGUOUS_BASE, Reason.LOW_COVERAGE, Reason.HIGH_RESIDUAL, Reason.HIGH_UNCERTAINTY}


def track(
    left: Image,
    right: Image,
    rig: StereoRig,
    parameters: TrackingParameters | None = None,
    previous: NeedleTrack | None = None,
) -> NeedleTrack:
    """The needle in a left and a right image (rows, columns) of uint8: `track_pair` for a notebook, without stamps."""
    return track_pair(StereoPair(Frame(left, 0), Frame(right, 0), 0), rig, parameters, previous)


def track_pair(
    pair: StereoPair,
    rig: StereoRig,
    parameters: TrackingParameters | None = None,
    previous: NeedleTrack | None = None,
) -> NeedleTrack:
    """The needle's shape, tip and base in space, with its status; never raises for what the images show.

    `previous` is the track of the pair before, or None to start without memory. Raises ValueError where the images do
    not have the rig's size.
    """
    parameters = parameters or TrackingParameters()
    images = (pair.left.image, pair.right.image)
    for image, camera, side in zip(images, (rig.left, rig.right), ("left", "right"), strict=True):
        if image.shape != camera.size_px[::-1]:
            raise ValueError(f"the {side} image is {image.shape[1]}x{image.shape[0]}, the rig says {camera.size_px}")
    stopwatch = Stopwatch()
    followed = _followed(images, rig, parameters, previous, pair.captured_at_ns, stopwatch)
    if previous is not None and followed is not None:
        since = previous.since_detection + 1
        return as_track(followed, pair.captured_at_ns, previous, since, Evidence(), stopwatch.elapsed_ms)
    try:
        shape, found = _searched(images, rig, parameters, previous, stopwatch)
    except NeedleNotFound as lost:
        return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason(lost.reason),), timing_ms=stopwatch.elapsed_ms)
    evidence = Evidence(found.left, found.right, found.correspondences)
    return as_track(shape, pair.captured_at_ns, previous, 0, evidence, stopwatch.elapsed_ms)


def _followed(
    images: Images,
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
    captured_at_ns: int,
    stopwatch: Stopwatch,
) -> Shape | None:
    """The needle refined from where it was, or None where that does not hold or a search is due."""
    if previous is None or previous.curve is None:
        return None
    try:
        with stopwatch("refine"):
            points_mm = previous.curve.points_mm
            since_s = (captured_at_ns - previous.captured_at_ns) * 1e-9
            refined = refine(images, rig, points_mm, _models(parameters), previous=previous, since_s=since_s)
            shape = judged(refined, rig, parameters, previous).doubted(previous.doubts)
    except NeedleNotFound:
        # Lost is not yet gone: the search that follows decides, and its reason is the one that is told.
        return None
    allowed = _PAIRS_PER_SEARCH_IN_DOUBT if _IN_DOUBT & set(shape.reasons) or shape.doubts else _PAIRS_PER_SEARCH
    return shape if not shape.reasons or previous.since_detection + 1 < allowed else None


def _searched(
    images: Images,
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
    stopwatch: Stopwatch,
) -> tuple[Shape, Candidate]:
    """The best shape that the whole images hold, and what it was detected as; raises NeedleNotFound."""
    candidates = detect(images, rig, parameters, stopwatch)
    found: list[tuple[Shape, Candidate]] = []
    lost: list[NeedleNotFound] = []
    for candidate in candidates:
        # What is much worse matched is examined only for want of a shape that holds.
        if candidate.score < _RIVAL_SHARE * candidates[0].score and any(not shape.reasons for shape, _ in found):
            continue
        try:
            with stopwatch("refine"):
                rough_mm = initial_curve(
                    candidate.points_mm, candidate.confidence, parameters.refine.spacing_mm, parameters.fit
                )
                refined = refine(images, rig, rough_mm, _models(parameters))
                found.append((judged(refined, rig, parameters, previous), candidate))
        except NeedleNotFound as error:
            lost.append(error)
    if not found:
        raise lost[0]
    # What begins at a sleeve is a needle rather than what is longer: vessels and rods are long.
    best, candidate = min(
        found,
        key=lambda each: (
            bool(each[0].reasons),
            Reason.AMBIGUOUS_BASE in each[0].reasons,
            -each[0].refined.log_odds * each[1].plausible,
        ),
    )
    if not best.reasons and any(not shape.reasons and differ(shape, best) for shape, _ in found):
        best = best.doubted([Reason.AMBIGUOUS_SHAPE])
    if _may_go_on(best, candidates, rig):
        best = best.doubted([Reason.TIP_NOT_SEEN])
    return best, candidate


def _may_go_on(shape: Shape, candidates: list[Candidate], rig: StereoRig) -> bool:
    """Whether something was detected ahead of the tip that may be more of the needle, behind a stretch without."""
    points = shape.curve.points_mm
    ahead = unit(points[-1] - points[-4])
    for candidate in candidates:
        # What lies on the needle in one view is a ghost of it: its rim in one view paired with its streak in the other.
        apart = [
            distance_from_curve(other, own)
            for other, own in zip(rig.project(candidate.points_mm), rig.project(points), strict=True)
        ]
        other = candidate.points_mm[np.min(apart, axis=0) > _APART_PX]
        gap = other - points[-1]
        near = np.linalg.norm(gap, axis=1) < _GOES_ON_WITHIN_MM
        near &= (unit(gap) @ ahead) > _GOES_ON_COSINE
        if near.any() and np.linalg.norm(np.ptp(other[near], axis=0)) > _GOES_ON_MM:
            return True
    return False


def _models(parameters: TrackingParameters) -> RefineModels:
    return RefineModels(
        parameters.needle,
        parameters.workspace,
        parameters.beside,
        parameters.fit,
        parameters.ends,
        parameters.tip,
        parameters.refine,
    )
