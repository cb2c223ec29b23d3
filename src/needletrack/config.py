"""The configuration: one TOML file, overridden by the environment; config/default.toml explains every key.

The tables of the file are the models below, nested as they are here: `[tracking.needle]` is
`Config.tracking.needle`, and NEEDLETRACK_TRACKING__NEEDLE__MAX_LENGTH_MM overrides a key of it.
"""

import hashlib
import json
import os
import re
import tomllib
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from annotated_types import Ge, Gt, Le
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from needletrack.calibration.tips import DriftParameters
from needletrack.capture.settings import CamerasSettings
from needletrack.errors import ConfigError
from needletrack.reading import text_of
from needletrack.tracking.needle import Needle
from needletrack.tracking.parameters import TrackingParameters
from needletrack.validation import complaints, known_keys, nearest_key

ENVIRONMENT_PREFIX = "NEEDLETRACK_"
# The longest has 20 kB; tomllib's time for a name of so many parts grows with their square.
_MOST_BYTES = 100_000

Positive = Annotated[float, Gt(0), AllowInfNan(False)]
NotNegative = Annotated[float, Ge(0), AllowInfNan(False)]


def _endpoint(text: str) -> str:
    # Zenoh's own form, with its options behind ? and #; whether it can be opened shows on opening.
    if not re.fullmatch(r"[a-z][a-z0-9_-]*/\S+", text):
        raise ValueError("is no Zenoh endpoint: protocol/address, e.g. tcp/127.0.0.1:7447")
    return text


def _key_prefix(text: str) -> str:
    if not re.fullmatch(r"[^/*$?#\s]+(/[^/*$?#\s]+)*", text):
        raise ValueError("is no Zenoh key: parts joined by single slashes, without blanks, *, $, ? and #")
    return text


Endpoint = Annotated[str, AfterValidator(_endpoint)]
KeyPrefix = Annotated[str, AfterValidator(_key_prefix)]
# TOML has no null: an empty string says that there is none.
OptionalPath = Annotated[Path | None, BeforeValidator(lambda value: None if value == "" else value)]


class RigConfig(BaseModel):
    """Which rig is in use."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: OptionalPath = Field(
        None,
        description="Rig file or Kalibr camchain, relative to this file; empty: a recording's own.",
    )
    max_age_days: Positive = Field(30.0, description="A calibration older than this is warned about, days.")


class PairingConfig(BaseModel):
    """Which left and right frames belong together."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tolerance_us: Positive = Field(1000.0, description="Greatest difference of the two stamps of a pair, microseconds.")
    offset_us: Annotated[float, AllowInfNan(False)] = Field(
        0.0,
        description="Right stamps of triggered cameras are this much later for one instant, microseconds.",
    )


class RecordingConfig(BaseModel):
    """Where recordings go, and how much they may take."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: OptionalPath = Field(
        None, description="`needletrack run` records everything into this folder; empty: nothing is recorded."
    )
    buffer_mb: Annotated[int, Ge(16)] = Field(
        256,
        description="Memory between cameras and disk, MB: what the disk may fall behind by before pairs are dropped.",
    )
    min_free_mb: Annotated[int, Ge(0)] = Field(
        1000, description="Recording pauses while the disk has less free than this, MB."
    )
    max_file_mb: Annotated[int, Ge(16)] = Field(8000, description="A new file is begun after so much, MB.")
    at_start: bool = Field(True, description="Record from the daemon's start; false: when it is told to (control).")


DEFAULT_NEEDLE = "default"


class NeedleType(BaseModel):
    """A needle that can be chosen while the daemon runs; what is left out is as in [tracking.needle]."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")] = Field(
        description="Its name in a request: letters, digits, '_', '.' and '-'."
    )
    min_diameter_mm: Positive | None = Field(None, description="As in [tracking.needle], mm.")
    max_diameter_mm: Positive | None = Field(None, description="As in [tracking.needle], mm.")
    min_length_mm: Positive | None = Field(None, description="As in [tracking.needle], mm.")
    max_length_mm: Positive | None = Field(None, description="As in [tracking.needle], mm.")
    tip_tapers_mm: Annotated[tuple[NotNegative, ...], Field(min_length=1)] | None = Field(
        None, description="As in [tracking.needle], mm."
    )

    @field_validator("name")
    @classmethod
    def _is_no_other(cls, name: str) -> str:
        if name == DEFAULT_NEEDLE:
            raise ValueError(f"{DEFAULT_NEEDLE!r} is the needle of [tracking.needle]: choose another name")
        return name

    def over(self, needle: Needle) -> Needle:
        """This type, where it says nothing as the other one; raises ValueError where that cannot be."""
        own = self.model_dump(exclude={"name"}, exclude_none=True)
        return Needle.model_validate({**needle.model_dump(), **own})


