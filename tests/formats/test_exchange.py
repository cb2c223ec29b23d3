"""Other tools' files: the same points land on the same pixels there and back, and files that others wrote are read."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from needletrack.errors import CalibrationError
from needletrack.formats.exchange import Format, export_rig, format_of, import_rig
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float
from needletrack.rig import Rig
from needletrack.synthetic.rig import default_rig

# What OpenCV's stereo_calib sample finds for its own pictures, samples/data/left01.jpg and so on (Apache 2.0).
OPENCV_INTRINSICS = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3398795381629998e+02, 0., 3.2838647414615605e+02, 0.,
       5.2871082254122143e+02, 2.3684272814037672e+02, 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 14
   dt: d
   data: [ -2.5896596034446923e-01, -1.2618399144051479e-01, 0., 0., 0.,
       0., 0., -3.9963356690988139e-01, 0., 0., 0., 0., 0., 0. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3398795381629998e+02, 0., 3.1377033136474824e+02, 0.,
       5.2871082254122143e+02, 2.4187045537694971e+02, 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 14
   dt: d
   data: [ -2.6296219996246428e-01, -1.2154546771207121e-02, 0., 0., 0.,
       0., 0., -1.9510575516727410e-01, 0., 0., 0., 0., 0., 0. ]
"""
OPENCV_EXTRINSICS = """%YAML:1.0
---
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 9.9997149582196887e-01, 4.8210106361039990e-03,
       5.8108002908933160e-03, -4.8866661262084174e-03,
       9.9992378065892118e-01, 1.1338137719252319e-02,
       -5.7556961129858961e-03, -1.1366209975903888e-02,
       9.9991883732282927e-01 ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -3.3427086816617235e+00, 4.6825937962329083e-02,
       3.6523404523280288e-03 ]
"""
# Its R1 and R2, of cv::stereoRectify.
OPENCV_R1 = """9.9994753470257836e-01 -9.1729784965332052e-03 4.5589809977615928e-03 9.1468661271598417e-03
    9.9994182998349390e-01 5.7158979446142759e-03 -4.6111476106960210e-03 -5.6738976694657908e-03
    9.9997327174427453e-01"""
# What ROS's camera_calibration wrote for somebody's stereo camera, six decimals each.
ROS_LEFT = """image_width: 1312
image_height: 541
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [853.415831, 0.000000, 641.228450, 0.000000, 852.608357, 167.569232, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.251963, 0.096396, -0.002254, -0.001636, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.999479, -0.000960, 0.032258, 0.000688, 0.999964, 0.008463, -0.032265, -0.008436, 0.999444]
projection_matrix:
  rows: 3
  cols: 4
  data: [834.752703, 0, 612.806038, 0.000000, 0, 834.752703, 158.305822, 0.000000, 0, 0, 1.000000, 0.000000]
"""
ROS_RIGHT = """image_width: 1312
image_height: 541
camera_name: narrow_stereo/right
camera_matrix:
  rows: 3
  cols: 3
  data: [851.257609, 0.000000, 637.135422, 0.000000, 851.168364, 154.698218, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.239563, 0.084455, -0.002111, -0.000161, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.999997, -0.001336, 0.002140, 0.001354, 0.999963, -0.008449, -0.002129, 0.008452, 0.999962]
projection_matrix:
  rows: 3
  cols: 4
  data: [834.752703, 0, 612.806038, -190.372340, 0, 834.752703, 158.305822, 0.000000, 0, 0, 1.000000, 0.000000]
"""
# A camera model as mrcal 2.2 writes it.
MRCAL = """{{
    'lensmodel':  'LENSMODEL_OPENCV5',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1000, 1001, 640, 480, -0.1, 0.02, 0.001, 0.002, 0.003,],

    # extrinsics are rt_fromref
    'extrinsics': [ {extrinsics},],

    'imagersize': [ 1280, 1024,],


}}
"""


