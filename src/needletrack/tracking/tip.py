"""Where the needle ends: the apex of a cone or of a round cap, from pictures of such ends fitted to both views.

The image is straightened along the curve and past its end. For an apex at each place and for each shape of end, what
the needle's inside and the background look like enters linearly and is solved for: the inside as a function of where
across the needle, another one on a cone, whose surface faces elsewhere; the background as a plane with a little bend.
What is left over tells how likely the apex is there. A taper does not shorten the needle so, nor a cap lengthen it: a
round end that is turned towards a view shows its side, and ends in the picture beyond its apex.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.kernels import Array, TipView, address, call, two_tip_views
from needletrack.records import Appearance, Float, Image, Reason
from needletrack.tracking.clipped import Flanks, outline
from needletrack.tracking.evidence import BLURS, HALF_WIDTHS
from needletrack.tracking.needle import Needle, Positive
from needletrack.tracking.silhouette import rows_of, unit_mm

# What is looked at, mm before and beyond a rough end, and the spacing of its rows.
BEFORE_MM, BEYOND_MM, ROW_MM = 8.0, 3.5, 0.2
# Apexes are tried from before to beyond the rough end, coarsely, then finely about the best. What follows the needle
# is rather too long than too short; and a round end looks like a cone of which nothing is seen, 2.5 mm further on.
TRIED_MM = (-4.5, 2.4)
# What was seen whole in the pair before ends near where it ended.
TRIED_AGAIN_MM = (-1.8, 2.4)
_COARSE_MM, _FINE_MM, _FINE_REACH_MM = 0.3, 0.05, 0.6
# A view places the apex along the needle this far from where it is: the curve is not quite right, nor is a picture.
_VIEW_SIGMA_MM = 0.1
ACROSS = np.arange(-6.75, 6.76, 0.5)
# Parts of the inside across the needle; spacing of the pictures of them along it, mm.
_PARTS = 5
PICTURE_MM = 0.05
_SATURATED_GRAY = 250
_SINE_STEP = 0.01
# Profiles to either side are shifted by this many rows at most; each costs so much, grey^2 per row^2.
_MOST_LAG, _LAG_PRICE = 24, 0.02
_LEAST_NOISE_GRAY = 1.0
# The image ends so far from its border, px. Profiles are smoothed along and across by this sigma, samples.
_MARGIN_PX, _SMOOTHED = 4.0, (1.0, 0.7)
# So many neighbouring samples err together.
_CORRELATED = 12.0
# Another shape of end whose log evidence is within this of the best one's is a rival of it.
_RIVAL = 3.0
# Standard deviations, grey: of the background's level, slopes and bends, of an inside, of the difference between
# neighbouring parts of it, and between a part on the cone and on the shaft.
_PLANE_GRAY = (200.0, 30.0, 30.0, 30.0, 15.0, 15.0, 1.0)
_BEHIND = len(_PLANE_GRAY)
_INSIDE_GRAY, _NEIGHBOUR_GRAY, _CONE_GRAY = 150.0, 80.0, 50.0


PICTURE_RULES = np.array(
    [
        _SATURATED_GRAY,
        _MARGIN_PX,
        _MOST_LAG,
        _LAG_PRICE,
        _LEAST_NOISE_GRAY,
        *_SMOOTHED,
    ]
)


class TipParameters(BaseModel):
    """How far a tip can be trusted at best."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_sigma_mm: Positive = Field(0.05, description="Least standard deviation of the tip along the needle, mm.")


@dataclass(frozen=True, slots=True)
class TipFit:
    """The apex along the curve, mm from its first point: of both views, of each view alone, and its sigma_mm.

    contrast: how much likelier, in each view, an end is there than that the needle goes on or was not there at all;
    square root of twice the log likelihood ratio, which is in sigmas. taper_mm: length of the cone, 0 for a round end.
    """

    at_mm: float
    each_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    contrast: tuple[float, float]
    taper_mm: float


@dataclass(frozen=True, slots=True)
class _Picture:
    """One view straightened past the end: grey and weight (rows, columns); sine of the angle to the line of sight.

    weighted (8, rows, columns): what does not depend on where the apex is, weighted: the background's seven parts, the
    last of them what lies behind the needle, and the picture itself. fixed (8, 8): its products.
    """

    gray: Float
    weight: Float
    noise_gray: float
    sine: float
    weighted: Float
    fixed: Float


