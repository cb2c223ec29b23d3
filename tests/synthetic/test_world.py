"""The drawn pair against its own truth: axis, noise, what hides what, and that one seed is one world."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from needletrack.geometry import spline
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Clock, Float
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion, Wave
from needletrack.synthetic.render import NOISE_FREE, Lens, Noise
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.tube import End
from needletrack.synthetic.world import DARK_ON_LIGHT, LIGHT_ON_DARK, STEEL, Lighting, Rod, World

RIG = default_rig()
ACROSS_PX = np.arange(-9.0, 9.25, 0.25)
# Where neither the tip's cone nor the base's end reaches into a cross section.
INNER = slice(12, -12)


def centroids_px(levels: Float, background_level: float, points_px: Float) -> tuple[Float, Float]:
    """Centroids across a line (N,) px, relative to it, and the line's normals (N, 2)."""
    tangents = spline.tangents(points_px)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    at = points_px[:, None] + ACROSS_PX[:, None] * normals[:, None]
    contrast = map_coordinates(levels, [at[..., 1], at[..., 0]], order=5) - background_level
    return (contrast @ ACROSS_PX) / contrast.sum(axis=1), normals


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("lighting", [DARK_ON_LIGHT, LIGHT_ON_DARK])
def test_the_drawn_axis_is_the_projected_truth(lighting: Lighting, seed: int) -> None:
    world = World(RIG, NeedleMotion.random(seed), lighting=lighting, noise=NOISE_FREE, sleeve=None)
    points_mm = world.truth(1.0).centerline_mm
    found_px = []
    for levels, points_px in zip(world.grey_levels(1.0), RIG.project(points_mm), strict=True):
        window = levels.astype(np.float64)
        off_px, normals = centroids_px(window, lighting.background_level, points_px)
        # What remains is interpolation of the 0.8 px blur between pixels.
        assert np.abs(off_px[INNER]).max() < 0.002
        found_px.append((points_px + off_px[:, None] * normals)[INNER])
    left_px, right_px = found_px
    found_mm = triangulate(RIG, RIG.left.undistort(left_px), RIG.right.undistort(right_px))
    # 0.002 px are 0.4 micrometres across and five times that in depth.
    assert np.linalg.norm(found_mm - points_mm[INNER], axis=1).max() < 0.003


def test_eight_bits_shift_the_axis_by_no_more_than_rounding_does() -> None:
    world = World(RIG, NeedleMotion.random(3), noise=NOISE_FREE, sleeve=None)
    pair, truth = world.pair(1.0)
    points_px, _ = RIG.project(truth.centerline_mm)
    off_px, _ = centroids_px(pair.left.image.astype(np.float64), 200.0, points_px)
    assert np.abs(off_px[INNER]).max() < 0.02
    assert abs(off_px[INNER].mean()) < 0.002


def test_noise_moves_the_axis_as_far_as_predicted() -> None:
    # Straight down the image, so that rows are cross sections with independent noise.
    needle = NeedleMotion((10.0, -45.0, 250.0), (0.05, 1.0, 0.0), Wave(90.0))
    noise = Noise(read=2.0, shot_variance_per_level=0.0)
    world = World(RIG, needle, noise=noise, sleeve=None)
    pair, truth = world.pair(0.0)
    (clean, _), (points_px, _) = world.grey_levels(0.0), RIG.project(truth.centerline_mm)
    rows = np.arange(int(points_px[0, 1]) + 20, int(points_px[-1, 1]) - 30)
    axis_px = np.interp(rows, points_px[:, 1], points_px[:, 0])
    columns = np.rint(axis_px).astype(int)[:, None] + np.arange(-8, 9)
    away_px = columns - axis_px[:, None]
    contrast = pair.left.image[rows[:, None], columns].astype(np.float64) - 200.0
    clean_contrast = clean[rows[:, None], columns].astype(np.float64) - 200.0
    off_px = (contrast * away_px).sum(axis=1) / contrast.sum(axis=1)
    variance = noise.read**2 + 1 / 12
    sigma_px = np.sqrt(variance * (away_px**2).sum(axis=1)) / np.abs(clean_contrast.sum(axis=1))
    assert len(rows) > 400
    assert abs(off_px.mean()) < 4 * sigma_px.mean() / np.sqrt(len(rows))
    # The standard deviation of n values is known to 1 / sqrt(2 n).
    assert (off_px / sigma_px).std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(rows)))


