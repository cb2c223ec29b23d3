"""The rig file, Kalibr's camchain, and everything about a rig that cannot be true."""

import copy
import json
import os
import re
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from needletrack.errors import CalibrationError
from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.rig import CalibrationInfo, Rig, find_rig, import_camchain, read_rig, write_rig
from needletrack.tracking.needle import Range, Workspace

LAB_A = Path(__file__).parent / "data" / "recordings" / "lab-a"

INFO = CalibrationInfo(
    method="kalibr",
    calibrated_at=datetime(2026, 5, 1, 12, 0, tzinfo=UTC),
    reprojection_rms_px=0.08,
    views=14,
    source="board of 12 × 9 squares",
)


def a_rig(name: str = "bench-2", **changes: Any) -> Rig:
    matrix = np.array([[1400.25, 0.0, 651.7], [0.0, 1401.5, 507.9], [0.0, 0.0, 1.0]])
    rotation = Rotation.from_euler("yxz", [-7.6, 0.3, -0.2], degrees=True).as_matrix()
    parts: dict[str, Any] = {
        "left": Camera(matrix, np.array([-0.11, 0.08, 2e-4, -2e-5]), (1280, 1024)),
        "right": Camera(matrix, np.array([-0.1, 0.085, -6e-5, 3e-4, 0.01]), (1280, 1024)),
        "right_from_left": RigidTransform(rotation, np.array([-69.3, 0.8, 10.0])),
        "name": name,
        "calibration": INFO,
    }
    return Rig(**(parts | changes))


def assert_same(rig: Rig, other: Rig) -> None:
    """Equal to the last bit."""
    for camera, twin in ((rig.left, other.left), (rig.right, other.right)):
        np.testing.assert_array_equal(camera.matrix, twin.matrix)
        np.testing.assert_array_equal(camera.distortion, twin.distortion)
        assert camera.size_px == twin.size_px
    np.testing.assert_array_equal(rig.right_from_left.rotation, other.right_from_left.rotation)
    np.testing.assert_array_equal(rig.right_from_left.translation_mm, other.right_from_left.translation_mm)
    assert (rig.name, rig.calibration, rig.digest) == (other.name, other.calibration, other.digest)


def document_of(rig: Rig, folder: Path) -> Any:
    write_rig(rig, folder / "rig.yaml")
    return yaml.safe_load((folder / "rig.yaml").read_text(encoding="utf-8"))


def camchain() -> Any:
    return yaml.safe_load((LAB_A / "camchain.yaml").read_text(encoding="utf-8"))


def dumped(document: Any, path: Path) -> Path:
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return path


def changed(document: Any, key: str, value: Any) -> Any:
    """A copy with the value at a dotted key replaced, or left out where it is `...`."""
    document = copy.deepcopy(document)
    *tables, last = key.split(".")
    table = document
    for part in tables:
        table = table[int(part) if isinstance(table, list) else part]
    if value is ...:
        del table[last]
    else:
        table[int(last) if isinstance(table, list) else last] = value
    return document


# Writing and reading


@settings(max_examples=30)
@given(
    angles=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    translation=st.tuples(st.floats(-150, -20), st.floats(-10, 10), st.floats(-10, 10)),
    focal=st.floats(900, 3000),
    distortion=st.lists(st.floats(-0.01, 0.01), min_size=4, max_size=5),
    reprojection=st.none() | st.floats(1e-3, 10),
)
def test_a_written_rig_reads_back_to_the_last_bit(
    angles: tuple[float, ...],
    translation: tuple[float, ...],
    focal: float,
    distortion: list[float],
    reprojection: float | None,
) -> None:
    matrix = np.array([[focal, 0.125, 640.1], [0.0, focal * 1.001, 511.9], [0.0, 0.0, 1.0]])
    pose = RigidTransform(Rotation.from_rotvec(angles).as_matrix(), np.array(translation))
    right = Camera(matrix, np.array(distortion), (1280, 1024))
    rig = a_rig(right=right, right_from_left=pose, calibration=CalibrationInfo(reprojection_rms_px=reprojection))
    with tempfile.TemporaryDirectory() as folder:
        write_rig(rig, Path(folder) / "rig.yaml")
        assert_same(read_rig(Path(folder) / "rig.yaml"), rig)


