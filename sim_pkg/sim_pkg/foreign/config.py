"""Which PettingZoo environment a scenario is, and what PettingZoo itself does not say of it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any, Literal

from pydantic import Field, field_validator

from crash_coach_common.plugins import Plugins
from crash_coach_common.strict_yaml import ConfigError, StrictModel, did_you_mean
from sim_pkg.scenarios.base import EpisodeLimit, StepSeconds

KIND = "pettingzoo"
PREFIX = f"{KIND}:"
ENTRY_POINT_GROUP = "crash_coach.environments"

Factory = Callable[..., Any]
"""Called with ``env_args``; returns a ParallelEnv."""


class EnvRules(StrictModel):
    """What has to be said of an environment beyond what its spaces tell."""

    stay_action: str | int | None = Field(
        None,
        description="the action that does nothing, by index or by its name in action_names: what "
        "a muted robot executes, and one that has left the episode",
    )
    action_names: tuple[str, ...] = Field(
        (), description="names of the actions, for messages; empty: action_0, action_1, ..."
    )
    success_return: float | None = Field(
        None, description="an episode with at least this return is a success; null: no such rule"
    )
    success_info: str | None = Field(
        None, description="key of infos that says at an episode's end whether it is a success"
    )
    team_reward: Literal["sum", "mean"] = Field(
        "sum", description="how the agents' rewards of a step make the team's"
    )
    episode_limit: EpisodeLimit | None = Field(
        None, description="steps after which an episode is cut; null: the environment's own limit"
    )
    dt_s: StepSeconds | None = Field(
        None, description="seconds per step, for hazards; null: by its render_fps, or else 1"
    )

    @field_validator("success_info")
    @classmethod
    def _one_rule(cls, success_info: str | None, info: Any) -> str | None:
        if success_info is not None and info.data.get("success_return") is not None:
            raise ValueError("success_return is given too: one of them says what a success is")
        return success_info


class PettingZooConfig(EnvRules):
    """A scenario of kind ``pettingzoo``."""

    kind: Literal["pettingzoo"]
    environment: str = Field(
        description="PACKAGE.MODULE:FACTORY, or a name that an installed package gives in its "
        f"entry points {ENTRY_POINT_GROUP}"
    )
    env_args: dict[str, Any] = Field({}, description="keyword arguments of the factory")


def load_factory(environment: str) -> Factory:
    """What makes the environment.

    Raises:
        ConfigError: a module that cannot be imported, or no such factory or entry point.
    """
    module_name, colon, path = environment.partition(":")
    if not colon:
        return _installed(environment)
    try:
        found: Any = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(
            f"environment {environment!r}: {error}: is its package installed here, or its folder "
            "on PYTHONPATH?"
        ) from error
    for name in path.split("."):
        if not hasattr(found, name):
            hint = did_you_mean(name, vars(found))
            raise ConfigError(f"environment {environment!r}: no {name!r} there{hint}")
        found = getattr(found, name)
    if not callable(found):
        raise ConfigError(f"environment {environment!r}: {found!r} cannot be called")
    factory: Factory = found
    return factory


def _check(name: str, factory: Any) -> None:
    if not callable(factory):
        raise ValueError(f"{factory!r} cannot be called")


INSTALLED: Plugins[Factory] = Plugins(ENTRY_POINT_GROUP, {}, _check)
"""Environments to which installed packages give a name."""


def _installed(name: str) -> Factory:
    if name in INSTALLED:
        return INSTALLED[name]
    known = f"; installed: {', '.join(sorted(INSTALLED))}" if INSTALLED else ""
    raise ConfigError(
        f"environment {name!r}{did_you_mean(name, INSTALLED)}: PACKAGE.MODULE:FACTORY is needed, "
        f"or a name among the entry points {ENTRY_POINT_GROUP}{known}"
    )


def build(config: PettingZooConfig, more: Mapping[str, Any]) -> Any:
    """A ParallelEnv. ``more``: further arguments of the factory.

    Raises:
        ConfigError: no such environment, arguments that it does not take, or something else than
            a ParallelEnv.
    """
    factory = load_factory(config.environment)
    arguments = {**config.env_args, **more}
    try:
        env = factory(**arguments)
    except TypeError as error:
        raise ConfigError(
            f"environment {config.environment!r} refuses its arguments {arguments}: {error}"
        ) from error
    if not hasattr(env, "possible_agents") or hasattr(env, "agent_iter"):
        raise ConfigError(
            f"environment {config.environment!r} gives {type(env).__name__}: a ParallelEnv with "
            "possible_agents is needed (PettingZoo's parallel_env, not env)"
        )
    return env
