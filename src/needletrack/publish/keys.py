"""Where a rig's messages live in Zenoh's key space, and how their encodings are named."""

import re
from dataclasses import dataclass

from needletrack.errors import PublishError

DEFAULT_PREFIX = "needletrack"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
TRACK_ENCODING = "application/json;needletrack.track.v1"
STATUS_ENCODING = "application/json;needletrack.status.v1"
OVERLAY_ENCODING = "image/jpeg"

# Zenoh gives * $ # ? / a meaning; a leading @ hides a key from wildcards, so that nobody would find the rig.
_CHUNK = re.compile(r"(?!@)[^/*$#?\s\x00-\x1f\x7f]+")


def checked_chunk(name: str, what: str) -> str:
    """The name, where it can be one chunk of a Zenoh key; raises PublishError otherwise."""
    if not _CHUNK.fullmatch(name):
        raise PublishError(
            f"{what} {name!r} cannot be part of a Zenoh key: use letters, digits, '-', '_' and '.', "
            "no '/', '*', '$', '#', '?', no space, no leading '@'"
        )
    return name


@dataclass(frozen=True)
class RigKeys:
    """The keys of one rig, `<prefix>/<rig>/{track,status,overlay,alive,clock}` and `<prefix>/<rig>/control/<command>`.

    Raises PublishError where rig or prefix cannot be part of a Zenoh key; only the prefix may hold '/'.
    """

    rig: str
    prefix: str = DEFAULT_PREFIX

    def __post_init__(self) -> None:
        checked_chunk(self.rig, "rig name")
        for chunk in self.prefix.split("/"):
            checked_chunk(chunk, "key prefix")

    @property
    def root(self) -> str:
        """What all keys of the rig begin with."""
        return f"{self.prefix}/{self.rig}"

    @property
    def readable(self) -> tuple[str, ...]:
        """The keys which a subscriber reads, or asks for what they say."""
        return (self.track, self.status, self.overlay, self.alive, self.clock)

    @property
    def track(self) -> str:
        """One sample a stereo pair."""
        return f"{self.root}/track"

    @property
    def overlay(self) -> str:
        """Both views with the curve in them, for people; on an endpoint of its own."""
        return f"{self.root}/overlay"

    @property
    def status(self) -> str:
        """The daemon's heartbeat; answers queries with the newest one."""
        return f"{self.root}/status"

    @property
    def alive(self) -> str:
        """The liveliness token of the daemon."""
        return f"{self.root}/alive"

    @property
    def clock(self) -> str:
        """Answers queries with the time of the daemon's clock."""
        return f"{self.root}/clock"

    def control(self, command: str) -> str:
        """Answers queries that ask for something to be done; command: its name, or * for all."""
        return f"{self.root}/control/{command}"
