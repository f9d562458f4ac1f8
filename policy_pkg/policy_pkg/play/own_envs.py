"""Our scenarios for the trainers of others, with crashes and a coach.

Importing this registers them with Gymnasium: ``crash_coach/buttons-v0``,
``crash_coach/skirmish-3m-v0``, ...; ``gymnasium.make("policy_pkg.play.own_envs:NAME")`` imports it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.team import TeamSpec
from crash_coach_pkg.wrappers import CrashWrapper, MultiAgentView
from crash_coach_pkg.wrappers.crash_wrapper import coach_settings
from sim_pkg.pettingzoo import ParallelArena
from sim_pkg.scenario_files import scenario_names


class CrashedArena(CrashWrapper):
    """A ParallelArena in which robots crash, and are drawn so."""

    def _crashing(self, agents: list[Any]) -> None:
        self.unwrapped.crashed = agents


def parallel_env(
    scenario: str | Path,
    coach: CoachConfig | Mapping[str, Any] | Coach | None = None,
    render_mode: str | None = None,
    seed: int = 0,
) -> ParallelArena | CrashedArena:
    """A scenario as a PettingZoo ParallelEnv.

    Args:
        scenario: a name of ``scenario_names()``, or the path of a YAML file.
        coach: settings as of CrashWrapper, or a Coach that another environment has too; None:
            nobody crashes.
        render_mode: as of ParallelArena.
        seed: of the episodes until ``reset`` is given one, and of the coach's draws.

    Raises:
        UserError: as ParallelArena and CrashWrapper, or wrong settings of the coach.
    """
    arena = ParallelArena(scenario, seed, render_mode)
    if coach is None:
        return arena
    if not isinstance(coach, Coach):
        coach = Coach(coach_settings(coach), TeamSpec.of(arena.spec), seed)
    return CrashedArena(arena, coach, stay_action=arena.spec.stay_actions[0])


def multi_agent_env(
    scenario: str | Path,
    coach: CoachConfig | Mapping[str, Any] | Coach | None = None,
    render_mode: str | None = None,
    seed: int = 0,
) -> MultiAgentView:
    """As ``parallel_env``, as the Gymnasium environment that EPyMARL and its kin expect."""
    env = parallel_env(scenario, coach, render_mode, seed)
    spec = env.unwrapped.spec
    # The last one: what a robot that can do nothing else is left with.
    return MultiAgentView(env, spec.stay_actions[-1], spec.episode_limit)


def registered_name(scenario: str) -> str:
    """Of a shipped scenario: ``crash_coach/skirmish-3m-v0`` of ``skirmish/3m``."""
    return f"crash_coach/{scenario.replace('/', '-')}-v0"


for _name in scenario_names():
    gymnasium.register(
        id=registered_name(_name),
        entry_point=f"{__name__}:multi_agent_env",
        kwargs={"scenario": _name},
        disable_env_checker=True,  # it expects a single reward, not one per agent
    )
