"""Cross sections and pictures of a straight needle, drawn by the blur's integral: what lies where is exact."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from needletrack.geometry.camera import Camera
from needletrack.geometry.spline import tangents
from needletrack.records import Float, Image


@dataclass(frozen=True)
class Look:
    """Levels across a needle: the background left and right of it, its inside, and a streak of light added to that.

    streak_at: the streak's middle, as a share -1 .. 1 of the half width; it covers 0.15 of that to either side.
    """

    left: float
    right: float
    inside: float
    streak: float = 0.0
    streak_at: float = 0.0

    def across(self, offsets: Float, half_width: Float | float, blur: float) -> Float:
        """Levels at offsets from the axis."""
        begun, ended = ndtr((offsets + half_width) / blur), ndtr((offsets - half_width) / blur)
        low, high = max(-1.0, self.streak_at - 0.15), min(1.0, self.streak_at + 0.15)
        streak = ndtr((offsets - low * half_width) / blur) - ndtr((offsets - high * half_width) / blur)
        return np.asarray(
            self.left * (1 - begun) + self.right * ended + self.inside * (begun - ended) + self.streak * streak
        )


# Without distortion the picture of a straight line is one, and its offsets are distances. 5.6 px are a millimetre.
CAMERA = Camera(np.array([[1400.0, 0.0, 80.0], [0.0, 1400.0, 200.0], [0.0, 0.0, 1.0]]), np.zeros(5), (160, 400))
DEPTH_MM, LENS_BLUR_PX, NOISE_GRAY = 250.0, 0.8, 1.8
PX_PER_MM = CAMERA.focal_px / DEPTH_MM


def line_mm(count: int = 50, aside_mm: float = 0.0) -> Float:
    """A straight needle's axis (count, 3), which crosses the picture; aside_mm: of the same slope, beside it."""
    along = np.linspace(-30.0, 30.0, count)
    return np.column_stack([0.12 * along + aside_mm, along, np.full(count, DEPTH_MM)])


def picture(look: Look, diameter_mm: float, rng: np.random.Generator) -> Image:
    """The noisy picture of a needle of that diameter along `line_mm`."""
    ends_px = CAMERA.project(line_mm(2))
    along = tangents(ends_px)[0]
    v, u = np.indices(CAMERA.size_px[::-1])
    offsets = (v - ends_px[0, 1]) * along[0] - (u - ends_px[0, 0]) * along[1]
    gray = look.across(offsets, diameter_mm / 2 * PX_PER_MM, LENS_BLUR_PX)
    return np.clip(np.rint(gray + NOISE_GRAY * rng.normal(size=gray.shape)), 0, 255).astype(np.uint8)
