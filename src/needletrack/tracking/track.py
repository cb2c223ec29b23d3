"""One stereo pair, and the track before it, to one needle track: every stage in order.

Search: detect (segment -> centerline -> match, triangulating) -> refine (axis, fit, ends) -> gates. With a previous
track the needle is followed: one glance at where it must be -> gates. Once in a few pairs what is followed is audited
by what a search finds; where cameras are faster than that, the audit may be of a pair a little before.
"""

from dataclasses import replace

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import distance_from_curve, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Evidence, Float, Frame, Image, NeedleTrack, Reason, Status, StereoPair
from needletrack.tracking.adjust import Images
from needletrack.tracking.detect import detect
from needletrack.tracking.fit import initial_curve
from needletrack.tracking.glance import MOST_LOOKS, SETTLED_MM
from needletrack.tracking.match import Candidate
from needletrack.tracking.motion import moving_like
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import (
    Glanced,
    RefineModels,
    Traced,
    glanced,
    is_line_beyond,
    refine,
    settled,
    trace,
)
from needletrack.tracking.shape import Shape, as_track, differ, judged
from needletrack.tracking.silhouette import make_banks, unit_mm
from needletrack.tracking.stopwatch import Stopwatch

# Candidates this close to the best one in score are examined as well: two that hold make the shape ambiguous.
_RIVAL_SHARE = 0.4
# What is followed is audited once in so many pairs; what is weak sooner.
PAIRS_PER_AUDIT, PAIRS_PER_AUDIT_OF_WEAK = 6, 2
# A detected line is of the shape that is followed where this share of it lies within so many pixels of it.
_CONFIRMED_SHARE, _CONFIRMED_PX = 0.5, 5.0
# What is detected so near to a tip, not behind it, and so long may be more of the needle: the far side of a hook.
_GOES_ON_WITHIN_MM, _GOES_ON_COSINE, _GOES_ON_MM = 40.0, -0.3, 4.0
# Farther away than so much it has to lead to the tip, where it is nearest, by this cosine: rods and vessels pass by.
_FAR_MM, _LEADS_COSINE = 20.0, 0.5
_APART_PX = 8.0
# Tips within so much of each other are the same: an audit confirms one that was followed there, mm.
_SAME_TIP_MM = 1.0
# What still moves so far when it was looked at as often as it is looked at is not known well enough, mm.
_UNSETTLED_MM = 0.3


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
    followed = None if previous is None else follow(pair, rig, parameters, previous)
    if followed is None or followed.curve is None:
        # Lost is not yet gone: the search decides, and its reason is the one that is told.
        return search(pair, rig, parameters, previous)
    if followed.since_detection < (PAIRS_PER_AUDIT_OF_WEAK if followed.reasons else PAIRS_PER_AUDIT):
        return followed
    return adopted(followed, audit(pair, rig, parameters, followed))


def follow(pair: StereoPair, rig: StereoRig, parameters: TrackingParameters, previous: NeedleTrack) -> NeedleTrack:
    """The needle of a pair before in this one; invalid where it is not where it must be: it has to be searched for.

    Raises ValueError where the images do not have the rig's size.
    """
    images, stopwatch = _images(pair, rig), Stopwatch()
    if previous.curve is None:
        return NeedleTrack(pair.captured_at_ns, Status.INVALID, previous.reasons)
    try:
        with stopwatch("refine"):
            models, since_s = _models(parameters), (pair.captured_at_ns - previous.captured_at_ns) * 1e-9
            seen = glanced(images, rig, models, previous=previous, since_s=since_s)
            if seen is None:
                points_mm = previous.curve.points_mm
                refined = refine(images, rig, points_mm, models, previous=previous, since_s=since_s)
                shape = judged(refined, rig, parameters, previous)
            else:
                shape = _settled(seen, images, rig, parameters, previous, since_s)
            # What was weak is not good again for looking so: it may have slid to what looks like its tip.
            shape = shape.doubted(_doubts_after(previous))
    except NeedleNotFound as lost:
        return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason(lost.reason),), timing_ms=stopwatch.elapsed_ms)
    since = previous.since_detection + 1
    return as_track(shape, pair.captured_at_ns, previous, since, Evidence(), stopwatch.elapsed_ms)


