"""The colours of all pictures."""

from collections.abc import Mapping
from types import MappingProxyType

from needletrack.records import Status

PAGE = "#0d1117"
PANEL = "#161b22"
RULE = "#30363d"
TEXT = "#f0f6fc"
MUTED = "#9da7b3"
DETECTED = "#ffffff"
BASE = "#f0f6fc"
TIP = "#ff5d8f"

STATUS_COLOR: Mapping[Status, str] = MappingProxyType(
    {Status.OK: "#3fb950", Status.DEGRADED: "#e3a008", Status.INVALID: "#f85149"}
)
# Apart in hue and in lightness, so that they stay apart for colour-blind readers.
SEEN_COLOR: Mapping[int, str] = MappingProxyType({2: "#22d3ee", 1: "#f5b041", 0: "#e040fb"})
SEEN_MEANING: Mapping[int, str] = MappingProxyType({2: "seen by both cameras", 1: "by one", 0: "by none"})