def find_tip(
    images: tuple[tuple[Image, Camera, Float], tuple[Image, Camera, Float]],
    arc_mm: Float,
    end_mm: float,
    appearance: Appearance,
    needle: Needle,
    parameters: TipParameters,
    flanks: Flanks | None = None,
    tried_mm: tuple[float, float] = TRIED_MM,
    foreseen_mm: tuple[float, float] = (0.0, np.inf),
) -> TipFit:
    """The apex near a rough end, end_mm along a curve whose rows lie at arc_mm (rows,), ROW_MM apart.

    images: for each view its image, its camera, and the curve (rows, 3) in that camera's frame. flanks: of a needle
    that is clipped, and whose outline therefore lies beyond it. tried_mm: apexes, from the rough end;
    foreseen_mm: where the end was expected, and how surely.
    """
    edges: list[_Edge | None] = [None, None]
    if flanks is not None:
        half_width = flanks.diameter_mm / 2 / unit_mm(needle)
        edges = [
            _Edge(half_width, blur_px / (camera.focal_px / float(np.median(local_mm[:, 2])) * unit_mm(needle)))
            for blur_px, (_, camera, local_mm) in zip(flanks.blur_px, images, strict=True)
        ]
    views = two_tip_views()
    kept = [
        _look(view, *image, arc_mm, appearance, needle, edge)
        for view, image, edge in zip(views, images, edges, strict=True)
    ]
    prior, log_prior = prior_of_parts()
    found = np.empty(8)
    failed = call(
        "find_tip",
        views,
        len(needle.tip_tapers_mm),
        arc_mm,
        len(arc_mm),
        len(ACROSS),
        PICTURE_MM,
        prior,
        log_prior,
        end_mm,
        rules(tried_mm, foreseen_mm, end_mm, parameters),
        found,
        np.empty(2 * ((len(arc_mm) + 1) * 19 * 16 + len(arc_mm)) + 2 * 23 * 23),
    )
    del kept
    if failed:
        raise NeedleNotFound("tip", Reason.TIP_NOT_SEEN)
    return tip_fit(found, needle.tip_tapers_mm)


def tip_fit(found: Float, tapers_mm: tuple[float, ...]) -> TipFit:
    """What the kernel found (8,) among ends of these shapes."""
    at_mm, *rest, shape = found.tolist()
    return TipFit(at_mm, (rest[0], rest[1]), (rest[2], rest[3]), (rest[4], rest[5]), tapers_mm[int(shape)])


def rules(
    tried_mm: tuple[float, float], foreseen_mm: tuple[float, float], end_mm: float, parameters: TipParameters
) -> Float:
    """How the kernel `find_tip` looks for an apex."""
    return np.array(
        [
            *tried_mm,
            _COARSE_MM,
            _FINE_MM,
            _FINE_REACH_MM,
            _CORRELATED,
            _VIEW_SIGMA_MM,
            _LEAST_NOISE_GRAY,
            foreseen_mm[0] - end_mm,
            foreseen_mm[1],
            parameters.min_sigma_mm,
            _RIVAL,
        ]
    )


@dataclass(frozen=True, slots=True)
class _Edge:
    """The true half width of a clipped needle and the blur of the lens, units across."""

    half_width: float
    blur: float


def _look(
    view: TipView,
    image: Image,
    camera: Camera,
    local_mm: Float,
    arc_mm: Float,
    appearance: Appearance,
    needle: Needle,
    edge: _Edge | None,
) -> list[Array]:
    """Lays out one view of an end, straightened, for the kernel; returns the arrays that it points to.

    What does not depend on where the apex is, is prepared: the background's seven parts, the last of them what lies
    behind the needle as it is beside it (what crosses there, a vessel say, crosses straight: profiles to either side
    are alike but for a shift along), and the picture itself.
    """
    count, columns = len(local_mm), len(ACROSS)
    gray, weight = np.empty((2, count, columns))
    weighted, fixed, noise = np.empty((count, columns, 8)), np.empty((8, 8)), np.empty(1)
    sine = call(
        "tip_picture",
        *rows_of(image),
        camera.lens,
        np.ascontiguousarray(local_mm),
        arc_mm,
        count,
        ACROSS,
        columns,
        unit_mm(needle),
        reach(appearance),
        PICTURE_RULES,
        gray,
        weight,
        weighted,
        fixed,
        noise,
        np.empty(4 * count * columns + 16 * count),
    )
    view.weight, view.weighted, view.fixed = address(weight), address(weighted), address(fixed)
    view.noise_gray = float(noise[0])
    kept: list[Array] = [weight, weighted, fixed]
    for shape, taper_mm in enumerate(needle.tip_tapers_mm):
        pictures = inside_pictures(taper_mm, appearance, unit_mm(needle), stepped(sine), edge)
        pictures.lay_out(view, shape)
        kept += [pictures.parts, pictures.own, pictures.extent]
    return kept


