"""What the rig's owner knows of the needle and of where it can be."""

from typing import Annotated, Literal, Self

from annotated_types import Ge, Gt
from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
EntrySide = Literal["none", "left", "right", "top", "bottom"]


class Range(BaseModel):
    """A closed interval; raises ValueError where its ends are exchanged."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min: float
    max: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.min < self.max:
            raise ValueError(f"min {self.min:g} is not below max {self.max:g}")
        return self


class Needle(BaseModel):
    """The needle types in use: a range of diameters (constant along one needle) and the greatest length."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_diameter_mm: Positive = Field(0.6, description="Thinnest needle in use, mm.")
    max_diameter_mm: Positive = Field(1.2, description="Thickest needle in use, mm.")
    min_length_mm: Positive = Field(8.0, description="Shortest visible length that is called a needle, mm.")
    max_length_mm: Positive = Field(120.0, description="Greatest visible length, mm.")
    tip_tapers_mm: tuple[NotNegative, ...] = Field(
        (0.0, 2.5), min_length=1, description="Shapes of tips in use: length of the cone, mm; 0 is a round end."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_diameter_mm > self.max_diameter_mm:
            raise ValueError("min_diameter_mm is above max_diameter_mm")
        if self.min_length_mm >= self.max_length_mm:
            raise ValueError("min_length_mm is not below max_length_mm")
        return self


class Workspace(BaseModel):
    """The box in the left camera's frame in which a needle can be, mm; x right, y down, z forward."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    x_mm: Range = Field(Range(min=-150.0, max=150.0), description="Left to right, mm.")
    y_mm: Range = Field(Range(min=-150.0, max=150.0), description="Top to bottom, mm.")
    z_mm: Range = Field(Range(min=200.0, max=310.0), description="Distance in front of the left camera, mm.")
    entry_side: EntrySide = Field(
        "none",
        description="Side of the left image at which the needle enters; tells base from tip where no sleeve is seen.",
    )
