"""Round things about an axis in space, and their outlines in a camera's picture.

Needle, sleeve, rod and vessel are all tubes. The outline of a straight stretch follows from the two planes
through the camera's centre that touch it; an end is the hull of its ring, an ellipse in the picture, and of
a cone's apex.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import ndtr

from needletrack.geometry import spline
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float

CONE_MM = 2.5
# Beyond so many standard deviations the blur's tail is less than a hundredth of a grey level.
BLUR_REACH = 4.0
SLICES_PER_BLUR = 2
LEAST_SLICES = 6

Side = Float | float


class End(StrEnum):
    """How a tube ends: cut off, with a hemisphere, or with a cone of 2.5 mm."""

    FLAT = "flat"
    ROUND = "round"
    CONE = "cone"


@dataclass(frozen=True, slots=True, eq=False)
class Tube:
    """A tube about an axis of points_mm (N, 3), which reaches to the apex of both ends."""

    points_mm: Float
    radius_mm: float
    first: End = End.FLAT
    last: End = End.FLAT


@dataclass(frozen=True, slots=True)
class Cap:
    """One end in the picture: an ellipse about the axis at ring_px along it, and an apex beyond that."""

    ring_px: float
    half_length_px: float
    half_width_px: float
    apex_px: float

    @property
    def reach_px(self) -> float:
        """How far the end reaches beyond the ring's centre."""
        return max(self.half_length_px, self.apex_px)

    def half_width_at(self, beyond_px: Float) -> Float:
        """Half width (N,) of the hull of ellipse and apex, at (N,) beyond the ring in [0, reach_px]."""
        a, b, apex = self.half_length_px, self.half_width_px, self.apex_px
        ellipse = b * np.sqrt(np.clip(1 - (beyond_px / max(a, 1e-9)) ** 2, 0, None))
        if apex <= a:
            return np.asarray(ellipse)
        touch = a**2 / apex
        slope = b * np.sqrt(1 - (a / apex) ** 2) / (apex - touch)
        return np.where(beyond_px < touch, ellipse, slope * (apex - beyond_px))


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """A tube in one picture.

    axis_px (N, 2) raw pixels, tangents (N, 2) of unit length, along_px (N,) arc length, half_width_px (N,);
    highlight (N,) is where light is mirrored into the camera, as a share -1 .. 1 of the half width, on the
    side of the normal (-tangent y, tangent x).
    """

    axis_px: Float
    tangents: Float
    along_px: Float
    half_width_px: Float
    highlight: Float
    first: Cap
    last: Cap

    @property
    def half_band_px(self) -> float:
        """Greatest distance from the axis, px, at which anything of the tube is seen without blur."""
        return max(float(self.half_width_px.max()), self.first.half_width_px, self.last.half_width_px)

    def coverage(self, points_px: npt.ArrayLike, blur_px: float) -> Float:
        """Share (P,) of the blurred pixels (P, 2) that shows the tube.

        The blur is a Gaussian of standard deviation blur_px, the pixel's own area included. Exact where the
        axis is straight over the reach of the blur.
        """
        return self._blurred(self._placed(points_px), blur_px)

    def coverage_and_streak(
        self, points_px: npt.ArrayLike, blur_px: float, streak_half_width: float
    ) -> tuple[Float, Float]:
        """The same, and the share (P,) of a streak about the highlight, its width a share of the tube's."""
        place = self._placed(points_px)
        center = self.highlight[place.nearest]
        low, high = np.clip(center - streak_half_width, -1, 1), np.clip(center + streak_half_width, -1, 1)
        return self._blurred(place, blur_px), self._blurred(place, blur_px, low, high)

    def _placed(self, points_px: npt.ArrayLike) -> "_Place":
        _, nearest = cKDTree(self.axis_px, balanced_tree=False, compact_nodes=False).query(points_px)
        offset = np.asarray(points_px) - self.axis_px[nearest]
        tangent = self.tangents[nearest]
        return _Place(
            nearest=nearest,
            along=self.along_px[nearest] + (offset * tangent).sum(axis=1),
            across=offset[:, 1] * tangent[:, 0] - offset[:, 0] * tangent[:, 1],
        )

    def _blurred(self, place: "_Place", blur_px: float, low: Side = -1.0, high: Side = 1.0) -> Float:
        across = place.across
        covered = _strip(across, self.half_width_px[place.nearest], low, high, blur_px)
        beyond_both_ends = self.first.ring_px - place.along, place.along - self.last.ring_px
        for cap, beyond in zip((self.first, self.last), beyond_both_ends, strict=True):
            near = beyond > -BLUR_REACH * blur_px
            sides = [np.broadcast_to(side, across.shape)[near] for side in (low, high)]
            covered[near] = _capped(cap, beyond[near], across[near], sides[0], sides[1], blur_px)
        return covered


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    nearest: npt.NDArray[np.intp]
    along: Float
    across: Float


