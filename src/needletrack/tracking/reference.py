"""The method of 2017, complete and unimproved: the yardstick that needletrack is measured against.

Nguyen, Kim, Choi, Kang, Park, Kim: A 3D Shape Tracking Algorithm for Flexible Needle in Brain Surgery (2017).
The stages are named after its sections: centerline extraction (2), corresponding point check (3),
reconstruction (4), projection error (5). Where the paper leaves something open, this is what was chosen:

1. Eq. 2 writes m_p^T F m_q = 0, eq. 5 gives the F of m_q^T F m_p = 0. `fundamental_matrix` returns eq. 5
   transposed, so that eq. 2, 7, 8 and 9 hold as printed. p is the left view, q the right one.
2. m_p^T F m_q is algebraic and changes with F's scale. The scale is a parameter, by default that of a
   translation of length one; `threshold_px` says what the threshold means in pixels. Eq. 8 is read with the
   absolute value that it lacks; as printed, it accepts every point on one side of the line
   (`absolute_residual`).
3. Lens distortion, of which the paper does not speak, is corrected (`correct_distortion`).
4. Every pair within the threshold is kept, many to many; the order of points along the needle is not used.
5. B = K_q [R|t] H^-1 with H = diag(K_p, 1); pixels have their origin at the centre of the top-left one. Eq.
   12 is as printed, with its weakness; `triangulation` may put the midpoint in its place.
6. The skeleton is a staircase of pixels with its spurs, and no point is moved off the grid.
7. There is no tip, no base and no frame without a needle. `track_reference` orders points by the path of the
   left skeleton, for output only, calls nothing ok, and states no tip.

Refraction is not modelled.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, field_validator
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import cross_matrix, epipolar_distance_map_px, homogeneous
from needletrack.geometry.spline import arc_length, curvature, resample
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.triangulation import triangulate
from needletrack.records import (
    Centerline,
    Correspondences,
    Evidence,
    Float,
    Image,
    Int,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    StereoPair,
    frozen_array,
)

Mask = npt.NDArray[np.bool_]
Scale = Literal["unit_translation", "unit_norm", "millimetres"]
Triangulation = Literal["eq12", "midpoint"]

GREATEST_K = 5
# Enough to even out the light; a higher limit amplifies the camera's noise until it is as strong as a needle.
_CLIP_LIMIT, _TILES = 2.0, (8, 8)
# Neighbours in a skeleton are at most a diagonal step apart.
_NEIGHBOUR_PX = 1.5
# No point leaves the grid, so that its noise is at least about a pixel.
_POINT_NOISE_PX = 1.0


class ReferenceParameters(BaseModel):
    """The few numbers of the 2017 method, and the choices that it leaves open."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    k: int = Field(1, description="Every k-th skeleton point is kept (section 2), 1 to 5.")
    threshold: float = Field(1e-4, gt=0, description="Greatest residual m_p^T F m_q of a pair (eq. 8).")
    fundamental_scale: Scale = Field(
        "unit_translation",
        description="Scale of F, without which the threshold means nothing: a translation of length one, "
        "a Frobenius norm of one, or eq. 5 with the translation in millimetres.",
    )
    absolute_residual: bool = Field(
        True, description="Whether the threshold bounds the residual's absolute value; eq. 8 omits the bars."
    )
    use_distance_map: bool = Field(
        True, description="One matrix product (eq. 9) rather than a test of every left and right point."
    )
    needle_px: int = Field(
        13, ge=3, description="Side of a square, px, that no needle fills: wider things are background."
    )
    border_px: int = Field(8, ge=0, description="Frame of the image, px, in which everything is noise.")
    correct_distortion: bool = Field(True, description="Undistort skeleton points before the epipolar test.")
    triangulation: Triangulation = Field(
        "eq12", description="The paper's closed form, or the midpoint of the two rays."
    )

    @field_validator("k")
    @classmethod
    def _without_gaps(cls, k: int) -> int:
        if not 1 <= k <= GREATEST_K:
            raise ValueError(
                f"k is {k}, not 1 to {GREATEST_K}: beyond {GREATEST_K} the gaps between the kept points "
                "break the curve (section 2 of the paper)"
            )
        return k