def test_the_streak_on_steel_lies_off_the_axis() -> None:
    needle = NeedleMotion((10.0, -40.0, 250.0), (1.0, 0.6, 0.0), Wave(70.0), diameter_mm=1.1)
    world = World(RIG, needle, lighting=STEEL, noise=NOISE_FREE, sleeve=None)
    for levels, points_px in zip(world.grey_levels(0.0), RIG.project(world.truth(0.0).centerline_mm), strict=True):
        tangents = spline.tangents(points_px)
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        at = points_px[:, None] + ACROSS_PX[:, None] * normals[:, None]
        profiles = map_coordinates(levels.astype(np.float64), [at[..., 1], at[..., 0]], order=3)[INNER]
        assert (np.abs(ACROSS_PX[profiles.argmax(axis=1)]) > 0.5).all()


def test_one_seed_is_one_world() -> None:
    def world(seed: int) -> World:
        return World(default_rig((640, 512)), NeedleMotion.random(1), Background(contrast=10.0, vessels=3), seed=seed)

    again, first = world(5), world(5)
    again.pair(2.0)
    one, other = first.pair(1.0)[0], again.pair(1.0)[0]
    np.testing.assert_array_equal(one.left.image, other.left.image)
    np.testing.assert_array_equal(one.right.image, other.right.image)
    assert (one.left.image != world(6).pair(1.0)[0].left.image).any()
    # Noise of one camera says nothing about the other's, or about the next pair's.
    still = World(default_rig((640, 512)), None)
    now, then = still.pair(0.0)[0], still.pair(1.0)[0]
    for image in (now.right.image, then.left.image):
        assert abs(np.corrcoef(now.left.image.ravel(), image.ravel())[0, 1]) < 4 / np.sqrt(image.size)


def test_stamps_come_from_the_time() -> None:
    world = World(default_rig((640, 512)), NeedleMotion.random(1), skew_ns=40_000)
    pairs = list(world.pairs(rate_hz=40.0, count=3, start_s=2.0))
    assert [pair.captured_at_ns for pair, _ in pairs] == [2_000_000_000, 2_025_000_000, 2_050_000_000]
    assert [pair.captured_at_ns for pair, _ in pairs] == [truth.captured_at_ns for _, truth in pairs]
    assert [pair.sequence for pair, _ in pairs] == [0, 1, 2]
    assert {pair.skew_us for pair, _ in pairs} == {40.0}
    assert {pair.clock for pair, _ in pairs} == {Clock.RECORDED}
    assert pairs[0][0].left.image.shape == (512, 640)


def test_truth_is_the_needle() -> None:
    needle = replace(NeedleMotion.random(4), tip=End.ROUND)
    truth = World(RIG, needle).truth(3.0)
    shape = needle.at(3.0)
    assert truth.present
    np.testing.assert_array_equal(truth.tip_mm, shape.points_mm[-1])
    np.testing.assert_array_equal(truth.tip_direction, shape.tangents[-1])
    np.testing.assert_array_equal(truth.centerline_mm[0], shape.base_mm)
    assert truth.visible.shape == (2, len(truth.centerline_mm))
    assert (truth.diameter_mm, truth.tip) == (needle.diameter_mm, End.ROUND)
    assert not truth.centerline_mm.flags.writeable


def differs(world: World, other: World) -> list[bool]:
    return [
        bool((one != another).any())
        for one, another in zip(world.grey_levels(0.0), other.grey_levels(0.0), strict=True)
    ]


def test_no_needle_and_a_needle_drawn_back() -> None:
    size = default_rig((640, 512))
    empty = World(size, None)
    drawn_back = World(size, replace(NeedleMotion.random(1), length_mm=Wave(0.0)))
    for world in (empty, drawn_back):
        assert not world.truth(0.0).present
        assert world.truth(0.0).visible.shape == (2, 0)
        assert len(world.pair(0.0)[1].centerline_mm) == 0
    assert differs(empty, World(size, None, rods=(Rod((0.0, 0.0, 200.0), (9.0, 9.0, 210.0)),))) == [
        True,
        True,
    ]
    assert differs(empty, drawn_back) == [True, True]
    assert differs(empty, replace(drawn_back, sleeve=None)) == [False, False]


