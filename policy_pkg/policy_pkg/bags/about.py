"""What a recording says about itself: the scenario and team behind its messages."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError

RECORD = "crash_coach"
"""Name of the MCAP metadata record."""
_CHECK = "crc32"
_FILE = ".yaml"


@dataclass(frozen=True)
class About:
    """Of one recording. '', -1, 0 or () where the recorder was not told."""

    robots: tuple[str, ...]
    scenario: str = ""
    seed: int = -1
    mode: str = "lockstep"
    stay_actions: tuple[int, ...] = ()
    dt_s: float = 0.0
    episode_limit: int = 0
    drops: Mapping[str, int] = field(default_factory=dict)
    """Messages lost in the recorder or on the way to it, by topic, up to where this was written."""

    def to_record(self) -> dict[str, str]:
        """As an MCAP metadata record: JSON values, and a checksum, as MCAP has none for it."""
        values = {key: json.dumps(value) for key, value in asdict(self).items()}
        return {**values, _CHECK: _checksum(values)}


def same_scenario(one: str, other: str) -> bool:
    """Whether two recordings can be of one scenario: names are equal, or a file's name is, as
    that may lie elsewhere. '' is not known, and can be any."""
    if not one or not other or one == other:
        return True
    files = [Path(name).suffix == _FILE for name in (one, other)]
    stems = [Path(name).name.removesuffix(_FILE) for name in (one, other)]
    return any(files) and stems[0] == stems[1]


def about_from_record(values: Mapping[str, str]) -> About:
    """Raises UserError where the record does not fit its checksum or has other entries."""
    named = {key: value for key, value in values.items() if key != _CHECK}
    if _checksum(named) != values.get(_CHECK):
        raise UserError(f"metadata record {RECORD!r} does not fit its checksum")
    try:
        decoded: dict[str, Any] = {key: json.loads(value) for key, value in named.items()}
        for key in ("robots", "stay_actions"):
            decoded[key] = tuple(decoded[key])
        return About(**decoded)
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"metadata record {RECORD!r}: {error}") from error


def _checksum(values: Mapping[str, str]) -> str:
    text = json.dumps(sorted(values.items()))
    return f"{zlib.crc32(text.encode()):08x}"
