"""Every error that needletrack raises on purpose."""


class NeedletrackError(Exception):
    """Base of all needletrack errors; its message names what is wrong, where, and the remedy."""


class ConfigError(NeedletrackError):
    """A configuration file, key or environment override cannot be used."""


class CalibrationError(NeedletrackError):
    """A rig file, calibration file or set of board views cannot be used."""


class CaptureError(NeedletrackError):
    """A camera or another live source cannot deliver stereo pairs."""


class RecordingError(NeedletrackError):
    """A recording cannot be read or written."""


class PublishError(NeedletrackError):
    """A Zenoh session, key or message cannot be opened, declared or decoded."""


class NeedleNotFound(NeedletrackError):
    """Normal life: this pair shows no needle that can be followed; `track` turns it into a status.

    stage: the stage that gave up; reason: a `Reason` code of `needletrack.records`.
    """

    def __init__(self, stage: str, reason: str) -> None:
        super().__init__(f"{stage}: {reason}")
        self.stage = stage
        self.reason = reason


class InstallationError(NeedletrackError):
    """The package is not installed as a whole."""