def rig_with(terms: int) -> Rig:
    stereo = default_rig()
    lens = np.array([-0.11, 0.075, 2e-4, -1e-4, 0.02, 0.01, -0.02, 0.005])[:terms]
    left = Camera(stereo.left.matrix, lens, stereo.left.size_px)
    right = Camera(stereo.right.matrix, 0.9 * lens, stereo.right.size_px)
    return Rig(left, right, stereo.right_from_left, "bench-2")


def workspace_mm() -> Float:
    ranges = np.linspace(-60, 70, 6), np.linspace(-55, 55, 6), np.linspace(210, 295, 4)
    return np.stack(np.meshgrid(*ranges), axis=-1).reshape(-1, 3)


def apart_px(one: StereoRig, two: StereoRig) -> float:
    points = workspace_mm()
    return float(np.abs(np.subtract(one.project(points), two.project(points))).max())


@pytest.mark.parametrize(
    ("kind", "terms"),
    [
        ("kalibr", 4),
        ("ros", 4),
        ("ros", 5),
        ("ros", 8),
        ("opencv", 4),
        ("opencv", 8),
        ("matlab", 4),
        ("matlab", 5),
        ("mrcal", 4),
        ("mrcal", 8),
    ],
)
def test_points_land_on_the_same_pixels_there_and_back(kind: Format, terms: int, tmp_path: Path) -> None:
    rig = rig_with(terms)
    ending = {"kalibr": "camchain.yaml", "opencv": "stereo.yaml", "matlab": "stereo.mat"}
    written = export_rig(rig, kind, tmp_path / ending.get(kind, "files"))
    assert format_of(written[0]) == kind
    back = import_rig(written, "bench-2")
    assert apart_px(rig, back) < 1e-6
    assert back.left.size_px == rig.left.size_px
    assert back.calibration.method == kind


@pytest.mark.parametrize(("kind", "terms"), [("kalibr", 5), ("matlab", 8)])
def test_a_lens_that_a_format_cannot_hold_is_refused_with_the_remedy(kind: Format, terms: int, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="calibrate with --lens"):
        export_rig(rig_with(terms), kind, tmp_path / "file")


def test_what_opencv_s_own_sample_wrote(tmp_path: Path) -> None:
    files = tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"
    for file, text in zip(files, (OPENCV_INTRINSICS, OPENCV_EXTRINSICS), strict=True):
        file.write_text(text)
    # The sample counts in squares, of 25 mm here.
    rig = import_rig(files, "sample", size_px=(640, 480), unit_mm=25.0)
    assert rig.baseline_mm == pytest.approx(25 * 3.343, rel=1e-3)
    assert len(rig.left.distortion) == 8
    # What the sample's rectification is to ours: the same up to where it puts the principal point.
    found, *_ = rig.rectification
    np.testing.assert_allclose(found, np.array(OPENCV_R1.split(), dtype=float).reshape(3, 3), atol=1e-7)
    # A point through OpenCV's own functions on the file's own numbers.
    point = np.array([[30.0, -20.0, 800.0]])
    expected, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), rig.left.matrix, rig.left.distortion)
    np.testing.assert_allclose(rig.project(point)[0], expected[0], atol=1e-9)
    with pytest.raises(CalibrationError, match="--size"):
        import_rig(files, "sample")


