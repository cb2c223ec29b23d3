"""Tracks a steerable needle in 3D from two calibrated cameras and publishes its shape over Zenoh.

    from needletrack import read_rig, track

    found = track(left_image, right_image, read_rig("rig.yaml"))
    if found.status == "ok":
        print(found.tip.position_mm, found.curve.points_mm)

Conventions, which hold in the whole package:

- **World frame** = left camera: x right, y down, z forward, in millimetres. Pixel (0, 0) is the centre of
  the top-left pixel. `a_from_b` names a transform so that neighbours cancel: `tip = rig_from_left @ ...`.
- **Names** say units and space: `_mm`, `_px`, `_ns`, `_rad`; `points_px` are raw (distorted) pixels,
  `undistorted_px` have the same camera matrix and no distortion.
- **Time**: the driver's stamp travels unchanged from the buffer to the message, together with its clock;
  nobody stamps again. Unix time is added where it is known. A replay keeps the recorded stamps, says that
  it is one, and counts latency from the moment at which the pair was released.
- **Shapes** run base -> tip. The base is where the needle leaves its sleeve (or the image), the tip is the
  free end. +z of the tip's pose runs along the needle; the roll about it cannot be observed and is set so
  that +x lies in the plane of +z and the left camera's x axis.
- **Status**: `ok`, a controller may act on it; `degraded`, there is a shape and the reasons say what is
  weak; `invalid`, there is none. Reasons are a closed list (`Reason`, docs/wire.md).
- **Refraction** in gel or glass is not modelled.
- Arrays in records are read-only; (N, 3) means N points, and images are (rows, columns) of uint8.

The public names are those of `needletrack.api`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from needletrack.api import *  # noqa: F403 - type checkers re-export what comes so
else:

    def __getattr__(name: str) -> object:
        # Only when a name is used: `needletrack --help` does not wait for it, and a program can still set the
        # variables that NumPy reads as it is imported.
        api = import_module("needletrack.api")
        if name not in api.__all__:
            raise AttributeError(f"module 'needletrack' has no attribute {name!r}")
        return getattr(api, name)
