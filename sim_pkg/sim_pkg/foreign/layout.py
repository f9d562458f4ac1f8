"""How a PettingZoo environment's agents become rows of arrays of one size."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten

from crash_coach_common.contract import EnvSpec, FloatArray
from crash_coach_common.strict_yaml import ConfigError, did_you_mean
from sim_pkg.foreign.config import EnvRules, PettingZooConfig

MASK = "action_mask"
OBSERVATION = "observation"
LIMITS = ("max_cycles", "max_steps", "max_episode_steps", "_max_episode_steps", "max_iter")
"""What environments call their limit of steps."""


@dataclass(frozen=True)
class AgentLayout:
    """One agent: its name there, and its spaces. ``first_action``: number of its action 0."""

    name: str
    observation: spaces.Space[Any]
    n_actions: int
    first_action: int
    masked: bool  # whether its observation is a dict of observation and action mask

    @property
    def features(self) -> int:
        return int(flatdim(self.observation))

    def row(self, observed: Any) -> FloatArray:
        """(features,) what the agent observes."""
        inner = observed[OBSERVATION] if self.masked else observed
        return np.asarray(flatten(self.observation, inner), dtype=np.float32)


def agent_layouts(env: Any, environment: str) -> tuple[AgentLayout, ...]:
    """Of every possible agent, in their order.

    Raises:
        ConfigError: no agent, continuous actions, or observations that cannot be flattened.
    """
    names = list(env.possible_agents)
    if not names:
        raise ConfigError(f"environment {environment!r} has no agents")
    return tuple(_agent(env, environment, name) for name in names)


def _agent(env: Any, environment: str, name: str) -> AgentLayout:
    space, actions = env.observation_space(name), env.action_space(name)
    where = f"environment {environment!r}: agent {name!r}"
    if not isinstance(actions, spaces.Discrete):
        raise ConfigError(
            f"{where} has actions {actions}: only Discrete ones can be learned and faulted (many "
            "environments have an argument for that, such as continuous_actions: false)"
        )
    masked = isinstance(space, spaces.Dict) and {OBSERVATION, MASK} <= set(space.spaces)
    inner = space[OBSERVATION] if masked else space
    try:
        flatdim(inner)
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(f"{where} observes {inner}, which has no fixed size") from error
    return AgentLayout(name, inner, int(actions.n), int(actions.start), masked)


def make_spec(
    scenario: str,
    env: Any,
    config: PettingZooConfig,
    agents: Sequence[AgentLayout],
    state: int,
    stated: bool,
) -> EnvSpec:
    """``state``: size of the state; ``stated``: it is the environment's own.

    Raises:
        ConfigError: what EnvRules has to say is missing or does not fit the environment.
    """
    n_actions = max(agent.n_actions for agent in agents)
    names = _action_names(config, n_actions)
    stay = _stay_action(config, names)
    robots = robot_names([str(agent.name) for agent in agents])
    # The others stand in where a mask forbids the stay action itself.
    others = tuple(a for a in range(n_actions) if a != stay)
    return EnvSpec(
        scenario=scenario,
        robots=robots,
        roles=tuple(re.sub(r"_?\d+$", "", robot) or robot for robot in robots),
        action_names=names,
        stay_actions=(stay, *others),
        obs_size=max(agent.features for agent in agents),
        state_size=state,
        episode_limit=_episode_limit(env, config),
        dt_s=_step_s(env, config),
        bounds=_bounds(env, agents, stated),
        reports_success=config.success_return is not None or config.success_info is not None,
        reports_positions=False,
    )


def robot_names(agents: Sequence[str]) -> tuple[str, ...]:
    """The agents' names as the rest knows them: letters, digits and _ only.

    Raises:
        ConfigError: two agents would have one name.
    """
    names = [re.sub(r"\W", "_", name, flags=re.ASCII) for name in agents]
    names = [f"agent_{name}" if not name or name[0].isdigit() else name for name in names]
    if len(set(names)) < len(names):
        raise ConfigError(f"agents {list(agents)}: their names differ by signs only")
    return tuple(names)


def _action_names(config: EnvRules, n_actions: int) -> tuple[str, ...]:
    if not config.action_names:
        return tuple(f"action_{i}" for i in range(n_actions))
    if len(config.action_names) != n_actions:
        raise ConfigError(
            f"action_names has {len(config.action_names)} names, but there are {n_actions} actions"
        )
    return config.action_names


def _stay_action(config: EnvRules, names: tuple[str, ...]) -> int:
    stay, known = config.stay_action, ", ".join(names)
    if stay is None:
        raise ConfigError(
            "stay_action is missing: it says which action does nothing, as a robot that is muted "
            f"needs; one of 0 to {len(names) - 1} ({known}), such as --set env_rules.stay_action=0"
        )
    if isinstance(stay, str):
        if stay not in names:
            raise ConfigError(
                f"stay_action = {stay!r}{did_you_mean(stay, names)}: actions are {known}"
            )
        return names.index(stay)
    if not 0 <= stay < len(names):
        raise ConfigError(f"stay_action = {stay}: actions are 0 to {len(names) - 1} ({known})")
    return stay


def _episode_limit(env: Any, config: PettingZooConfig) -> int:
    if config.episode_limit is not None:
        return config.episode_limit
    inner = getattr(env, "unwrapped", env)
    for name in LIMITS:
        for limit in (config.env_args.get(name), getattr(env, name, 0), getattr(inner, name, 0)):
            if isinstance(limit, int) and limit > 0:
                return limit
    raise ConfigError(
        "episode_limit is missing: the environment does not tell how many steps an episode has "
        "at most; for example --set env_rules.episode_limit=100"
    )


def _step_s(env: Any, config: EnvRules) -> float:
    if config.dt_s is not None:
        return config.dt_s
    fps = getattr(env, "metadata", {}).get("render_fps")
    return 1.0 / fps if isinstance(fps, int | float) and fps > 0 else 1.0


def _bounds(env: Any, agents: Sequence[AgentLayout], stated: bool) -> tuple[float, float]:
    """Of all features; 0 is among them, because rows are padded."""
    low, high = 0.0, 1.0
    own = [getattr(env, "state_space", None)] if stated else []
    for space in [*own, *(agent.observation for agent in agents)]:
        if isinstance(space, spaces.Box):
            low = min(low, float(space.low.min(initial=0.0)))
            high = max(high, float(space.high.max(initial=0.0)))
        elif not isinstance(space, spaces.Discrete | spaces.MultiBinary):
            return -np.inf, np.inf
    return low, high