@dataclass(frozen=True, slots=True)
class Segment:
    """The region taken for the needle: mask (rows, columns) and offset_px (column, row) of its box."""

    mask: Mask
    offset_px: tuple[int, int]


@dataclass(frozen=True, slots=True)
class View:
    """One image's centerline: its segment, skeleton_px (M, 2) raw pixels, and which of them are kept.

    kept (N,) indexes every k-th skeleton point. centerline_px (M, 2) is the skeleton in the pixels that
    matching uses: undistorted unless `correct_distortion` is off.
    """

    segment: Segment
    skeleton_px: Float
    kept: Int
    centerline_px: Float

    def __post_init__(self) -> None:
        skeleton_px = frozen_array(self.skeleton_px, (None, 2), "skeleton_px")
        object.__setattr__(self, "skeleton_px", skeleton_px)
        centerline_px = frozen_array(self.centerline_px, (len(skeleton_px), 2), "centerline_px")
        object.__setattr__(self, "centerline_px", centerline_px)
        object.__setattr__(self, "kept", frozen_array(self.kept, (None,), "kept", np.int64))

    @property
    def points_px(self) -> Float:
        """The point set S_p or S_q (eq. 1), (N, 2)."""
        return self.centerline_px[self.kept]


@dataclass(frozen=True, slots=True)
class ProjectionError:
    """Eq. 13: how far the points project from the centerlines.

    distances_px (N, 2): left and right, of each point; mean_px: their mean; mean_mm is mean_px at the needle:
    each distance times depth / focal length.
    """

    distances_px: Float
    mean_px: float
    mean_mm: float


@dataclass(frozen=True, slots=True)
class ReferenceResult:
    """What every stage found, for tables, pictures and tests.

    distance_map (I, J): the residual of every two points (Fig. 6), None where the double loop ran; pairs (N,
    2): indices into both point sets; points_mm (N, 3): one a pair, in the left camera's frame.
    """

    left: View
    right: View
    distance_map: Float | None
    pairs: Int
    points_mm: Float
    error: ProjectionError

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", frozen_array(self.pairs, (None, 2), "pairs", np.int64))
        points_mm = frozen_array(self.points_mm, (len(self.pairs), 3), "points_mm")
        object.__setattr__(self, "points_mm", points_mm)


# Section 2: centerline extraction


def equalize(image: Image) -> Image:
    """The image (rows, columns) with its histogram equalised tile by tile, after a light blur against noise.

    Equalised as a whole, an unevenly lit background spreads over all grey levels and takes the needle's
    contrast: 5 of the 10 views of `lab-a` then give the needle and nothing else, with tiles all 10.
    """
    blurred = cv2.GaussianBlur(image, (3, 3), 0)
    return np.asarray(cv2.createCLAHE(_CLIP_LIMIT, _TILES).apply(blurred), dtype=np.uint8)


def enhance_contrast(image: Image, needle_px: int) -> tuple[Image, Image]:
    """How much darker, and how much brighter, thin things are than their surroundings, (rows, columns) each.

    Black hat and top hat of a square of needle_px; both, since the paper does not say which the needle is.
    """
    square = np.ones((needle_px, needle_px), np.uint8)
    darker = cv2.morphologyEx(image, cv2.MORPH_BLACKHAT, square)
    brighter = cv2.morphologyEx(image, cv2.MORPH_TOPHAT, square)
    return np.asarray(darker, dtype=np.uint8), np.asarray(brighter, dtype=np.uint8)


