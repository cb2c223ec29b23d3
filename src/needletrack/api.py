"""The public names of needletrack, under which `import needletrack` offers them."""

from needletrack.client import Freshness, Health, Received, Subscriber
from needletrack.config import Config, load_config
from needletrack.errors import (
    CalibrationError,
    CaptureError,
    ConfigError,
    NeedletrackError,
    PublishError,
    RecordingError,
)
from needletrack.geometry.camera import Camera
from needletrack.geometry.stereo import StereoRig
from needletrack.geometry.transform import RigidTransform
from needletrack.publish.message import StatusMessage, TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.recording.replay import ReplaySource
from needletrack.records import (
    BasePose,
    Clock,
    DropReason,
    Frame,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    StereoPair,
    TipPose,
)
from needletrack.rig import Rig, find_rig, import_camchain, read_rig, write_rig
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.track import track, track_pair

__all__ = [
    "AslRecording",
    "BasePose",
    "CalibrationError",
    "Camera",
    "CaptureError",
    "Clock",
    "Config",
    "ConfigError",
    "DropReason",
    "Frame",
    "Freshness",
    "Health",
    "NeedleCurve",
    "NeedleTrack",
    "NeedletrackError",
    "PublishError",
    "Quality",
    "Reason",
    "Received",
    "RecordingError",
    "ReplaySource",
    "Rig",
    "RigidTransform",
    "Status",
    "StatusMessage",
    "StereoPair",
    "StereoRig",
    "Subscriber",
    "TipPose",
    "TrackMessage",
    "TrackingParameters",
    "find_rig",
    "import_camchain",
    "load_config",
    "read_rig",
    "track",
    "track_pair",
    "write_rig",
]