def test_everything_known_of_the_calibration_is_kept(tmp_path: Path) -> None:
    write_rig(a_rig(), tmp_path / "rig.yaml")
    assert read_rig(tmp_path / "rig.yaml").calibration == INFO


def test_a_rational_lens_is_kept(tmp_path: Path) -> None:
    lens = np.array([-0.1, 0.05, 1e-4, 2e-4, 0.01, 0.02, 0.01, 0.003])
    rig = a_rig(left=Camera(a_rig().left.matrix, lens, (1280, 1024)))
    write_rig(rig, tmp_path / "rig.yaml")
    assert_same(read_rig(tmp_path / "rig.yaml"), rig)


def test_a_lens_that_the_file_cannot_hold_is_refused(tmp_path: Path) -> None:
    rig = a_rig(left=Camera(a_rig().left.matrix, np.zeros(12), (1280, 1024)))
    with pytest.raises(CalibrationError, match=r"rig\.yaml: .*rational has 8 coefficients, not 12"):
        write_rig(rig, tmp_path / "rig.yaml")


def test_a_failed_write_leaves_the_old_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rig.yaml"
    write_rig(a_rig("old"), path)

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(CalibrationError, match=r"rig\.yaml: cannot write the rig file: No space left"):
        write_rig(a_rig("new"), path)
    assert read_rig(path).name == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent/rig\.yaml: cannot write the rig file: No such file"):
        write_rig(a_rig(), tmp_path / "absent" / "rig.yaml")


def test_a_rotation_rounded_to_five_decimals_is_made_exact(tmp_path: Path) -> None:
    document = document_of(a_rig(), tmp_path)
    rounded = np.round(a_rig().right_from_left.rotation, 5)
    read = read_rig(dumped(changed(document, "right_from_left.rotation", rounded.tolist()), tmp_path / "r.yaml"))
    rotation = read.right_from_left.rotation
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14
    # Nine entries, each rounded by 0.5e-5 at most.
    assert np.linalg.norm(rotation - a_rig().right_from_left.rotation) < 2 * 3 * 0.5e-5


