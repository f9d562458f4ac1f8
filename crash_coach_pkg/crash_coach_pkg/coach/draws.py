"""Who of a team is faulted, and the faults of a plan that follow from it."""

from __future__ import annotations

import math

import numpy as np

from crash_coach_common.contract import BoolArray, UserError
from crash_coach_pkg.coach.config import FaultConfig
from crash_coach_pkg.coach.victims import draw_exactly
from crash_coach_pkg.faults import fault_mode
from crash_coach_pkg.plan import AT_START_STEP, Fault, Trigger, TriggerKind
from crash_coach_pkg.team import TeamSpec


def draw_victims(config: FaultConfig, team: TeamSpec, rng: np.random.Generator) -> BoolArray:
    """(n,) the victims of one episode; with a hazard or condition: whom it can strike.

    ``victims``, or ``crashed_exactly`` of the candidates, or every candidate; without hazard or
    condition as many of these, drawn, as ``max_crashed`` and ``min_alive`` allow.
    """
    if config.victims:
        return np.array([name in config.victims for name in team.robots])
    candidates = team.of_role(config.victim_role)
    count = _victim_count(config, team)
    return among(candidates, team.n, draw_exactly(rng, len(candidates), count))


def _victim_count(config: FaultConfig, team: TeamSpec) -> int:
    """How many of the candidates a draw of victims takes."""
    candidates = len(team.of_role(config.victim_role))
    if config.crashed_exactly >= 0:
        return config.crashed_exactly
    return candidates if config.triggered else min(candidates, most_crashed(config, team.n))


def left_to_chance(config: FaultConfig, team: TeamSpec) -> bool:
    """Whether draws say whom it strikes, when, or how: then episodes differ by them."""
    if config.hazard_rate_hz > 0 or fault_mode(config.crash_mode).draws:
        return True
    candidates = len(team.of_role(config.victim_role))
    return not config.victims and 0 < _victim_count(config, team) < candidates


def among(candidates: tuple[int, ...], n: int, mask: BoolArray) -> BoolArray:
    """(n,) from a (len(candidates),) mask of them."""
    out = np.zeros(n, dtype=np.bool_)
    out[list(candidates)] = mask
    return out


def draw_faults(
    config: FaultConfig, team: TeamSpec, mask: BoolArray, entry: int = 0
) -> tuple[Fault, ...]:
    """The faults of the robots in ``mask``, (n,), which come from entry ``entry`` of a scenario."""
    mode = fault_mode(config.crash_mode).name
    parameters = tuple(sorted(config.crash_parameters.items()))
    trigger = trigger_of(config, team)
    return tuple(
        Fault(
            int(robot), mode, config.start_step, config.duration_steps, parameters, trigger, entry
        )
        for robot in np.flatnonzero(mask)
    )


def trigger_of(config: FaultConfig, team: TeamSpec) -> Trigger:
    """What starts the fault. A hazard of lambda strikes in a step with p = 1 - exp(-lambda dt).

    Raises:
        UserError: a hazard, but the length of a control step is unknown.
    """
    if config.hazard_rate_hz > 0:
        return Trigger(TriggerKind.HAZARD, (-math.expm1(-config.hazard_rate_hz * _dt_s(team)),))
    if config.near_radius_m > 0:
        return Trigger(TriggerKind.NEAR, (*config.near_point_m, config.near_radius_m))
    if config.return_above is not None:
        return Trigger(TriggerKind.RETURN_ABOVE, (config.return_above,))
    return AT_START_STEP


def _dt_s(team: TeamSpec) -> float:
    if team.dt_s is None:
        raise UserError(
            "hazard_rate_hz needs the length of a control step: this team's dt_s is unknown"
        )
    return team.dt_s


def check_team(config: FaultConfig, team: TeamSpec) -> None:
    """Holds the settings against a team.

    Raises:
        UserError: an unknown robot or role, limits that this team cannot keep, or a hazard
            without the length of a control step.
    """
    unknown = [name for name in config.victims if name not in team.robots]
    if unknown:
        raise UserError(
            f"unknown robot {unknown[0]!r} in victims; one of: {', '.join(team.robots)}"
        )
    if config.victim_role and config.victim_role not in team.roles:
        known = ", ".join(dict.fromkeys(team.roles)) or "this team has no roles"
        raise UserError(f"unknown victim_role {config.victim_role!r}; one of: {known}")
    for key, value in (("min_alive", config.min_alive), ("max_crashed", config.max_crashed)):
        if value > team.n:
            raise UserError(f"{key} {value} is more than the team's {team.n} robots")
    trigger_of(config, team)
    _check_counts(config, team)


def _check_counts(config: FaultConfig, team: TeamSpec) -> None:
    limit = most_crashed(config, team.n)
    candidates = len(team.of_role(config.victim_role))
    if config.crashed_exactly > candidates:
        whom = f"robots of role {config.victim_role!r}" if config.victim_role else "robots"
        raise UserError(
            f"crashed_exactly asks for {config.crashed_exactly} crashed robots; the team has "
            f"{candidates} {whom}"
        )
    if config.triggered:
        return  # the schedule keeps the limits: who is faulted together is not known before
    for key, wanted in (
        ("victims", len(config.victims)),
        ("crashed_exactly", config.crashed_exactly),
    ):
        if wanted > limit:
            raise UserError(
                f"{key} asks for {wanted} crashed robots, but min_alive {config.min_alive} and "
                f"max_crashed {config.max_crashed} allow {limit} of {team.n}"
            )


def most_crashed(config: FaultConfig, n: int) -> int:
    """Robots of n that ``max_crashed`` and ``min_alive`` allow to crash together."""
    limit = n - config.min_alive
    return limit if config.max_crashed < 0 else min(limit, config.max_crashed)
