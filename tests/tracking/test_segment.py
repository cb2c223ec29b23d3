"""Ridges of drawn needles, and of what is no line: both polarities, noise, wide bands, blobs, faint contrast."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
import pytest
from tests.tracking.scenes import ARC, RIG, SIZE_PX, WIDTHS_PX, WORLDS, scene, seen_at

from needletrack.records import Float, Image
from needletrack.synthetic.render import Material, Noise
from needletrack.synthetic.world import Lighting, World
from needletrack.tracking.segment import Mask, Ridges, SegmentParameters, find_ridges

SHAPE = SIZE_PX[::-1]


def ridges_of(image: Image, widths_px: tuple[float, float] = WIDTHS_PX) -> Ridges:
    return find_ridges(image, widths_px, SegmentParameters())


def at_points(mask: Mask, ridges: Ridges, points_px: Float) -> npt.NDArray[np.bool_]:
    columns, rows = np.rint((points_px + 0.5) / ridges.reduction - 0.5).astype(int).T
    return np.asarray(mask[rows, columns])


def shares_on_the_axis(image: Image, points_px: Float) -> tuple[float, float]:
    """Share of the points of an axis where a bright and where a dark line is found."""
    ridges = ridges_of(image)
    bright, dark = (float(at_points(mask, ridges, points_px).mean()) for mask in (ridges.bright, ridges.dark))
    return bright, dark


def noisy(levels: npt.ArrayLike, sigma: float = 1.0) -> Image:
    noise = np.random.default_rng(3).normal(0.0, sigma, SHAPE)
    return np.clip(np.rint(np.asarray(levels) + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("name", "is_dark"), [("dark", True), ("light", False), ("steel", True)])
def test_a_needle_is_a_line_of_its_own_polarity_alone(name: str, is_dark: bool) -> None:
    truth = scene(name).truth
    for image, points_px in zip(scene(name).images, RIG.project(truth.centerline_mm), strict=True):
        # Without the last of the cone, which is thinner than a pixel, and what lies before the sleeve, which is wide.
        bright, dark = shares_on_the_axis(image, points_px[8:-4])
        own, other = (dark, bright) if is_dark else (bright, dark)
        assert own == 1.0
        # The lobes that a second derivative has beside a line lie beyond its edges, not on its axis.
        assert other == 0.0


@pytest.mark.parametrize("noise", [1.0, 2.0, 4.0])
def test_contrast_is_judged_by_the_noise(noise: float) -> None:
    def found(contrast: float) -> Ridges:
        lighting = Lighting(120.0, Material(120.0 - contrast), Material(120.0), Material(0.0), Material(0.0))
        world = World(RIG, ARC, lighting=lighting, sleeve=None, noise=Noise(noise, 0.0))
        return ridges_of(seen_at(world).pair.left.image)

    points_px, _ = RIG.project(ARC.at(0.0).points_mm)
    clear = found(6 * noise)
    assert at_points(clear.dark, clear, points_px).mean() > 0.9
    # A mean over 5 px of width and as many along has a fifth of the noise: at one sigma it is five of its own, which
    # among 50 000 pixels is not yet a line.
    assert not found(noise).dark.any()


@pytest.mark.parametrize("sigma", [1.0, 5.0, 20.0])
def test_noise_is_no_line(sigma: float) -> None:
    ridges = ridges_of(noisy(120.0, sigma))
    assert not ridges.bright.any()
    assert not ridges.dark.any()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_constant_image_has_no_line(level: int) -> None:
    ridges = ridges_of(np.full(SHAPE, level, np.uint8))
    assert not ridges.bright.any()
    assert not ridges.dark.any()


def test_what_is_ten_times_too_wide_is_no_line_inside() -> None:
    column = np.arange(SHAPE[1])
    wide_px = 10 * WIDTHS_PX[1]
    inside = np.abs(column - 360.0) < wide_px / 2
    ridges = ridges_of(noisy(np.where(inside, 40.0, 200.0)[None].repeat(SHAPE[0], axis=0)))
    # Beside each of its edges the second derivative has a lobe, as far as the widest filter reaches: five times its
    # sigma, which is half a needle's width or two reduced pixels.
    reach_px = 5 * max(WIDTHS_PX[1] / 2, 2.0 * ridges.reduction)
    core = np.abs(np.arange(ridges.dark.shape[1]) * ridges.reduction - 360.0) < wide_px / 2 - reach_px
    assert core.sum() >= 5
    assert not ridges.dark[:, core].any()


def test_a_round_spot_is_no_line() -> None:
    y, x = np.indices(SHAPE)
    spots = np.zeros(SHAPE)
    for u, v in [(200, 150), (400, 300), (600, 500)]:
        spots = np.maximum(spots, np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * (WIDTHS_PX[1] / 2) ** 2)))
    ridges = ridges_of(noisy(200.0 - 150.0 * spots))
    # It curves both ways; what is left is a rim of a pixel or two where one way has the upper hand.
    middles = np.array([(200.0, 150.0), (400.0, 300.0), (600.0, 500.0)])
    assert not at_points(ridges.dark, ridges, middles).any()


def test_a_dark_line_beneath_a_bright_one_does_not_swallow_it() -> None:
    y, x = np.indices(SHAPE)
    steep = np.abs(x - 360.0) < WIDTHS_PX[0] / 2
    flat = np.abs(y - 320.0) < WIDTHS_PX[1] / 2
    ridges = ridges_of(noisy(np.where(steep, 230.0, np.where(flat, 30.0, 120.0))))
    along = np.column_stack([np.full(500, 360.0), np.linspace(70.0, 570.0, 500)])
    # The crossing itself, a few widths, belongs to neither.
    assert at_points(ridges.bright, ridges, along).mean() > 1 - 6 * WIDTHS_PX[1] / 500
    assert not at_points(ridges.dark, ridges, along).any()


@pytest.mark.parametrize("times", [1, 2])
def test_the_reduced_image_keeps_its_place(times: int) -> None:
    image = scene("dark").pair.left.image
    enlarged = image.repeat(times, axis=0).repeat(times, axis=1)
    ridges = ridges_of(enlarged, (WIDTHS_PX[0] * times, WIDTHS_PX[1] * times))
    # The thinnest needle is kept about a pixel wide, so that twice the size is reduced twice as much.
    assert ridges.reduction == 3 * times
    assert ridges.reduced.shape == tuple(n // ridges.reduction for n in enlarged.shape)
    rows, columns = (n * ridges.reduction for n in ridges.reduced.shape)
    np.testing.assert_allclose(ridges.reduced.mean(), enlarged[:rows, :columns].mean(), rtol=1e-4)
    points_px, _ = RIG.project(scene("dark").truth.centerline_mm)
    # The middle of pixel i is at i + 0.5 of its width.
    assert at_points(ridges.dark, ridges, (points_px + 0.5) * times - 0.5).mean() > 0.95


def test_thresholds_can_be_raised() -> None:
    image = scene("dark").pair.left.image
    contrast = WORLDS["dark"].lighting.background_level - WORLDS["dark"].lighting.needle.level
    strict = replace_parameters(min_response_gray=2 * contrast)
    assert not find_ridges(image, WIDTHS_PX, strict).dark.any()
    assert find_ridges(image, WIDTHS_PX, replace_parameters(min_response_gray=contrast / 10)).dark.any()


def replace_parameters(**changes: float) -> SegmentParameters:
    return SegmentParameters.model_validate(changes)


def test_a_line_of_light_is_a_line_of_dark_in_the_negative() -> None:
    image = scene("dark").pair.left.image
    ridges, negative = ridges_of(image), ridges_of(255 - image)
    # But for rounding in 32 bits, where a response is as high as the threshold.
    assert (ridges.dark != negative.bright).mean() < 1e-3
    assert (ridges.bright != negative.dark).mean() < 1e-3
    assert ridges.dark.mean() > 1e-2


def test_images_of_different_sizes_and_threads_do_not_disturb_each_other() -> None:
    # Arrays are kept from call to call, for each thread its own.
    image = scene("steel").images[0]
    images = [image, image[:300, :400].copy()] * 3
    alone = [ridges_of(each) for each in images]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(ridges_of, images))
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one.bright, other.bright)
        assert np.array_equal(one.dark, other.dark)
    assert alone[0].dark.any()


@pytest.mark.parametrize("reduction", [1, 2, 3, 5])
def test_images_are_reduced_to_the_means_of_whole_squares(reduction: int) -> None:
    image = np.random.default_rng(2).integers(0, 256, (31, 47), dtype=np.uint8)
    # The thinnest line is to be 0.9 px wide after it.
    found = ridges_of(image, (0.9 * reduction, 4.0 * reduction))
    assert found.reduction == reduction
    rows, columns = 31 // reduction, 47 // reduction
    squares = image[: rows * reduction, : columns * reduction].reshape(rows, reduction, columns, reduction)
    means = squares.mean(axis=(1, 3))
    assert found.reduced.shape == (rows, columns)
    assert np.abs(found.reduced - means).max() <= 0.5 + 1e-4
