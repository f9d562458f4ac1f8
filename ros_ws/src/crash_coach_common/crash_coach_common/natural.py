"""Names in the order that people expect."""

from __future__ import annotations

import re


def natural(text: str) -> list[tuple[int, str]]:
    """Sort key: robot_2 before robot_10."""
    parts = re.split(r"(\d+)", text)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
