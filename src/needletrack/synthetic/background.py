"""What lies behind the needle: a plane with a smooth texture, and vessels that branch on it."""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float
from needletrack.synthetic.render import GreyLevels
from needletrack.synthetic.tube import End, Tube

# The texture is smooth: it is computed every so many pixels, and enlarged.
STRIDE_PX = 8
TEXTURE_WAVES = 24
SHORTEST_WAVE_MM, LONGEST_WAVE_MM = 30.0, 180.0
VESSEL_STEP_MM = 0.5
# Vessels enter over this circle on the plane and run towards its middle, which both cameras see.
VIEW_CENTER_MM = (15.0, 0.0)
VIEW_RADIUS_MM = 130.0


@dataclass(frozen=True, slots=True)
class Background:
    """A plane facing the left camera, the standard deviation of its smooth texture, and vessels on it."""

    distance_mm: float = 350.0
    contrast: float = 0.0
    vessels: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A smooth pattern on a plane: waves with wave_vectors_per_mm (K, 2), phases_rad and weights (K,)."""

    wave_vectors_per_mm: Float
    phases_rad: Float
    weights: Float

    @classmethod
    def random(cls, rng: np.random.Generator, contrast: float) -> Self:
        """A pattern of standard deviation `contrast`; long waves are the higher ones."""
        length_mm = np.exp(rng.uniform(np.log(SHORTEST_WAVE_MM), np.log(LONGEST_WAVE_MM), TEXTURE_WAVES))
        angle_rad = rng.uniform(0, 2 * np.pi, TEXTURE_WAVES)
        vectors = (2 * np.pi / length_mm)[:, None] * np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
        weights = contrast * length_mm / np.sqrt((length_mm**2).sum() / 2)
        return cls(vectors, rng.uniform(0, 2 * np.pi, TEXTURE_WAVES), weights)

    def at(self, plane_mm: Float) -> Float:
        """Values (N,) at points (N, 2) of the plane."""
        return np.asarray(np.sin(plane_mm @ self.wave_vectors_per_mm.T + self.phases_rad) @ self.weights)


def plane_levels(
    camera: Camera, camera_from_world: RigidTransform, level: float, texture: Texture, distance_mm: float
) -> GreyLevels:
    """Grey levels (rows, columns) of a camera's view of the plane z = distance_mm in the world frame."""
    width, height = camera.size_px
    columns, rows = -(-width // STRIDE_PX), -(-height // STRIDE_PX)
    u, v = np.meshgrid((np.arange(columns) + 0.5) * STRIDE_PX - 0.5, (np.arange(rows) + 0.5) * STRIDE_PX - 0.5)
    rays = np.column_stack([camera.normalize(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)])
    world_from_camera = camera_from_world.inverse()
    directions = rays @ world_from_camera.rotation.T
    center_mm = world_from_camera.translation_mm
    on_plane_mm = center_mm + (distance_mm - center_mm[2]) / directions[:, 2:] * directions
    coarse = (level + texture.at(on_plane_mm[:, :2])).reshape(rows, columns).astype(np.float32)
    fine = cv2.resize(coarse, (columns * STRIDE_PX, rows * STRIDE_PX), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(np.clip(fine[:height, :width], 0, None), dtype=np.float32)


def vessels(rng: np.random.Generator, count: int, distance_mm: float) -> list[Tube]:
    """Winding tubes in the plane z = distance_mm, some thin as a needle; each third is a branch."""
    grown: list[_Vessel] = []
    for number in range(count):
        if number % 3 == 2:
            parent = grown[-1]
            fork = int(rng.integers(len(parent.points_mm) // 4, len(parent.points_mm) // 2))
            start_mm = parent.points_mm[fork]
            heading_rad = parent.heading_rad[fork] + rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 0.9)
            radius_mm = parent.radius_mm * rng.uniform(0.5, 0.8)
            length_mm = rng.uniform(80.0, 160.0)
        else:
            side_rad = rng.uniform(0, 2 * np.pi)
            start_mm = VIEW_CENTER_MM + VIEW_RADIUS_MM * np.array([np.cos(side_rad), np.sin(side_rad)])
            heading_rad = side_rad + np.pi + rng.uniform(-0.6, 0.6)
            radius_mm = rng.uniform(0.6, 2.5)
            length_mm = rng.uniform(180.0, 360.0)
        grown.append(_winding(rng, start_mm, heading_rad, length_mm, radius_mm))
    return [
        Tube(
            np.column_stack([vessel.points_mm, np.full(len(vessel.points_mm), distance_mm)]),
            vessel.radius_mm,
            End.ROUND,
            End.ROUND,
        )
        for vessel in grown
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Vessel:
    points_mm: Float
    heading_rad: Float
    radius_mm: float


def _winding(
    rng: np.random.Generator, start_mm: Float, heading_rad: float, length_mm: float, radius_mm: float
) -> _Vessel:
    at_mm = np.arange(0.0, length_mm, VESSEL_STEP_MM)
    headings = np.full(len(at_mm), heading_rad)
    for _ in range(3):
        wave_rad = 2 * np.pi * at_mm / rng.uniform(25.0, 120.0) + rng.uniform(0, 2 * np.pi)
        headings += rng.uniform(0.1, 0.3) * np.sin(wave_rad)
    steps_mm = VESSEL_STEP_MM * np.column_stack([np.cos(headings), np.sin(headings)])
    return _Vessel(start_mm + np.cumsum(steps_mm, axis=0), headings, radius_mm)
