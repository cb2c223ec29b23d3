"""Both views with the tracked curve in them, drawn within milliseconds: for pictures that keep up with the cameras."""

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.pictures.palette import BASE, SEEN_COLOR, STATUS_COLOR, TIP
from needletrack.records import Float, Image, NeedleTrack, StereoPair

# OpenCV draws at this fraction of a pixel.
_SHIFT = 4


def draw_views(track: NeedleTrack, pair: StereoPair, rig: StereoRig) -> npt.NDArray[np.uint8]:
    """The raw images side by side (height, 2 * width, 3), BGR, with the reprojected curve, base and tip.

    The curve's colour says how many cameras saw each point; a bar at the top has the status's colour.
    """
    drawn = np.hstack(
        [
            _view(track, pair.left.image, rig.left, RigidTransform.identity()),
            _view(track, pair.right.image, rig.right, rig.right_from_left),
        ]
    )
    drawn[: max(4, drawn.shape[0] // 128)] = _bgr(STATUS_COLOR[track.status])
    return drawn


def _view(track: NeedleTrack, image: Image, camera: Camera, camera_from_left: RigidTransform) -> npt.NDArray[np.uint8]:
    drawn = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    thick = max(1, image.shape[0] // 512)

    def pixels(points_mm: Float) -> npt.NDArray[np.int32]:
        points_px = camera.project(camera_from_left.apply(np.atleast_2d(points_mm)))
        # Far outside, OpenCV's own coordinates would overflow.
        return np.asarray(np.round(np.clip(points_px, -1e5, 1e5) * 2**_SHIFT), dtype=np.int32)

    if track.curve is not None:
        points, seen = pixels(track.curve.points_mm), track.curve.seen
        for start, end, count in zip(points[:-1], points[1:], np.minimum(seen[:-1], seen[1:]), strict=True):
            color = _bgr(SEEN_COLOR[int(count)])
            cv2.line(drawn, start.tolist(), end.tolist(), color, thick, cv2.LINE_AA, _SHIFT)
    for end_pose, color in ((track.base, _bgr(BASE)), (track.tip, _bgr(TIP))):
        if end_pose is not None:
            (at,) = pixels(end_pose.position_mm).tolist()
            cv2.circle(drawn, at, 5 * thick << _SHIFT, color, thick, cv2.LINE_AA, _SHIFT)
    return drawn


def _bgr(color: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return blue, green, red
