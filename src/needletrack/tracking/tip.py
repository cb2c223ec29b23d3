"""Where the needle ends: the apex of a cone or of a round cap, from pictures of such ends fitted to both views.

The image is straightened along the curve and past its end. For an apex at each place and for each shape of end, what
the needle's inside and the background look like enters linearly and is solved for: the inside as a function of where
across the needle, another one on a cone, whose surface faces elsewhere; the background as a plane with a little bend.
What is left over tells how likely the apex is there. A taper does not shorten the needle so, nor a cap lengthen it: a
round end that is turned towards a view shows its side, and ends in the picture beyond its apex.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.special import ndtr

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents, unit
from needletrack.records import Appearance, Float, Image
from needletrack.tracking.clipped import Flanks, outline
from needletrack.tracking.evidence import BLURS, HALF_WIDTHS
from needletrack.tracking.needle import Needle, Positive
from needletrack.tracking.profile import noise_gray
from needletrack.tracking.silhouette import straightened, unit_mm

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
_ACROSS = np.arange(-6.5, 6.51, 0.5)
# Parts of the inside across the needle; spacing of the pictures of them along it, mm.
_PARTS = 5
_PICTURE_MM = 0.05
_SATURATED_GRAY = 250
# Profiles to either side are shifted by this many rows at most; each costs so much, grey^2 per row^2.
_MOST_LAG, _LAG_PRICE = 24, 0.02
_LEAST_NOISE_GRAY = 1.0
# So many neighbouring samples err together.
_CORRELATED = 12.0
# Another shape of end whose log evidence is within this of the best one's is a rival of it.
_RIVAL = 3.0
# Standard deviations, grey: of the background's level, slopes and bends, of an inside, of the difference between
# neighbouring parts of it, and between a part on the cone and on the shaft.
_PLANE_GRAY = (200.0, 30.0, 30.0, 30.0, 15.0, 15.0, 1.0)
_BEHIND = len(_PLANE_GRAY)
_INSIDE_GRAY, _NEIGHBOUR_GRAY, _CONE_GRAY = 150.0, 80.0, 50.0


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
    """One view straightened past the end: grey and weight (rows, columns); sine of the angle to the line of sight."""

    gray: Float
    weight: Float
    noise_gray: float
    sine: float


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
    pictures = [_picture(image, camera, local_mm, needle) for image, camera, local_mm in images]
    edges: list[_Edge | None] = [None, None]
    if flanks is not None:
        half_width = flanks.diameter_mm / 2 / unit_mm(needle)
        edges = [
            _Edge(half_width, blur_px / (camera.focal_px / float(np.median(local_mm[:, 2])) * unit_mm(needle)))
            for blur_px, (_, camera, local_mm) in zip(flanks.blur_px, images, strict=True)
        ]
    coarse = np.arange(tried_mm[0], tried_mm[1] + _COARSE_MM / 2, _COARSE_MM) + end_mm
    scans = [
        [_Scan(p, arc_mm, taper, appearance, unit_mm(needle), edge) for p, edge in zip(pictures, edges, strict=True)]
        for taper in needle.tip_tapers_mm
    ]
    # Every shape has its own best place, and its likelihood is too sharp to be compared on the coarse grid.
    samples = np.array([max(1.0, float(p.weight.sum())) for p in pictures])
    fine: list[tuple[Float, Float]] = []
    for views in scans:
        rough = np.stack([scan.misfits(coarse) for scan in views])
        cost = _negative_log(rough, np.maximum(rough[:, :, 0].min(axis=1) / samples, _LEAST_NOISE_GRAY**2))
        best = int((_together(coarse, cost) + _unforeseen(coarse, foreseen_mm)).argmin())
        near = np.arange(-_FINE_REACH_MM, _FINE_REACH_MM + _FINE_MM / 2, _FINE_MM) + coarse[best]
        fine.append((near, np.stack([scan.misfits(near) for scan in views])))
    # The scale of what is left over is each view's own: that of its best fit.
    scale = np.min([found[:, :, 0].min(axis=1) for _, found in fine], axis=0) / samples
    scale = np.maximum(scale, [p.noise_gray**2 for p in pictures])
    costs = [_negative_log(found, scale) for _, found in fine]
    both = [
        _together(places, cost) + _unforeseen(places, foreseen_mm)
        for (places, _), cost in zip(fine, costs, strict=True)
    ]
    tapered = int(np.argmin([each.min() for each in both]))
    near, found = fine[tapered]
    cost = costs[tapered]
    at_mm, least = _lowest(near, both[tapered]), float(both[tapered].min())
    sigma = [max(parameters.min_sigma_mm, _width_mm(near, view)) for view in cost]
    # Another shape of end that explains the pictures nearly as well would put the apex elsewhere.
    for (places, _), other in zip(fine, both, strict=True):
        if other is not both[tapered] and other.min() - least < _RIVAL:
            sigma = [float(np.hypot(s, (_lowest(places, other) - at_mm) / 2)) for s in sigma]
    contrast = [
        scan.contrast(arc_mm, float(of_view[:, 0].min()), float(each))
        for scan, of_view, each in zip(scans[tapered], found, scale, strict=True)
    ]
    return TipFit(
        at_mm,
        (_lowest(near, cost[0]), _lowest(near, cost[1])),
        (sigma[0], sigma[1]),
        (contrast[0], contrast[1]),
        float(needle.tip_tapers_mm[tapered]),
    )


def _negative_log(found: Float, scale: Float) -> Float:
    """Negative log evidence (2, T) of both views' misfits (2, T, 2) at their scales (2,)."""
    return np.asarray(found[:, :, 0] / scale[:, None] / 2 / _CORRELATED + found[:, :, 1] / 2)


