"""Tracks in the robot's frame: everything turned, distances kept, and the uncertainty that goes with it."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needletrack.calibration.board import Checkerboard
from needletrack.config import Config
from needletrack.errors import CalibrationError
from needletrack.geometry.transform import RigidTransform
from needletrack.publish.frames import in_published_frame
from needletrack.publish.message import TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.board import calibrate_from_recording
from needletrack.recording.registration import QUATERNION, RIG, ROBOT, PointPairs, read_pairs, registered
from needletrack.records import NeedleTrack, StereoPair
from needletrack.replay import Replay
from needletrack.rig import Rig, find_rig, read_rig, write_rig

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"
NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
POINTS_MM = np.array([[-40.0, -30, 220], [45, -25, 230], [-35, 35, 240], [40, 30, 225], [0, 0, 290], [20, -10, 260]])
ROBOT_FROM_RIG = RigidTransform(
    Rotation.from_euler("zyx", [80, -20, 130], degrees=True).as_matrix(), np.array([412.0, -80, 950])
)


class Kept:
    def __init__(self) -> None:
        self.took: list[tuple[NeedleTrack, TrackMessage]] = []

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self.took.append((track, message))


def placed(rig: Rig, noise_mm: float = 0.0) -> Rig:
    random = np.random.default_rng(2)
    robot_mm = ROBOT_FROM_RIG.apply(POINTS_MM) + (random.normal(0, noise_mm, POINTS_MM.shape) if noise_mm else 0.0)
    return registered(rig, PointPairs(POINTS_MM, robot_mm, None), "robot_base", NOW)[0]


def tracked(rig: Rig) -> tuple[NeedleTrack, TrackMessage]:
    kept = Kept()
    recording = AslRecording(RECORDINGS / "lab-a", rig)
    Replay(recording, Config(), independent=True, end=1).run(Event(), sinks=[kept])
    return kept.took[0]


def test_a_registered_rig_publishes_in_the_robot_s_frame() -> None:
    rig = find_rig(RECORDINGS / "lab-a")
    plain, message_left = tracked(rig)
    track, message = tracked(placed(rig))
    assert message_left.frame_id == f"{rig.name}_left"
    assert message.frame_id == "robot_base"
    assert plain.curve is not None
    assert message.centerline_mm is not None
    np.testing.assert_allclose(message.centerline_mm, ROBOT_FROM_RIG.apply(plain.curve.points_mm), atol=1e-5)
    # Sinks such as the report go on in the left camera's frame, in which the images are.
    assert track.curve is not None
    np.testing.assert_array_equal(track.curve.points_mm, plain.curve.points_mm)
    assert plain.tip is not None
    assert message.tip is not None
    turn = ROBOT_FROM_RIG.rotation
    np.testing.assert_allclose(message.tip.direction, turn @ plain.tip.direction, atol=1e-8)
    np.testing.assert_allclose(
        Rotation.from_quat(message.tip.orientation_xyzw).as_matrix()[:, 2], message.tip.direction, atol=1e-8
    )
    np.testing.assert_allclose(message.tip.covariance_mm2, turn @ plain.tip.covariance_mm2 @ turn.T, atol=1e-6)
    assert message.rig_digest != message_left.rig_digest
    assert message.length_mm == message_left.length_mm


def test_velocity_is_turned_and_never_shifted() -> None:
    rig = placed(find_rig(RECORDINGS / "lab-a"))
    track, _ = tracked(rig)
    assert track.tip is not None
    moving = replace(track, tip=replace(track.tip, velocity_mm_s=np.array([1.0, 2.0, 3.0])))
    published = in_published_frame(moving, rig.registration)
    assert published.tip is not None
    assert published.tip.velocity_mm_s is not None
    expected = ROBOT_FROM_RIG.rotation @ np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(published.tip.velocity_mm_s, expected)
    assert in_published_frame(track, None) is track


def test_sigmas_hold_what_the_calibration_and_the_registration_leave_open() -> None:
    rig = find_rig(RECORDINGS / "lab-a")
    board = calibrate_from_recording(RECORDINGS / "calib-a", Checkerboard(11, 11, 2.0), "bench", NOW).rig
    plain, calibrated, at_robot = tracked(rig)[0], tracked(board)[0], tracked(placed(board, 0.05))[0]
    sigmas = []
    for track in (plain, calibrated, at_robot):
        assert track.curve is not None
        sigmas.append(float(np.median(track.curve.sigma_mm)))
    # Five views of the small board leave focal length and distance open, most of which a registration absorbs.
    assert sigmas[1] > 3 * sigmas[0]
    assert sigmas[0] < sigmas[2] < sigmas[1]
    points_mm = np.array([[0.0, 0, 250]])
    of_calibration = board.calibration_covariance_mm2(points_mm)
    assert of_calibration is not None
    assert rig.calibration_covariance_mm2(points_mm) is None
    np.testing.assert_array_equal(np.linalg.eigvalsh(of_calibration[0]) > 0, True)


def test_a_registration_is_written_read_and_void_after_another_calibration(tmp_path: Path) -> None:
    rig = placed(find_rig(RECORDINGS / "lab-a"), 0.1)
    write_rig(rig, tmp_path / "rig.yaml")
    back = read_rig(tmp_path / "rig.yaml")
    assert back.registration == rig.registration
    assert back.digest == rig.digest != back.geometry_digest
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("1400.191", "1401.191", 1))
    with pytest.raises(CalibrationError, match="was made with another calibration"):
        read_rig(tmp_path / "rig.yaml")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("rig_x_mm,rig_y_mm\n1,2\n", "the column rig_z_mm is missing"),
        (
            "rig_x_mm,rig_y_mm,rig_z_mm,robot_x_mm,robot_y_mm,robot_z_mm\n1,2,3,4,5,six\n",
            "line 2: robot_z_mm is 'six', which is no number",
        ),
        (
            "rig_x_mm,rig_y_mm,rig_z_mm,robot_x_mm,robot_y_mm,robot_z_mm,robot_qx\n1,2,3,4,5,6,0\n",
            "only",
        ),
        (
            f"{','.join((*RIG, *ROBOT, *QUATERNION))}\n1,2,3,4,5,6,0,0,0,2\n",
            "the quaternion of pair 1 has length 2.000",
        ),
    ],
)
def test_pairs_that_cannot_be_read_name_the_line(text: str, match: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(CalibrationError, match=match):
        read_pairs(tmp_path / "pairs.csv")