class ControlConfig(BaseModel):
    """What may be asked of `needletrack run` while it runs, and by whom."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(
        False, description="Take requests to record, to take a snapshot, to detect anew, to change the needle."
    )
    token_file: OptionalPath = Field(
        None,
        description="File with a secret that every request must bear, readable by its owner alone; empty: none is "
        "asked for.",
    )
    snapshot_folder: OptionalPath = Field(None, description="Where snapshots go; empty: recording.folder.")
    needles: tuple[NeedleType, ...] = Field(
        (),
        description="Needle types to change to, each a [[control.needles]]: name, and keys of [tracking.needle].",
    )

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [needle.name for needle in self.needles]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"needles: {', '.join(twice)} twice")
        return self


class DaemonConfig(BaseModel):
    """How `needletrack run` lives on its machine; what is not permitted is left out with a warning."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    realtime_priority: Annotated[int, Ge(0), Le(90)] = Field(
        50, description="SCHED_FIFO priority of capture, tracking has one less; 0: ordinary scheduling."
    )
    lock_memory: bool = Field(True, description="Keep all memory resident.")
    cpus: tuple[Annotated[int, Ge(0)], ...] = Field(
        (), description="Processors that capture and tracking run on; empty: any."
    )
    metrics_port: Annotated[int, Ge(0), Le(65535)] = Field(
        9464, description="Prometheus metrics on this port of 127.0.0.1; 0: none."
    )


class TlsConfig(BaseModel):
    """The files of a mutually authenticated TLS link: all three, or none."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    authority: OptionalPath = Field(
        None, description="Certificate of the authority whom both sides trust, PEM; empty: no TLS."
    )
    certificate: OptionalPath = Field(None, description="Our own certificate, PEM.")
    key: OptionalPath = Field(None, description="Its private key, PEM, for its owner alone to read (chmod 600).")

    @model_validator(mode="after")
    def _all_or_none(self) -> Self:
        missing = [name for name in ("authority", "certificate", "key") if getattr(self, name) is None]
        if len(missing) in (1, 2):
            raise ValueError(f"{' and '.join(missing)} is missing: authority, certificate and key go together")
        return self


class OverlayConfig(BaseModel):
    """Pictures for people, kept away from the tracks: a session and endpoints of their own."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_hz: Annotated[float, Ge(0), Le(30), AllowInfNan(False)] = Field(
        0.0, description="Pictures a second, at most: both views with the curve in them; 0: none."
    )
    jpeg_quality: Annotated[int, Ge(10), Le(100)] = Field(80, description="Quality of the JPEG, 10 to 100.")
    listen: tuple[Endpoint, ...] = Field(
        ("tcp/127.0.0.1:7448",), description="Zenoh endpoints to listen on, other than those of the tracks."
    )
    connect: tuple[Endpoint, ...] = Field((), description="Zenoh endpoints to connect to.")


