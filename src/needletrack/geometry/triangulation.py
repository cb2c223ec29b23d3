"""Points in space from matched points of two views."""

import numpy as np
import numpy.typing as npt

from needletrack.geometry.epipolar import homogeneous
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float


def triangulate(rig: StereoRig, left_undistorted_px: npt.ArrayLike, right_undistorted_px: npt.ArrayLike) -> Float:
    """Points (N, 3) mm in the left camera's frame, nearest to both rays of undistorted pixels (N, 2).

    The midpoint of the rays' common perpendicular (Hartley & Sturm 1997, section 2.4); unlike the linear method it
    does not depend on the scale of the coordinates. Parallel rays give NaN.
    """
    pose = rig.right_from_left
    left_rays = homogeneous(left_undistorted_px) @ np.linalg.inv(rig.left.matrix).T
    right_rays = homogeneous(right_undistorted_px) @ np.linalg.inv(rig.right.matrix).T @ pose.rotation
    left_rays /= np.linalg.norm(left_rays, axis=1, keepdims=True)
    right_rays /= np.linalg.norm(right_rays, axis=1, keepdims=True)
    right_center_mm = -pose.rotation.T @ pose.translation_mm
    cosine = (left_rays * right_rays).sum(axis=1)
    along_left, along_right = left_rays @ right_center_mm, right_rays @ right_center_mm
    sine_squared = 1 - cosine**2
    sine_squared[sine_squared < 1e-14] = np.nan
    left_depth = (along_left - cosine * along_right) / sine_squared
    right_depth = (cosine * along_left - along_right) / sine_squared
    on_left = left_depth[:, None] * left_rays
    on_right = right_center_mm + right_depth[:, None] * right_rays
    return np.asarray((on_left + on_right) / 2)
