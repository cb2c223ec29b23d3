"""Whether the cameras still stand as they did, from tracking itself, which tells less than a board (`drift`).

Along a needle, matched points lie on epipolar lines by construction; only its tip, which each view finds by itself, may
lie off its line. A pitch, a roll away from the middle and a vertical shift move it across; a yaw and a shift along the
baseline move it along, and change depth and length in silence.
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from needletrack.geometry.epipolar import epipolar_distance_px
from needletrack.geometry.stereo import StereoRig
from needletrack.records import Float, NeedleTrack, Reason, Status

_MAD_SIGMA = 1.4826
# The standard error of a median is this many times that of a mean.
_MEDIAN_ERROR = 1.2533


class DriftParameters(BaseModel):
    """When tips that lie off their epipolar lines say that a camera has moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    window_pairs: int = Field(60, ge=5, description="So many of the last tips that both views found are looked at.")
    least_pairs: int = Field(10, ge=5, description="Fewer than this say nothing.")
    max_offset_px: float = Field(
        0.3, gt=0, description="Greatest median distance of the right tip from its epipolar line, px."
    )
    clear_sigmas: float = Field(4.0, gt=0, description="It must exceed its own standard error by this factor.")


@dataclass(frozen=True, slots=True)
class DriftState:
    """The last tips' signed distances from their epipolar lines, px, the newest last: a value, as a track is.

    has_moved: whether they lie off their lines, to one side, by more than chance and tips allow. Once they do it takes
    half of what is tolerated to say that they do no more: an alarm that comes and goes with the noise helps nobody.
    """

    offsets_px: tuple[float, ...] = ()
    has_moved: bool = False

    def after(self, track: NeedleTrack, rig: StereoRig, parameters: DriftParameters) -> "DriftState":
        """The state with one more track; one without a tip in both views adds nothing."""
        tip_px = track.evidence.tip_px
        if tip_px is None or track.status is Status.INVALID:
            return self
        left, right = rig.left.undistort(tip_px[[0]]), rig.right.undistort(tip_px[[1]])
        offset = float(epipolar_distance_px(rig.fundamental, left, right)[0])
        offsets = (*self.offsets_px, offset)[-parameters.window_pairs :]
        return DriftState(offsets, _moved(np.array(offsets), parameters, already=self.has_moved))


def _moved(offsets_px: Float, parameters: DriftParameters, *, already: bool) -> bool:
    if len(offsets_px) < parameters.least_pairs:
        return False
    median = float(np.median(offsets_px))
    if already:
        return abs(median) > parameters.max_offset_px / 2
    spread = _MAD_SIGMA * float(np.median(np.abs(offsets_px - median)))
    error = float(_MEDIAN_ERROR * spread / np.sqrt(len(offsets_px)))
    return abs(median) > max(parameters.max_offset_px, parameters.clear_sigmas * error)


def doubted(track: NeedleTrack) -> NeedleTrack:
    """The track, not ok because the cameras have moved; one without a shape stays as it is."""
    if track.status is Status.INVALID:
        return track
    found = {*track.reasons, Reason.CALIBRATION_DRIFT}
    return replace(track, status=Status.DEGRADED, reasons=tuple(reason for reason in Reason if reason in found))