def segment(image: Image, parameters: ReferenceParameters) -> Segment:
    """The region of an image (rows, columns) taken for the needle: the longest thin one, its holes filled.

    Equalisation, contrast enhancement, Otsu's threshold (1979, DOI 10.1109/TSMC.1979.4310076), the image's
    border cleared, and then the region whose bounding box has the greatest diagonal. Raises NeedleNotFound
    where nothing is longer than two needles are wide.
    """
    hats = enhance_contrast(equalize(image), parameters.needle_px)
    threshold, _ = cv2.threshold(cv2.max(*hats), 0, 255, cv2.THRESH_OTSU)
    outlines = [outline for hat in hats for outline in _outlines(hat, threshold, parameters.border_px)]
    boxes = np.array([cv2.boundingRect(outline) for outline in outlines]).reshape(-1, 4)
    diagonals = np.hypot(boxes[:, 2], boxes[:, 3])
    if len(diagonals) == 0 or diagonals.max() < 2 * parameters.needle_px:
        raise NeedleNotFound("segment", Reason.NO_CANDIDATE)
    longest = int(diagonals.argmax())
    column, row, width, height = (int(side) for side in boxes[longest])
    region = np.zeros((height, width), np.uint8)
    cv2.drawContours(region, outlines, longest, 1, cv2.FILLED, offset=(-column, -row))
    return Segment(region.astype(np.bool_), (column, row))


def _outlines(hat: Image, threshold: float, border_px: int) -> list[npt.NDArray[np.int32]]:
    inside = cv2.threshold(hat, threshold, 255, cv2.THRESH_BINARY)[1]
    inside[:border_px], inside[:, :border_px] = 0, 0
    inside[len(inside) - border_px :], inside[:, inside.shape[1] - border_px :] = 0, 0
    # Tracing outlines costs a tenth of labelling the regions.
    found, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(outline, dtype=np.int32) for outline in found]


def skeleton(region: Segment) -> Float:
    """Pixels (N, 2) of the region's skeleton, raw, column by column as MATLAB's `find` lists them.

    Zhang & Suen 1984 (DOI 10.1145/357994.358023) on the bounding box: of scikit-image's four methods the
    fastest.
    """
    thinned = skeletonize(np.pad(region.mask, 1), method="zhang")
    columns, rows = np.nonzero(thinned.T)
    return np.asarray(np.column_stack([columns, rows]) + np.array(region.offset_px) - 1.0)


def extract_centerline(image: Image, camera: Camera, parameters: ReferenceParameters) -> View:
    """All of section 2 on one camera's image (rows, columns); raises NeedleNotFound where nothing is thin."""
    region = segment(image, parameters)
    skeleton_px = skeleton(region)
    if len(skeleton_px) == 0:
        raise NeedleNotFound("segment", Reason.NO_CANDIDATE)
    centerline_px = camera.undistort(skeleton_px) if parameters.correct_distortion else skeleton_px
    return View(region, skeleton_px, np.arange(0, len(skeleton_px), parameters.k), centerline_px)


# Section 3: corresponding point check


def fundamental_matrix(rig: StereoRig, scale: Scale = "unit_translation") -> Float:
    """F (3, 3) with m_p^T F m_q = 0 as eq. 2 has it: the transpose of eq. 5, at the scale named.

    Of the forms which eq. 5 gives as equal, this is K_q^-T R [R^T t]x K_p^-1; those with K_p^T are det(K_p)
    times as large.
    """
    rotation, translation = rig.right_from_left.rotation, rig.right_from_left.translation_mm
    if scale == "unit_translation":
        translation = translation / np.linalg.norm(translation)
    left_inverse, right_inverse = np.linalg.inv(rig.left.matrix), np.linalg.inv(rig.right.matrix)
    f = right_inverse.T @ rotation @ cross_matrix(rotation.T @ translation) @ left_inverse  # eq. 5
    return np.asarray(f.T / np.linalg.norm(f) if scale == "unit_norm" else f.T)


def epipolar_lines(fundamental: Float, left_px: npt.ArrayLike) -> Float:
    """Lines l_q (N, 3) in the right view of points (N, 2) in the left one, not normalised (eq. 7)."""
    return homogeneous(left_px) @ fundamental  # eq. 7


def threshold_px(fundamental: Float, left_px: npt.ArrayLike, threshold: float) -> Float:
    """The algebraic threshold as a distance (N,) px from the epipolar line of each left point (N, 2)."""
    slope = np.linalg.norm(epipolar_lines(fundamental, left_px)[:, :2], axis=1)
    return np.asarray(threshold / slope)