def reach(appearance: Appearance) -> float:
    """How far the picture of the needle reaches to either side, units."""
    return float(HALF_WIDTHS[appearance.half_width]) + 2 * BLURS[appearance.blur]


def stepped(sine: float) -> float:
    """The sine of the angle between needle and line of sight, in steps, so that pictures of ends can be kept."""
    return max(round(sine / _SINE_STEP) * _SINE_STEP, 0.2)


@dataclass(frozen=True, eq=False)
class EndPictures:
    """Pictures (S, parts, columns) of each part of the inside of an end, from before_mm before its apex on.

    own (S, parts, parts): their products; extent (S, parts, 2): the columns from which to which a part shows. Before
    and beyond them all is as in the outermost.
    """

    before_mm: float
    parts: Float
    own: Float
    extent: npt.NDArray[np.uint8]

    def lay_out(self, view: TipView, shape: int) -> None:
        """Hands them to the kernel as those of a shape; the view points to their arrays."""
        view.parts, view.distances[shape], view.before_mm[shape] = self.parts.shape[1], len(self.parts), self.before_mm
        view.pictures[shape], view.own[shape] = address(self.parts), address(self.own)
        view.extent[shape] = address(self.extent)


@lru_cache(maxsize=64)
def inside_pictures(
    taper_mm: float, appearance: Appearance, unit_length_mm: float, sine: float, edge: _Edge | None
) -> EndPictures:
    """The pictures of an end; edge: of a clipped needle, which looks wider than it is."""
    half_width, blur = float(HALF_WIDTHS[appearance.half_width]), BLURS[appearance.blur]
    true = half_width if edge is None else min(edge.half_width, half_width)
    radius_mm = true * unit_length_mm
    along_mm = blur * unit_length_mm / sine
    # A clipped outline ends beyond the apex, by what it is wider times the slope of the cone.
    widened_mm = (half_width - true) / true * max(taper_mm, radius_mm)
    reach = int(np.ceil((4 * along_mm + widened_mm) / PICTURE_MM)) + 1
    before = np.arange(-reach, np.ceil(max(taper_mm, radius_mm) / PICTURE_MM) + reach + 1) * PICTURE_MM
    if taper_mm > 0:
        width = true * np.clip(before / taper_mm, 0.0, 1.0)
    else:
        # A hemisphere's picture is a circle about its centre, which lies its radius before the apex: seen from its
        # side that is where the shaft ends, seen from the front the circle shows whole.
        past = np.maximum((radius_mm - before) * sine, 0.0) / radius_mm
        width = true * np.sqrt(np.clip(1 - past**2, 0.0, 1.0))
    if edge is not None:
        along = edge.blur * unit_length_mm / sine / PICTURE_MM
        width = outline(width, (edge.blur, along), half_width)
    distances, count, columns = len(before), 2 * _PARTS, len(ACROSS)
    pictures, spare = np.empty((2, distances, count, columns))
    on_end = int(np.searchsorted(before, taper_mm or radius_mm))
    rows = along_mm / PICTURE_MM
    call("end_pictures", width, distances, on_end, ACROSS, columns, _PARTS, blur, rows, pictures, spare)
    own, extent = np.empty((distances, count, count)), np.empty((distances, count, 2), np.uint8)
    call("pictures_of", pictures, distances, count, columns, own, extent)
    return EndPictures(float(before[0]), pictures, own, extent)


@lru_cache(maxsize=1)
def prior_of_parts() -> tuple[Float, float]:
    """Inverse prior covariance of the background's 7 numbers and the inside's parts, grey^-2; its log determinant."""
    parts = 2 * _PARTS
    precision = np.zeros((_BEHIND + parts, _BEHIND + parts))
    precision[:_BEHIND, :_BEHIND] = np.diag(np.array(_PLANE_GRAY) ** -2.0)
    steps = np.diff(np.eye(_PARTS), axis=0) / _NEIGHBOUR_GRAY
    each = steps.T @ steps + np.eye(_PARTS) / _INSIDE_GRAY**2
    for start in range(_BEHIND, _BEHIND + parts, _PARTS):
        precision[start : start + _PARTS, start : start + _PARTS] = each
    apart = np.hstack([np.eye(_PARTS), -np.eye(_PARTS)]) / _CONE_GRAY
    precision[_BEHIND:, _BEHIND:] += apart.T @ apart
    return precision, float(np.linalg.slogdet(precision)[1])