class PublishingConfig(BaseModel):
    """Where the tracks go."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    listen: tuple[Endpoint, ...] = Field(
        ("tcp/127.0.0.1:7447",),
        description="Zenoh endpoints to listen on, protocol/address; loopback reaches this machine alone.",
    )
    connect: tuple[Endpoint, ...] = Field(
        (), description="Zenoh endpoints to connect to, such as a router's, protocol/address."
    )
    key_prefix: KeyPrefix = Field("needletrack", description="First part of every key: <key_prefix>/<rig>/track.")
    heartbeat_s: Annotated[Positive, Le(60)] = Field(
        0.5, description="Interval of the status messages, seconds, at most 60."
    )
    tls: TlsConfig = Field(TlsConfig(), description="Who may connect; with it, every endpoint is tls/HOST:PORT.")
    overlay: OverlayConfig = Field(OverlayConfig(), description="Pictures for people.")


class SubscribingConfig(BaseModel):
    """Where `needletrack watch`, `needletrack control` and the Python client find the daemon."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["peer", "client"] = Field(
        "peer", description="peer: of the daemon itself; client: of a router, or of the daemon."
    )
    connect: tuple[Endpoint, ...] = Field(
        ("tcp/127.0.0.1:7447",), description="Zenoh endpoints of the daemon or the router, protocol/address."
    )
    key_prefix: KeyPrefix = Field("needletrack", description="As the daemon's publishing.key_prefix.")
    tls: TlsConfig = Field(TlsConfig(), description="Our part of the link's TLS.")


class Config(BaseModel):
    """Everything that can be configured; `Config()` holds the defaults and reads no file or environment."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig: RigConfig = Field(RigConfig(), description="Which rig is in use.")
    tracking: TrackingParameters = Field(
        TrackingParameters(), description="The needle, where it can be, and how each stage looks for it."
    )
    drift: DriftParameters = Field(DriftParameters(), description="When a camera counts as moved.")
    pairing: PairingConfig = Field(PairingConfig(), description="Which frames belong together.")
    publishing: PublishingConfig = Field(PublishingConfig(), description="Where the tracks go.")
    subscribing: SubscribingConfig = Field(SubscribingConfig(), description="Where a subscriber finds the daemon.")
    cameras: CamerasSettings = Field(CamerasSettings(), description="The two cameras.")
    recording: RecordingConfig = Field(RecordingConfig(), description="Where recordings go.")
    daemon: DaemonConfig = Field(DaemonConfig(), description="How the daemon lives on its machine.")
    control: ControlConfig = Field(ControlConfig(), description="What may be asked of it while it runs.")

    @model_validator(mode="after")
    def _needle_types_can_be(self) -> Self:
        for needle in self.control.needles:
            try:
                needle.over(self.tracking.needle)
            except ValidationError as error:
                fault = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
                raise ValueError(
                    f"control.needles: {needle.name}, with what it leaves to tracking.needle: {fault}"
                ) from error
        return self

    @cached_property
    def digest(self) -> str:
        """Twelve hexadecimal digits (SHA-256) of every value that can change a track, but for the rig's path."""
        # The rig has a digest of its own; where a recording goes, how the process is scheduled, what it could be asked,
        # who may read and who does change no track.
        excluded: dict[str, Any] = {
            "rig": {"path"},
            "recording": True,
            "daemon": True,
            "control": True,
            "subscribing": True,
            "publishing": {"tls", "overlay"},
        }
        values = self.model_dump(mode="json", exclude=excluded)
        content = json.dumps(values, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:12]

    def with_needle(self, name: str) -> "Config":
        """The configuration with the needle type of this name in use; raises ConfigError for an unknown name."""
        if name == DEFAULT_NEEDLE:
            return self
        whole = {needle.name: needle.over(self.tracking.needle) for needle in self.control.needles}
        if name not in whole:
            known = ", ".join([DEFAULT_NEEDLE, *whole])
            raise ConfigError(f"no needle {name!r} in control.needles of the configuration: there are {known}")
        # The types stay what they are: what they left out was said by the needle that is replaced.
        types = tuple(NeedleType(name=other, **needle.model_dump()) for other, needle in whole.items())
        values = {field: getattr(self, field) for field in Config.model_fields}
        values["tracking"] = self.tracking.model_copy(update={"needle": whole[name]})
        values["control"] = self.control.model_copy(update={"needles": types})
        # Not by model_copy, which would keep the digest.
        return Config.model_validate(values)


