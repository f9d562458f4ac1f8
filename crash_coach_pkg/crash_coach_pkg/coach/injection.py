"""Crashing robots by hand, as values of the coach's parameters: what an operator sets at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.parameters import NO_RETURN, Value
from crash_coach_pkg.faults import check_parameters, fault_mode

NOBODY_ELSE: Mapping[str, Value] = {
    "crashed_exactly": -1,
    "victim_role": "",
    "hazard_rate_hz": 0.0,
    "near_radius_m": 0.0,
    "return_above": NO_RETURN,
}
"""Ends every other way in which the coach was told to choose victims."""


def injection(
    victims: Sequence[str],
    mode: str,
    apply_at: str,
    start_step: int,
    duration_steps: int,
    parameters: Mapping[str, float],
) -> dict[str, Value]:
    """Parameters that make ``victims`` crash and nobody else; to be set all or none.

    Args:
        apply_at: next_step or next_episode.
        start_step: first faulted step of each episode, for next_episode.
        duration_steps: control steps; 0: until the episode ends.
        parameters: of the mode; what is missing has its default.

    Raises:
        UserError: no victims, an unknown mode, or parameters that it does not have.
    """
    if not victims:
        raise UserError("name at least one robot to crash")
    known = check_parameters(mode, parameters).model_dump()
    name = fault_mode(mode).name
    return {
        **NOBODY_ELSE,
        **{f"{name}.{parameter}": value for parameter, value in known.items()},
        "enabled": True,
        "victims": tuple(victims),
        "crash_mode": mode,
        "apply_at": apply_at,
        "start_step": start_step,
        "duration_steps": duration_steps,
    }


def describe(victims: Sequence[str], mode: str, apply_at: str, values: Mapping[str, float]) -> str:
    """'robot_1, robot_2: delay (steps 2) from the next step on'"""
    how = ", ".join(f"{name} {value:g}" for name, value in values.items())
    shown = f"{mode} ({how})" if how else mode
    return f"{', '.join(victims)}: {shown} from the {apply_at.replace('_', ' ')} on"
