"""A needle so bright that the picture saturates: its axis, its diameter and its end from what is left of its flanks.

Where the needle is clipped only the outer slope of the blurred edge is left, which lies beyond the edge by as much as
the needle is brighter than white: it looks too wide, more so on its brighter side. How steeply the slope falls off
tells how bright it is. Each flank is an edge of unknown brightness behind the blur of the lens; the raw pixels that
are not clipped have its value, those that are at least white (a censored or Tobit model, Tobin 1958, Econometrica 26).
Interpolation between pixels would ring at clipped ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.special import log_ndtr, ndtr

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float, Image, Int
from needletrack.tracking.profile import Mask
from needletrack.tracking.silhouette import AxisOffsets

# A pixel of so much is clipped: the last value but one may still be rounded noise of a clipped one.
CLIPPED_GRAY = 254
# The background is seen this far beside the needle as wide as it looks, px; what lies deeper inside than that is
# clipped whatever the edge: two sigmas of the widest blur and the widening.
_RIM_PX, _DEEP_PX = 4.5, 2.5
# A section is clipped where this share of its pixels is, of those within this share of its half width as it looks. A
# streak of light on steel leaves a rim unclipped that is wider.
_CLIPPED_SHARE, _CORE = 0.95, 0.6
# A needle is clipped along most of itself, or has a glint on it, which is narrower and says nothing of its edges.
_CLIPPED_ALONG = 0.6
# Below this share of its middle a needle is not looked at more closely; from this share on it is white all over.
WORTH_A_LOOK, WHITE = 0.3, 0.85
# So many points of the curve make a window: errors of neighbouring axis points count as one over that length.
_POINTS_PER_WINDOW = 3
# Fewer windows in both views than that do not hold a diameter.
_LEAST_WINDOWS = 4
# The blur, px, and its standard deviation (log): that of lenses in and nearly in focus, 0.45 to 1.1.
_BLUR_PX, _BLUR_LOG = 0.7, 0.3
# How bright a flank is over its background, in units of what is left to white, and standard deviations (log): of a
# side as a whole, of which next to nothing is known; of one window after another, 3 mm on, which a bend of 0.01 per mm
# turns by 0.03 rad towards the light.
_BRIGHT, _BRIGHT_LOG, _BRIGHT_STEP_LOG = 3.0, 3.0, 0.03
# Background's tilt away from the needle, grey per px.
_TILT_GRAY = 1.0
# The blur is a Gaussian and the flank evenly bright to this share.
_SHAPE_SHARE = 0.03
_LEAST_NOISE_GRAY = 1.0
# So many neighbouring pixels err together, for what the model leaves out is as wide as the blur: for sigmas.
_CORRELATED = 4.0
# Residuals beyond so many sigmas count for less and less (Cauchy).
_ROBUST = 4.0
# One step moves background, tilt and log brightness by no more than this; the axis was known to _MIDDLE_PX before.
_LONGEST_STEP, _MIDDLE_PX = np.array([50.0, 3.0, 0.7]), 1.0
# A contour is drawn in steps of this share of the blur.
_CONTOUR_STEP = 0.1
_ROUNDS, _UNTIL_PX, _NEAR_PX = 20, 5e-3, 5e-2
# An axis point is no better than this, px: pixels are not exactly square and evenly sensitive.
_LEAST_SIGMA_PX = 0.03
# Clipping widens each side by at most so many sigmas of the blur, at an edge some ten times brighter than white.
_MOST_WIDENING = 1.7


@dataclass(frozen=True, slots=True)
class Flanks:
    """A clipped needle: its true diameter_mm, and the blur_px of the lens in the left and in the right view."""

    diameter_mm: float
    blur_px: tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Pixels beside a curve: point (K,) they belong to, signed distance across_px (K,) of it, gray (K,)."""

    point: Int
    across_px: Float
    gray: Float


@dataclass(frozen=True, slots=True)
class _View:
    """The clipped windows of one view and the pixels of their F = 2 W flanks, low and high side of each in turn.

    window (N,) of each point, -1: not clipped. Of each pixel (F, K): across_px, radius_scale px per mm of radius,
    gray, and whether it is there. step_log (W - 1,): how much brightness may differ from window to window.
    background (F,).
    """

    window: Int
    across_px: Float
    radius_scale: Float
    gray: Float
    there: Float
    step_log: Float
    background: Float
    noise_gray: float

    @property
    def windows(self) -> int:
        """Number W of them."""
        return len(self.background) // 2


