"""Scripted policies: what they all are, the two that fit every scenario, and how to get one.

They calibrate scenarios, test them and show them. A scripted policy is decentralised: it picks
each robot's action from that robot's observation row, its availability mask, its index and its
own memory, as a robot could on board. It is deterministic: an episode's actions follow from
``(seed, episode)`` and what is observed, bit for bit, whatever the number of arenas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import (
    BatchEnv,
    BoolArray,
    EnvSpec,
    EpisodeArray,
    FloatArray,
    IntArray,
    stay_action,
)
from crash_coach_common.strict_yaml import ConfigError, StrictModel, did_you_mean

# Keeps a policy's random numbers apart from the environment's of the same (seed, episode).
_STREAM = 0x5C819ED


class ScriptedPolicy(Protocol):
    """A hand-written team over B arenas."""

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Forgets what it knew of ``arenas``: episode ``episodes[i]`` starts in ``arenas[i]``.

        To be called with what ``BatchEnv.reset`` is called with.
        """
        ...

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        """Fills ``actions`` (B, n), one available action for each robot, and goes on by a step.

        obs: (B, n, O); available: (B, n, A). Rows of arenas that do not run are filled too,
        and mean nothing.
        """
        ...


@dataclass(frozen=True)
class Entry:
    """One policy of the library.

    ``fits``: the configuration model of the scenarios that it plays; StrictModel: all.
    ``build``: (spec, that configuration, n_arenas) -> the policy.
    """

    fits: type[StrictModel]
    build: Callable[[EnvSpec, Any, int], ScriptedPolicy]


class ConfiguredEnv(BatchEnv, Protocol):
    """An environment that was built from a scenario's configuration."""

    @property
    def config(self) -> StrictModel: ...


def make_scripted(name: str, env: ConfiguredEnv) -> ScriptedPolicy:
    """The policy ``name`` for as many arenas as ``env`` has.

    Raises:
        ConfigError: no such policy, or one that does not play this scenario.
    """
    fitting = scripted_names(env)
    known = f"for scenario {env.spec.scenario!r} there are: {', '.join(fitting)}"
    if name not in REGISTRY:
        raise ConfigError(
            f"unknown scripted policy {name!r}{did_you_mean(name, REGISTRY)}; {known}"
        )
    if name not in fitting:
        raise ConfigError(
            f"scripted policy {name!r} does not play scenario {env.spec.scenario!r}; {known}"
        )
    return REGISTRY[name].build(env.spec, env.config, env.n_arenas)


def scripted_names(env: ConfiguredEnv) -> tuple[str, ...]:
    """The policies that can play ``env``, sorted."""
    return tuple(sorted(n for n, entry in REGISTRY.items() if isinstance(env.config, entry.fits)))


def policy_rng(seed: int, episode: int) -> np.random.Generator:
    """The generator of everything random in a policy's episode; independent of the scenario's."""
    key: npt.NDArray[np.uint64] = np.array([seed ^ _STREAM, episode], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


class Random:
    """Every robot picks uniformly among its available actions."""

    def __init__(self, spec: EnvSpec, config: StrictModel, n_arenas: int) -> None:
        self._draws = np.zeros((n_arenas, spec.episode_limit, spec.n_robots))
        self._steps = np.zeros(n_arenas, dtype=np.intp)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        for arena, episode in zip(arenas.tolist(), episodes.tolist(), strict=True):
            self._draws[arena] = policy_rng(seed, episode).random(self._draws.shape[1:])
        self._steps[arenas] = 0

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        draws = self._draws[np.arange(len(self._steps)), self._steps]
        order = np.cumsum(available, axis=-1)
        # draws < 1, so the pick is below the number of available actions.
        pick = (draws * order[..., -1]).astype(np.intp)
        actions[:] = np.argmax(order > pick[..., None], axis=-1)
        # An arena that has ended stays on its last row until the next begin.
        np.minimum(self._steps + 1, self._draws.shape[1] - 1, out=self._steps)


class Hold:
    """Every robot stays, as a muted robot does."""

    def __init__(self, spec: EnvSpec, config: StrictModel, n_arenas: int) -> None:
        self._stay_actions = spec.stay_actions

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Nothing to forget."""

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        actions[:] = stay_action(available, self._stay_actions)


REGISTRY: dict[str, Entry] = {
    "random": Entry(StrictModel, Random),
    "hold": Entry(StrictModel, Hold),
}
"""All policies by name; sim_pkg.scripted adds those of its modules' ENTRIES."""
