"""One stereo pair, and the track before it, to one needle track: every stage in order.

segment -> centerline -> match -> (triangulate) -> refine: observe the axis, fit one curve, find the ends -> gates.
With a previous track the first three are skipped as long as refinement from it holds.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.epipolar import sampson_distance_px
from needletrack.geometry.spline import curvature, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import orientation_along
from needletrack.records import (
    BasePose,
    Evidence,
    Float,
    Frame,
    Image,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    StereoPair,
    TipPose,
)
from needletrack.tracking.centerline import trace_centerlines
from needletrack.tracking.fit import CurveFit, initial_curve
from needletrack.tracking.gates import weaknesses
from needletrack.tracking.match import Candidate, match_lines
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import WIDTH_ALLOWANCE, Refined, RefineModels, refine
from needletrack.tracking.segment import find_ridges

# Candidates this close to the best one in score are examined as well: two that hold make the shape ambiguous.
_RIVAL_SHARE = 0.4
_SAME_SHAPE_MM = 2.0
# A weak track is searched for anew once in so many pairs, sooner where its shape is in doubt; one that holds is not.
_PAIRS_PER_SEARCH = 30
_PAIRS_PER_SEARCH_IN_DOUBT = 10
_IN_DOUBT = {Reason.AMBIGUOUS_BASE, Reason.LOW_COVERAGE, Reason.HIGH_RESIDUAL, Reason.TIP_NOT_SEEN}
_MAX_VELOCITY_INTERVAL_NS = 250_000_000


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
    stopwatch = _Stopwatch()
    found = _from_previous(images, rig, parameters, previous, stopwatch)
    if found is None:
        try:
            found = _from_images(images, rig, parameters, previous, stopwatch)
        except NeedleNotFound as lost:
            return NeedleTrack(
                pair.captured_at_ns, Status.INVALID, (Reason(lost.reason),), timing_ms=stopwatch.elapsed_ms
            )
    return found.to_track(pair.captured_at_ns, previous, stopwatch)


class _Found:
    """A refined shape with its verdict; becomes the published track."""

    def __init__(
        self,
        refined: Refined,
        rig: StereoRig,
        parameters: TrackingParameters,
        previous: NeedleTrack | None,
        evidence: Evidence,
        since_detection: int,
    ) -> None:
        seen = np.stack([view.seen for view in refined.observed])
        sigma = _sigma_across(refined.fit)
        length = float(np.linalg.norm(np.diff(refined.fit.points_mm, axis=0), axis=1).sum())
        bend = curvature(refined.fit.derivative(1), refined.fit.derivative(2))
        self.refined, self.rig, self.evidence, self.since_detection = refined, rig, evidence, since_detection
        self.curve = NeedleCurve(refined.fit.points_mm, sigma, seen.sum(axis=0), bend, length)
        self.coverage = float(seen.all(axis=0).mean())
        self.firm_mm = float(sum(view.firm.mean() for view in refined.observed)) * length
        tip_px = refined.tip_px
        left_px, right_px = rig.left.undistort(tip_px[[0]]), rig.right.undistort(tip_px[[1]])
        self.tip_epipolar_px = float(sampson_distance_px(rig.fundamental, left_px, right_px)[0])
        self.reasons = weaknesses(
            refined,
            self.curve,
            self.coverage,
            self.tip_epipolar_px,
            rig,
            parameters.needle,
            parameters.workspace,
            parameters.gates,
            previous,
        )

    def to_track(self, captured_at_ns: int, previous: NeedleTrack | None, stopwatch: "_Stopwatch") -> NeedleTrack:
        refined, points = self.refined, self.curve.points_mm
        out = unit(refined.fit.derivative(1))
        covariance = refined.fit.point_covariance_mm2()[-1] + max(refined.tip.sigma_mm) ** 2 * np.outer(
            out[-1], out[-1]
        )
        tip = TipPose(
            points[-1],
            out[-1],
            orientation_along(out[-1]),
            (covariance + covariance.T) / 2,
            _velocity_mm_s(points[-1], captured_at_ns, previous),
            int(self.curve.seen[-1]),
        )
        return NeedleTrack(
            captured_at_ns,
            Status.DEGRADED if self.reasons else Status.OK,
            self.reasons,
            self.curve,
            tip,
            BasePose(points[0], out[0]),
            refined.diameter_mm,
            self.since_detection,
            Quality(refined.fit.rms_px, self.tip_epipolar_px, self.coverage),
            stopwatch.elapsed_ms,
            self.evidence,
        )


def _from_previous(
    images: tuple[Image, Image],
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
    stopwatch: "_Stopwatch",
) -> _Found | None:
    """The needle refined from where it was, or None where that does not hold or a search is due."""
    if previous is None or previous.curve is None:
        return None
    try:
        with stopwatch("refine"):
            base_mm = None if previous.base is None else previous.base.position_mm
            rounds = parameters.refine.max_tracking_rounds
            refined = refine(images, rig, previous.curve.points_mm, _models(parameters), rounds, base_mm)
            found = _Found(refined, rig, parameters, previous, Evidence(), previous.since_detection + 1)
    except NeedleNotFound:
        # Lost is not yet gone: the search that follows decides, and its reason is the one that is told.
        return None
    allowed = _PAIRS_PER_SEARCH_IN_DOUBT if _IN_DOUBT & set(found.reasons) else _PAIRS_PER_SEARCH
    return found if not found.reasons or found.since_detection < allowed else None


def _from_images(
    images: tuple[Image, Image],
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
    stopwatch: "_Stopwatch",
) -> _Found:
    """The needle searched for in the whole images; raises NeedleNotFound."""
    needle, z_mm = parameters.needle, parameters.workspace.z_mm
    lines = []
    for image, camera in zip(images, (rig.left, rig.right), strict=True):
        widths_px = (
            needle.min_diameter_mm * camera.focal_px / z_mm.max,
            needle.max_diameter_mm * camera.focal_px / z_mm.min,
        )
        with stopwatch("segment"):
            ridges = find_ridges(image, widths_px, parameters.segment)
        with stopwatch("centerline"):
            px_per_mm = 2 * camera.focal_px / (z_mm.min + z_mm.max)
            lines.append(trace_centerlines(ridges, widths_px[1] * WIDTH_ALLOWANCE, px_per_mm, parameters.centerline))
    with stopwatch("match"):
        candidates = match_lines(lines[0], lines[1], rig, needle, parameters.workspace, parameters.match)
    found: list[_Found] = []
    lost: list[NeedleNotFound] = []
    for candidate in candidates:
        # What is a little worse matched is examined only for want of a shape that holds, or as a rival of it.
        if candidate.score < _RIVAL_SHARE * candidates[0].score and any(not shape.reasons for shape in found):
            continue
        try:
            with stopwatch("refine"):
                found.append(_examine(candidate, images, rig, parameters, previous))
        except NeedleNotFound as error:
            lost.append(error)
    if not found:
        raise lost[0]
    best = min(found, key=lambda shape: (bool(shape.reasons), -shape.firm_mm))
    if not best.reasons and any(_is_rival(shape, best) for shape in found if not shape.reasons):
        best.reasons = (Reason.AMBIGUOUS_SHAPE,)
    return best


def _examine(
    candidate: Candidate,
    images: tuple[Image, Image],
    rig: StereoRig,
    parameters: TrackingParameters,
    previous: NeedleTrack | None,
) -> _Found:
    rough = initial_curve(candidate.points_mm, candidate.confidence, parameters.refine.spacing_mm, parameters.fit)
    refined = refine(images, rig, rough, _models(parameters), parameters.refine.max_rounds)
    evidence = Evidence(candidate.left, candidate.right, candidate.correspondences)
    return _Found(refined, rig, parameters, previous, evidence, 0)


def _is_rival(shape: _Found, best: _Found) -> bool:
    offset = np.linalg.norm(shape.curve.points_mm[:, None] - best.curve.points_mm[None], axis=2).min(axis=1)
    return float(np.median(offset)) > _SAME_SHAPE_MM


def _models(parameters: TrackingParameters) -> RefineModels:
    return RefineModels(
        parameters.needle,
        parameters.workspace,
        parameters.axis,
        parameters.fit,
        parameters.ends,
        parameters.refine,
    )


def _sigma_across(fit: CurveFit) -> Float:
    """Square root (N,) of the larger eigenvalue of each point's covariance across the tangent."""
    along = unit(fit.derivative(1))
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    flattened = across @ fit.point_covariance_mm2() @ across
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(flattened)[:, -1], 1e-12)))


def _velocity_mm_s(tip_mm: Float, captured_at_ns: int, previous: NeedleTrack | None) -> Float | None:
    if previous is None or previous.tip is None or previous.status is not Status.OK:
        return None
    elapsed_ns = captured_at_ns - previous.captured_at_ns
    if not 0 < elapsed_ns <= _MAX_VELOCITY_INTERVAL_NS:
        return None
    return np.asarray((tip_mm - previous.tip.position_mm) / (elapsed_ns * 1e-9))


class _Stopwatch:
    """Milliseconds spent in each stage of one pair."""

    def __init__(self) -> None:
        self.elapsed_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.elapsed_ms[stage] = self.elapsed_ms.get(stage, 0.0) + (time.perf_counter() - start) * 1e3