def _doubts_after(track: NeedleTrack) -> tuple[Reason, ...]:
    """What is doubtful of a needle that is followed from a track: that it is the needle, where that was weak."""
    return (*track.doubts, Reason.AMBIGUOUS_SHAPE) if set(track.reasons) - {Reason.JUMP} else track.doubts


def _settled(
    first: Glanced,
    images: Images,
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack,
    since_s: float,
) -> Shape:
    """What a first glance found, looked at again from there until that changes it no more; raises NeedleNotFound.

    What is weak in a way that it was not before is worth a second look as well. What still changes after some looks is
    not known better than that.
    """
    glance, looks = first, first.looks
    shape = judged(glance.refined, rig, parameters, previous)
    # Of 59 second looks at what was weak in the same way before, none made it good.
    newly_weak = looks == 1 and bool(set(shape.reasons) - set(previous.reasons))
    while looks < MOST_LOOKS and (glance.aside_mm >= SETTLED_MM or newly_weak):
        try:
            again = glanced(
                images,
                rig,
                _models(parameters),
                previous=previous,
                since_s=since_s,
                first_mm=glance.refined.fit.points_mm,
                is_astray=glance.aside_mm >= SETTLED_MM,
                most_looks=MOST_LOOKS - looks,
            )
            if again is None:
                break
            seen = judged(again.refined, rig, parameters, previous)
        except NeedleNotFound:
            break
        if glance.aside_mm >= SETTLED_MM or len(seen.reasons) < len(shape.reasons):
            shape = seen
        glance, looks, newly_weak = again, looks + again.looks, False
    return shape if glance.aside_mm < _UNSETTLED_MM else shape.weakened([Reason.HIGH_UNCERTAINTY])


def search(
    pair: StereoPair, rig: StereoRig, parameters: TrackingParameters, previous: NeedleTrack | None = None
) -> NeedleTrack:
    """The needle in the whole images, wherever it was; raises ValueError where they do not have the rig's size."""
    images, stopwatch = _images(pair, rig), Stopwatch()
    try:
        candidates = detect(images, rig, parameters, stopwatch)
        shape, found = _best(candidates, [], images, rig, parameters, previous, stopwatch)
        if _may_go_on(shape, candidates, images, rig, parameters):
            shape = shape.doubted([Reason.TIP_NOT_SEEN])
    except NeedleNotFound as lost:
        lost_for = (Reason(lost.reason),)
        track = NeedleTrack(pair.captured_at_ns, Status.INVALID, lost_for, timing_ms=stopwatch.elapsed_ms)
    else:
        evidence = Evidence() if found is None else Evidence(found.left, found.right, found.correspondences)
        track = as_track(shape, pair.captured_at_ns, previous, 0, evidence, stopwatch.elapsed_ms)
    return replace(track, searched_sequence=pair.sequence)


def warm_up(rig: StereoRig, parameters: TrackingParameters) -> None:
    """Make ready what the first search needs: it takes a multiple of the next ones."""
    blank = Frame(np.zeros(rig.left.size_px[::-1], np.uint8), 0)
    search(StereoPair(blank, blank, 0), rig, parameters)
    depth_mm = (parameters.workspace.z_mm.min + parameters.workspace.z_mm.max) / 2
    make_banks(parameters.needle, rig.left.focal_px * unit_mm(parameters.needle) / depth_mm)


