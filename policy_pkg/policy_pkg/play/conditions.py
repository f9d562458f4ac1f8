"""Under which crashes a team is evaluated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.faults import fault_mode
from crash_coach_pkg.plan import Planner
from crash_coach_pkg.team import TeamSpec

Parameters = Mapping[str, float]
NO_PARAMETERS: Parameters = MappingProxyType({})


@dataclass(frozen=True)
class Condition:
    """Under which crashes of a coach a policy is evaluated.

    ``drawn``: whether victims or effects may be drawn in each episode.
    ``crashed``: exactly so many robots; None where the condition says something else.
    ``victim``: the robot that it is about; "" where it is about none, or several.
    """

    name: str
    crash: CoachConfig
    drawn: bool = True
    crashed: int | None = None
    victim: str = ""


@dataclass(frozen=True)
class Planned:
    """Crashes that something else than a coach plans, such as a fault scenario.

    ``planner``: for a team and the evaluation's seed; raises UserError where it cannot.
    ``drawn``: as of a Condition.
    """

    name: str
    planner: Callable[[TeamSpec, int], Planner]
    drawn: bool = True


def crash_free() -> Condition:
    return Condition("crash-free", CoachConfig(), drawn=False, crashed=0)


def at_rate(rate: float, mode: str = "mute", parameters: Parameters = NO_PARAMETERS) -> Condition:
    """Every robot crashes on its own with probability ``rate``; no re-sampling (the paper's)."""
    who = {"crash_rate": rate, "resample": False}
    condition = _fixed(f"rate {rate:g}", who, mode, parameters)
    return replace(condition, drawn=condition.drawn or 0 < rate < 1)


def exactly(count: int, mode: str = "mute", parameters: Parameters = NO_PARAMETERS) -> Condition:
    """``count`` uniformly drawn robots crash in every episode."""
    condition = _fixed(f"{count} crashed", {"crashed_exactly": count}, mode, parameters)
    return replace(condition, drawn=count > 0, crashed=count)


def named(
    victims: Sequence[str], mode: str = "mute", parameters: Parameters = NO_PARAMETERS
) -> Condition:
    """These robots crash in every episode."""
    who = {"victims": tuple(victims)}
    condition = _fixed(f"{', '.join(victims)} {mode}", who, mode, parameters)
    return replace(condition, victim=victims[0] if len(victims) == 1 else "")


def within(condition: Condition, start_step: int, duration_steps: int) -> Condition:
    """The same crashes in these control steps of every episode alone; 0 steps: to its end.

    Crash-free stays what it is.
    """
    if condition.crashed == 0 or not (start_step or duration_steps):
        return condition
    steps = {"start_step": start_step, "duration_steps": duration_steps}
    crash = CoachConfig.model_validate({**condition.crash.model_dump(), **steps})
    return replace(condition, name=f"{condition.name}{when(**steps)}", crash=crash)


def when(start_step: int, duration_steps: int) -> str:
    """', steps 20 to 24', ', from step 20 on'; nothing for whole episodes."""
    if duration_steps:
        return f", steps {start_step} to {start_step + duration_steps - 1}"
    return f", from step {start_step} on" if start_step else ""


def _fixed(name: str, who: dict[str, Any], mode: str, parameters: Parameters) -> Condition:
    how = {"strategy": "fixed", "crash_mode": mode, "crash_parameters": dict(parameters)}
    crash = CoachConfig.model_validate({**how, **who})
    return Condition(name, crash, fault_mode(mode).draws)