def distance_map(fundamental: Float, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Float:
    """D (I, J), the residual m_p^T F m_q of every two points, in one matrix product (eq. 9)."""
    return epipolar_lines(fundamental, left_px) @ homogeneous(right_px).T  # eq. 9


def pairs_in_map(distances: Float, threshold: float, *, absolute: bool = True) -> Int:
    """Indices (N, 2) of pairs whose residual is within the threshold, by left, then right point (eq. 10)."""
    return np.argwhere((np.abs(distances) if absolute else distances) <= threshold)  # eq. 8


def pairs_by_loop(
    fundamental: Float,
    left_px: npt.ArrayLike,
    right_px: npt.ArrayLike,
    threshold: float,
    *,
    absolute: bool = True,
) -> Int:
    """The pairs (N, 2) of `pairs_in_map`, by testing every left against every right point (section 3.3).

    On plain floats: over NumPy vectors the same loop takes 24 to 60 times as long, and would flatter the map.
    """
    lowest = -threshold if absolute else -np.inf
    right = np.asarray(right_px, dtype=np.float64).tolist()
    pairs = [
        (i, j)
        for i, (a, b, c) in enumerate(epipolar_lines(fundamental, left_px).tolist())
        for j, (x, y) in enumerate(right)
        if lowest <= a * x + b * y + c <= threshold  # eq. 8
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


# Section 4: reconstruction


def triangulate_eq12(rig: StereoRig, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Float:
    """Points (N, 3) mm in the left camera's frame from pairs (N, 2) of pinhole pixels (eq. 11, 12).

    Exact for exact pairs. Only x_q / y_q of the right point counts: where the line from the pixels' origin
    through m_q runs along the epipolar line, numerator and denominator vanish together and the depth is
    noise. Infinite or NaN where the denominator is zero.
    """
    pose = rig.right_from_left
    h_inverse = np.eye(4)
    h_inverse[:3, :3] = np.linalg.inv(rig.left.matrix)
    b = rig.right.matrix @ np.column_stack([pose.rotation, pose.translation_mm]) @ h_inverse
    m_p = homogeneous(left_px)
    x_q, y_q = np.asarray(right_px, dtype=np.float64).T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_mm = (x_q * b[1, 3] - y_q * b[0, 3]) / (m_p @ b[0, :3] * y_q - x_q * (m_p @ b[1, :3]))  # eq. 12
        projective = np.column_stack([depth_mm[:, None] * m_p, np.ones(len(m_p))])
        return (projective @ h_inverse.T)[:, :3]  # eq. 11


def reconstruct(rig: StereoRig, left_px: Float, right_px: Float, method: Triangulation) -> Float:
    """Points (N, 3) mm of pairs (N, 2) of pinhole pixels, by the paper's closed form or by the midpoint."""
    return (triangulate_eq12 if method == "eq12" else triangulate)(rig, left_px, right_px)


# Section 5: projection error


def projection_error(rig: StereoRig, points_mm: Float, left_px: Float, right_px: Float) -> ProjectionError:
    """Eq. 13 for points (N, 3) and the centerlines (M, 2) of both views, in pinhole pixels.

    The paper multiplies pixels by the sensor's pixel size, which is a length on the sensor; here a pixel
    counts as depth / focal length, a length at the needle. Bounded by the matching threshold, the error says
    nothing about the shape's accuracy.
    """
    distances, lengths = [], []
    for camera, centerline_px, in_camera_mm in (
        (rig.left, left_px, points_mm),
        (rig.right, right_px, rig.right_from_left.apply(points_mm)),
    ):
        projected = in_camera_mm @ camera.matrix.T
        distance, _ = cKDTree(centerline_px).query(projected[:, :2] / projected[:, 2:])
        distances.append(distance)
        lengths.append(distance * np.abs(in_camera_mm[:, 2]) / camera.focal_px)
    distances_px = np.column_stack(distances)
    return ProjectionError(distances_px, float(distances_px.mean()), float(np.mean(lengths)))  # eq. 13


# The whole


def reference_stages(
    left: Image, right: Image, rig: StereoRig, parameters: ReferenceParameters | None = None
) -> ReferenceResult:
    """Every stage of the method on one pair of images (rows, columns), with what each found.

    Pairs whose depth eq. 12 leaves undefined are left out. Raises NeedleNotFound where a view shows nothing
    thin, or where no pair is within the threshold.
    """
    parameters = parameters or ReferenceParameters()
    left_view = extract_centerline(left, rig.left, parameters)
    right_view = extract_centerline(right, rig.right, parameters)
    fundamental = fundamental_matrix(rig, parameters.fundamental_scale)
    threshold, absolute = parameters.threshold, parameters.absolute_residual
    distances = None
    if parameters.use_distance_map:
        distances = distance_map(fundamental, left_view.points_px, right_view.points_px)
        pairs = pairs_in_map(distances, threshold, absolute=absolute)
    else:
        pairs = pairs_by_loop(fundamental, left_view.points_px, right_view.points_px, threshold, absolute=absolute)
    left_px, right_px = left_view.points_px[pairs[:, 0]], right_view.points_px[pairs[:, 1]]
    points_mm = reconstruct(rig, left_px, right_px, parameters.triangulation)
    defined = np.isfinite(points_mm).all(axis=1) & (points_mm[:, 2] != 0)
    if not defined.any():
        raise NeedleNotFound("match", Reason.NO_STEREO_MATCH)
    pairs, points_mm = pairs[defined], points_mm[defined]
    error = projection_error(rig, points_mm, left_view.centerline_px, right_view.centerline_px)
    return ReferenceResult(left_view, right_view, distances, pairs, points_mm, error)


def track_reference(pair: StereoPair, rig: StereoRig, parameters: ReferenceParameters | None = None) -> NeedleTrack:
    """The method's answer for a pair, in the records of our own method: degraded, or invalid without a shape.

    The curve connects, along the path of the left skeleton, the means of each left point's reconstructions;
    base and tip may be exchanged, and no tip is stated. The paper has no uncertainty: sigma_mm is what a
    pixel of noise does to the triangulation and to the choice of partners, in the worst direction: such a
    curve has no tangent to measure across.
    """
    parameters = parameters or ReferenceParameters()
    try:
        found = reference_stages(pair.left.image, pair.right.image, rig, parameters)
        return _track(pair.captured_at_ns, found, rig, parameters)
    except NeedleNotFound as error:
        return NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason(error.reason),))


def along_skeleton(skeleton_px: Float) -> Int:
    """Indices (N,) of the pixels on the longest shortest path through a skeleton (M, 2), from end to end.

    Spurs are left out. The paper gives no order of points: this one serves output only.
    """
    count = len(skeleton_px)
    steps = cKDTree(skeleton_px).query_pairs(_NEIGHBOUR_PX, output_type="ndarray")
    lengths = np.linalg.norm(skeleton_px[steps[:, 0]] - skeleton_px[steps[:, 1]], axis=1)
    graph = csr_array((lengths, (steps[:, 0], steps[:, 1])), shape=(count, count))
    start = _farthest(dijkstra(graph, directed=False, indices=0))
    distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [_farthest(distance)]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int64)