def load_config(path: Path | str | None = None) -> Config:
    """The configuration of a TOML file (None: the defaults) with the environment's overrides.

    Paths in the file are relative to the file, those in the environment to the working directory. Raises
    ConfigError that names file or variable, key, value and what is allowed.
    """
    # On top of the defaults: a file may set one end of a range and leave the other.
    values = Config().model_dump()
    if path is not None:
        path = Path(path)
        values = _merged(values, _anchored(_read_toml(path), path.resolve().parent))
    variables = _variables()
    values = _merged(values, _anchored(_read_environment(variables), Path.cwd()))
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        found = [f"{_origin(c.path, variables, path)}: {c.message}" for c in complaints(error, Config)]
        raise ConfigError("\n".join(found)) from error


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(text_of(path, _MOST_BYTES))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror or error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: not a configuration: it nests too deep") from error
    except ValueError as error:  # also for a number of thousands of digits
        raise ConfigError(f"{path}: not a TOML file: {error}") from error


def _variables() -> dict[str, tuple[str, ...]]:
    """The environment variables that mean us, with their keys; ConfigError for one that no key answers to.

    pydantic-settings lets a variable pass whose first part is no field (its issue 985).
    """
    variables = {
        name: tuple(name.lower().removeprefix(ENVIRONMENT_PREFIX.lower()).split("__"))
        for name in sorted(os.environ)
        if name.upper().startswith(ENVIRONMENT_PREFIX)
    }
    known = set(known_keys(Config))
    for name, keys in variables.items():
        if keys not in known:
            near = nearest_key(Config, keys)
            hint = f"did you mean {_variable(near)}?" if near else "docs/configuration.md tells how they are named"
            raise ConfigError(f"environment variable {name}: no such key: {hint}")
    return variables


def _read_environment(variables: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    if not variables:
        return {}
    # It, and all models built once more, take 0.1 s, for which who sets no variable does not wait.
    from pydantic_settings import BaseSettings, EnvSettingsSource, SettingsConfigDict, SettingsError

    class Environment(BaseSettings, Config):
        """Config, as pydantic-settings wants it for reading the environment."""

        model_config = SettingsConfigDict(
            env_prefix=ENVIRONMENT_PREFIX, env_nested_delimiter="__", frozen=True, extra="forbid"
        )

    try:
        return EnvSettingsSource(Environment)()
    except SettingsError as error:
        refused = getattr(error.__cause__, "doc", None)
        name = next((name for name in variables if os.environ[name] == refused), f"{ENVIRONMENT_PREFIX}*")
        raise ConfigError(
            f"environment variable {name} = {refused!r}: a list or table is written as JSON, "
            """e.g. '["tcp/127.0.0.1:7447"]'"""
        ) from error


def _merged(values: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    merged = dict(values)
    for key, value in overrides.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


_TLS_FILES = ("authority", "certificate", "key")
_PATHS = (
    ("rig", "path"),
    ("recording", "folder"),
    ("control", "token_file"),
    ("control", "snapshot_folder"),
    *(("publishing", "tls", name) for name in _TLS_FILES),
    *(("subscribing", "tls", name) for name in _TLS_FILES),
)


def _anchored(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The same values with their paths made absolute."""
    for path in _PATHS:
        values = _anchored_at(values, path, folder)
    return values


def _anchored_at(values: dict[str, Any], path: tuple[str, ...], folder: Path) -> dict[str, Any]:
    head, *rest = path
    below = values.get(head)
    if rest and isinstance(below, dict):
        return {**values, head: _anchored_at(below, tuple(rest), folder)}
    if not rest and isinstance(below, str) and below:
        anchored = Path(below)
        with suppress(RuntimeError):  # ~ of a user who is not there: the name stays, and is not found
            anchored = anchored.expanduser()
        return {**values, head: folder / anchored}
    return values


def _origin(entry: tuple[str | int, ...], variables: dict[str, tuple[str, ...]], path: Path | None) -> str:
    """Where a wrong entry was written: the file, or the variables that set it or a part of it."""
    names = [name for name, keys in variables.items() if keys[: len(entry)] == entry[: len(keys)]]
    return f"environment variable {', '.join(names)}" if names else str(path)


def _variable(keys: tuple[str, ...]) -> str:
    return ENVIRONMENT_PREFIX + "__".join(keys).upper()
