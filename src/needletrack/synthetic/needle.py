"""A needle as a function of time: how far it is out, how it bends, where its sleeve stands."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from needletrack.records import Float, frozen_array
from needletrack.synthetic.tube import End

Vector = tuple[float, float, float]

# The centerline is integrated in steps a tenth of those that the truth reports; 0.05 mm is about half a pixel
# of a 2560 pixel wide view at 250 mm, fine enough to draw from.
TRUTH_STEP_MM = 0.5
STEPS_PER_TRUTH_STEP = 10
# What is out by less is called retracted.
LEAST_LENGTH_MM = 0.1


@dataclass(frozen=True, slots=True)
class Wave:
    """A smooth function of time: mean + amplitude sin(2 pi t / period_s + phase_rad)."""

    mean: float
    amplitude: float = 0.0
    period_s: float = 1.0
    phase_rad: float = 0.0

    def __call__(self, t_s: float) -> float:
        """The value at a time in seconds."""
        return self.mean + self.amplitude * float(np.sin(2 * np.pi * t_s / self.period_s + self.phase_rad))


STILL = Wave(0.0)


@dataclass(frozen=True, slots=True, eq=False)
class NeedleShape:
    """The axis outside the sleeve at one instant, base -> tip, evenly spaced; no points where retracted.

    points_mm (N, 3) in the left camera's frame, tangents (N, 3) of unit length, curvature_per_mm (N,);
    base_mm, base_direction (3,) are where the sleeve stands, also when the needle is retracted.
    """

    points_mm: Float
    tangents: Float
    curvature_per_mm: Float
    base_mm: Float
    base_direction: Float

    def __post_init__(self) -> None:
        n = len(self.points_mm)
        object.__setattr__(self, "points_mm", frozen_array(self.points_mm, (n, 3), "points_mm"))
        object.__setattr__(self, "tangents", frozen_array(self.tangents, (n, 3), "tangents"))
        object.__setattr__(self, "curvature_per_mm", frozen_array(self.curvature_per_mm, (n,), "curvature_per_mm"))
        object.__setattr__(self, "base_mm", frozen_array(self.base_mm, (3,), "base_mm"))
        object.__setattr__(self, "base_direction", frozen_array(self.base_direction, (3,), "base_direction"))


@dataclass(frozen=True, slots=True)
class NeedleMotion:
    """A needle pushed out of `base_mm` along `direction`, bending in a plane that may turn along its length.

    Its curvature runs linearly from bend - change / 2 at the base to bend + change / 2 at the tip: an arc,
    an S, a hook. At bend_plane_rad 0 it bends parallel to the image; the plane turns about the base
    direction, and by torsion_rad_per_mm along the needle. shift_mm moves base and sleeve. All in the left
    camera's frame.
    """

    base_mm: Vector
    direction: Vector
    length_mm: Wave
    bend_per_mm: Wave = STILL
    bend_change_per_mm: Wave = STILL
    bend_plane_rad: Wave = STILL
    torsion_rad_per_mm: Wave = STILL
    shift_mm: tuple[Wave, Wave, Wave] = (STILL, STILL, STILL)
    diameter_mm: float = 0.9
    tip: End = End.CONE

    @classmethod
    def random(cls, seed: int, center_mm: Vector = (15.0, 0.0, 254.0)) -> Self:
        """A needle of 48-92 mm that enters from any side, passes near `center_mm` and never rests."""
        rng = np.random.default_rng(seed)

        def wave(mean: float, amplitude: float) -> Wave:
            return Wave(mean, amplitude, float(rng.uniform(5.0, 10.0)), float(rng.uniform(0.0, 2 * np.pi)))

        side_rad = rng.uniform(0.0, 2 * np.pi)
        heading_rad = side_rad + np.pi + rng.uniform(-0.25, 0.25)
        rise = rng.uniform(-0.2, 0.2)
        x, y, z = np.array(center_mm) + 42.0 * np.array([np.cos(side_rad), np.sin(side_rad), rise])
        return cls(
            base_mm=(float(x), float(y), float(z)),
            direction=(
                float(np.cos(heading_rad)),
                float(np.sin(heading_rad)),
                float(rng.uniform(-0.2, 0.2) - rise),
            ),
            length_mm=wave(70.0, 22.0),
            bend_per_mm=wave(float(rng.uniform(-0.006, 0.006)), 0.002),
            bend_change_per_mm=wave(float(rng.uniform(-0.006, 0.006)), 0.002),
            bend_plane_rad=wave(float(rng.uniform(0.0, 2 * np.pi)), 0.2),
            torsion_rad_per_mm=wave(float(rng.uniform(-0.005, 0.005)), 0.002),
            shift_mm=(wave(0.0, 3.0), wave(0.0, 3.0), wave(0.0, 3.0)),
            diameter_mm=float(rng.uniform(0.7, 1.1)),
            tip=End.CONE if rng.random() < 0.5 else End.ROUND,
        )

    def at(self, t_s: float) -> NeedleShape:
        """The needle at a time in seconds."""
        base_mm = np.array(self.base_mm) + np.array([wave(t_s) for wave in self.shift_mm])
        frame = _frame_along(np.array(self.direction))
        length_mm = self.length_mm(t_s)
        if length_mm < LEAST_LENGTH_MM:
            none = np.zeros((0, 3))
            return NeedleShape(none, none, np.zeros(0), base_mm, frame[:, 2])
        steps = int(np.ceil(length_mm / TRUTH_STEP_MM)) * STEPS_PER_TRUTH_STEP
        step_mm = length_mm / steps

        def bend(share: Float) -> Float:
            return self.bend_per_mm(t_s) + self.bend_change_per_mm(t_s) * (share - 0.5)

        middle = (np.arange(steps) + 0.5) / steps
        plane_rad = self.bend_plane_rad(t_s) + self.torsion_rad_per_mm(t_s) * length_mm * middle
        axes = np.column_stack([np.cos(plane_rad), np.sin(plane_rad), np.zeros(steps)])
        turn_rad = (bend(middle) * step_mm)[:, None] * axes
        # Each chord of a step points along the tangent in its middle: half a turn before it, half a turn
        # after.
        half = Rotation.from_rotvec(turn_rad / 2).as_matrix()
        after = np.concatenate([frame[None], frame @ _running_product(half @ half)])
        chords = step_mm * (after[:-1] @ half)[:, :, 2]
        return NeedleShape(
            points_mm=base_mm + np.concatenate([np.zeros((1, 3)), np.cumsum(chords, axis=0)]),
            tangents=after[:, :, 2],
            curvature_per_mm=np.abs(bend(np.linspace(0.0, 1.0, steps + 1))),
            base_mm=base_mm,
            base_direction=frame[:, 2],
        )


def _frame_along(direction: Float) -> Float:
    z = direction / np.linalg.norm(direction)
    reference = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = np.cross(z, reference)
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


def _running_product(matrices: Float) -> Float:
    # Doubling (Hillis & Steele 1986): after round k every entry holds the product of its last 2^k factors.
    product = matrices.copy()
    reach = 1
    while reach < len(product):
        product[reach:] = product[:-reach] @ product[reach:]
        reach *= 2
    return product
