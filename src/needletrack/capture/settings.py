"""What a configuration says about the two cameras."""

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from pydantic import AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field

Positive = Annotated[float, Gt(0), AllowInfNan(False)]
# TOML has no null: an empty string says that there is none.
_EMPTY_IS_NONE = BeforeValidator(lambda value: None if value == "" else value)
OptionalPositive = Annotated[Positive | None, _EMPTY_IS_NONE]
OptionalInt = Annotated[int | None, _EMPTY_IS_NONE]
PixelFormat = Literal["GREY", "Y10", "Y12", "Y16", "YUYV", "UYVY", "MJPG"]


class CameraSettings(BaseModel):
    """One of the two cameras."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str = Field("", description="Its place on the bus, or its serial number: `needletrack doctor` lists them.")
    controls: dict[str, int] = Field({}, description="Controls of this camera alone, over those of both.")


class CamerasSettings(BaseModel):
    """Both cameras, and what they have in common."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: PixelFormat = Field("GREY", description="Pixel format: GREY, Y10, Y12, Y16, YUYV, UYVY or MJPG.")
    size_px: tuple[Annotated[int, Gt(0)], Annotated[int, Gt(0)]] = Field(
        (1280, 1024), description="Width and height of the images, px; the rig's."
    )
    rate_hz: OptionalPositive = Field(60.0, description="Frames a second; empty: as a trigger or the driver has it.")
    exposure_us: OptionalPositive = Field(None, description="Exposure, microseconds; empty: as it is.")
    gain: OptionalInt = Field(None, description="Gain in the driver's own unit; empty: as it is.")
    controls: dict[str, int] = Field(
        {}, description="Further controls of both, as `v4l2-ctl --list-ctrls` names them, e.g. { trigger_mode = 1 }."
    )
    significant_bits: Annotated[int, Ge(8), Le(16)] = Field(
        16,
        description="Of Y16: how many of the lower bits the sensor fills; the upper 8 are tracked, all recorded.",
    )
    clock: Literal["driver", "monotonic", "realtime"] = Field(
        "driver", description="Clock of the stamps: what the driver says, or one where it says nothing."
    )
    buffers: Annotated[int, Ge(3), Le(32)] = Field(8, description="Buffers asked of the driver for each camera.")
    stall_s: Positive = Field(0.5, description="Without a frame for so long, seconds, a camera has stalled.")
    left: CameraSettings = Field(CameraSettings(), description="The left camera.")
    right: CameraSettings = Field(CameraSettings(), description="The right camera.")

    @property
    def recorded_bits(self) -> Literal[8, 16]:
        """Bits of a pixel in a recording."""
        return 16 if self.format in ("Y10", "Y12", "Y16") else 8

    def of(self, side: Literal["left", "right"]) -> CameraSettings:
        """One camera's own settings."""
        return self.left if side == "left" else self.right
