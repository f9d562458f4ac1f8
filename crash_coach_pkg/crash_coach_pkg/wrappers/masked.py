"""Observations beside an action mask: PettingZoo's dict of ``observation`` and ``action_mask``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces

MASK = "action_mask"
OBSERVATION = "observation"
_KEYS = {OBSERVATION, MASK}


def is_masked(observed: Any) -> bool:
    return isinstance(observed, Mapping) and set(observed) >= _KEYS


def inner_space(space: Any) -> Any:
    """The space of what is observed beside a mask, or ``space`` itself."""
    masked = isinstance(space, spaces.Dict) and set(space.spaces) >= _KEYS
    return space[OBSERVATION] if masked else space


def inner(observed: Any) -> Any:
    return observed[OBSERVATION] if is_masked(observed) else observed


def mask_of(observed: Any, info: Mapping[str, Any]) -> Any:
    """The mask beside the observation, or in ``infos``; None: everything is allowed."""
    return observed[MASK] if is_masked(observed) else info.get(MASK)