def clipped_axis(
    images: tuple[Image, Image],
    rig: StereoRig,
    points_mm: Float,
    observed: tuple[AxisOffsets, AxisOffsets],
    expected_px: Sequence[Float],
    seen_diameter_mm: float,
    is_shaft: Mask,
    before: Flanks | None = None,
) -> tuple[Flanks, tuple[AxisOffsets, AxisOffsets]] | None:
    """The flanks of a needle about a curve (N, 3), and the offsets observed there put right where they are clipped.

    expected_px: offset (N,) of this curve in each view from where it was observed. is_shaft (N,): whether the needle is
    known to have its full thickness there. before: its flanks as they were nearly. None where too little is clipped, or
    it is no evenly bright needle.
    """
    cameras = ((rig.left, points_mm), (rig.right, rig.right_from_left.apply(points_mm)))
    views = [
        _view(image, camera, local_mm, seen_diameter_mm, is_shaft)
        for image, (camera, local_mm) in zip(images, cameras, strict=True)
    ]
    if sum(0 if view is None else view.windows for view in views) < _LEAST_WINDOWS:
        return None
    px_per_mm = [camera.focal_px / float(np.median(local_mm[:, 2])) for camera, local_mm in cameras]
    solved = _solve(views, seen_diameter_mm / 2, float(np.mean(px_per_mm)), before)
    if solved is None:
        return None
    radius_mm, blur_px, per_view = solved
    widening_px = (seen_diameter_mm / 2 - radius_mm) * np.mean(px_per_mm)
    if not -0.5 * max(blur_px) < widening_px < _MOST_WIDENING * max(blur_px):
        return None
    offsets = []
    for view, found, seen, at in zip(views, per_view, observed, expected_px, strict=True):
        if view is None or found is None:
            offsets.append(seen)
            continue
        middle_px, sigma_px = found
        known = view.window >= 0
        # On a cone, or where one may be, the silhouette of such a needle is as biased as elsewhere.
        offsets.append(
            AxisOffsets(
                seen.center_px,
                seen.normal,
                np.where(known, at + middle_px[view.window], seen.offset_px),
                np.where(known, sigma_px[view.window], np.where(is_shaft, seen.sigma_px, np.inf)),
            )
        )
    return Flanks(2 * radius_mm, blur_px), (offsets[0], offsets[1])


def _pixels(image: Image, camera: Camera, local_mm: Float, reach_px: float) -> _Pixels:
    """The pixels within reach_px of a curve (N, 3) in this camera's frame, each with the point it lies beside."""
    center = camera.project(local_mm)
    along = tangents(center)
    spacing = np.linalg.norm(np.gradient(center, axis=0), axis=1)
    turn = np.gradient(along, axis=0)
    bend = (turn[:, 1] * along[:, 0] - turn[:, 0] * along[:, 1]) / np.maximum(spacing, 1e-6)
    side = int(np.ceil(np.hypot(reach_px, spacing.max() / 2))) + 1
    grid = np.stack(np.meshgrid(np.arange(-side, side + 1), np.arange(-side, side + 1)), axis=-1).reshape(-1, 2)
    at = np.rint(center).astype(np.int64)[:, None] + grid
    apart = at - center[:, None]
    s = (apart * along[:, None]).sum(axis=2)
    across = apart[..., 1] * along[:, None, 0] - apart[..., 0] * along[:, None, 1] - 0.5 * bend[:, None] * s**2
    rows, columns = image.shape
    beside = (s >= -spacing[:, None] / 2) & (s < spacing[:, None] / 2) & (np.abs(across) < reach_px)
    beside &= (at >= 0).all(axis=2) & (at[..., 0] < columns) & (at[..., 1] < rows)
    point, which = np.nonzero(beside)
    x, y = at[point, which].T
    return _Pixels(point, across[point, which], image[y, x].astype(np.float64))


