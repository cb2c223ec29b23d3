"""The search of both whole images for what may be the needle, without any memory."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import arc_length, tangents, unit
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Appearance, Float, Reason
from needletrack.tracking.adjust import Images
from needletrack.tracking.centerline import trace_centerlines
from needletrack.tracking.evidence import HALF_WIDTHS, INSIDES, Grid, log_evidence, log_evidence_of_no_needle, products
from needletrack.tracking.fit import initial_curve
from needletrack.tracking.match import Candidate, match_lines
from needletrack.tracking.needle import Needle
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import WIDTH_ALLOWANCE
from needletrack.tracking.segment import find_ridges
from needletrack.tracking.silhouette import cut_sections, unit_mm
from needletrack.tracking.stopwatch import Stopwatch

# A candidate is looked at so often along its length, and kept where so many places of both views show a needle, by
# their log odds, over this length.
_SPACING_MM = 2.5
_SHOWN, _SHOWN_SHARE, _SHOWN_OVER_MM = 3.0, 0.6, 8.0
# So many candidates, the best first, are looked at together.
_TOGETHER = 4
# Square of the cosine between curve and line of sight from which on it leaps.
_LEAP = 0.75
# What scores less than this share of the best is not worth a refinement.
_LEAST_SHARE = 0.15
# Seeds are off by a pixel or two: the silhouette may be a fifth of the thickest needle and more away.
_NEAR = Grid(1, 5)


def detect(images: Images, rig: StereoRig, parameters: TrackingParameters, stopwatch: Stopwatch) -> list[Candidate]:
    """Left-right pairs of lines that may be the needle, the best first; raises NeedleNotFound where there is none."""
    needle, z_mm = parameters.needle, parameters.workspace.z_mm
    lines = []
    for image, camera in zip(images, (rig.left, rig.right), strict=True):
        widths_px = (
            needle.min_diameter_mm * camera.focal_px / z_mm.max,
            needle.max_diameter_mm * camera.focal_px / z_mm.min,
        )
        px_per_mm = 2 * camera.focal_px / (z_mm.min + z_mm.max)
        with stopwatch("segment"):
            ridges = find_ridges(image, widths_px, parameters.segment)
        with stopwatch("centerline"):
            lines.append(trace_centerlines(ridges, widths_px[1] * WIDTH_ALLOWANCE, px_per_mm, parameters.centerline))
    with stopwatch("match"):
        candidates = match_lines(lines[0], lines[1], rig, needle, parameters.workspace, parameters.match)
    with stopwatch("judge"):
        judged = _judged(candidates, images, rig, parameters)
    if not judged:
        raise NeedleNotFound("match", Reason.NO_STEREO_MATCH)
    return judged


def _judged(
    candidates: list[Candidate], images: Images, rig: StereoRig, parameters: TrackingParameters
) -> list[Candidate]:
    """The parts of the candidates that both views show as a needle, the best first."""
    wanted = parameters.match.max_candidates
    judged: list[Candidate] = []
    waiting = sorted(candidates, key=_at_best, reverse=True)
    while waiting:
        curves_mm = [
            initial_curve(each.points_mm, each.confidence, _SPACING_MM, parameters.fit) for each in waiting[:_TOGETHER]
        ]
        supports = silhouette_support(images, rig, curves_mm, parameters.needle)
        for candidate, curve_mm, support in zip(waiting, curves_mm, supports, strict=False):
            judged.extend(_shown(candidate, curve_mm, support, parameters.needle))
        judged.sort(key=lambda c: -c.score)
        least = _LEAST_SHARE * judged[0].score if judged else 0.0
        if len(judged) >= wanted:
            least = max(least, judged[wanted - 1].score)
        waiting = [each for each in waiting[_TOGETHER:] if _at_best(each) > least]
    return [each for each in judged[:wanted] if each.score >= _LEAST_SHARE * judged[0].score]


def _at_best(candidate: Candidate) -> float:
    return candidate.plausible * candidate.length_mm


def _shown(candidate: Candidate, curve_mm: Float, support: Float, needle: Needle) -> list[Candidate]:
    """The parts of a candidate that both views show as a needle, scored by their length.

    What the two lines are of does not matter to their match; whether there is a silhouette of one diameter at that
    depth in both views does: support (2, N), of the curve (N, 3) that it is.
    """
    spacing_mm = float(arc_length(curve_mm)[-1]) / (len(curve_mm) - 1)
    shown = (support > _SHOWN).mean(axis=0)
    along = tangents(curve_mm)
    towards = (along * unit(curve_mm)).sum(axis=1) ** 2
    present = uniform_filter1d(shown, max(3, round(_SHOWN_OVER_MM / spacing_mm)), mode="nearest") > _SHOWN_SHARE
    # A curve that leaps in depth goes over from one thing to another there.
    present &= towards < _LEAP
    edges = np.flatnonzero(np.diff(np.concatenate([[0], present.astype(np.int8), [0]])))
    arc = arc_length(candidate.points_mm)
    at = arc / max(float(arc[-1]), 1e-9) * (len(curve_mm) - 1)
    parts = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        chosen = (at >= a - 0.5) & (at <= b - 0.5)
        if (b - a) * spacing_mm >= needle.min_length_mm / 2 and chosen.sum() >= 3:
            parts.append(candidate.part(chosen, candidate.plausible * float(shown[a:b].sum()) * spacing_mm))
    return parts


def silhouette_support(images: Images, rig: StereoRig, curves_mm: list[Float], needle: Needle) -> list[Float]:
    """Log Bayes factor (2, N) in each view of a needle about each point of each curve (N, 3) over none there.

    Of one diameter, blur of the lens and inside a curve: those that explain most.
    """
    views = [
        cut_sections(image, camera, local, needle).values
        for curve_mm in curves_mm
        for image, camera, local in (
            (images[0], rig.left, curve_mm),
            (images[1], rig.right, rig.right_from_left.apply(curve_mm)),
        )
    ]
    sections = products(np.concatenate(views))
    low, high = 0.9 * needle.min_diameter_mm / 2 / unit_mm(needle), 1.3 * needle.max_diameter_mm / 2 / unit_mm(needle)
    # Half way between a sharp lens and one nearly in focus; every fifth width is near enough.
    blur = 2
    widths = [i for i, w in enumerate(HALF_WIDTHS) if low <= w <= high][1::5]
    tables = np.stack(
        [
            _anywhere(log_evidence(sections, Appearance(w, blur, inside), _NEAR))
            for w in widths
            for inside in range(len(INSIDES))
        ]
    )
    tables -= log_evidence_of_no_needle(sections, blur)
    says = np.clip(tables, -5.0, 20.0)
    stops = np.cumsum([2 * len(curve_mm) for curve_mm in curves_mm])
    starts = stops - [2 * len(curve_mm) for curve_mm in curves_mm]
    best = np.add.reduceat(says, starts, axis=1).argmax(axis=0)
    return [tables[k, a:b].reshape(2, -1) for k, a, b in zip(best, starts, stops, strict=True)]


def _anywhere(log_evidence: Float) -> Float:
    """Log evidence (N,) of one place or another, summed over all (N, S); `np.logaddexp` takes three times as long."""
    most = log_evidence.max(axis=1)
    return np.asarray(most + np.log(np.exp(log_evidence - most[:, None]).sum(axis=1)))
