"""One PettingZoo environment, its episodes step by step, as rows of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, EnvSpec, FloatArray, IntArray, UserError
from sim_pkg.foreign.config import EnvRules
from sim_pkg.foreign.layout import MASK, AgentLayout


@dataclass(frozen=True)
class Rows:
    """Where an arena writes: its parts of the batch's arrays."""

    obs: FloatArray  # (n, O)
    state: FloatArray  # (S,)
    available: BoolArray  # (n, A)


@dataclass(frozen=True)
class Outcome:
    """Of one step."""

    reward: float
    terminated: bool
    truncated: bool
    success: bool


class ForeignArena:
    """Args: ``env``: a ParallelEnv that is this arena's alone; ``stated``: it has a state of its
    own, otherwise the joined observations are the state."""

    def __init__(
        self,
        env: Any,
        agents: tuple[AgentLayout, ...],
        spec: EnvSpec,
        rules: EnvRules,
        rows: Rows,
        stated: bool,
    ) -> None:
        self.env = env
        self._agents = agents
        self._spec = spec
        self._rules = rules
        self._rows = rows
        self._stated = stated
        self._steps = 0
        self._return = 0.0

    @property
    def alive(self) -> BoolArray:
        """(n,) whose agent is still in the episode."""
        return np.array([agent.name in self.env.agents for agent in self._agents])

    def begin(self, seed: int, episode: int) -> None:
        """Starts an episode that follows from the two numbers."""
        self._steps = 0
        self._return = 0.0
        observations, infos = self.env.reset(seed=episode_seed(seed, episode))
        self._observe(observations, infos)

    def step(self, actions: IntArray) -> Outcome:
        """(n,) actions; those of agents that have left the episode are ignored."""
        alive = list(self.env.agents)
        chosen = {
            agent.name: int(action) + agent.first_action
            for agent, action in zip(self._agents, actions, strict=True)
            if agent.name in alive
        }
        observations, rewards, terminations, truncations, infos = self.env.step(chosen)
        total = float(sum(float(reward) for reward in rewards.values()))
        reward = total / len(self._agents) if self._rules.team_reward == "mean" else total
        self._steps += 1
        self._return += reward
        self._observe(observations, infos)
        gone = all(terminations.get(a, True) or truncations.get(a, False) for a in self.env.agents)
        cut = not gone and self._steps >= self._spec.episode_limit
        over = gone or cut
        truncated = cut or (gone and any(truncations.values()))
        success = over and self._success(infos)
        return Outcome(reward, over and not truncated, truncated, success)

    def _success(self, infos: Mapping[Any, Mapping[str, Any]]) -> bool:
        rules = self._rules
        if rules.success_return is not None:
            return self._return >= rules.success_return
        if rules.success_info is None:
            return False
        told = [info[rules.success_info] for info in infos.values() if rules.success_info in info]
        if not told:
            keys = sorted({key for info in infos.values() for key in info})
            raise UserError(
                f"scenario {self._spec.scenario!r}: success_info = {rules.success_info!r}: no such "
                f"key in infos at an episode's end; there are: {', '.join(keys) or 'none'}"
            )
        return all(bool(value) for value in told)

    def _observe(self, observations: Mapping[Any, Any], infos: Mapping[Any, Any]) -> None:
        rows, alive = self._rows, set(self.env.agents)
        rows.obs[:] = 0.0
        rows.available[:] = False
        for i, agent in enumerate(self._agents):
            if agent.name in observations:
                rows.obs[i, : agent.features] = agent.row(observations[agent.name])
            if agent.name in alive:
                rows.available[i, : agent.n_actions] = self._mask(agent, observations, infos)
            else:
                rows.available[i, self._spec.stay_actions[0]] = True
        rows.state[:] = self._state()

    def _state(self) -> FloatArray:
        if not self._stated:
            return self._rows.obs.ravel()
        state = own_state(self.env)
        if state is None or state.shape != self._rows.state.shape:
            found = None if state is None else state.shape
            raise UserError(
                f"scenario {self._spec.scenario!r}: its state had {self._spec.state_size} values "
                f"and now has shape {found}"
            )
        return state

    def _mask(
        self, agent: AgentLayout, observations: Mapping[Any, Any], infos: Mapping[Any, Any]
    ) -> npt.NDArray[np.bool_] | bool:
        """(n_actions,) what the agent may do; True: anything."""
        if agent.masked:
            mask = observations[agent.name][MASK]
        else:
            mask = infos.get(agent.name, {}).get(MASK)
        if mask is None:
            return True
        allowed = np.asarray(mask).astype(np.bool_)
        if allowed.shape != (agent.n_actions,) or not allowed.any():
            raise UserError(
                f"scenario {self._spec.scenario!r}: the action mask of agent {agent.name!r} is "
                f"{mask!r}: {agent.n_actions} values are needed, at least one of them not 0"
            )
        return allowed


def episode_seed(seed: int, episode: int) -> int:
    """What an environment is reset with: 31 bits, which every library takes."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0]) >> 1


def own_state(env: Any) -> FloatArray | None:
    """(S,) the environment's own global state, after a reset; None where it has none."""
    state = getattr(env, "state", None)
    if not callable(state):
        return None
    try:
        found = state()
    except (NotImplementedError, AttributeError):  # a wrapper's, around one without
        return None
    return np.asarray(found, dtype=np.float32).ravel()