def _view(image: Image, camera: Camera, local_mm: Float, seen_diameter_mm: float, is_shaft: Mask) -> _View | None:
    """What one view shows of a needle that it clips; None where it does not."""
    scale = camera.focal_px / local_mm[:, 2]
    seen_px = seen_diameter_mm / 2 * scale
    pixels = _pixels(image, camera, local_mm, float(seen_px.max()) + _RIM_PX)
    n = len(local_mm)
    core = np.abs(pixels.across_px) < _CORE * seen_px[pixels.point]
    count = np.bincount(pixels.point[core], minlength=n)
    clipped = np.bincount(pixels.point[core & (pixels.gray >= CLIPPED_GRAY)], minlength=n)
    usable = is_shaft & (count > 0) & (clipped >= _CLIPPED_SHARE * count)
    group = np.minimum(np.arange(n) // _POINTS_PER_WINDOW, max(0, n // _POINTS_PER_WINDOW - 1))
    kept = np.unique(group[usable])
    if len(kept) == 0 or usable.sum() < _CLIPPED_ALONG * is_shaft.sum():
        return None
    window = np.where(usable, np.searchsorted(kept, group), -1)
    beside = np.abs(pixels.across_px) - seen_px[pixels.point]
    mine = (window[pixels.point] >= 0) & (beside > -_DEEP_PX) & (beside < _RIM_PX)
    flank = 2 * window[pixels.point] + (pixels.across_px > 0)
    order = np.flatnonzero(mine)[np.argsort(flank[mine], kind="stable")]
    starts = np.searchsorted(flank[order], np.arange(2 * len(kept) + 1))
    most = int(np.diff(starts).max())
    there = np.arange(most) < np.diff(starts)[:, None]
    at = order[np.minimum(starts[:-1, None] + np.arange(most), len(order) - 1)]
    outer = there & (beside[at] > _RIM_PX / 2)
    if not outer.any(axis=1).all():
        return None
    gray = pixels.gray[at]
    background = np.nanmedian(np.where(outer, gray, np.nan), axis=1)
    # The mean departure of a normal one is 0.798 sigma.
    scatter = np.abs(gray - background[:, None])[outer]
    return _View(
        window,
        pixels.across_px[at],
        scale[pixels.point[at]],
        gray,
        there.astype(np.float64),
        _BRIGHT_STEP_LOG * np.sqrt(np.diff(kept)),
        background,
        max(_LEAST_NOISE_GRAY, float(scatter.mean()) / 0.798),
    )


_Found = tuple[Float, Float]


def _solve(
    views: Sequence[_View | None], seen_radius_mm: float, px_per_mm: float, before: Flanks | None
) -> tuple[float, tuple[float, float], list[_Found | None]] | None:
    """Radius, mm, both blurs, px, and of each view its windows' middle and sigma (W,), px; None: it does not settle.

    Gauss-Newton over all of them at once, with steps no longer than the model is nearly linear. The windows of a view
    make a band, which radius and blurs border (Schur complement).
    """
    if before is None:
        radius, log_blur = seen_radius_mm - 0.6 * _BLUR_PX / px_per_mm, np.full(2, np.log(_BLUR_PX))
    else:
        radius, log_blur = before.diameter_mm / 2, np.log(before.blur_px)
    middles = [np.zeros(0 if v is None else v.windows) for v in views]
    flanks = [np.zeros((0, 3)) if v is None else _first_flanks(v) for v in views]
    firsts = [each.copy() for each in flanks]
    moved = np.inf
    bands: list[_Band | None] = []
    border = np.eye(3)
    for _ in range(_ROUNDS):
        border = np.diag([1e-6, _BLUR_LOG**-2, _BLUR_LOG**-2])
        target = np.array([0.0, *((log_blur - np.log(_BLUR_PX)) * _BLUR_LOG**-2)])
        bands = []
        try:
            for k, view in enumerate(views):
                if view is None:
                    bands.append(None)
                    continue
                band = _band(view, radius, float(np.exp(log_blur[k])), middles[k], flanks[k], firsts[k])
                bands.append(band)
                # The border's columns are radius and this view's blur.
                mine = np.array([0, 1 + k])
                border[np.ix_(mine, mine)] += band.border - band.beside.T @ band.solved[:, 1:]
                target[mine] += band.target - band.beside.T @ band.solved[:, 0]
            step = -np.linalg.solve(border, target)
        except (LinAlgError, ValueError):
            return None
        radius += float(np.clip(step[0], -0.4 / px_per_mm, 0.4 / px_per_mm))
        log_blur = np.log(np.clip(np.exp(log_blur + np.clip(step[1:], -0.15, 0.15)), 0.3, 2.0))
        for k, solved in enumerate(bands):
            if solved is not None:
                own = -(solved.solved[:, 0] + solved.solved[:, 1:] @ step[[0, 1 + k]]).reshape(-1, 7)
                middles[k] = middles[k] + np.clip(own[:, 0], -0.5, 0.5)
                flanks[k] = flanks[k] + np.clip(own[:, 1:].reshape(-1, 3), -_LONGEST_STEP, _LONGEST_STEP)
        moved = max(abs(step[0]) * px_per_mm, np.abs(step[1:]).max())
        if moved < _UNTIL_PX:
            break
    if moved > _NEAR_PX or radius <= 0:
        return None
    inverse = np.linalg.inv(border)
    found: list[_Found | None] = []
    for k, last in enumerate(bands):
        if last is None:
            found.append(None)
            continue
        by = last.solved[::7, 1:]
        spread = ((by @ inverse[np.ix_([0, 1 + k], [0, 1 + k])]) * by).sum(axis=1)
        units = np.zeros((len(last.solved), len(by)))
        units[7 * np.arange(len(by)), np.arange(len(by))] = 1.0
        variance = np.diagonal(solveh_banded(last.normal, units, lower=True)[::7]) + spread
        variance = _CORRELATED * np.maximum(1.0, last.misfit) * variance
        found.append((middles[k], np.hypot(np.sqrt(variance), _LEAST_SIGMA_PX)))
    return radius, (float(np.exp(log_blur[0])), float(np.exp(log_blur[1]))), found


@dataclass(frozen=True, slots=True)
class _Band:
    """Normal equations of one view's windows, of which each has a middle, and background, tilt, log brightness twice.

    normal (8, 7 W) lower band; beside (7 W, 2) by radius and log blur, border (2, 2) of these, target (2,) their
    gradient; solved (7 W, 3): the band's solution for its own gradient and for `beside`. misfit (W,).
    """

    normal: Float
    beside: Float
    border: Float
    target: Float
    solved: Float
    misfit: Float


def _band(view: _View, radius: float, blur: float, middle: Float, flanks: Float, firsts: Float) -> _Band:
    hessian, slope, misfit = _flank_normals(view, radius, blur, middle, flanks)
    count = view.windows
    blocks, beside, own = np.zeros((count, 7, 7)), np.zeros((count, 7, 2)), np.zeros((count, 7))
    for side in (0, 1):
        here = np.array([0, *range(1 + 3 * side, 4 + 3 * side)])
        blocks[:, here[:, None], here] += hessian[side::2, 2:, 2:]
        beside[:, here] += hessian[side::2, 2:, :2]
        own[:, here] += slope[side::2, 2:]
    own[:, 0] += middle * _MIDDLE_PX**-2
    blocks[:, 0, 0] += _MIDDLE_PX**-2
    coupling = np.zeros((count, 7))
    for side in (0, 1):
        tilt, log = 2 + 3 * side, 3 + 3 * side
        blocks[:, tilt, tilt] += _TILT_GRAY**-2
        own[:, tilt] += flanks[side::2, 1] * _TILT_GRAY**-2
        # Each of so many windows knows of the side as a whole its part.
        precision = np.eye(count) / (count * _BRIGHT_LOG**2)
        apart = np.diff(np.eye(count), axis=0) / view.step_log[:, None]
        precision = precision + apart.T @ apart
        blocks[:, log, log] += np.diagonal(precision)
        coupling[:-1, log] = np.diagonal(precision, -1)
        own[:, log] += precision @ (flanks[side::2, 2] - firsts[side::2, 2].mean())
    normal = np.zeros((8, 7 * count))
    for row in range(7):
        for column in range(row + 1):
            normal[row - column, column::7] = blocks[:, row, column]
    normal[7] = coupling.ravel()
    side_by_side = beside.reshape(-1, 2)
    solved = solveh_banded(normal, np.column_stack([own.ravel(), side_by_side]), lower=True)
    return _Band(normal, side_by_side, hessian[:, :2, :2].sum(axis=0), slope[:, :2].sum(axis=0), solved, misfit)


def _first_flanks(view: _View) -> Float:
    """Background, tilt and log brightness (2 W, 3) to begin with."""
    white = np.maximum(CLIPPED_GRAY - view.background, 10.0)
    return np.column_stack([view.background, np.zeros(len(white)), np.log(_BRIGHT * white)])


def _flank_normals(view: _View, radius: float, blur: float, middle: Float, linear: Float) -> tuple[Float, Float, Float]:
    """Hessian (F, 6, 6) and gradient (F, 6) of the negative log likelihood of each flank by radius, log blur, middle,
    background, tilt and log brightness; and the mean squared misfit (W,) of each window."""
    half = radius * view.radius_scale
    x = view.across_px - np.repeat(middle, 2)[:, None]
    low, high = (x + half) / blur, (half - x) / blur
    passed = ndtr(low) + ndtr(high) - 1
    low_density, high_density = (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) for z in (low, high))
    background, slant, bright = linear[:, 0, None], linear[:, 1, None], np.exp(linear[:, 2, None])
    tilt = np.abs(view.across_px) - half
    jacobian = np.stack(
        [
            bright * (low_density + high_density) / blur * view.radius_scale,
            -bright * (low_density * low + high_density * high),
            -bright * (low_density - high_density) / blur,
            np.ones_like(x),
            tilt,
            bright * passed,
        ],
        axis=2,
    )
    sigma = np.hypot(view.noise_gray, _SHAPE_SHARE * np.maximum(view.gray - view.background[:, None], 0.0))
    slope, curvature, misfit = _censored(background + slant * tilt + bright * passed, view.gray, sigma)
    free = view.there * (view.gray < CLIPPED_GRAY)
    total, number = ((v * free).reshape(len(middle), -1).sum(axis=1) for v in (misfit, np.ones_like(x)))
    each = total / np.maximum(number - 7, 1)
    # Where something else is beside the needle, a window has less of a say.
    weight = view.there / np.repeat(np.maximum(1.0, each / np.median(each)), 2)[:, None]
    turned = jacobian.swapaxes(1, 2)
    hessian = turned @ (jacobian * (weight * curvature)[:, :, None])
    gradient = (turned @ (weight * slope)[:, :, None])[:, :, 0]
    return hessian, gradient, each


