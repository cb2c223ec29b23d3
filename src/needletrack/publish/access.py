"""Who may do what with a rig's keys: Zenoh's access control, made from the rig's name; what is not named is denied.

The rules speak of the far end of a link, known by the common name of its certificate, so that one set holds on
daemon, subscriber and router alike. They do not cover what a session sends to itself.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

from needletrack.publish.keys import RigKeys

ROUTER_NAME = "needletrack.router"

# What a source of data sends, and what somebody who wants it sends.
_GIVES = ("put", "reply", "declare_queryable", "liveliness_token")
_ASKS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


class Role(StrEnum):
    """Who takes part in a rig's messages."""

    PUBLISHER = "publisher"
    CONTROLLER = "controller"
    OPERATOR = "operator"


def common_name(rig: str, role: Role) -> str:
    """The common name in the certificate of a rig's role, such as `bench-2.controller`."""
    return f"{rig}.{role.value}"


def access_control(rigs: Sequence[RigKeys]) -> dict[str, Any]:
    """Zenoh's `access_control` for these rigs: each publisher gives on its own rig's keys and nobody else does.

    Controllers read tracks, heartbeats, overlays and liveliness, and ask for the status and the clock. Operators query
    the rig's `control` keys as well; controllers may not: a loop that moves a robot has no need to, and one that was
    taken over can then neither stop a recording nor change the needle under its own pose.
    """
    rules: list[dict[str, Any]] = []
    subjects = [{"id": "router", "cert_common_names": [ROUTER_NAME]}]
    policies: list[dict[str, Any]] = []
    for keys in rigs:
        everything = [f"{keys.root}/**", f"{keys.root}/**/@adv/**"]
        read = [*keys.readable, *(f"{key}/@adv/**" for key in keys.readable)]
        of_rig = {
            "gives": _rule("ingress", _GIVES, everything),
            "is-asked": _rule("egress", _ASKS, everything),
            "reads": _rule("ingress", _ASKS, read),
            "is-told": _rule("egress", _GIVES, read),
            "controls": _rule("ingress", _ASKS, everything),
            "is-answered": _rule("egress", _GIVES, everything),
        }
        rules += [{"id": f"{keys.root} {name}", **rule} for name, rule in of_rig.items()]
        may = {
            Role.PUBLISHER: ("gives", "is-asked"),
            Role.CONTROLLER: ("reads", "is-told"),
            Role.OPERATOR: ("controls", "is-answered"),
        }
        for role, names in may.items():
            name = common_name(keys.rig, role)
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"rules": [f"{keys.root} {rule}" for rule in names], "subjects": [name]})
        # A router passes on what others gave it, both ways.
        both = ("gives", "is-asked", "controls", "is-answered")
        policies.append({"rules": [f"{keys.root} {rule}" for rule in both], "subjects": ["router"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {"permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}