def audit(pair: StereoPair, rig: StereoRig, parameters: TrackingParameters, followed: NeedleTrack) -> NeedleTrack:
    """What a second, thorough look at a pair makes of the track that was followed to it.

    That track as it is seen without haste, another one that explains the whole images better, or the same with doubts:
    of what nothing else confirms. Raises ValueError where the images do not have the rig's size.
    """
    if followed.curve is None:
        raise ValueError("there is no shape to audit")
    images, stopwatch = _images(pair, rig), Stopwatch()
    own: list[tuple[Shape, Candidate | None]] = []
    try:
        with stopwatch("refine"):
            refined = refine(images, rig, followed.curve.points_mm, _models(parameters), previous=followed)
            own = [(judged(refined, rig, parameters, None), None)]
    except NeedleNotFound:
        pass
    try:
        candidates = detect(images, rig, parameters, stopwatch)
    except NeedleNotFound:
        candidates = []
    curve_mm = own[0][0].curve.points_mm if own else followed.curve.points_mm
    of_it = [_is_of(candidate, curve_mm, rig) for candidate in candidates]
    confirming = max((c.score for c, mine in zip(candidates, of_it, strict=True) if mine), default=0.0)
    holds = bool(own) and not own[0][0].reasons and _ends_at(own[0][0], followed.curve.points_mm[-1])
    # A shape that holds, to the tip that was followed, is compared with what was detected more clearly than itself; one
    # that does not, with all: what lies along it too may be the needle of which this is a part, or that goes astray.
    rivals = [c for c, mine in zip(candidates, of_it, strict=True) if not (holds and (mine or c.score < confirming))]
    try:
        shape, _ = _best(rivals, own, images, rig, parameters, None, stopwatch)
    except NeedleNotFound:
        return replace(with_doubts(followed, (Reason.AMBIGUOUS_SHAPE,)), searched_sequence=pair.sequence)
    if not any(_is_of(candidate, shape.curve.points_mm, rig) for candidate in candidates):
        shape = shape.doubted([Reason.AMBIGUOUS_SHAPE])
    elif _may_go_on(shape, candidates, images, rig, parameters):
        shape = shape.doubted([Reason.TIP_NOT_SEEN])
    track = as_track(shape, pair.captured_at_ns, None, 0, Evidence(), stopwatch.elapsed_ms)
    track = replace(track, searched_sequence=pair.sequence)
    if track.tip is None or followed.tip is None or _differ(track, followed):
        return track
    assert track.curve is not None
    assert followed.curve is not None
    moving = moving_like(track.curve, followed.curve)
    return replace(track, curve=moving, tip=replace(track.tip, velocity_mm_s=followed.tip.velocity_mm_s))


def adopted(now: NeedleTrack, audited: NeedleTrack, followed: NeedleTrack | None = None) -> NeedleTrack:
    """The track to go on from, of what has been followed until now and what an audit made of it at its own time.

    What an audit of a pair before found in the same place lends its looks and doubts, and is doubtful where it was weak
    itself; what it found elsewhere, or found to end elsewhere than was followed to that pair, is gone on from instead.
    """
    if audited.captured_at_ns == now.captured_at_ns:
        return replace(audited, timing_ms={**now.timing_ms, **audited.timing_ms})
    if audited.curve is None or now.curve is None or _differ(audited, now):
        return audited
    ends_mm = [each.curve.points_mm[-1] for each in (audited, followed) if each is not None and each.curve is not None]
    if len(ends_mm) == 2 and np.linalg.norm(ends_mm[0] - ends_mm[1]) >= _SAME_TIP_MM:
        return audited
    doubted = with_doubts(now, _doubts_after(audited))
    return replace(doubted, appearance=audited.appearance, diameter_mm=audited.diameter_mm, since_detection=0)


def with_doubts(track: NeedleTrack, doubts: tuple[Reason, ...]) -> NeedleTrack:
    """The track with these doubts, and no others."""
    both = (set(track.reasons) - set(track.doubts)) | set(doubts)
    reasons = tuple(reason for reason in Reason if reason in both)
    return replace(
        track,
        status=Status.DEGRADED if reasons or track.tip is None else Status.OK,
        reasons=reasons or (() if track.tip is not None else (Reason.TIP_NOT_SEEN,)),
        tip=None if Reason.TIP_NOT_SEEN in reasons else track.tip,
        doubts=doubts,
        since_detection=0,
    )


def _images(pair: StereoPair, rig: StereoRig) -> Images:
    images = (pair.left.image, pair.right.image)
    for image, camera, side in zip(images, (rig.left, rig.right), ("left", "right"), strict=True):
        if image.shape != camera.size_px[::-1]:
            raise ValueError(f"the {side} image is {image.shape[1]}x{image.shape[0]}, the rig says {camera.size_px}")
    return images


def _differ(track: NeedleTrack, other: NeedleTrack) -> bool:
    return track.curve is None or other.curve is None or differ(track.curve, other.curve)


def _ends_alike(shape: Shape, other: Shape) -> bool:
    return _ends_at(shape, other.curve.points_mm[-1])


def _ends_at(shape: Shape, tip_mm: Float) -> bool:
    return bool(np.linalg.norm(shape.curve.points_mm[-1] - tip_mm) < _SAME_TIP_MM)


