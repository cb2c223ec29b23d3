"""The 2017 method: its equations on exact projections, its stages on the bundled recordings."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from needletrack.errors import NeedleNotFound
from needletrack.geometry.camera import Camera
from needletrack.geometry.epipolar import epipolar_distance_px, homogeneous
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.geometry.triangulation import triangulate
from needletrack.records import Float, Frame, Image, Reason, Status, StereoPair
from needletrack.synthetic.rig import default_rig
from needletrack.tracking.reference import (
    ReferenceParameters,
    Scale,
    along_skeleton,
    distance_map,
    equalize,
    extract_centerline,
    fundamental_matrix,
    pairs_by_loop,
    pairs_in_map,
    projection_error,
    reference_stages,
    segment,
    skeleton,
    threshold_px,
    track_reference,
    triangulate_eq12,
)

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"


class Recording:
    """A bundled recording with the truth that its own cameras had."""

    def __init__(self, name: str) -> None:
        truth = json.loads((RECORDINGS / name / "truth.json").read_text())
        left, right = (
            Camera(np.array(camera["K"]), np.array(camera["dist"]), tuple(camera["size"]))
            for camera in truth["cameras"]
        )
        pose = RigidTransform(np.array(truth["cameras"][1]["R"]), np.array(truth["cameras"][1]["t"]))
        self.rig = StereoRig(left, right, pose)
        self.frames = truth["frames"]
        self.pairs = [
            StereoPair(frame(left), frame(right), number)
            for number, (left, right) in enumerate(zip(files(name, 0), files(name, 1), strict=True))
        ]


def files(name: str, camera: int) -> list[Path]:
    return sorted((RECORDINGS / name / f"cam{camera}" / "data").glob("*.png"))


def frame(file: Path) -> Frame:
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    return Frame(np.asarray(image, dtype=np.uint8), int(file.stem))


@pytest.fixture(scope="module")
def lab() -> Recording:
    return Recording("lab-a")


def distance_from_curve(points: Float, line: Float) -> Float:
    """Distance (N,) of each point (N, D) from a polyline (M, D)."""
    start, step = line[:-1], np.diff(line, axis=0)
    along = ((points[:, None] - start) * step).sum(-1) / (step**2).sum(-1)
    nearest = start + np.clip(along, 0, 1)[..., None] * step
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1))


def rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def pinhole_pixels(rig: StereoRig, points_mm: Float) -> tuple[Float, Float]:
    left = points_mm @ rig.left.matrix.T
    right = rig.right_from_left.apply(points_mm) @ rig.right.matrix.T
    return left[:, :2] / left[:, 2:], right[:, :2] / right[:, 2:]


def points_in_view(seed: int = 0, count: int = 200) -> Float:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-45, 45, (count, 2)), random.uniform(200, 310, count)])


# Section 3: the corresponding point check


def test_f_obeys_eq_2_and_is_the_transpose_of_eq_5() -> None:
    rig = default_rig()
    left_px, right_px = pinhole_pixels(rig, points_in_view())
    f = fundamental_matrix(rig)
    as_printed = np.einsum("ni,ij,nj->n", homogeneous(left_px), f, homogeneous(right_px))
    exchanged = np.einsum("ni,ij,nj->n", homogeneous(right_px), f, homogeneous(left_px))
    assert np.abs(as_printed).max() < 1e-12
    assert np.abs(exchanged).min() > 1e-6
    eq_5 = fundamental_matrix(rig, "unit_norm").T
    np.testing.assert_allclose(eq_5, rig.fundamental, atol=1e-12)


def test_the_forms_that_eq_5_gives_as_equal_differ_by_the_determinant_of_k() -> None:
    rig = default_rig()
    k_p, k_q = rig.left.matrix, rig.right.matrix
    rotation, translation = rig.right_from_left.rotation, rig.right_from_left.translation_mm

    def cross(v: Float) -> Float:
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    second = np.linalg.inv(k_q).T @ rotation @ k_p.T @ cross(k_p @ rotation.T @ translation)
    third = fundamental_matrix(rig, "millimetres").T
    np.testing.assert_allclose(second, np.linalg.det(k_p) * third, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("scale", "low_px", "high_px"), [("unit_translation", 0.135, 0.145), ("unit_norm", 0.005, 0.009)]
)
def test_what_the_threshold_means_in_pixels(lab: Recording, scale: Scale, low_px: float, high_px: float) -> None:
    f = fundamental_matrix(lab.rig, scale)
    left_px, right_px = pinhole_pixels(lab.rig, np.array(lab.frames[0]["centerline_mm"]))
    at_px = threshold_px(f, left_px, 1e-4)
    assert low_px < at_px.min() <= at_px.max() < high_px
    # A right point moved off its line by that much has the residual of the threshold.
    lines = homogeneous(left_px) @ f
    normal = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    residual = np.diag(distance_map(f, left_px, right_px + at_px[:, None] * normal))
    np.testing.assert_allclose(np.abs(residual), 1e-4, rtol=1e-6)
    moved_px = epipolar_distance_px(lab.rig.fundamental, left_px, right_px + at_px[:, None] * normal)
    np.testing.assert_allclose(np.abs(moved_px), at_px, rtol=1e-6)


@pytest.mark.parametrize("absolute", [True, False])
@pytest.mark.parametrize("threshold", [1e-4, 1e-3])
def test_double_loop_and_distance_map_give_the_same_pairs(lab: Recording, threshold: float, absolute: bool) -> None:
    pair, parameters = lab.pairs[0], ReferenceParameters()
    left_px = extract_centerline(pair.left.image, lab.rig.left, parameters).points_px
    right_px = extract_centerline(pair.right.image, lab.rig.right, parameters).points_px
    f = fundamental_matrix(lab.rig)
    in_map = pairs_in_map(distance_map(f, left_px, right_px), threshold, absolute=absolute)
    assert len(in_map) > 10
    np.testing.assert_array_equal(in_map, pairs_by_loop(f, left_px, right_px, threshold, absolute=absolute))


def test_both_ways_give_the_same_result(lab: Recording) -> None:
    pair = lab.pairs[3]
    with_map = reference_stages(pair.left.image, pair.right.image, lab.rig, ReferenceParameters(k=2))
    without = reference_stages(
        pair.left.image, pair.right.image, lab.rig, ReferenceParameters(k=2, use_distance_map=False)
    )
    assert without.distance_map is None
    assert with_map.distance_map is not None
    assert with_map.distance_map.shape == (len(with_map.left.points_px), len(with_map.right.points_px))
    np.testing.assert_array_equal(with_map.points_mm, without.points_mm)


@pytest.mark.parametrize("k", [0, 6, -1])
def test_k_outside_1_to_5_is_refused_with_the_reason(k: int) -> None:
    with pytest.raises(ValidationError, match="beyond 5 the gaps between the kept points break the curve"):
        ReferenceParameters(k=k)


@pytest.mark.parametrize("k", [1, 2, 3, 4, 5])
def test_every_kth_point_is_kept(lab: Recording, k: int) -> None:
    view = extract_centerline(lab.pairs[2].left.image, lab.rig.left, ReferenceParameters(k=k))
    np.testing.assert_array_equal(view.points_px, view.centerline_px[::k])


# Section 4: reconstruction


@given(
    x_mm=st.floats(-45, 45),
    y_mm=st.floats(-40, 40),
    z_mm=st.floats(200, 310),
    tilt_rad=st.floats(-0.05, 0.05),
)
def test_eq_12_is_exact_for_exact_pairs(x_mm: float, y_mm: float, z_mm: float, tilt_rad: float) -> None:
    rig = default_rig()
    roll = RigidTransform(np.asarray(cv2.Rodrigues(np.array([0, 0, tilt_rad]))[0], dtype=np.float64), np.zeros(3))
    rig = StereoRig(rig.left, rig.right, roll @ rig.right_from_left)
    points_mm = np.array([[x_mm, y_mm, z_mm]])
    left_px, right_px = pinhole_pixels(rig, points_mm)
    # Pixels are rounded at 1e-13; eq. 12 magnifies that by the inverse of this sine.
    sine = sine_from_origin(rig, left_px, right_px)[0]
    tolerance_mm = 1e-8 / max(sine, 1e-6)
    np.testing.assert_allclose(triangulate_eq12(rig, left_px, right_px), points_mm, atol=tolerance_mm)
    np.testing.assert_allclose(triangulate(rig, left_px, right_px), points_mm, atol=1e-8)


def sine_from_origin(rig: StereoRig, left_px: Float, right_px: Float) -> Float:
    """Sine (N,) of the angle between the epipolar line and the line from the origin of pixels through m_q."""
    lines = homogeneous(left_px) @ fundamental_matrix(rig)
    normal = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return np.asarray(np.abs((normal * right_px).sum(axis=1)) / np.linalg.norm(right_px, axis=1))


def test_eq_12_fails_where_the_line_from_the_origin_runs_along_the_epipolar_line() -> None:
    rig = default_rig()
    # Near the top of the image the line from the origin is nearly a row, as epipolar lines are; below not.
    points_mm = np.column_stack([np.zeros(200), np.linspace(-110, 80, 200), np.full(200, 250.0)])
    left_px, right_px = pinhole_pixels(rig, points_mm)
    random = np.random.default_rng(5)
    noise_px = random.normal(0, 0.1, (400, *right_px.shape))
    eq12 = np.array([triangulate_eq12(rig, left_px, right_px + noise)[:, 2] - 250 for noise in noise_px])
    midpoint = np.array([triangulate(rig, left_px, right_px + noise)[:, 2] - 250 for noise in noise_px])
    sine = sine_from_origin(rig, left_px, right_px)
    eq12_mm, midpoint_mm = np.median(np.abs(eq12), axis=0), np.median(np.abs(midpoint), axis=0)
    worst, best = int(sine.argmin()), int(sine.argmax())
    assert sine[worst] < 0.05
    assert sine[best] > 0.5
    assert eq12_mm[worst] > 20 * midpoint_mm[worst]
    assert eq12_mm[best] < 3 * midpoint_mm[best]


def test_eq_12_depends_on_where_pixels_have_their_origin() -> None:
    rig = default_rig()
    points_mm = points_in_view()
    left_px, right_px = pinhole_pixels(rig, points_mm)
    shift = np.array([[1, 0, 500.0], [0, 1, 4000.0], [0, 0, 1]])
    moved = StereoRig(
        rig.left,
        Camera(shift @ rig.right.matrix, rig.right.distortion, rig.right.size_px),
        rig.right_from_left,
    )
    off_px = np.array([0.3, 0.3])
    here_mm = triangulate_eq12(rig, left_px, right_px + off_px)
    there_mm = triangulate_eq12(moved, left_px, right_px + off_px + shift[:2, 2])
    np.testing.assert_allclose(triangulate_eq12(moved, left_px, right_px + shift[:2, 2]), points_mm, atol=1e-6)
    assert np.median(np.abs(here_mm - there_mm).max(axis=1)) > 0.1


# Section 5: projection error


def test_the_projection_error_is_the_distance_from_the_centerlines() -> None:
    rig = default_rig()
    points_mm = np.array([[0.0, 0.0, 250.0], [5.0, 1.0, 250.0]])
    left_px, right_px = pinhole_pixels(rig, points_mm)
    error = projection_error(rig, points_mm, left_px + np.array([0, 2]), right_px + np.array([3, 0]))
    np.testing.assert_allclose(error.distances_px, [[2, 3], [2, 3]], rtol=1e-9)
    assert error.mean_px == pytest.approx(2.5)
    # The right camera's depth and focal length are nearly the left one's.
    assert error.mean_mm == pytest.approx(2.5 * 250 / rig.left.focal_px, rel=0.05)


def test_the_projection_error_is_bounded_by_the_threshold_and_blind_to_the_shape(lab: Recording) -> None:
    """The arch of frame 2 runs along the epipolar lines: tens of millimetres off, and eq. 13 is content."""
    pair = lab.pairs[2]
    found = reference_stages(pair.left.image, pair.right.image, lab.rig)
    f = fundamental_matrix(lab.rig)
    assert found.error.distances_px[:, 0].max() < 1e-9
    assert found.error.distances_px[:, 1].max() <= 1.5 * threshold_px(f, found.left.points_px, 1e-4).max()
    truth_mm = np.array(lab.frames[2]["centerline_mm"])
    assert rms(distance_from_curve(found.points_mm, truth_mm)) > 10


def test_eq_8_as_printed_lets_pairs_through_that_lie_far_off(lab: Recording) -> None:
    pair = lab.pairs[3]
    images = pair.left.image, pair.right.image
    bounded = reference_stages(*images, lab.rig)
    as_printed = reference_stages(*images, lab.rig, ReferenceParameters(absolute_residual=False))
    assert len(as_printed.pairs) > 100 * len(bounded.pairs)
    assert bounded.error.mean_px < 0.1
    assert as_printed.error.mean_px > 10


# Section 2: centerline extraction


def test_both_polarities_of_the_lab_are_segmented(lab: Recording) -> None:
    """Dark needles on white and white ones on dark: nearly all of the needle, and next to nothing else."""
    for pair, truth in zip(lab.pairs, lab.frames, strict=True):
        centerline_mm = np.array(truth["centerline_mm"])
        projections_px = lab.rig.project(centerline_mm)
        for number, image in enumerate((pair.left.image, pair.right.image)):
            points_px = skeleton(segment(image, ReferenceParameters()))
            seen_px = projections_px[number][np.array(truth["visible"][number], dtype=bool)]
            assert np.mean(distance_from_curve(points_px, projections_px[number]) < 3) > 0.95
            nearest_px = np.linalg.norm(seen_px[:, None] - points_px, axis=2).min(axis=1)
            assert np.mean(nearest_px < 3) > 0.95


def test_equalizing_keeps_the_size_and_spreads_the_grey_levels(lab: Recording) -> None:
    image = lab.pairs[1].left.image
    equalized = equalize(image)
    assert equalized.shape == image.shape
    assert equalized.std() > image.std()


def test_nothing_in_the_border_is_segmented() -> None:
    image = np.full((200, 300), 128, np.uint8)
    image[:, 4:8] = 255
    image[100:103, 40:200] = 255
    with_border = segment(image, ReferenceParameters(border_px=12))
    assert with_border.offset_px[0] >= 12
    assert with_border.mask.shape[1] == pytest.approx(160, abs=4)
    # The line at the border is the longer one.
    assert segment(image, ReferenceParameters(border_px=0)).mask.shape[0] == 200


def test_the_skeleton_runs_through_the_middle_of_a_line() -> None:
    image = np.full((200, 300), 128, np.uint8)
    image[98:103, 40:200] = 255
    across = skeleton(segment(image, ReferenceParameters()))
    upright = skeleton(segment(np.ascontiguousarray(image.T), ReferenceParameters()))
    # Zhang and Suen's thinning may favour one side by half a pixel, and rounds the ends.
    assert np.median(across[:, 1]) == pytest.approx(100, abs=0.5)
    assert np.median(upright[:, 0]) == pytest.approx(100, abs=0.5)
    assert across[:, 0].min() == pytest.approx(40, abs=4)
    assert across[:, 0].max() == pytest.approx(199, abs=4)


def test_an_even_image_has_no_needle() -> None:
    even: Image = np.full((200, 300), 128, np.uint8)
    with pytest.raises(NeedleNotFound) as found:
        segment(even, ReferenceParameters())
    assert (found.value.stage, found.value.reason) == ("segment", Reason.NO_CANDIDATE)


def test_the_path_along_a_skeleton_leaves_spurs_out() -> None:
    line = np.column_stack([np.arange(40.0), np.round(5 * np.sin(np.arange(40) / 10))])
    spur = np.array([[20.0, line[20, 1] + step] for step in (1, 2, 3)])
    shuffled = np.random.default_rng(0).permutation(np.concatenate([line, spur]))
    path = shuffled[along_skeleton(shuffled)]
    assert len(path) == 40
    np.testing.assert_array_equal(path if path[0, 0] == 0 else path[::-1], line)


# The whole


def test_the_lab_is_as_good_and_as_bad_as_measured_before(lab: Recording) -> None:
    """A quarter of the points find a partner at 1e-4, nine tenths at 1e-3; rms 0.3-0.5 mm."""
    errors_mm, found, found_at_1e_3 = [], [], []
    for pair, truth in zip(lab.pairs, lab.frames, strict=True):
        track = track_reference(pair, lab.rig)
        assert track.curve is not None
        errors_mm.append(rms(distance_from_curve(track.curve.points_mm, np.array(truth["centerline_mm"]))))
        found.append(track.quality.coverage)
        found_at_1e_3.append(track_reference(pair, lab.rig, ReferenceParameters(threshold=1e-3)).quality.coverage)
    assert 0.2 < float(np.median(errors_mm)) < 0.5
    assert 0.15 < float(np.median(np.array(found))) < 0.4
    assert float(np.median(np.array(found_at_1e_3))) > 0.9


def test_its_sigmas_hold(lab: Recording) -> None:
    inside = []
    for pair, truth in zip(lab.pairs, lab.frames, strict=True):
        curve = track_reference(pair, lab.rig).curve
        assert curve is not None
        inside.append(distance_from_curve(curve.points_mm, np.array(truth["centerline_mm"])) <= 2 * curve.sigma_mm)
    assert np.concatenate(inside).mean() > 0.95


@pytest.mark.parametrize("name", ["absent-a", "hard-a", "lab-a", "steel-a", "tissue-a"])
def test_it_is_never_ok_and_never_fails(name: str) -> None:
    recording = Recording(name)
    for pair in recording.pairs:
        track = track_reference(pair, recording.rig, ReferenceParameters(k=2, triangulation="midpoint"))
        assert track.captured_at_ns == pair.captured_at_ns
        assert track.status is not Status.OK
        assert track.tip is None
        if track.status is Status.DEGRADED:
            assert track.reasons == (Reason.REFERENCE_METHOD, Reason.AMBIGUOUS_BASE)
            assert track.curve is not None
            assert np.isfinite(track.curve.points_mm).all()
            assert np.isfinite(track.curve.curvature_per_mm).all()
            assert (track.curve.sigma_mm > 0).all()


def test_a_pair_without_anything_thin_is_invalid() -> None:
    rig = default_rig()
    even = Frame(np.full((1024, 1280), 128, np.uint8), 5)
    track = track_reference(StereoPair(even, even, 0), rig)
    assert track.status is Status.INVALID
    assert track.reasons == (Reason.NO_CANDIDATE,)


def test_two_needles_in_different_epipolar_planes_are_no_match() -> None:
    rig = default_rig()
    above, below = (np.full((1024, 1280), 128, np.uint8) for _ in range(2))
    above[100:104, 300:700] = 255
    below[900:904, 300:700] = 255
    track = track_reference(StereoPair(Frame(above, 5), Frame(below, 6), 0), rig)
    assert track.status is Status.INVALID
    assert track.reasons == (Reason.NO_STEREO_MATCH,)


def test_points_of_the_curve_are_evenly_spaced(lab: Recording) -> None:
    curve = track_reference(lab.pairs[3], lab.rig, ReferenceParameters(threshold=1e-3)).curve
    assert curve is not None
    steps_mm = np.linalg.norm(np.diff(curve.points_mm, axis=0), axis=1)
    # Resampling cuts the polyline's corners, so that chords are never longer than the step along the arc.
    assert steps_mm.max() <= curve.length_mm / (len(curve.points_mm) - 1) + 1e-9
