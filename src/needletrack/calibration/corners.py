"""Corners of a checkerboard to a few hundredths of a pixel: two blurred edges that cross, fitted to the picture.

Within less than a square of it, a corner is a + b·(p - p0) + c erf(d1 / √2 s) erf(d2 / √2 s): d1 and d2 are distances
from its two edges, s the blur. Gauss-Newton over all pixels around, all corners at once; where the picture is saturated
the model may go beyond it, or white that is overexposed eats into black and passes for blur. On path-traced boards of
known place whose squares are 10 px wide, localized Radon transforms (Duda & Frese 2018) leave 0.06 px a coordinate,
alike for neighbouring corners, so that a rig is four times as wrong as its residuals promise; gradients
(cv2.cornerSubPix) 0.077 px at best and 0.3 px where their window meets the next corner; this 0.03 px.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from needletrack.records import Float, Image

# Pixels within this share of a square, seen from the corner, belong to it alone.
_REACH = 0.42
_MOST_HALF_PX = 10
_ROUNDS = 12
_SATURATED_GRAY = 250.0
_SETTLED_PX = 1e-3
_BLUR_PX, _USUAL_BLUR_PX = (0.25, 6.0), 0.7


@dataclass(frozen=True, slots=True)
class FittedCorners:
    """corners_px (N, 2), NaN where the fit failed; blur_px and contrast_gray (N,): sigma of the edges, half step.

    misfit (N,): what the model leaves of the picture, rms, as a share of the half step; small where a corner is.
    """

    corners_px: Float
    blur_px: Float
    contrast_gray: Float
    misfit: Float


def fit_corners(
    image: Image, rough_px: Float, along_px: Float, down_px: Float, clear: float | None = None
) -> FittedCorners:
    """Corners near rough_px (N, 2) in an image (rows, columns).

    along_px, down_px (N, 2): from each corner to the next along the board's rows and columns. clear: the share of a
    square next to its edges that markers leave free.
    """
    count = len(rough_px)
    shortest = float(np.median(np.minimum(np.linalg.norm(along_px, axis=1), np.linalg.norm(down_px, axis=1))))
    half = int(np.clip(np.ceil(_REACH * 1.5 * shortest), 2, _MOST_HALF_PX))
    middle = np.rint(rough_px).astype(np.int64)
    steps = np.arange(-half, half + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(steps, steps))
    columns, rows = middle[:, :1] + dx, middle[:, 1:] + dy
    height, width = image.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    gray = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    away = np.stack([columns, rows], axis=-1) - rough_px[:, None]
    lattice = np.linalg.inv(np.stack([along_px, down_px], axis=-1))
    share = np.abs(away @ lattice.swapaxes(1, 2))
    # The border is soft: a pixel that comes or goes must not move the corner.
    weight = np.clip((_REACH - share.max(axis=-1)) / 0.1, 0, 1) * inside
    if clear is not None:
        weight *= np.clip((clear - share.min(axis=-1)) / 0.05, 0, 1)
    # x0 y0 (from rough), two angles, log of the blur, level, two slopes, contrast.
    state = np.zeros((count, 9))
    state[:, 2] = np.arctan2(along_px[:, 1], along_px[:, 0])
    state[:, 3] = np.arctan2(down_px[:, 1], down_px[:, 0])
    total = np.maximum(weight.sum(axis=1), 1e-9)
    state[:, 5] = (weight * gray).sum(axis=1) / total
    signs = np.sign((away @ lattice.swapaxes(1, 2)).prod(axis=-1))
    state[:, 8] = (weight * (gray - state[:, 5:6]) * signs).sum(axis=1) / total
    # White that is saturated may be far brighter: begun beyond it, the fit finds how far; begun below, it does not.
    is_saturated = ((gray >= _SATURATED_GRAY) * weight).sum(axis=1) > 0.2 * total
    darkest = np.where(weight > 0, gray, np.inf).min(axis=1)
    state[:, 5] = np.where(is_saturated, 255.0, state[:, 5])
    state[:, 8] = np.where(is_saturated, np.sign(state[:, 8]) * (255.0 - darkest), state[:, 8])
    state[:, 4] = np.log(_USUAL_BLUR_PX)
    damping = np.full(count, 1e-3)
    residual, jacobian = _linearized(state, away, gray)
    cost = (weight * residual**2).sum(axis=1)
    for _ in range(_ROUNDS):
        weighted = jacobian * weight[..., None]
        normal = weighted.swapaxes(1, 2) @ jacobian
        gradient = (weighted.swapaxes(1, 2) @ residual[..., None])[..., 0]
        diagonal = np.einsum("nii->ni", normal)
        normal[:, np.arange(9), np.arange(9)] += damping[:, None] * diagonal + 1e-9 * (1 + diagonal)
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -0.5, 0.5)
        step[:, 2:5] = np.clip(step[:, 2:5], -0.3, 0.3)
        ahead = state + step
        ahead[:, 4] = np.clip(ahead[:, 4], *np.log(_BLUR_PX))
        residual_ahead, jacobian_ahead = _linearized(ahead, away, gray)
        cost_ahead = (weight * residual_ahead**2).sum(axis=1)
        better = cost_ahead <= cost
        state = np.where(better[:, None], ahead, state)
        residual = np.where(better[:, None], residual_ahead, residual)
        jacobian = np.where(better[:, None, None], jacobian_ahead, jacobian)
        cost = np.where(better, cost_ahead, cost)
        damping = np.where(better, damping / 5, damping * 10)
        if np.abs(step[better, :2]).max(initial=0.0) < _SETTLED_PX:
            break
    found = rough_px + state[:, :2]
    # A fit that ran away, or that sees no corner, is none.
    lost = (np.linalg.norm(state[:, :2], axis=1) > 0.25 * shortest) | (total < 12) | ~np.isfinite(found).all(axis=1)
    found[lost] = np.nan
    contrast = np.abs(state[:, 8])
    misfit = np.sqrt(cost / total) / np.maximum(contrast, 1.0)
    return FittedCorners(found, np.exp(state[:, 4]), contrast, misfit)


def _linearized(state: Float, away: Float, gray: Float) -> tuple[Float, Float]:
    """What is left of the greys (N, M), and the model's derivatives (N, M, 9)."""
    p = away - state[:, None, :2]
    blur = np.exp(state[:, 4])[:, None]
    edges = []
    for column in (2, 3):
        cosine, sine = np.cos(state[:, column])[:, None], np.sin(state[:, column])[:, None]
        # Distance from the edge, positive to its left, and along it.
        distance = -sine * p[..., 0] + cosine * p[..., 1]
        along = cosine * p[..., 0] + sine * p[..., 1]
        scaled = distance / (np.sqrt(2) * blur)
        slope = np.exp(-(scaled**2)) * np.sqrt(2 / np.pi) / blur
        edges.append((erf(scaled), slope, distance, along, cosine, sine))
    (first, first_slope, first_at, first_along, c1, s1), (second, second_slope, second_at, second_along, c2, s2) = edges
    contrast = state[:, 8, None]
    product = first * second
    model = state[:, 5, None] + (state[:, None, 6:8] * p).sum(axis=-1) + contrast * product
    by_first, by_second = contrast * second * first_slope, contrast * first * second_slope
    jacobian = np.stack(
        [
            by_first * s1 + by_second * s2 - state[:, 6, None],
            -by_first * c1 - by_second * c2 - state[:, 7, None],
            -by_first * first_along,
            -by_second * second_along,
            -by_first * first_at - by_second * second_at,
            np.ones_like(model),
            p[..., 0],
            p[..., 1],
            product,
        ],
        axis=-1,
    )
    # What is saturated was at least so bright: a model beyond it is no misfit (a censored fit).
    beyond = (gray >= _SATURATED_GRAY) & (model >= gray)
    return np.where(beyond, 0.0, gray - model), np.where(beyond[..., None], 0.0, jacobian)