def _unforeseen(at_mm: Float, foreseen_mm: tuple[float, float]) -> Float:
    """Negative log of how likely an apex at at_mm (T,) is for where it was expected, with what sigma."""
    expected, sigma = foreseen_mm
    return np.asarray(0.5 * ((at_mm - expected) / sigma) ** 2)


def _together(at_mm: Float, cost: Float) -> Float:
    """Negative log evidence (T,) of an apex at at_mm (T,) from that of each view (2, T), which may be a little off."""
    off = 0.5 * ((at_mm[:, None] - at_mm) / _VIEW_SIGMA_MM) ** 2
    return np.asarray((cost[:, None, :] + off).min(axis=2).sum(axis=0))


def _lowest(at: Float, cost: Float) -> float:
    """Where the parabola through the lowest of evenly spaced values and its neighbours is lowest."""
    i = int(np.clip(np.argmin(cost), 1, len(cost) - 2))
    bend = cost[i - 1] - 2 * cost[i] + cost[i + 1]
    shift = 0.0 if bend <= 0 else float(np.clip((cost[i - 1] - cost[i + 1]) / (2 * bend), -1, 1))
    return float(at[i] + shift * (at[1] - at[0]))


def _width_mm(at: Float, cost: Float) -> float:
    """Standard deviation of the place whose negative log likelihoods these are."""
    weight = np.exp(cost.min() - cost)
    weight /= weight.sum()
    return float(np.sqrt((weight * (at - weight @ at) ** 2).sum()))


def _picture(image: Image, camera: Camera, local_mm: Float, needle: Needle) -> _Picture:
    gray = straightened(image, camera, local_mm, _ACROSS, needle)
    inside = camera.contains(camera.project(local_mm), margin_px=4.0)
    toward = np.abs((unit(local_mm) * tangents(local_mm)).sum(axis=1))
    weight = (gray < _SATURATED_GRAY) & inside[:, None]
    sine = float(np.sqrt(max(0.0, 1 - np.median(toward) ** 2)))
    return _Picture(gray, weight.astype(np.float64), max(_LEAST_NOISE_GRAY, noise_gray(gray)), max(sine, 0.2))


@dataclass(frozen=True, slots=True)
class _Edge:
    """The true half width of a clipped needle and the blur of the lens, units across."""

    half_width: float
    blur: float


