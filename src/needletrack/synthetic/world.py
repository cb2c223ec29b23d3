"""The synthetic world: what stands where at a time, its stereo pair, and the exact truth about it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from needletrack.geometry import spline
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Frame, StereoPair, frozen_array
from needletrack.synthetic.background import Background, Texture, plane_levels, vessels
from needletrack.synthetic.needle import STEPS_PER_TRUTH_STEP, NeedleMotion, NeedleShape, Vector
from needletrack.synthetic.render import GreyLevels, Lens, Material, Noise, exposed, painted, vignette
from needletrack.synthetic.tube import End, Outline, Tube, outline

# The needle is drawn this far into its sleeve, which hides it.
HIDDEN_MM = 6.0
BORDER_BLURS = 2.0
# Long straight things are cut into pieces of this length, so that the lens bends them.
PIECE_MM = 0.5
# Random streams of one seed; those of the noise are named by camera and stamp.
_BACKGROUND_STREAM, _NOISE_STREAM = 0, 1


@dataclass(frozen=True, slots=True)
class Lighting:
    """Grey levels of all things, and the direction, in the left camera's frame, to the light they mirror."""

    background_level: float
    needle: Material
    sleeve: Material
    rod: Material
    vessel: Material
    toward_light: Vector = (-0.35, -0.8, -0.5)


DARK_ON_LIGHT = Lighting(200.0, Material(35.0), Material(25.0), Material(120.0, 60.0, 0.4), Material(130.0))
LIGHT_ON_DARK = Lighting(50.0, Material(235.0), Material(90.0, 60.0, 0.3), Material(130.0, 50.0, 0.4), Material(25.0))
STEEL = Lighting(115.0, Material(55.0, 170.0), Material(22.0), Material(120.0, 60.0, 0.4), Material(75.0))


@dataclass(frozen=True, slots=True)
class Sleeve:
    """The cylinder which the needle leaves."""

    diameter_mm: float = 5.0
    length_mm: float = 18.0


