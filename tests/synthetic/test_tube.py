"""Outlines against the silhouettes of surfaces projected point by point, blurred by brute force."""

import cv2
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from needletrack.geometry import spline
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.tube import CONE_MM, End, Tube, outline

LIGHT = (-0.35, -0.8, -0.5)
BLUR_PX = 0.8
SUPERSAMPLING = 8


def straight(start_mm: Float, direction: Float, length_mm: float, radius_mm: float, **ends: End) -> Tube:
    at_mm = np.linspace(0, length_mm, int(length_mm / 0.05) + 1)
    return Tube(start_mm + at_mm[:, None] * direction, radius_mm, **ends)


def surface_mm(tube: Tube, end: End) -> Float:
    """Points on the surface of a straight tube that is cut off at its first end."""
    start, tip = tube.points_mm[0], tube.points_mm[-1]
    direction = spline.unit(tip - start)
    length_mm = np.linalg.norm(tip - start)
    x = spline.unit(np.cross(direction, [0.3, 0.5, 0.8]))
    around = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ring = np.cos(around)[:, None] * x + np.sin(around)[:, None] * np.cross(direction, x)
    if end is End.ROUND:
        polar = np.linspace(0, np.pi / 2, 40)
        profile = [(length_mm - tube.radius_mm * (1 - np.sin(a)), tube.radius_mm * np.cos(a)) for a in polar]
    elif end is End.CONE:
        profile = [(length_mm - CONE_MM, tube.radius_mm), (length_mm, 0.0)]
    else:
        profile = [(length_mm, tube.radius_mm)]
    return np.concatenate([start + at * direction + r * ring for at, r in [(0.0, tube.radius_mm), *profile]])


TOWARD, AWAY, FLAT_ON, STEEP = (0.4, -0.5, -1.2), (-0.3, 1.0, 0.8), (1.0, 0.2, 0.1), (0.2, 0.25, 1.0)


@pytest.mark.parametrize("direction", [TOWARD, AWAY, FLAT_ON, STEEP])
@pytest.mark.parametrize(
    # A 5 mm sleeve's two edges lie unlike far from its axis, by up to 0.1 px here; it is drawn alike.
    ("end", "radius_mm", "greatest_error"),
    [
        (End.CONE, 0.35, 0.02),
        (End.CONE, 0.6, 0.02),
        (End.ROUND, 0.35, 0.02),
        (End.ROUND, 0.6, 0.02),
        (End.FLAT, 0.6, 0.02),
        (End.FLAT, 2.5, 0.06),
    ],
)
def test_coverage_is_that_of_the_blurred_silhouette(
    end: End, radius_mm: float, greatest_error: float, direction: tuple[float, float, float]
) -> None:
    rig = default_rig()
    tube = straight(np.array([20.0, -15.0, 250.0]), spline.unit(direction), 8.0, radius_mm, last=end)
    shape = outline(tube, rig.right, rig.right_from_left, LIGHT)

    silhouette_px = rig.right.project(rig.right_from_left.apply(surface_mm(tube, end)))
    low = np.floor(silhouette_px.min(axis=0)).astype(int) - 5
    high = np.ceil(silhouette_px.max(axis=0)).astype(int) + 6
    # The centre of sub-pixel (i, j) lies at low + (j + 0.5, i + 0.5) / SUPERSAMPLING - 0.5.
    sub_px = (silhouette_px - low + 0.5) * SUPERSAMPLING - 0.5
    rows, columns = (high - low)[::-1] * SUPERSAMPLING
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    borders = ConvexHull(sub_px).equations
    outside_px = np.full((rows, columns), -np.inf)
    for normal_x, normal_y, offset in borders:
        np.maximum(outside_px, normal_x * j + normal_y * i + offset, out=outside_px)
    canvas = np.clip(0.5 - outside_px, 0, 1)
    blurred = cv2.GaussianBlur(canvas, (0, 0), BLUR_PX * SUPERSAMPLING)
    # Between the two middle sub-pixels lies the pixel's centre.
    half = SUPERSAMPLING // 2
    at_centers = sum(blurred[half - a :: SUPERSAMPLING, half - b :: SUPERSAMPLING] for a in (0, 1) for b in (0, 1))
    expected = np.asarray(at_centers) / 4

    u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    covered = shape.coverage(pixels, BLUR_PX).reshape(expected.shape)
    assert np.abs(covered - expected).max() < greatest_error
    # On average along the outline they agree far better.
    around_px = ConvexHull(silhouette_px).area
    assert abs(covered.sum() - expected.sum()) < greatest_error / 3 * around_px


def test_the_width_falls_with_depth() -> None:
    rig = default_rig()
    near, far = (
        outline(
            straight(np.array([0.0, 0.0, depth_mm]), np.array([0.0, 1.0, 0.0]), 10.0, 0.5),
            rig.left,
            RigidTransform.identity(),
            LIGHT,
        ).half_width_px
        for depth_mm in (200.0, 300.0)
    )
    # Distortion and the needle's own radius change this by less than a thousandth so near the middle.
    np.testing.assert_allclose(near[0], rig.left.matrix[0, 0] * 0.5 / 200, rtol=2e-3)
    np.testing.assert_allclose(near[0] / far[0], 300 / 200, rtol=2e-3)


def test_the_highlight_lies_on_the_side_of_the_light() -> None:
    rig = default_rig()
    tube = straight(np.array([0.0, 0.0, 250.0]), np.array([1.0, 0.0, 0.0]), 10.0, 0.5)
    from_above, from_below, from_the_camera = (
        outline(tube, rig.left, RigidTransform.identity(), light).highlight[100]
        for light in ((0.0, -1.0, -0.5), (0.0, 1.0, -0.5), (0.0, 0.0, -1.0))
    )
    # The picture's normal (-tangent y, tangent x) of a tube that runs to the right points down.
    assert -1 < from_above < -0.3
    assert 0.3 < from_below < 1
    assert abs(from_the_camera) < 0.05


def test_the_streak_is_part_of_the_tube() -> None:
    rig = default_rig()
    tube = straight(np.array([0.0, 0.0, 250.0]), spline.unit(np.array([1.0, 0.3, 0.0])), 10.0, 0.5)
    shape = outline(tube, rig.left, RigidTransform.identity(), LIGHT)
    u, v = np.meshgrid(np.arange(630, 730), np.arange(490, 560))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    covered, streak = shape.coverage_and_streak(pixels, BLUR_PX, 0.2)
    np.testing.assert_array_equal(covered, shape.coverage(pixels, BLUR_PX))
    assert (streak <= covered + 1e-12).all()
    # A fifth of the half width to either side of the highlight is a fifth of the area.
    np.testing.assert_allclose(streak.sum() / covered.sum(), 0.2, rtol=0.01)