def _censored(level: Float, gray: Float, sigma: Float) -> tuple[Float, Float, Float]:
    """Slope and curvature by `level` of the negative log likelihood of grey levels, and twice that likelihood."""
    is_clipped = gray >= CLIPPED_GRAY
    above = np.clip((level - (CLIPPED_GRAY - 0.5)) / sigma, -_ROBUST, 30.0)
    log = log_ndtr(above)
    mills = np.exp(-0.5 * above**2 - log) / np.sqrt(2 * np.pi)
    off = (level - gray) / sigma
    weight = 1 / (1 + (off / _ROBUST) ** 2)
    slope = np.where(is_clipped, -mills, weight * off) / sigma
    curvature = np.where(is_clipped, mills * (mills + above), weight) / sigma**2
    twice = np.where(is_clipped, -2 * log, _ROBUST**2 * np.log1p((off / _ROBUST) ** 2))
    return slope, curvature, twice


def outline(half_width: Float, blur: tuple[float, float], seen: float) -> Float:
    """Half width (S,) as it looks where clipped, of a body of that half width (S,) whose thickest part looks like seen.

    blur: standard deviation across, in the units of the widths, and along, in samples. What is as bright as the edge
    seen is a contour of the blurred picture: about an apex it draws in, where there is too little light to clip.
    """
    across, along = blur
    level = float(ndtr((half_width.max() - seen) / across))
    x = np.arange(0.0, seen + 3 * _CONTOUR_STEP * across, _CONTOUR_STEP * across)
    passed = ndtr((half_width[:, None] - x) / across) + ndtr((half_width[:, None] + x) / across) - 1
    passed = gaussian_filter1d(passed, along, axis=0, mode="nearest")
    beyond = np.argmax(passed < level, axis=1)
    rows = np.arange(len(passed))
    inner, outer = passed[rows, np.maximum(beyond - 1, 0)], passed[rows, beyond]
    share = np.clip((inner - level) / np.maximum(inner - outer, 1e-12), 0.0, 1.0)
    return np.where(beyond > 0, x[np.maximum(beyond - 1, 0)] + share * _CONTOUR_STEP * across, 0.0)
