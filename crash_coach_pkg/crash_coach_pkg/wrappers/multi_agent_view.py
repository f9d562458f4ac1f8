"""A ParallelEnv as the Gymnasium environment that EPyMARL and its kin expect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten

from crash_coach_common.contract import UserError
from crash_coach_pkg.wrappers.masked import inner, inner_space, mask_of

Rows = npt.NDArray[np.float32]


class MultiAgentView(gymnasium.Env[Any, Any]):
    """Lists with an entry per agent, in the order of ``possible_agents``, from beginning to end.

    Observations are flattened and padded to one length, as are action masks. Agents that have left
    observe zeros, have only ``stay_action``, and get reward 0. It is the view that EPyMARL's
    wrapper of Gymnasium environments uses (Tuple spaces, lists of rewards, ``reset`` and ``step``
    as Gymnasium's) with SMAC's methods (``get_obs``, ``get_state``, ``get_avail_actions``, ...).

    Args:
        env: a ParallelEnv with Discrete actions that begin with 0, such as a CrashWrapper.
        stay_action: of agents that have left.
        episode_limit: steps of an episode at most, for ``get_env_info``.

    Raises:
        UserError: other actions.
    """

    def __init__(self, env: Any, stay_action: int, episode_limit: int) -> None:
        self.env = env
        self.metadata = {"render_modes": [], **getattr(env, "metadata", {})}
        self.render_mode = getattr(env, "render_mode", None)
        self.agents = list(env.possible_agents)
        self.n_agents = len(self.agents)
        self.episode_limit = episode_limit
        self._stay = stay_action
        for agent in self.agents:
            space = env.action_space(agent)
            if not isinstance(space, spaces.Discrete) or int(space.start) != 0:
                raise UserError(f"agent {agent!r} has actions {space}: Discrete ones from 0")
        self._inner = [inner_space(env.observation_space(agent)) for agent in self.agents]
        self._obs_size = max(int(flatdim(space)) for space in self._inner)
        self._counts = [int(env.action_space(agent).n) for agent in self.agents]
        box = spaces.Box(-np.inf, np.inf, (self._obs_size,), np.float32)
        self.observation_space = spaces.Tuple([box] * self.n_agents)
        self.action_space = spaces.Tuple([spaces.Discrete(n) for n in self._counts])
        self._observed: dict[Any, Any] = {}
        self._infos: dict[Any, dict[str, Any]] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[tuple[Rows, ...], dict[str, Any]]:
        """(n observations, infos)."""
        self._observed, self._infos = self.env.reset(seed=seed, options=options)
        return tuple(self.get_obs()), self._flat_infos()

    def step(  # type: ignore[override]  # a list of rewards: the style it is for
        self, actions: Sequence[int]
    ) -> tuple[tuple[Rows, ...], list[float], bool, bool, dict[str, Any]]:
        """(n observations, n rewards, terminated, truncated, infos)."""
        alive = list(self.env.agents)
        chosen = {a: int(actions[i]) for i, a in enumerate(self.agents) if a in alive}
        self._observed, rewards, _, truncations, self._infos = self.env.step(chosen)
        over = not self.env.agents
        truncated = over and any(truncations.values())
        listed = [float(rewards.get(agent, 0.0)) for agent in self.agents]
        return tuple(self.get_obs()), listed, over and not truncated, truncated, self._flat_infos()

    def get_obs(self) -> list[Rows]:
        """n times (O,)."""
        return [self._row(i) for i in range(self.n_agents)]

    def get_state(self) -> Rows:
        """(S,) the environment's state, or where it has none the joined observations."""
        try:
            return np.asarray(self.env.state(), dtype=np.float32).ravel()
        except (NotImplementedError, AttributeError):
            return np.concatenate(self.get_obs())

    def get_avail_actions(self) -> list[list[int]]:
        """n times A ones and zeros."""
        return [self.get_avail_agent_actions(i) for i in range(self.n_agents)]

    def get_avail_agent_actions(self, agent_id: int) -> list[int]:
        agent, width = self.agents[agent_id], max(self._counts)
        if agent not in self.env.agents:
            return [int(action == self._stay) for action in range(width)]
        observed = self._observed.get(agent)
        mask = mask_of(observed, self._infos.get(agent, {}))
        own = [1] * self._counts[agent_id] if mask is None else [int(bool(m)) for m in mask]
        return own + [0] * (width - len(own))

    def get_env_info(self) -> dict[str, int]:
        """Sizes, by EPyMARL's names; the state's only after a reset."""
        return {
            "state_shape": len(self.get_state()),
            "obs_shape": self._obs_size,
            "n_actions": max(self._counts),
            "n_agents": self.n_agents,
            "episode_limit": self.episode_limit,
        }

    def close(self) -> None:
        self.env.close()

    def render(self) -> Any:
        return self.env.render()

    def _row(self, index: int) -> Rows:
        row = np.zeros(self._obs_size, dtype=np.float32)
        observed = self._observed.get(self.agents[index])
        if observed is not None:
            flat = flatten(self._inner[index], inner(observed))
            features = np.asarray(flat, dtype=np.float32)
            row[: len(features)] = features
        return row

    def _flat_infos(self) -> dict[str, Any]:
        """Lists by key: ``crashed`` and ``executed_action`` of each agent."""
        told = [self._infos.get(agent, {}) for agent in self.agents]
        return {
            "crashed": [bool(info.get("crashed", False)) for info in told],
            "executed_action": [int(info.get("executed_action", self._stay)) for info in told],
        }