def _farthest(distance: Float) -> int:
    return int(np.where(np.isfinite(distance), distance, -1.0).argmax())


def _track(captured_at_ns: int, found: ReferenceResult, rig: StereoRig, parameters: ReferenceParameters) -> NeedleTrack:
    path = along_skeleton(found.left.skeleton_px)
    rank = np.full(len(found.left.skeleton_px), -1)
    rank[path] = np.arange(len(path))
    kept_rank = rank[found.left.kept]
    pair_rank = kept_rank[found.pairs[:, 0]]
    order = np.argsort(pair_rank, kind="stable")
    order = order[pair_rank[order] >= 0]
    ranks, first, partners = np.unique(pair_rank[order], return_index=True, return_counts=True)
    if len(ranks) < 2:
        raise NeedleNotFound("match", Reason.NO_STEREO_MATCH)
    pairs, points_mm = found.pairs[order], found.points_mm[order]
    means_mm = np.add.reduceat(points_mm, first) / partners[:, None]
    left_px = found.left.points_px[pairs[first, 0]]
    return NeedleTrack(
        captured_at_ns,
        Status.DEGRADED,
        (Reason.REFERENCE_METHOD, Reason.AMBIGUOUS_BASE),
        curve=_curve(means_mm, _covariances_mm2(rig, left_px, found.right.points_px, means_mm, parameters)),
        quality=Quality(
            reprojection_rms_px=float(np.sqrt((found.error.distances_px**2).mean())),
            coverage=len(ranks) / int((kept_rank >= 0).sum()),
        ),
        evidence=_evidence(found, rig, path, pairs),
    )


