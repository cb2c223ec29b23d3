"""Epipolar geometry of two calibrated views, in undistorted pixels (the lines are straight only there).

Convention of Hartley & Zisserman: right^T F left = 0, F = K_r^-T R [R^T t]x K_l^-1. Eq. 2 of Nguyen et al. 2017
writes the transpose, m_p^T F m_q; see `tracking/reference.py`.
"""

import numpy as np
import numpy.typing as npt

from needletrack.records import Float


def cross_matrix(vector: npt.ArrayLike) -> Float:
    """The matrix [v]x (3, 3) with [v]x w = v x w."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def homogeneous(points: npt.ArrayLike) -> Float:
    """Points (N, 2) with a third coordinate of one, (N, 3)."""
    array = np.asarray(points, dtype=np.float64)
    return np.column_stack([array, np.ones(len(array))])


def fundamental_matrix(left_matrix: Float, right_matrix: Float, rotation: Float, translation_mm: Float) -> Float:
    """F (3, 3), right^T F left = 0 for undistorted pixels, scaled to unit Frobenius norm (H&Z eq. 9.2; paper eq. 5).

    left_matrix, right_matrix (3, 3): camera matrices; rotation (3, 3), translation_mm (3,): right_from_left.
    """
    f = (
        np.linalg.inv(right_matrix).T
        @ rotation
        @ cross_matrix(rotation.T @ translation_mm)
        @ np.linalg.inv(left_matrix)
    )
    return np.asarray(f / np.linalg.norm(f))


def epipoles(left_matrix: Float, right_matrix: Float, rotation: Float, translation_mm: Float) -> tuple[Float, Float]:
    """Both epipoles as homogeneous undistorted pixels (3,), left then right (paper eq. 6)."""
    return left_matrix @ (-rotation.T @ translation_mm), right_matrix @ translation_mm


def epipolar_lines(fundamental: Float, points_px: npt.ArrayLike) -> Float:
    """Lines (N, 3) in the other view of undistorted points (N, 2), a^2 + b^2 = 1 so that line . point is in pixels.

    Pass F for points of the left view, F^T for points of the right one (paper eq. 7).
    """
    lines = homogeneous(points_px) @ fundamental.T
    return np.asarray(lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True))


def epipolar_distance_px(fundamental: Float, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Float:
    """Signed distance (N,) px of each right point from the epipolar line of its left point; undistorted (N, 2)."""
    return np.asarray((epipolar_lines(fundamental, left_px) * homogeneous(right_px)).sum(axis=1))


def epipolar_distance_map_px(fundamental: Float, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Float:
    """Signed distance (I, J) px of right point j from the epipolar line of left point i (paper eq. 9, normalised)."""
    return epipolar_lines(fundamental, left_px) @ homogeneous(right_px).T


def sampson_distance_px(fundamental: Float, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Float:
    """First-order geometric distance (N,) px, unsigned, of pairs from the epipolar constraint (H&Z eq. 11.9)."""
    left, right = homogeneous(left_px), homogeneous(right_px)
    right_lines, left_lines = left @ fundamental.T, right @ fundamental
    algebraic = (right * right_lines).sum(axis=1)
    gradient = (right_lines[:, :2] ** 2).sum(axis=1) + (left_lines[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs(algebraic) / np.sqrt(gradient))
