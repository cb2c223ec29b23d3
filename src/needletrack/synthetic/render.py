"""Pictures of tubes: materials, lens, camera noise, eight bits."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.geometry.camera import Camera
from needletrack.records import Float, Image
from needletrack.synthetic.tube import BLUR_REACH, Outline

GreyLevels = npt.NDArray[np.float32]

# OpenCV draws a band through every so many pixels of an axis; the rest is its sagitta and rounding.
BAND_STEP_PX = 6.0
BAND_SPARE_PX = 2.0


@dataclass(frozen=True, slots=True)
class Material:
    """What a tube looks like: its grey level, and a streak of mirrored light added to it.

    Levels in 8-bit steps, above 255 saturates; streak_half_width is a share of the tube's half width.
    """

    level: float
    streak_level: float = 0.0
    streak_half_width: float = 0.15


@dataclass(frozen=True, slots=True)
class Lens:
    """The point spread's standard deviation, pixel area included; the share of light lost in corners."""

    blur_px: float = 0.8
    vignetting: float = 0.0


@dataclass(frozen=True, slots=True)
class Noise:
    """Camera noise in 8-bit steps: a constant part, and shot noise whose variance grows with the level."""

    read: float = 1.0
    shot_variance_per_level: float = 0.02

    def sigma(self, levels: npt.ArrayLike) -> Float:
        """Standard deviation at grey levels, without the rounding to eight bits (1/12 of variance)."""
        return np.sqrt(self.read**2 + self.shot_variance_per_level * np.asarray(levels, dtype=np.float64))


NOISE_FREE = Noise(0.0, 0.0)


def vignette(camera: Camera, lost_in_corners: float) -> GreyLevels:
    """Transmission (rows, columns) that falls with the squared distance from the principal point."""
    width, height = camera.size_px
    u, v = camera.matrix[0, 2], camera.matrix[1, 2]
    x = ((np.arange(width) - u) ** 2).astype(np.float32)
    y = ((np.arange(height) - v) ** 2).astype(np.float32)
    return np.asarray(1 - lost_in_corners * (y[:, None] + x) / (y.max() + x.max()), dtype=np.float32)


def painted(levels: GreyLevels, layers: Sequence[tuple[Outline, Material]], lens: Lens) -> GreyLevels:
    """Grey levels (rows, columns) with tubes painted over them, the later ones in front."""
    picture = levels.copy()
    for shape, material in layers:
        u, v = _pixels_near(shape, lens.blur_px, picture.shape)
        if len(u) == 0:
            continue
        points = np.column_stack([u, v]).astype(np.float64)
        if material.streak_level == 0:
            covered = shape.coverage(points, lens.blur_px)
            light = material.level * covered
        else:
            covered, streak = shape.coverage_and_streak(points, lens.blur_px, material.streak_half_width)
            light = material.level * covered + material.streak_level * streak
        picture[v, u] = picture[v, u] * (1 - covered) + light
    return picture


def exposed(levels: GreyLevels, noise: Noise, rng: np.random.Generator) -> Image:
    """The camera's 8-bit image (rows, columns) of grey levels: shot and read noise, rounded and clipped."""
    noisy = levels
    if noise != NOISE_FREE:
        sigma = np.sqrt(np.float32(noise.read**2) + np.float32(noise.shot_variance_per_level) * levels)
        noisy = levels + sigma * rng.standard_normal(levels.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _pixels_near(
    shape: Outline, blur_px: float, size: tuple[int, ...]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    reach = shape.half_band_px + BLUR_REACH * blur_px + BAND_SPARE_PX
    picks = np.unique(np.searchsorted(shape.along_px, np.arange(0.0, shape.along_px[-1], BAND_STEP_PX)))
    path = shape.axis_px[np.append(picks, len(shape.axis_px) - 1)]
    low = np.maximum(np.floor(path.min(axis=0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(path.max(axis=0) + reach) + 1, (size[1], size[0])).astype(int)
    if (low >= high).any():
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    band = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    corners = np.rint(path - low).astype(np.int32)
    cv2.polylines(band, [corners], isClosed=False, color=1, thickness=2 * int(np.ceil(reach)) + 1)
    v, u = np.nonzero(band)
    return u + low[0], v + low[1]