def test_what_ros_wrote(tmp_path: Path) -> None:
    files = tmp_path / "left.yaml", tmp_path / "right.yaml"
    for file, text in zip(files, (ROS_LEFT, ROS_RIGHT), strict=True):
        file.write_text(text)
    rig = import_rig(files, "narrow")
    # Tx = -f B.
    assert rig.baseline_mm == pytest.approx(1000 * 190.372340 / 834.752703, rel=1e-6)
    # The same point on the same row of both rectified pictures, as ROS rectifies them.
    points = np.array([[0.1, 0.05, 2.0], [-0.4, -0.1, 3.0], [0.3, 0.1, 1.5]]) * 1000
    for document, camera, local in zip(
        (ROS_LEFT, ROS_RIGHT), (rig.left, rig.right), (points, rig.right_from_left.apply(points)), strict=True
    ):
        read = yaml.safe_load(document)
        turn = np.array(read["rectification_matrix"]["data"]).reshape(3, 3)
        projection = np.array(read["projection_matrix"]["data"]).reshape(3, 4)
        rectified, _ = cv2.undistortPoints(camera.project(local), camera.matrix, camera.distortion), None
        rays = np.column_stack([rectified.reshape(-1, 2), np.ones(len(points))]) @ turn.T
        rows = projection[1, 1] * rays[:, 1] / rays[:, 2] + projection[1, 2]
        columns = projection[0, 0] * rays[:, 0] / rays[:, 2] + projection[0, 2]
        left_turn = np.array(yaml.safe_load(ROS_LEFT)["rectification_matrix"]["data"]).reshape(3, 3)
        in_rectified = points @ left_turn.T / 1000
        homogeneous = np.column_stack([in_rectified, np.ones(len(points))]) @ projection.T
        # Six decimals of a rotation are 1e-3 px.
        np.testing.assert_allclose(rows, homogeneous[:, 1] / homogeneous[:, 2], atol=5e-3)
        np.testing.assert_allclose(columns, homogeneous[:, 0] / homogeneous[:, 2], atol=5e-3)


def test_what_mrcal_wrote(tmp_path: Path) -> None:
    files = tmp_path / "left.cameramodel", tmp_path / "right.cameramodel"
    files[0].write_text(MRCAL.format(extrinsics="0, 0, 0, 0, 0, 0"))
    files[1].write_text(MRCAL.format(extrinsics="0.01, 0.02, 0.03, -0.07, 0.001, 0.002"))
    rig = import_rig(files, "bench")
    assert rig.baseline_mm == pytest.approx(1000 * np.linalg.norm([0.07, 0.001, 0.002]))
    np.testing.assert_allclose(rig.right_from_left.rotation, cv2.Rodrigues(np.array([0.01, 0.02, 0.03]))[0], atol=1e-12)
    np.testing.assert_array_equal(rig.left.distortion, [-0.1, 0.02, 0.001, 0.002, 0.003])


def _without_baseline(text: str) -> str:
    return text.replace("-190.372340", "0.0")


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (_without_baseline, "one by one, not as a stereo pair"),
        (lambda text: text.replace("plumb_bob", "equidistant"), "equidistant"),
        (lambda text: text.replace("0.999997", "0.899997"), "not a rotation"),
        (lambda text: text.replace("camera_matrix:", "camera:"), "no camera_matrix"),
        (lambda text: text.replace("image_width: 1312\n", ""), "'image_width' is missing"),
    ],
)
def test_a_file_that_cannot_be_true_is_refused(damage: Callable[[str], str], match: str, tmp_path: Path) -> None:
    files = tmp_path / "left.yaml", tmp_path / "right.yaml"
    files[0].write_text(ROS_LEFT)
    files[1].write_text(damage(ROS_RIGHT))
    with pytest.raises(CalibrationError, match=match):
        import_rig(files, "narrow")


def test_files_of_no_known_format_and_lone_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(CalibrationError, match="format is not known"):
        import_rig([tmp_path / "a.txt"], "x")
    (tmp_path / "left.yaml").write_text(ROS_LEFT)
    with pytest.raises(CalibrationError, match="the left and the right one"):
        import_rig([tmp_path / "left.yaml"], "x")
    (tmp_path / "broken.yml").write_text("%YAML:1.0\n---\nM1: [1")
    with pytest.raises(CalibrationError, match=r"not an OpenCV FileStorage|missing"):
        import_rig([tmp_path / "broken.yml"], "x", size_px=(640, 480))


def test_skew_is_not_dropped_in_silence(tmp_path: Path) -> None:
    rig = rig_with(4)
    skewed = rig.left.matrix.copy()
    skewed[0, 1] = 2.0
    rig = replace(rig, left=Camera(skewed, rig.left.distortion, rig.left.size_px))
    for kind in ("ros", "mrcal", "kalibr"):
        with pytest.raises(CalibrationError, match="skew"):
            export_rig(rig, kind, tmp_path / kind)