def outline(tube: Tube, camera: Camera, camera_from_world: RigidTransform, light: npt.ArrayLike) -> Outline:
    """The tube's outline in a camera's picture; light (3,) points towards the light, in the world frame."""
    axis = camera_from_world.apply(tube.points_mm)
    direction = spline.tangents(axis)
    radius = tube.radius_mm
    # Touching planes: outward normals m with m . direction = 0 and m . (axis + radius m) = 0.
    side = spline.unit(np.cross(direction, axis))
    away = axis - (axis * direction).sum(axis=1, keepdims=True) * direction
    away_mm = np.linalg.norm(away, axis=1, keepdims=True)
    away /= away_mm
    sine = radius / away_mm
    normal = np.sqrt(1 - sine**2) * side
    axis_px = camera.project(axis)
    tangents = spline.tangents(axis_px)
    picture_normal = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    edges = [
        ((camera.project(axis + radius * (sign * normal - sine * away)) - axis_px) * picture_normal).sum(axis=1)
        for sign in (1.0, -1.0)
    ]
    half_width = (edges[0] - edges[1]) / 2
    half_way = spline.unit(spline.unit(np.asarray(light) @ camera_from_world.rotation.T) - spline.unit(axis))
    toward_side = (half_way * side).sum(axis=1)
    toward_camera = -(half_way * away).sum(axis=1)
    highlight = np.sign(half_width) * toward_side / np.hypot(toward_side, toward_camera)

    along_mm, along_px = spline.arc_length(axis), spline.arc_length(axis_px)
    half_width = np.abs(half_width)

    def cap(end: End, at_mm: float, end_px: float, step: int) -> Cap:
        setback = {End.FLAT: 0.0, End.ROUND: radius, End.CONE: CONE_MM}[end]
        ring_mm = float(np.clip(at_mm - step * setback, 0.0, along_mm[-1]))
        ring_px = float(np.interp(ring_mm, along_mm, along_px))
        width_px = float(np.interp(ring_mm, along_mm, half_width))
        if end is End.ROUND:
            return Cap(ring_px, width_px, width_px, 0.0)
        index = int(np.argmin(np.abs(along_mm - ring_mm)))
        rim = camera.project(axis[index] + radius * away[index]) - axis_px[index]
        length_px = abs(float(rim[0] @ tangents[index]))
        return Cap(ring_px, length_px, width_px, abs(end_px - ring_px))

    return Outline(
        axis_px=axis_px,
        tangents=tangents,
        along_px=along_px,
        half_width_px=half_width,
        highlight=highlight,
        first=cap(tube.first, 0.0, 0.0, -1),
        last=cap(tube.last, float(along_mm[-1]), float(along_px[-1]), 1),
    )


def _strip(across: Float, half_width: Side, low: Side, high: Side, blur_px: float) -> Float:
    return np.asarray(ndtr((across - low * half_width) / blur_px) - ndtr((across - high * half_width) / blur_px))


def _capped(cap: Cap, beyond: Float, across: Float, low: Side, high: Side, blur_px: float) -> Float:
    # The blur is separable along and across the axis: cut the end into slices of constant width, weigh each
    # by the blur along the axis. Before the ring lies the strip, beyond the end nothing.
    slices = max(LEAST_SLICES, int(np.ceil(cap.reach_px / blur_px * SLICES_PER_BLUR)))
    borders = np.linspace(0.0, cap.reach_px, slices + 1)
    covered = ndtr(-beyond / blur_px) * _strip(across, cap.half_width_px, low, high, blur_px)
    passed = ndtr((borders[:, None] - beyond) / blur_px)
    widths = cap.half_width_at((borders[:-1] + borders[1:]) / 2)
    for weight, width in zip(np.diff(passed, axis=0), widths, strict=True):
        covered += weight * _strip(across, width, low, high, blur_px)
    return np.asarray(covered)
