"""Drawn pictures of a board whose place is known exactly: for tests of detection, blur, motion and drift."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Float, Image

_FINE = 3
_BACKGROUND_GRAY = 128.0


@dataclass(frozen=True, slots=True)
class Texture:
    """A flat board's picture: gray (rows, columns), px_per_mm, and the pixel (2,) of the first inner corner."""

    gray: Image
    px_per_mm: float
    origin_px: Float


def checkerboard_texture(squares: tuple[int, int], square_mm: float, px_per_mm: float | None = None) -> Texture:
    """Black and white squares, the first one black, with a white border of one square."""
    side = 40 if px_per_mm is None else round(square_mm * px_per_mm)
    columns, rows = squares
    cells = np.full((rows + 2, columns + 2), 230, dtype=np.uint8)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    cells[1:-1, 1:-1] = np.where((x + y) % 2 == 0, 25, 230)
    gray = np.kron(cells, np.ones((side, side), dtype=np.uint8))
    # Between pixel 2 side - 1 and 2 side, where the second square begins.
    return Texture(gray, side / square_mm, np.full(2, 2.0 * side - 0.5))


def draw_board(
    rig: StereoRig,
    texture: Texture,
    left_from_board: RigidTransform,
    *,
    blur_px: float = 0.5,
    noise_gray: float = 1.5,
    exposure: float = 1.0,
    seed: int = 0,
) -> tuple[Image, Image]:
    """What both cameras see of a board (rows, columns), blurred by a sigma of blur_px, with read noise.

    exposure: times the usual one; what it takes beyond 255 is saturated.
    """
    random = np.random.default_rng(seed)
    poses = (left_from_board, rig.right_from_left @ left_from_board)
    left, right = (
        _draw(camera, texture, pose, blur_px, noise_gray, exposure, random)
        for camera, pose in zip((rig.left, rig.right), poses, strict=True)
    )
    return left, right


def _draw(
    camera: Camera,
    texture: Texture,
    camera_from_board: RigidTransform,
    blur_px: float,
    noise_gray: float,
    exposure: float,
    random: np.random.Generator,
) -> Image:
    width, height = camera.size_px
    fine = (np.arange(_FINE * max(width, height)) - (_FINE - 1) / 2) / _FINE
    rays = _rays(camera)
    columns, rows = np.meshgrid(fine[: _FINE * width], fine[: _FINE * height])
    at_x, at_y = (
        cv2.remap(part, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR) for part in rays
    )
    # Ray and board's plane: X = s (x, y, 1), n . X = n . t.
    normal, origin = camera_from_board.rotation[:, 2], camera_from_board.translation_mm
    depth = (normal @ origin) / (normal[0] * at_x + normal[1] * at_y + normal[2])
    x_axis, y_axis = camera_from_board.rotation[:, 0], camera_from_board.rotation[:, 1]
    board_x = depth * (x_axis[0] * at_x + x_axis[1] * at_y + x_axis[2]) - x_axis @ origin
    board_y = depth * (y_axis[0] * at_x + y_axis[1] * at_y + y_axis[2]) - y_axis @ origin
    seen = cv2.remap(
        texture.gray.astype(np.float32),
        (board_x * texture.px_per_mm + texture.origin_px[0]).astype(np.float32),
        (board_y * texture.px_per_mm + texture.origin_px[1]).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=_BACKGROUND_GRAY,
    )
    seen = np.where(depth > 0, seen, _BACKGROUND_GRAY).astype(np.float32)
    picture = cv2.resize(seen, camera.size_px, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px > 0 else picture
    noisy = exposure * picture + random.normal(0, noise_gray, picture.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def _rays(camera: Camera) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Normalised image coordinates of every pixel's centre."""
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = camera.normalize(np.column_stack([columns.ravel(), rows.ravel()]))
    x, y = rays.reshape(height, width, 2).astype(np.float32).transpose(2, 0, 1)
    return np.ascontiguousarray(x), np.ascontiguousarray(y)
