"""The namespace that a whole graph lies in: several fleets share a domain."""

from __future__ import annotations

import re

from crash_coach_common.contract import UserError

_FORM = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def checked_namespace(text: str) -> str:
    """``fleet_a``, ``/fleet_a`` or ``/fleet_a/`` as ``/fleet_a``; empty for none or ``/``.

    Raises:
        UserError: it is no ROS namespace.
    """
    plain = text.strip("/")
    namespace = f"/{plain}" if plain else ""
    if namespace and not _FORM.fullmatch(namespace):
        raise UserError(
            f"namespace {text!r} is no ROS namespace: letters, digits and _ between slashes, no "
            "part beginning with a digit, such as fleet_a or site_1/fleet_a"
        )
    return namespace