def test_numbers_that_yaml_takes_for_text_are_read(tmp_path: Path) -> None:
    write_rig(a_rig(), tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text(encoding="utf-8").replace("-2.0e-05", "-2e-05")
    assert "-2e-05" in text
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    assert_same(read_rig(tmp_path / "rig.yaml"), a_rig())


SKEWED = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.01], [0.0, 0.0, 1.0]]
MIRRORED = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
BACKWARD = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "other", "not a rig file: its first entry must be `format: needletrack-rig`"),
        ("version", 2, "version = 2: should be 1"),
        ("name", "a/b", "the name 'a/b' is not made of letters"),
        ("name", ..., "name is missing"),
        ("focal", 3, "unknown key focal"),
        ("cameras.left.camera_matrix.cz", 3, "unknown key cameras.left.camera_matrix.cz: known here: fx, fy"),
        ("cameras.right", ..., "cameras.right is missing (The right camera)"),
        ("cameras.left.camera_matrix.fx", -1400, "cameras.left.camera_matrix.fx = -1400: should be greater"),
        ("cameras.left.camera_matrix.fx", float("nan"), "cameras.left.camera_matrix.fx = nan: should be"),
        (
            "cameras.left.camera_matrix.fy",
            8.0,
            "left camera: the focal lengths 1400.25, 8 do not fit 1280x1024",
        ),
        (
            "cameras.right.camera_matrix.cx",
            9000,
            "right camera: the principal point (9000, 507.9) lies far outside",
        ),
        ("cameras.right.size_px", [640, 512], "the images differ in size: left 1280x1024, right 640x512"),
        ("cameras.left.size_px", [1280], "cameras.left.size_px"),
        (
            "cameras.left.distortion.model",
            "equidistant",
            "cameras.left.distortion.model = 'equidistant': should be",
        ),
        ("cameras.left.distortion.coefficients", [0.1], "radtan has 4 or 5 coefficients, not 1"),
        (
            "cameras.left.distortion.coefficients",
            [-0.9, 0.0, 0.0, 0.0],
            "left camera: the distortion has no inverse",
        ),
        ("right_from_left.rotation", SKEWED, "right_from_left.rotation is not a rotation"),
        ("right_from_left.rotation", MIRRORED, "right_from_left.rotation is not a rotation"),
        ("right_from_left.rotation", BACKWARD, "the cameras share no view at any distance"),
        ("right_from_left.translation_mm", [0, 0, 0], "the baseline is 0 mm"),
        (
            "right_from_left.translation_mm",
            [-0.0693, 0, 0.01],
            "metres and millimetres may have been exchanged",
        ),
        ("right_from_left.translation_mm", [-69300, 0, 0], "metres and millimetres may have been exchanged"),
        (
            "calibration.calibrated_at",
            "2026-05-01T12:00:00",
            "calibration.calibrated_at = '2026-05-01T12:00:00': ",
        ),
        ("calibration.views", 0, "calibration.views = 0: should be greater than 0"),
    ],
)
def test_a_contradictory_rig_file_is_refused_by_file_and_key(
    tmp_path: Path, key: str, value: Any, message: str
) -> None:
    path = dumped(changed(document_of(a_rig(), tmp_path), key, value), tmp_path / "wrong.yaml")
    with pytest.raises(CalibrationError, match=re.escape(f"{path}: ") + ".*" + re.escape(message)):
        read_rig(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format: [", "not a YAML file"),
        ("- 1\n- 2\n", "not a rig file"),
        ("", "not a rig file"),
        ("cam0: {}", "not a rig file"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=re.escape(f"{path}: {message}")):
        read_rig(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"rig\.yaml: cannot read the calibration: No such file"):
        read_rig(tmp_path / "rig.yaml")


def test_the_documented_rig_file_is_one(tmp_path: Path) -> None:
    text = (Path(__file__).parents[1] / "docs" / "configuration.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "rig.yaml").write_text(example, encoding="utf-8")
    rig = read_rig(tmp_path / "rig.yaml")
    assert (rig.name, rig.calibration.views) == ("bench-2", 14)


# Kalibr


def test_a_camchain_projects_as_the_true_cameras_do() -> None:
    rig = import_camchain(LAB_A / "camchain.yaml")
    truth = json.loads((LAB_A / "truth.json").read_text(encoding="utf-8"))
    points = np.concatenate([np.array(frame["centerline_mm"]) for frame in truth["frames"]])
    for camera, seen in zip(truth["cameras"], rig.project(points), strict=True):
        exact = Camera(np.array(camera["K"]), np.array(camera["dist"]), tuple(camera["size"]))
        pose = RigidTransform(np.array(camera["R"]), np.array(camera["t"]))
        # The file's nine digits leave 5e-7 px of a coordinate of 1000, and the lens adds its own.
        np.testing.assert_allclose(seen, exact.project(pose.apply(points)), rtol=0, atol=1e-5)
    assert (rig.name, rig.calibration.method) == ("lab-a", "kalibr")
    assert import_camchain(LAB_A / "camchain.yaml", name="bench").name == "bench"


def test_an_imported_camchain_is_written_as_a_rig_file(tmp_path: Path) -> None:
    rig = import_camchain(LAB_A / "camchain.yaml")
    write_rig(rig, tmp_path / "rig.yaml")
    assert_same(read_rig(tmp_path / "rig.yaml"), rig)


def test_a_camchain_without_distortion_is_taken(tmp_path: Path) -> None:
    document = changed(camchain(), "cam0.distortion_model", "none")
    rig = import_camchain(dumped(changed(document, "cam0.distortion_coeffs", []), tmp_path / "camchain.yaml"))
    np.testing.assert_array_equal(rig.left.distortion, np.zeros(4))


def test_keys_of_other_tools_in_a_camchain_are_let_pass(tmp_path: Path) -> None:
    document = changed(camchain(), "cam1.cam_overlaps", [0])
    rig = import_camchain(dumped(document, tmp_path / "camchain.yaml"), "lab-a")
    assert_same(rig, import_camchain(LAB_A / "camchain.yaml"))


def test_a_folder_name_becomes_a_rig_name(tmp_path: Path) -> None:
    folder = tmp_path / "Room 3 (left)"
    folder.mkdir()
    assert import_camchain(dumped(camchain(), folder / "camchain.yaml")).name == "Room-3-left"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("cam0", ..., "not a Kalibr camchain: it has no cam0"),
        ("cam1", ..., "holds cam0: a rig has cam0 (left) and cam1 (right), no more"),
        ("cam2", {}, "holds cam0, cam1, cam2: a rig has cam0 (left) and cam1 (right), no more"),
        ("cam1", 3, "cam1 is not a table"),
        ("cam0.camera_model", "omni", "cam0.camera_model is 'omni', which is not supported: calibrate with"),
        ("cam0.camera_model", "ds", "cam0.camera_model is 'ds'"),
        (
            "cam1.distortion_model",
            "equidistant",
            "cam1.distortion_model is 'equidistant', which is not supported",
        ),
        ("cam1.distortion_model", ..., "cam1.distortion_model is None"),
        ("cam1.distortion_coeffs", [0.1, 0.2], "radtan has 4 coefficients, not 2"),
        ("cam0.intrinsics", [1, 2, 3], "cam0.intrinsics"),
        ("cam0.resolution", ..., "cam0.resolution is missing (Width and height, px)"),
        ("cam1.T_cn_cnm1", ..., "cam1.T_cn_cnm1 is missing"),
        ("cam1.T_cn_cnm1.0.0", 0.98, "cam1.T_cn_cnm1 is not a rotation"),
        ("cam1.T_cn_cnm1.3", [0, 0, 1, 1], "cam1.T_cn_cnm1: the last row is not 0 0 0 1"),
        ("cam1.T_cn_cnm1.0.3", -69.3, "the baseline is 69300 mm"),
    ],
)
def test_a_camchain_of_another_kind_is_refused_by_file_and_key(
    tmp_path: Path, key: str, value: Any, message: str
) -> None:
    path = dumped(changed(camchain(), key, value), tmp_path / "camchain.yaml")
    with pytest.raises(CalibrationError, match=re.escape(f"{path}: ") + ".*" + re.escape(message)):
        import_camchain(path)


# The rig of a recording


def test_the_rig_of_a_folder_is_its_camchain() -> None:
    assert_same(find_rig(LAB_A), import_camchain(LAB_A / "camchain.yaml"))


@pytest.mark.parametrize("name", ["camchain.yaml", "bench-camchain.yaml", "camchain-2026-05-01.yaml"])
def test_kalibrs_own_file_names_are_found(tmp_path: Path, name: str) -> None:
    dumped(camchain(), tmp_path / name)
    assert find_rig(tmp_path).digest == find_rig(LAB_A).digest


def test_a_rig_file_that_agrees_with_the_camchain_is_preferred(tmp_path: Path) -> None:
    dumped(camchain(), tmp_path / "camchain.yaml")
    write_rig(import_camchain(LAB_A / "camchain.yaml", "bench"), tmp_path / "rig.yaml")
    assert find_rig(tmp_path).name == "bench"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        # 0.02 px more than the camchain says, twice the tolerance.
        ("cam0.intrinsics.2", 651.757728, "they project the same points up to 0.02 px apart"),
        # 0.1 mm more: half a pixel at 250 mm, and 0.7 px at the near end of the workspace.
        ("cam1.T_cn_cnm1.0.3", -0.0691869603222, "they project the same points up to 0.7"),
    ],
)
def test_a_rig_file_that_contradicts_the_camchain_is_refused(
    tmp_path: Path, key: str, value: float, message: str
) -> None:
    write_rig(import_camchain(LAB_A / "camchain.yaml"), tmp_path / "rig.yaml")
    dumped(changed(camchain(), key, value), tmp_path / "camchain.yaml")
    with pytest.raises(CalibrationError, match=f"rig.yaml and camchain.yaml contradict each other: {message}"):
        find_rig(tmp_path)


