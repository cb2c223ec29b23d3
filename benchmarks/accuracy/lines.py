"""The needle's line in both images, as it is handed to methods that cannot find it themselves.

Two segmentations, as the peers have none for such images: the masks of the 2017 method, thinned, and the lines that our
own detector hands to its next stage. Each line begins where the needle begins, which truth tells: the peers take the
exit point for known.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from needletrack.errors import NeedleNotFound
from needletrack.geometry.spline import arc_length, resample
from needletrack.records import Float, NeedleTrack, StereoPair
from needletrack.rig import Rig
from needletrack.scoring import TrueShape
from needletrack.tracking.reference import ReferenceParameters, along_skeleton, extract_centerline

# Fewer points make no line.
_LEAST_POINTS = 10


@dataclass(frozen=True, eq=False)
class ViewLine:
    """One view: points_px (N, 2) in order, undistorted_px (N, 2) the same, region_px (M, 2): all that is the needle."""

    points_px: Float
    undistorted_px: Float
    region_px: Float


@dataclass(frozen=True, eq=False)
class PairLines:
    """The lines of both views."""

    left: ViewLine
    right: ViewLine


Segmentation = Callable[[StereoPair, NeedleTrack, Rig, TrueShape], PairLines | None]


def by_reference(pair: StereoPair, ours: NeedleTrack, rig: Rig, truth: TrueShape) -> PairLines | None:
    """The 2017 method's masks and their skeletons' longest paths; None where it finds nothing."""
    found: list[tuple[Float, Float]] = []
    try:
        for image, camera in ((pair.left.image, rig.left), (pair.right.image, rig.right)):
            view = extract_centerline(image, camera, ReferenceParameters())
            rows, columns = np.nonzero(view.segment.mask)
            region_px = np.column_stack([columns, rows]) + np.array(view.segment.offset_px, dtype=np.float64)
            found.append((view.skeleton_px[along_skeleton(view.skeleton_px)], np.asarray(region_px)))
    except NeedleNotFound:
        return None
    return _from_base(found, rig, truth)


def by_detector(pair: StereoPair, ours: NeedleTrack, rig: Rig, truth: TrueShape) -> PairLines | None:
    """What our detector found on the pair alone, a point a pixel; None where it found nothing."""
    if ours.evidence.left is None or ours.evidence.right is None:
        return None
    lines = [line.points_px for line in (ours.evidence.left, ours.evidence.right)]
    even = [resample(line, max(int(arc_length(line)[-1]), 2)) for line in lines]
    return _from_base([(line, line) for line in even], rig, truth)


SEGMENTATIONS: dict[str, Segmentation] = {"2017 masks": by_reference, "our lines": by_detector}


def visible_from(truth: TrueShape) -> int:
    """Index of the first true point that both cameras see: where the needle leaves its sleeve."""
    return int(truth.seen.argmax())


def _from_base(found: list[tuple[Float, Float]], rig: Rig, truth: TrueShape) -> PairLines | None:
    bases_px: tuple[Float | None, ...] = (None, None)
    if len(truth.centerline_mm):
        bases_px = tuple(seen[0] for seen in rig.project(truth.centerline_mm[visible_from(truth)][None]))
    views = []
    for (line, region_px), base_px, camera in zip(found, bases_px, (rig.left, rig.right), strict=True):
        points_px = line if base_px is None else _beginning_at(line, base_px)
        if len(points_px) < _LEAST_POINTS:
            return None
        views.append(ViewLine(points_px, camera.undistort(points_px), region_px))
    return PairLines(*views)


def _beginning_at(line_px: Float, base_px: Float) -> Float:
    """The line (N, 2) from its point nearest to the base on, that end first which is nearer to the base."""
    off_px = np.linalg.norm(line_px - base_px, axis=1)
    if off_px[-1] < off_px[0]:
        line_px, off_px = line_px[::-1], off_px[::-1]
    return line_px[int(off_px.argmin()) :]
