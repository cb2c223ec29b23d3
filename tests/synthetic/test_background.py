import numpy as np
import pytest

from needletrack.geometry.transform import RigidTransform
from needletrack.synthetic.background import Texture, plane_levels, vessels
from needletrack.synthetic.rig import default_rig


def test_both_cameras_see_one_texture_on_the_plane() -> None:
    rig = default_rig((640, 512))
    texture = Texture.random(np.random.default_rng(3), 20.0)
    x, y = np.meshgrid(np.linspace(-60, 90, 12), np.linspace(-60, 60, 10))
    on_plane = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 350.0)])
    expected = 120.0 + texture.at(on_plane[:, :2])
    # A right camera that stands 30 mm further back.
    rotation = rig.right_from_left.rotation
    poses = RigidTransform.identity(), RigidTransform(rotation, -rotation @ np.array([68.0, 0.0, -30.0]))
    for camera, pose in zip((rig.left, rig.right), poses, strict=True):
        pixels = camera.project(pose.apply(on_plane))
        levels = plane_levels(camera, pose, 120.0, texture, 350.0)
        assert levels.shape == (512, 640)
        column, row = np.rint(pixels).astype(int).T
        # Half a pixel beside it (0.25 mm on the plane) the texture is at most steepness x 0.25 mm off.
        steepness = (np.abs(texture.weights) * np.linalg.norm(texture.wave_vectors_per_mm, axis=1)).sum()
        np.testing.assert_allclose(levels[row, column], expected, atol=steepness * 0.36 + 0.2)


def test_the_texture_has_the_contrast_asked_for() -> None:
    far_apart = np.random.default_rng(1).uniform(-1e5, 1e5, (20000, 2))
    values = Texture.random(np.random.default_rng(2), 15.0).at(far_apart)
    # The standard deviation of 20000 independent values is known to 0.5 %.
    assert values.std() == pytest.approx(15.0, rel=0.03)
    assert not Texture.random(np.random.default_rng(2), 0.0).at(far_apart).any()


def test_vessels_lie_on_the_plane_and_branch() -> None:
    grown = vessels(np.random.default_rng(4), 6, 350.0)
    assert len(grown) == 6
    for vessel in grown:
        assert (vessel.points_mm[:, 2] == 350.0).all()
        assert 0.3 <= vessel.radius_mm <= 2.5
    for trunk, branch in ((grown[1], grown[2]), (grown[4], grown[5])):
        assert np.linalg.norm(trunk.points_mm - branch.points_mm[0], axis=1).min() <= 0.5
        assert branch.radius_mm < trunk.radius_mm