def test_a_rig_file_and_a_camchain_of_other_image_sizes_are_refused(tmp_path: Path) -> None:
    write_rig(import_camchain(LAB_A / "camchain.yaml"), tmp_path / "rig.yaml")
    document = changed(camchain(), "cam0.resolution", [1300, 1024])
    dumped(changed(document, "cam1.resolution", [1300, 1024]), tmp_path / "camchain.yaml")
    with pytest.raises(CalibrationError, match="contradict each other: images of 1280x1024 and of 1300x1024"):
        find_rig(tmp_path)


def test_rounding_is_no_contradiction(tmp_path: Path) -> None:
    document = camchain()
    for camera in document.values():
        camera["intrinsics"] = [round(value, 4) for value in camera["intrinsics"]]
    dumped(document, tmp_path / "camchain.yaml")
    write_rig(import_camchain(LAB_A / "camchain.yaml", "exact"), tmp_path / "rig.yaml")
    assert find_rig(tmp_path).name == "exact"


def test_a_folder_without_a_rig_says_what_to_add(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"no rig: add rig\.yaml or Kalibr's camchain\.yaml, or name"):
        find_rig(tmp_path)


def test_two_camchains_are_refused(tmp_path: Path) -> None:
    for name in ("camchain.yaml", "old-camchain.yaml"):
        dumped(camchain(), tmp_path / name)
    with pytest.raises(CalibrationError, match=r"more than one camchain \(camchain\.yaml, old-camchain\.yaml\)"):
        find_rig(tmp_path)


