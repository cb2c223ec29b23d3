"""Every parameter of tracking, gathered from the stages that own them."""

from pydantic import BaseModel, ConfigDict, Field

from needletrack.tracking.beside import BesideParameters
from needletrack.tracking.centerline import CenterlineParameters
from needletrack.tracking.ends import EndsParameters
from needletrack.tracking.fit import FitParameters
from needletrack.tracking.gates import GateParameters
from needletrack.tracking.match import MatchParameters
from needletrack.tracking.needle import Needle, Workspace
from needletrack.tracking.refine import RefineParameters
from needletrack.tracking.segment import SegmentParameters
from needletrack.tracking.tip import TipParameters


class TrackingParameters(BaseModel):
    """What `track` needs beside the images and the rig."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    needle: Needle = Field(Needle(), description="The needle types in use.")
    workspace: Workspace = Field(Workspace(), description="Where a needle can be.")
    segment: SegmentParameters = Field(SegmentParameters(), description="Thin structures in each image.")
    centerline: CenterlineParameters = Field(CenterlineParameters(), description="Lines traced along them.")
    match: MatchParameters = Field(MatchParameters(), description="Lines of both views paired.")
    beside: BesideParameters = Field(BesideParameters(), description="What lies beside the needle.")
    fit: FitParameters = Field(FitParameters(), description="One curve in space for both views.")
    ends: EndsParameters = Field(EndsParameters(), description="Base and tip.")
    tip: TipParameters = Field(TipParameters(), description="The tip, to a fraction of a pixel.")
    refine: RefineParameters = Field(RefineParameters(), description="Following the needle from a rough curve.")
    gates: GateParameters = Field(GateParameters(), description="When a shape is ok.")
