"""The two cameras of a configuration."""

from needletrack.capture.kernel import Kernel
from needletrack.capture.live import LiveSource
from needletrack.config import Config


def both_cameras(config: Config, kernel: Kernel | None = None) -> LiveSource:
    """Both cameras as configured; kernel: where they are (None: this machine's)."""
    return LiveSource(
        config.cameras, tolerance_us=config.pairing.tolerance_us, offset_us=config.pairing.offset_us, kernel=kernel
    )
