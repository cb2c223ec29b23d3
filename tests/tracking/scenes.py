"""Drawn worlds with exact truth that several tests of tracking look at; each is drawn and tracked once."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float, Image, NeedleTrack, StereoPair
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.render import Material
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import DARK_ON_LIGHT, LIGHT_ON_DARK, STEEL, Rod, Truth, World
from needletrack.tracking.track import track_pair

SIZE_PX = (720, 640)
MIDDLE_MM = (12.0, 0.0, 250.0)


def _region_of_interest(camera: Camera, middle_px: Float) -> Camera:
    low_px = np.rint(middle_px - (np.array(SIZE_PX) - 1) / 2)
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= low_px
    return Camera(matrix, camera.distortion, SIZE_PX)


def close_up_rig() -> StereoRig:
    """The default cameras of 1280 px, which read out 720 x 640 px about the middle of the workspace: 128 x 113 mm.

    As sharp as the whole image, at a third of its cost: a needle of 0.9 mm is 5 px wide.
    """
    whole = default_rig((1280, 1024))
    left_px, right_px = whole.project(np.array([MIDDLE_MM]))
    return StereoRig(
        _region_of_interest(whole.left, left_px[0]),
        _region_of_interest(whole.right, right_px[0]),
        whole.right_from_left,
    )


RIG = close_up_rig()
PX_PER_MM = RIG.left.focal_px / MIDDLE_MM[2]
# Of the default range of diameters, at the far and at the near end of the default workspace.
WIDTHS_PX = (0.6 * RIG.left.focal_px / 310.0, 1.2 * RIG.left.focal_px / 200.0)
# Down across the epipolar lines, which are nearly rows, away from the cameras, bent out of the image's plane.
ARC = NeedleMotion(
    (8.0, -34.0, 246.0), (0.12, 1.0, 0.12), Wave(68.0), bend_per_mm=Wave(0.004), bend_plane_rad=Wave(0.6)
)


@dataclass(frozen=True, eq=False)
class Scene:
    pair: StereoPair
    truth: Truth

    @property
    def images(self) -> tuple[Image, Image]:
        return self.pair.left.image, self.pair.right.image


def seen_at(world: World, t_s: float = 0.0) -> Scene:
    """A world at a time; drawn anew."""
    pair, truth = world.pair(t_s)
    return Scene(pair, truth)


# Named scenes are drawn once; a mild texture lies behind the needle.
BEHIND = Background(contrast=5.0)
WORLDS: dict[str, World] = {
    "dark": World(RIG, ARC, BEHIND, DARK_ON_LIGHT),
    "light": World(RIG, ARC, BEHIND, replace(LIGHT_ON_DARK, sleeve=Material(90.0))),
    "steel": World(RIG, ARC, BEHIND, STEEL),
}


@cache
def scene(name: str) -> Scene:
    return seen_at(WORLDS[name])


@cache
def tracked(name: str) -> NeedleTrack:
    """The track of a named scene, started without memory and with the default parameters."""
    return track_pair(scene(name).pair, RIG)


def steered_fast(seed: int) -> World:
    """A needle that is pushed and drawn back while it bends and its base wanders, by up to 3 mm from pair to pair.

    Of steel, dark or light, before texture, vessels and a rod, as the seed has it.
    """
    random = np.random.default_rng(seed)
    lighting = (STEEL, STEEL, DARK_ON_LIGHT, LIGHT_ON_DARK)[random.integers(4)]
    needle = NeedleMotion(
        (random.uniform(-15, 15), -34.0, random.uniform(236, 256)),
        (random.uniform(-0.4, 0.4), 1.0, random.uniform(-0.3, 0.3)),
        Wave(random.uniform(45, 70), random.uniform(5, 20), random.uniform(1.5, 4)),
        bend_per_mm=Wave(random.uniform(0, 0.008), random.uniform(0, 0.006), random.uniform(1.5, 4)),
        bend_plane_rad=Wave(random.uniform(0, 6), random.uniform(0, 0.5), 3.0),
        shift_mm=(
            Wave(0.0, random.uniform(0, 3), 2.0),
            Wave(0.0, random.uniform(0, 2), 2.5),
            Wave(0.0, random.uniform(0, 3), 3.0),
        ),
    )
    rods: tuple[Rod, ...] = ()
    if random.random() < 0.5:
        heights_mm = random.uniform(-20, 20, 2)
        rods = (Rod((-45.0, heights_mm[0], 228.0), (45.0, heights_mm[1], 232.0), random.uniform(0.5, 2)),)
    background = Background(contrast=random.uniform(0, 15), vessels=int(random.integers(0, 7)))
    return World(default_rig((960, 768)), needle, background, lighting, seed=seed, rods=rods)


def drawn_at_random(seed: int) -> World:
    """A needle of any lighting, bend and motion, before a background and beside a rod as the seed has them.

    Sleeves and rods of metal have streaks of light on them that look like needles.
    """
    random = np.random.default_rng(seed)
    size_px = ((960, 768), (1280, 1024), (1600, 1200))[int(random.integers(3))]
    needle = NeedleMotion(
        (8.0 + random.uniform(-12, 12), -34.0 + random.uniform(-8, 8), 246.0 + random.uniform(-20, 25)),
        (random.uniform(-0.6, 0.6), 1.0, random.uniform(-0.5, 0.5)),
        Wave(random.uniform(40, 85), random.uniform(0, 8), random.uniform(0.5, 2.0)),
        bend_per_mm=Wave(random.uniform(-0.006, 0.006), random.uniform(0, 0.004), random.uniform(0.5, 1.5)),
        bend_plane_rad=Wave(random.uniform(0, 6), random.uniform(0, 1), random.uniform(0.7, 2)),
        shift_mm=(
            Wave(0.0, random.uniform(0, 2), random.uniform(0.5, 1.5)),
            Wave(0.0, random.uniform(0, 2), random.uniform(0.5, 1.5)),
            Wave(0.0, random.uniform(0, 2), random.uniform(0.5, 1.5)),
        ),
    )
    rods: tuple[Rod, ...] = ()
    if random.random() >= 0.6:
        rods = (
            Rod(
                (-45.0 + random.uniform(-10, 10), -30.0, 235.0 - random.uniform(0, 40)),
                (-30.0 + random.uniform(0, 60), 45.0, 240.0 - random.uniform(0, 40)),
            ),
        )
    lighting = (STEEL, STEEL, DARK_ON_LIGHT, LIGHT_ON_DARK)[int(random.integers(4))]
    background = Background(contrast=random.uniform(0, 16), vessels=int(random.integers(0, 9)))
    return World(default_rig(size_px), needle, background, lighting, seed=seed, rods=rods)