@dataclass(frozen=True, slots=True)
class Rod:
    """A straight rod in front of everything, between two points in the left camera's frame."""

    start_mm: Vector
    end_mm: Vector
    diameter_mm: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is exactly so in one pair, base -> tip, left camera's frame; no points where no needle is out.

    centerline_mm (N, 3), from where the needle leaves its sleeve to the apex of its tip, evenly spaced along
    the arc; tangents (N, 3) of unit length; curvature_per_mm (N,); visible (2, N): in the left and in the
    right image, with nothing in front.
    """

    captured_at_ns: int
    centerline_mm: Float
    tangents: Float
    curvature_per_mm: Float
    visible: npt.NDArray[np.bool_]
    diameter_mm: float
    tip: End

    def __post_init__(self) -> None:
        n = len(self.centerline_mm)
        object.__setattr__(self, "centerline_mm", frozen_array(self.centerline_mm, (n, 3), "centerline_mm"))
        object.__setattr__(self, "tangents", frozen_array(self.tangents, (n, 3), "tangents"))
        object.__setattr__(self, "curvature_per_mm", frozen_array(self.curvature_per_mm, (n,), "curvature_per_mm"))
        object.__setattr__(self, "visible", frozen_array(self.visible, (2, n), "visible", np.bool_))

    @property
    def present(self) -> bool:
        """Whether there is a needle outside its sleeve."""
        return len(self.centerline_mm) > 0

    @property
    def tip_mm(self) -> Float:
        """The apex of the tip (3,); IndexError where no needle is present."""
        return np.asarray(self.centerline_mm[-1])

    @property
    def tip_direction(self) -> Float:
        """Unit direction (3,) out of the tip; IndexError where no needle is present."""
        return np.asarray(self.tangents[-1])


@dataclass(frozen=True, eq=False)
class World:
    """A scene before a rig; the same seed gives the same bytes, in whatever order times are asked for.

    needle None: neither needle nor sleeve. The right camera's stamps are skew_ns later than the left's; the
    needle stands still meanwhile.
    """

    rig: StereoRig
    needle: NeedleMotion | None
    background: Background = field(default_factory=Background)
    lighting: Lighting = DARK_ON_LIGHT
    noise: Noise = field(default_factory=Noise)
    seed: int = 0
    sleeve: Sleeve | None = Sleeve()
    rods: tuple[Rod, ...] = ()
    lens: Lens = field(default_factory=Lens)
    skew_ns: int = 0

    def pair(self, t_s: float, sequence: int = 0) -> tuple[StereoPair, Truth]:
        """The stereo pair taken at a time in seconds, stamped with it, and the truth about it."""
        stamp_ns = round(t_s * 1e9)
        shape = self._shape(t_s)
        views = self._views(shape)
        frames = []
        for index, levels in enumerate(self._levels(views)):
            rng = np.random.default_rng((self.seed, _NOISE_STREAM, index, stamp_ns))
            frames.append(Frame(exposed(levels, self.noise, rng), stamp_ns + index * self.skew_ns))
        return StereoPair(frames[0], frames[1], sequence), self._truth(shape, views, stamp_ns)

    def pairs(self, rate_hz: float, count: int, start_s: float = 0.0) -> Iterator[tuple[StereoPair, Truth]]:
        """`count` pairs with their truth, evenly spaced in time and numbered from 0."""
        for sequence in range(count):
            yield self.pair(start_s + sequence / rate_hz, sequence)

    def grey_levels(self, t_s: float) -> tuple[GreyLevels, GreyLevels]:
        """Left and right image (rows, columns) before noise, rounding and clipping."""
        left, right = self._levels(self._views(self._shape(t_s)))
        return left, right

    def truth(self, t_s: float) -> Truth:
        """The truth alone, without a picture."""
        shape = self._shape(t_s)
        return self._truth(shape, self._views(shape), round(t_s * 1e9))

    @property
    def _cameras(self) -> tuple[tuple[Camera, RigidTransform], ...]:
        return (self.rig.left, RigidTransform.identity()), (self.rig.right, self.rig.right_from_left)

    def _shape(self, t_s: float) -> NeedleShape | None:
        return self.needle.at(t_s) if self.needle else None

    def _views(self, shape: NeedleShape | None) -> list["_View"]:
        return [self._view(shape, camera, pose) for camera, pose in self._cameras]

    def _view(self, shape: NeedleShape | None, camera: Camera, camera_from_world: RigidTransform) -> "_View":
        behind: list[tuple[Tube, Material]] = []
        in_front: list[tuple[Tube, Material]] = []
        hidden_mm = 0.0
        if shape is not None and self.sleeve:
            back_mm = shape.base_mm - self.sleeve.length_mm * shape.base_direction
            sleeve = _straight(back_mm, shape.base_mm, self.sleeve.diameter_mm), self.lighting.sleeve
            in_camera_mm = camera_from_world.apply(shape.base_mm)
            facing = -float(shape.base_direction @ camera_from_world.rotation.T @ spline.unit(in_camera_mm))
            if facing > 0:
                # The needle is seen from the middle of the mouth on. Where that is seen edge-on, needle and
                # sleeve would share one blurred border, through which the background shines: there they
                # overlap.
                behind.append(sleeve)
                overlap_mm = BORDER_BLURS * self.lens.blur_px * in_camera_mm[2] / camera.focal_px
                hidden_mm = max(0.0, overlap_mm - facing * self.sleeve.diameter_mm / 2)
            else:
                # The mouth faces away: its rim hides where the needle leaves it.
                in_front.append(sleeve)
                hidden_mm = min(HIDDEN_MM, self.sleeve.length_mm)
        if self.needle and shape is not None and len(shape.points_mm):
            behind.append((_needle_tube(self.needle, shape, hidden_mm), self.lighting.needle))
        for rod in self.rods:
            rod_tube = _straight(np.array(rod.start_mm), np.array(rod.end_mm), rod.diameter_mm)
            in_front.append((rod_tube, self.lighting.rod))
        return _View(
            self._outlines(behind, camera, camera_from_world),
            self._outlines(in_front, camera, camera_from_world),
        )

    def _outlines(
        self, tubes: list[tuple[Tube, Material]], camera: Camera, camera_from_world: RigidTransform
    ) -> list[tuple[Outline, Material]]:
        light = self.lighting.toward_light
        return [(outline(tube, camera, camera_from_world, light), material) for tube, material in tubes]

    def _levels(self, views: list["_View"]) -> list[GreyLevels]:
        pictures = [
            painted(scenery, [*view.behind, *view.in_front], self.lens)
            for scenery, view in zip(self._scenery, views, strict=True)
        ]
        if self.lens.vignetting == 0:
            return pictures
        return [picture * transmission for picture, transmission in zip(pictures, self._transmission, strict=True)]

    @cached_property
    def _transmission(self) -> list[GreyLevels]:
        return [vignette(camera, self.lens.vignetting) for camera, _ in self._cameras]

    @cached_property
    def _scenery(self) -> list[GreyLevels]:
        rng = np.random.default_rng((self.seed, _BACKGROUND_STREAM))
        texture = Texture.random(rng, self.background.contrast)
        distance_mm = self.background.distance_mm
        clutter = [(vessel, self.lighting.vessel) for vessel in vessels(rng, self.background.vessels, distance_mm)]
        return [
            painted(
                plane_levels(camera, pose, self.lighting.background_level, texture, distance_mm),
                self._outlines(clutter, camera, pose),
                self.lens,
            )
            for camera, pose in self._cameras
        ]

    def _truth(self, shape: NeedleShape | None, views: list["_View"], stamp_ns: int) -> Truth:
        diameter_mm, tip = (self.needle.diameter_mm, self.needle.tip) if self.needle else (0.0, End.FLAT)
        if shape is None or len(shape.points_mm) == 0:
            none = np.zeros((0, 3))
            unseen = np.zeros((2, 0), dtype=np.bool_)
            return Truth(stamp_ns, none, none, np.zeros(0), unseen, diameter_mm, tip)
        told = slice(None, None, STEPS_PER_TRUTH_STEP)
        points_mm = shape.points_mm[told]
        visible = []
        for view, (camera, pose) in zip(views, self._cameras, strict=True):
            pixels = camera.project(pose.apply(points_mm))
            seen = camera.contains(pixels)
            for other, _ in view.in_front:
                seen &= other.coverage(pixels, self.lens.blur_px) < 0.5
            visible.append(seen)
        return Truth(
            captured_at_ns=stamp_ns,
            centerline_mm=points_mm,
            tangents=shape.tangents[told],
            curvature_per_mm=shape.curvature_per_mm[told],
            visible=np.array(visible),
            diameter_mm=diameter_mm,
            tip=tip,
        )


@dataclass(frozen=True, slots=True)
class _View:
    behind: list[tuple[Outline, Material]]
    in_front: list[tuple[Outline, Material]]


def _straight(start_mm: Float, end_mm: Float, diameter_mm: float) -> Tube:
    pieces = max(1, int(np.ceil(np.linalg.norm(end_mm - start_mm) / PIECE_MM)))
    return Tube(start_mm + np.linspace(0, 1, pieces + 1)[:, None] * (end_mm - start_mm), diameter_mm / 2)


def _needle_tube(needle: NeedleMotion, shape: NeedleShape, hidden_mm: float) -> Tube:
    points_mm = shape.points_mm
    if hidden_mm > 0:
        step_mm = np.linalg.norm(points_mm[1] - points_mm[0])
        back = np.arange(int(np.ceil(hidden_mm / step_mm)), 0, -1) * step_mm
        points_mm = np.concatenate([shape.base_mm - back[:, None] * shape.base_direction, points_mm])
    return Tube(points_mm, needle.diameter_mm / 2, last=needle.tip)
