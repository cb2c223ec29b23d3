"""Small recordings, written where a test wants them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from needletrack.geometry.camera import Camera
from needletrack.geometry.transform import RigidTransform
from needletrack.records import Image
from needletrack.rig import Rig, write_rig

SIZE_PX = (64, 48)


def small_rig(size_px: tuple[int, int] = SIZE_PX) -> Rig:
    """Two parallel cameras of a small image size."""
    width, height = size_px
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    camera = Camera(matrix, np.zeros(4), size_px)
    return Rig(camera, camera, RigidTransform(np.eye(3), np.array([-60.0, 0.0, 0.0])), "small")


def own_rig() -> Rig:
    """Under this process's own name: a machine runs one daemon of a rig, and other tests may run at the same time."""
    return replace(small_rig(), name=f"small-{os.getpid()}")


def image_of(stamp_ns: int) -> Image:
    """Noise that tells frames apart."""
    return np.random.default_rng(stamp_ns).integers(0, 256, SIZE_PX[::-1], dtype=np.uint8)


def write_recording(folder: Path, left_ns: Sequence[int], right_ns: Sequence[int] | None = None) -> Path:
    """A rig file, and for each camera a data.csv with an image for every stamp."""
    for camera, stamps in (("cam0", left_ns), ("cam1", left_ns if right_ns is None else right_ns)):
        data = folder / camera / "data"
        data.mkdir(parents=True)
        for stamp in stamps:
            assert cv2.imwrite(str(data / f"{stamp}.png"), image_of(stamp))
        lines = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (folder / camera / "data.csv").write_text("#timestamp [ns],filename\n" + lines, encoding="utf-8")
    write_rig(small_rig(), folder / "rig.yaml")
    return folder
