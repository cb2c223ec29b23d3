"""The frame of what is published: the left camera's, or the robot's where the rig is registered to it."""

from dataclasses import replace

from needletrack.geometry.transform import RigidTransform, turned_orientation
from needletrack.records import NeedleTrack, TipPose
from needletrack.rig import Registration


def in_published_frame(track: NeedleTrack, registration: Registration | None) -> NeedleTrack:
    """The track with positions, directions, velocity and covariance in the robot's frame; itself where not registered.

    Its sigmas include the calibration's and the registration's share already (`Rig.calibration_covariance_mm2`).
    """
    if registration is None or track.curve is None:
        return track
    robot_from_rig = registration.robot_from_rig
    turn = robot_from_rig.rotation
    curve = replace(track.curve, points_mm=robot_from_rig.apply(track.curve.points_mm))
    tip = None if track.tip is None else _moved_tip(track.tip, robot_from_rig)
    base = track.base
    if base is not None:
        base = replace(base, position_mm=robot_from_rig.apply(base.position_mm), direction=turn @ base.direction)
    return replace(track, curve=curve, tip=tip, base=base)


def _moved_tip(tip: TipPose, robot_from_rig: RigidTransform) -> TipPose:
    turn = robot_from_rig.rotation
    return replace(
        tip,
        position_mm=robot_from_rig.apply(tip.position_mm),
        direction=turn @ tip.direction,
        orientation_xyzw=turned_orientation(turn, tip.orientation_xyzw),
        covariance_mm2=turn @ tip.covariance_mm2 @ turn.T,
        velocity_mm_s=None if tip.velocity_mm_s is None else turn @ tip.velocity_mm_s,
    )