def _is_of(candidate: Candidate, points_mm: Float, rig: StereoRig) -> bool:
    """Whether a candidate is of a curve (N, 3), as both views show it."""
    apart = [
        distance_from_curve(other, own)
        for other, own in zip(rig.project(candidate.points_mm), rig.project(points_mm), strict=True)
    ]
    return float((np.max(apart, axis=0) < _CONFIRMED_PX).mean()) > _CONFIRMED_SHARE


def _best(
    candidates: list[Candidate],
    known: list[tuple[Shape, Candidate | None]],
    images: Images,
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
    stopwatch: Stopwatch,
) -> tuple[Shape, Candidate | None]:
    """The best of the shapes that are known and that candidates lead to; raises NeedleNotFound where there is none."""
    found = [*known]
    lost: list[NeedleNotFound] = []
    baseless: list[tuple[Traced, Candidate]] = []

    def settle(traced: Traced, candidate: Candidate) -> None:
        refined = settled(images, rig, traced, _models(parameters))
        found.append((judged(refined, rig, parameters, previous), candidate))

    def any_holds() -> bool:
        return any(not shape.reasons for shape, _ in found)

    for candidate in candidates:
        # What is much worse matched is examined only for want of a shape that holds.
        if candidate.score < _RIVAL_SHARE * candidates[0].score and any_holds():
            continue
        # What lies along a shape that holds leads to it once more.
        if any(
            led_to is not None and not shape.reasons and _is_of(candidate, shape.curve.points_mm, rig)
            for shape, led_to in found
        ):
            continue
        try:
            with stopwatch("refine"):
                rough_mm = initial_curve(
                    candidate.points_mm, candidate.confidence, parameters.refine.spacing_mm, parameters.fit
                )
                traced = trace(images, rig, rough_mm, _models(parameters))
                if traced.base_is_known:
                    settle(traced, candidate)
                else:
                    baseless.append((traced, candidate))
        except NeedleNotFound as error:
            lost.append(error)
    # What has no base does not hold: it matters only where nothing does.
    for traced, candidate in () if any_holds() else baseless:
        try:
            with stopwatch("refine"):
                settle(traced, candidate)
        except NeedleNotFound as error:
            lost.append(error)
    if not found:
        raise lost[0] if lost else NeedleNotFound("track", Reason.NO_STEREO_MATCH)
    # What begins at a sleeve is a needle rather than what is longer: vessels and rods are long.
    best, led_to = min(
        found,
        key=lambda each: (
            bool(each[0].reasons),
            Reason.AMBIGUOUS_BASE in each[0].reasons,
            -each[0].refined.log_odds * (1.0 if each[1] is None else each[1].plausible),
        ),
    )
    if not best.reasons and any(not shape.reasons and differ(shape.curve, best.curve) for shape, _ in found):
        best = best.doubted([Reason.AMBIGUOUS_SHAPE])
    # Fits of one needle that end at different places do not know where it ends.
    if not best.reasons and any(not shape.reasons and not _ends_alike(shape, best) for shape, _ in found):
        best = best.doubted([Reason.TIP_NOT_SEEN])
    return best, led_to


def _may_go_on(
    shape: Shape, candidates: list[Candidate], images: Images, rig: StereoRig, parameters: TrackingParameters
) -> bool:
    """Whether a line goes on beyond the tip, or something was detected ahead of it, that may be more of the needle."""
    points = shape.curve.points_mm
    if is_line_beyond(images, rig, points, shape.refined.diameter_mm, parameters.beside):
        return True
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
        if near.any() and np.linalg.norm(np.ptp(other[near], axis=0)) > _GOES_ON_MM and _leads_to(points[-1], other):
            return True
    return False


def _leads_to(tip_mm: Float, line_mm: Float) -> bool:
    """Whether a line (N, 3) comes near a tip, or runs towards it where it is nearest."""
    gap = line_mm - tip_mm
    nearest = int(np.argmin(np.linalg.norm(gap, axis=1)))
    if np.linalg.norm(gap[nearest]) < _FAR_MM:
        return True
    along = line_mm[min(nearest + 5, len(line_mm) - 1)] - line_mm[max(nearest - 5, 0)]
    return bool(abs(unit(along) @ unit(gap[nearest])) > _LEADS_COSINE)


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