def test_a_rod_hides_what_lies_behind_it() -> None:
    needle = NeedleMotion((15.0, -40.0, 250.0), (0.1, 1.0, 0.0), Wave(80.0))
    # Through the middle of both cameras' view of the needle's middle, nearer to them.
    rod = Rod((-40.0, 8.0, 215.0), (70.0, -12.0, 215.0), diameter_mm=4.0)
    bare = World(RIG, needle, noise=NOISE_FREE)
    world = replace(bare, rods=(rod,))
    truth = world.truth(0.0)
    assert bare.truth(0.0).visible[:, 4:].all()
    for levels, visible, points_px in zip(
        world.grey_levels(0.0), truth.visible, RIG.project(truth.centerline_mm), strict=True
    ):
        u, v = np.rint(points_px).astype(int).T
        dark = levels[v, u] < 70
        # A rod of 4 mm at 215 mm hides 4.6 mm of a needle that crosses it at 250 mm.
        assert 4.0 < 0.5 * (~visible[4:]).sum() < 6.0
        # Where the truth says seen, the dark needle is seen, but for the blurred borders and the cone's apex.
        assert (dark == visible)[4:-4].mean() > 0.97


@pytest.mark.parametrize("depth_slope", [-0.6, 0.6])
def test_the_sleeve_hides_the_needle_only_where_its_mouth_faces_away(depth_slope: float) -> None:
    needle = NeedleMotion((15.0, -20.0, 250.0), (0.0, 1.0, depth_slope), Wave(60.0))
    truth = World(RIG, needle).truth(0.0)
    hidden_mm = 0.5 * (~truth.visible).sum(axis=1)
    if depth_slope < 0:
        assert (hidden_mm == 0).all()
    else:
        # The rim, 2.5 mm from the axis, hides 2.5 mm x tan(slope), but for what perspective adds.
        assert (np.abs(hidden_mm - 2.5 * depth_slope) < 1.0).all()
        assert truth.visible[:, 10:].all()


@pytest.mark.parametrize("depth_slope", [-0.3, -0.05, 0.0, 0.05, 0.3])
def test_nothing_shines_through_between_needle_and_sleeve(depth_slope: float) -> None:
    # Seen edge-on from the left camera: its axis, through the middle of the picture, is z.
    needle = NeedleMotion((0.0, 0.0, 250.0), (0.0, 1.0, depth_slope), Wave(30.0))
    world = World(RIG, needle, noise=NOISE_FREE)
    along_mm = np.linspace(-2.0, 2.0, 81)[:, None] * spline.unit([0.0, 1.0, depth_slope])
    for levels, points_px in zip(
        world.grey_levels(0.0), RIG.project(np.array([0.0, 0.0, 250.0]) + along_mm), strict=True
    ):
        seen = map_coordinates(levels.astype(np.float64), points_px.T[::-1], order=1)
        # Needle and sleeve are darker than 40, the background is 200.
        assert seen.max() < 40 + 0.06 * 200


def test_what_leaves_the_image_is_not_visible() -> None:
    needle = NeedleMotion((-70.0, 0.0, 250.0), (-1.0, 0.0, 0.0), Wave(80.0))
    truth = World(RIG, needle, sleeve=None).truth(0.0)
    for camera, visible, points_px in zip(
        (RIG.left, RIG.right), truth.visible, RIG.project(truth.centerline_mm), strict=True
    ):
        np.testing.assert_array_equal(visible, camera.contains(points_px))
        assert visible[0]
        assert not visible[-1]


def test_vessels_are_seen_in_both_views_and_lie_behind() -> None:
    size = default_rig((640, 512))
    plain = World(size, None, noise=NOISE_FREE)
    assert differs(plain, replace(plain, background=Background(vessels=4))) == [True, True]


def test_a_lens_may_darken_the_corners() -> None:
    size = default_rig((640, 512))
    plain = World(size, None, noise=NOISE_FREE)
    vignetted = replace(plain, lens=Lens(vignetting=0.4))
    for before, after in zip(plain.grey_levels(0.0), vignetted.grey_levels(0.0), strict=True):
        assert (after <= before).all()
        assert after.min() == pytest.approx(0.6 * 200.0, abs=0.1)