class _Scan:
    """One view against ends of one shape."""

    def __init__(
        self,
        picture: _Picture,
        arc_mm: Float,
        taper_mm: float,
        appearance: Appearance,
        unit_length_mm: float,
        edge: _Edge | None,
    ) -> None:
        self._picture, self._arc_mm = picture, arc_mm
        half_width, blur = float(HALF_WIDTHS[appearance.half_width]), BLURS[appearance.blur]
        self._before_mm, self._inside = _inside_pictures(taper_mm, appearance, unit_length_mm, picture.sine, edge)
        x = np.broadcast_to(_ACROSS / _ACROSS[-1], picture.gray.shape)
        along = (arc_mm - arc_mm.mean()) / (np.ptp(arc_mm) / 2)
        s = np.broadcast_to(along[:, None], picture.gray.shape)
        behind = _behind(picture.gray, half_width + 2 * blur)
        planes = np.stack([np.ones_like(x), x, s, x * s, x * x, s * s, behind]).reshape(_BEHIND, -1)
        gray = (picture.gray - np.median(picture.gray)).ravel()
        # What does not depend on where the apex is, weighted: the planes, and the picture itself as a seventh.
        fixed = np.concatenate([planes, gray[None]])
        self._weighted = fixed * picture.weight.ravel()
        self._fixed = self._weighted @ fixed.T
        self._prior = _prior(len(self._inside)) * picture.noise_gray**2 * _CORRELATED
        self._log_prior = float(np.linalg.slogdet(self._prior)[1])

    def misfits(self, at_mm: Float) -> Float:
        """For apexes at_mm (A,) along the curve, (A, 2): squared greys left over, log of what the parts could show.

        The second counts against an end of many parts (evidence, not likelihood).
        """
        index = np.rint((at_mm[:, None] - self._arc_mm - self._before_mm[0]) / _PICTURE_MM).astype(np.int64)
        count, weight = len(self._inside), self._picture.weight
        inside = np.take(self._inside, index, axis=1, mode="clip")
        weighted = inside if weight.all() else inside * weight
        inside, weighted = (each.reshape(count, len(at_mm), -1).swapaxes(0, 1) for each in (inside, weighted))
        mixed = inside @ self._weighted.T
        normal = np.empty((len(at_mm), *self._prior.shape))
        normal[:, :_BEHIND, :_BEHIND] = self._fixed[:_BEHIND, :_BEHIND]
        normal[:, _BEHIND:, :_BEHIND] = mixed[..., :_BEHIND]
        normal[:, :_BEHIND, _BEHIND:] = mixed[..., :_BEHIND].swapaxes(1, 2)
        normal[:, _BEHIND:, _BEHIND:] = weighted @ inside.swapaxes(1, 2)
        normal += self._prior
        target = np.concatenate(
            [np.broadcast_to(self._fixed[:_BEHIND, _BEHIND], (len(at_mm), _BEHIND)), mixed[..., _BEHIND]], axis=1
        )
        explained = (np.linalg.solve(normal, target[..., None])[..., 0] * target).sum(axis=1)
        freedom = np.linalg.slogdet(normal)[1] - self._log_prior
        return np.column_stack([self._fixed[_BEHIND, _BEHIND] - explained, freedom])

    def contrast(self, arc_mm: Float, least: float, scale: float) -> float:
        """By how many sigmas an end of that misfit is better than a needle that goes on, and than none."""
        others = self.misfits(np.array([arc_mm[-1] + 4.0, arc_mm[0] - 2.0]))[:, 0]
        return float(np.sqrt(max(0.0, (others.min() - least) / scale / _CORRELATED)))