# What follows from a rig


def test_the_digest_tells_geometries_apart_and_nothing_else() -> None:
    rig = a_rig()
    assert re.fullmatch("[0-9a-f]{12}", rig.digest)
    assert a_rig("other", calibration=CalibrationInfo()).digest == rig.digest
    five_terms = Camera(rig.left.matrix, np.append(rig.left.distortion, 0.0), rig.left.size_px)
    assert a_rig(left=five_terms).digest == rig.digest
    moved = RigidTransform(rig.right_from_left.rotation, rig.right_from_left.translation_mm + np.array([0, 0, 1e-4]))
    assert a_rig(right_from_left=moved).digest != rig.digest
    assert a_rig(left=rig.right, right=rig.left).digest != rig.digest


def test_points_are_seen_by_both_cameras_where_they_lie_in_both_images() -> None:
    rig = a_rig()
    points = np.array([[0.0, 0, 250], [-110, 0, 250], [110, 0, 250], [0, 0, -250], [0, 400, 250]])
    left, right = (rig.left.contains(rig.project(points)[0]), rig.right.contains(rig.project(points)[1]))
    np.testing.assert_array_equal(left, [True, True, True, True, False])  # what lies behind projects as well
    np.testing.assert_array_equal(right, [True, False, True, True, False])
    np.testing.assert_array_equal(rig.seen_by_both(points), [True, False, True, False, False])


def test_a_lens_that_folds_back_shows_nothing_far_off_the_axis() -> None:
    # With k1 = -0.2 alone the image radius falls again beyond r = 1.29 and is zero at r = 2.24.
    lens = Camera(a_rig().left.matrix, np.array([-0.2, 0, 0, 0]), (1280, 1024))
    rig = a_rig(left=lens, right=lens)
    ray = np.array([2.2, 0.0, 1.0]) * 250
    assert lens.contains(lens.project([ray])).all()
    assert not rig.seen_by_both([ray]).any()


def test_a_workspace_out_of_view_is_refused() -> None:
    a_rig().require_view_of(Workspace())
    away = Workspace(x_mm=Range(min=2000.0, max=2100.0))
    with pytest.raises(CalibrationError, match=r"rig bench-2: no part of the workspace \(x 2000 to 2100 mm"):
        a_rig().require_view_of(away)
