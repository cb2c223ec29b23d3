"""From figures to pixels, and pixels to PNG files that are whole or not there."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from needletrack.errors import NeedletrackError
from needletrack.records import Image

# Level 6 takes three times as long as level 3 and saves a twentieth.
_COMPRESSION = 3


def rendered(figure: Figure) -> Image:
    """A figure's pixels (rows, columns, 3), RGB."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), dtype=np.uint8)[..., :3].copy()


def write_png(picture: Figure | Image, path: Path | str) -> Path:
    """Write a figure, or pixels (rows, columns, 3) RGB, to a PNG file that appears whole or not at all.

    Makes the folder where there is none, and returns the path. Raises NeedletrackError where it cannot.
    """
    path = Path(path)
    pixels = rendered(picture) if isinstance(picture, Figure) else picture
    _, data = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(data.tobytes())
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise NeedletrackError(
            f"{path}: cannot write the picture: {error.strerror or error}; choose another folder"
        ) from error
    return path