def _curve(polyline_mm: Float, covariances_mm2: Float) -> NeedleCurve:
    length_mm = arc_length(polyline_mm)
    points_mm = resample(polyline_mm, len(polyline_mm))
    at_mm = np.linspace(0.0, length_mm[-1], len(points_mm))
    entries = covariances_mm2.reshape(-1, 9).T
    covariances = np.column_stack([np.interp(at_mm, length_mm, entry) for entry in entries]).reshape(-1, 3, 3)
    first = np.gradient(points_mm, at_mm, axis=0)
    return NeedleCurve(
        points_mm=points_mm,
        sigma_mm=np.sqrt(np.linalg.eigvalsh(covariances)[:, -1]),
        seen=np.full(len(points_mm), 2),
        curvature_per_mm=curvature(first, np.gradient(first, at_mm, axis=0)),
        length_mm=float(length_mm[-1]),
    )


def _covariances_mm2(
    rig: StereoRig, left_px: Float, right_px: Float, points_mm: Float, parameters: ReferenceParameters
) -> Float:
    """Covariances (N, 3, 3) about the points (N, 3) of left points (N, 2) that a pixel of noise implies.

    A pixel each of left and right position, carried through the triangulation, and the scatter of what the
    right points (J, 2) within a pixel of the left point's epipolar line would have given.
    """
    within = np.abs(epipolar_distance_map_px(rig.fundamental, left_px, right_px)) <= _POINT_NOISE_PX
    left, right = np.nonzero(within)
    off_mm = reconstruct(rig, left_px[left], right_px[right], parameters.triangulation) - points_mm[left]
    scatter = np.zeros((len(left_px), 3, 3))
    np.add.at(scatter, left, off_mm[:, :, None] * off_mm[:, None])
    scatter /= np.maximum(within.sum(axis=1), 1)[:, None, None]
    return scatter + _noise_covariances_mm2(rig, points_mm, parameters.triangulation)


def _noise_covariances_mm2(rig: StereoRig, points_mm: Float, method: Triangulation) -> Float:
    """Covariances (N, 3, 3) of points whose four pixel coordinates carry a pixel of noise each."""
    left_px, right_px = (
        (in_camera @ camera.matrix.T)[:, :2] / in_camera[:, 2:]
        for camera, in_camera in ((rig.left, points_mm), (rig.right, rig.right_from_left.apply(points_mm)))
    )
    small_px = 1e-3
    columns = [
        (reconstruct(rig, left_px + small_px * left, right_px + small_px * right, method) - points_mm) / small_px
        for left, right in zip(np.eye(4)[:, :2], np.eye(4)[:, 2:], strict=True)
    ]
    jacobian = _POINT_NOISE_PX * np.stack(columns, axis=2)
    return jacobian @ jacobian.transpose(0, 2, 1)


def _evidence(found: ReferenceResult, rig: StereoRig, path: Int, pairs: Int) -> Evidence:
    left_px = rig.left.undistort(found.left.skeleton_px[found.left.kept[pairs[:, 0]]])
    right_px = rig.right.undistort(found.right.skeleton_px[found.right.kept[pairs[:, 1]]])
    return Evidence(
        left=_centerline(found.left, path),
        right=_centerline(found.right, along_skeleton(found.right.skeleton_px)),
        correspondences=Correspondences(left_px, right_px),
    )


def _centerline(view: View, path: Int) -> Centerline:
    width_px = np.count_nonzero(view.segment.mask) / len(view.skeleton_px)
    return Centerline(view.skeleton_px[path], np.full(len(path), width_px))