def _inside_pictures(
    taper_mm: float, appearance: Appearance, unit_length_mm: float, sine: float, edge: _Edge | None
) -> tuple[Float, Float]:
    """Distances before the apex (S,), mm, and the pictures (parts, S, columns) of each part of the inside there.

    Before and beyond them all is as in the outermost. edge: of a clipped needle, which looks wider than it is.
    """
    half_width, blur = float(HALF_WIDTHS[appearance.half_width]), BLURS[appearance.blur]
    true = half_width if edge is None else min(edge.half_width, half_width)
    radius_mm = true * unit_length_mm
    along_mm = blur * unit_length_mm / sine
    # A clipped outline ends beyond the apex, by what it is wider times the slope of the cone.
    widened_mm = (half_width - true) / true * max(taper_mm, radius_mm)
    reach = int(np.ceil((4 * along_mm + widened_mm) / _PICTURE_MM)) + 1
    before = np.arange(-reach, np.ceil(max(taper_mm, radius_mm) / _PICTURE_MM) + reach + 1) * _PICTURE_MM
    if taper_mm > 0:
        width = true * np.clip(before / taper_mm, 0.0, 1.0)
    else:
        # A hemisphere's picture is a circle about its centre, which lies its radius before the apex: seen from its
        # side that is where the shaft ends, seen from the front the circle shows whole.
        past = np.maximum((radius_mm - before) * sine, 0.0) / radius_mm
        width = true * np.sqrt(np.clip(1 - past**2, 0.0, 1.0))
    if edge is not None:
        along = edge.blur * unit_length_mm / sine / _PICTURE_MM
        width = outline(width, (edge.blur, along), half_width)
    borders = np.linspace(-1, 1, _PARTS + 1)[:, None, None] * width[:, None]
    passed = ndtr((_ACROSS - borders) / blur)
    parts = passed[:-1] - passed[1:]
    on_end = (before < (taper_mm or radius_mm))[:, None]
    parts = np.concatenate([np.where(on_end, 0.0, parts), np.where(on_end, parts, 0.0)])
    return before, np.asarray(gaussian_filter1d(parts, along_mm / _PICTURE_MM, axis=1, mode="nearest"))


def _apart(one: Float, other: Float, lag: int) -> float:
    """Mean squared difference of two profiles, the other `lag` rows further on, where they overlap."""
    ahead, behind = max(lag, 0), max(-lag, 0)
    count = len(one) - abs(lag)
    off = one[behind : behind + count] - other[ahead : ahead + count]
    return float(off @ off) / count


def _behind(gray: Float, reach: float) -> Float:
    """The background (rows, columns), behind the needle, to `reach` units either side, as it is beside it.

    What crosses there, a vessel say, crosses straight: profiles to either side are alike but for a shift along.
    """
    smooth = gaussian_filter(gray, (1.0, 0.7))
    # Of a needle that nearly fills the picture the outermost columns are taken.
    beside = np.abs(_ACROSS) > min(reach, _ACROSS[-1] - 0.75)
    left, right = np.flatnonzero(beside & (_ACROSS < 0))[-1], np.flatnonzero(beside & (_ACROSS > 0))[0]
    share = np.clip((_ACROSS - _ACROSS[left]) / (_ACROSS[right] - _ACROSS[left]), 0.0, 1.0)
    rows = np.arange(len(gray), dtype=np.float64)
    one, other = smooth[:, left], smooth[:, right]
    lag = min(range(-_MOST_LAG, _MOST_LAG + 1), key=lambda lag: _apart(one, other, lag) + _LAG_PRICE * lag**2)
    filled = smooth.copy()
    for column in np.flatnonzero(~beside):
        t = share[column]
        filled[:, column] = np.interp(rows - lag * t, rows, one) * (1 - t)
        filled[:, column] += np.interp(rows + lag * (1 - t), rows, other) * t
    return np.asarray(filled - np.median(filled))


def _prior(parts: int) -> Float:
    """Inverse prior covariance of the background's 6 numbers and the inside's parts, grey^-2."""
    precision = np.zeros((_BEHIND + parts, _BEHIND + parts))
    precision[:_BEHIND, :_BEHIND] = np.diag(np.array(_PLANE_GRAY) ** -2.0)
    steps = np.diff(np.eye(_PARTS), axis=0) / _NEIGHBOUR_GRAY
    each = steps.T @ steps + np.eye(_PARTS) / _INSIDE_GRAY**2
    for start in range(_BEHIND, _BEHIND + parts, _PARTS):
        precision[start : start + _PARTS, start : start + _PARTS] = each
    apart = np.hstack([np.eye(_PARTS), -np.eye(_PARTS)]) / _CONE_GRAY
    precision[_BEHIND:, _BEHIND:] += apart.T @ apart
    return precision
