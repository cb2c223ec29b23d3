import numpy as np
import pytest

from needletrack.geometry.transform import RigidTransform
from needletrack.synthetic.render import NOISE_FREE, Lens, Material, Noise, exposed, painted, vignette
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.tube import Tube, outline

SIZE = (300, 400)


def levels_of(value: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.full(SIZE, value, dtype=np.float32)


@pytest.mark.parametrize("level", [20.0, 120.0, 200.0])
def test_noise_has_the_stated_standard_deviation(level: float) -> None:
    noise = Noise(read=1.5, shot_variance_per_level=0.03)
    image = exposed(levels_of(level), noise, np.random.default_rng(0))
    expected = np.sqrt(float(noise.sigma(level)) ** 2 + 1 / 12)
    # The standard deviation of n values is known to 1 / sqrt(2 n), their mean to sigma / sqrt(n).
    assert image.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * image.size))
    assert image.mean() == pytest.approx(level, abs=4 * expected / np.sqrt(image.size))


def test_without_noise_levels_are_rounded_and_clipped() -> None:
    levels = np.array([[-3.0, 0.4, 0.6], [254.4, 255.4, 320.0]], dtype=np.float32)
    image = exposed(levels, NOISE_FREE, np.random.default_rng(0))
    np.testing.assert_array_equal(image, [[0, 0, 1], [254, 255, 255]])


def test_vignetting_takes_the_stated_share_in_the_farthest_corner() -> None:
    camera = default_rig((400, 300)).left
    transmission = vignette(camera, 0.3)
    assert transmission.shape == SIZE
    assert transmission.min() == pytest.approx(0.7, abs=1e-6)
    center = tuple(np.rint(camera.matrix[1::-1, 2]).astype(int))
    assert transmission[center] == pytest.approx(1.0, abs=1e-4)


def test_later_layers_stand_in_front_and_the_picture_is_not_changed() -> None:
    rig = default_rig((400, 300))

    def bar(x: float, y: float) -> Tube:
        along = np.linspace(-20, 20, 201)[:, None]
        return Tube(np.array([0.0, 0.0, 250.0]) + along * np.array([x, y, 0.0]), 2.0)

    light = (0.0, 0.0, -1.0)
    across, down = (outline(bar(*d), rig.left, RigidTransform.identity(), light) for d in ((1, 0), (0, 1)))
    plain = levels_of(100.0)
    dark, bright = Material(10.0), Material(200.0)
    u, v = np.rint(rig.left.project([[0.0, 0.0, 250.0]])[0]).astype(int)
    assert painted(plain, [(across, dark), (down, bright)], Lens())[v, u] == pytest.approx(200.0, abs=0.5)
    assert painted(plain, [(down, bright), (across, dark)], Lens())[v, u] == pytest.approx(10.0, abs=0.5)
    assert (plain == 100.0).all()


def test_what_lies_outside_the_image_is_not_drawn() -> None:
    rig = default_rig((400, 300))
    beside = Tube(np.array([400.0, 0.0, 250.0]) + np.linspace(0, 10, 50)[:, None] * np.array([0.0, 1.0, 0.0]), 1.0)
    shape = outline(beside, rig.left, RigidTransform.identity(), (0.0, 0.0, -1.0))
    np.testing.assert_array_equal(painted(levels_of(80.0), [(shape, Material(0.0))], Lens()), levels_of(80.0))


def test_a_streak_brightens_the_side_of_the_light() -> None:
    rig = default_rig((1280, 1024))
    along = np.linspace(-10, 10, 401)[:, None]
    tube = Tube(np.array([0.0, 0.0, 250.0]) + along * np.array([1.0, 0.0, 0.0]), 0.6)
    shape = outline(tube, rig.left, RigidTransform.identity(), (0.0, -1.0, -0.6))
    picture = painted(np.full((1024, 1280), 100, dtype=np.float32), [(shape, Material(50.0, 150.0))], Lens())
    u, v = np.rint(rig.left.project([[0.0, 0.0, 250.0]])[0]).astype(int)
    profile = picture[v - 6 : v + 7, u]
    assert 2 <= 6 - int(profile.argmax()) <= 3
    assert profile.max() > 90
