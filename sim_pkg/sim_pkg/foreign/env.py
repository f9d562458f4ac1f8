"""A batch of PettingZoo environments: see contract.BatchEnv for every method."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import (
    BoolArray,
    EnvSpec,
    EpisodeArray,
    FloatArray,
    IntArray,
    StepResult,
    UserError,
)
from sim_pkg.foreign.arena import ForeignArena, Rows, own_state
from sim_pkg.foreign.config import PettingZooConfig, build
from sim_pkg.foreign.layout import agent_layouts, make_spec


class ForeignEnv:
    """B environments of one factory.

    Agents that have left their episode observe zeros and can only stay. Observations are flattened
    and padded with zeros, actions that an agent does not have are never available.

    Args:
        scenario: what it is called.
        n_arenas: at least 1; each is an environment of its own.
        pictures: for ``picture``; the factory gets render_mode="rgb_array".

    Raises:
        ConfigError: the environment cannot be made, or its rules do not fit it.
        ValueError: n_arenas below 1.
    """

    def __init__(
        self, config: PettingZooConfig, scenario: str, n_arenas: int, pictures: bool = False
    ) -> None:
        if n_arenas < 1:
            raise ValueError(f"n_arenas is {n_arenas}; at least 1 is needed")
        more = {"render_mode": "rgb_array"} if pictures else {}
        first = build(config, more)
        agents = agent_layouts(first, config.environment)
        first.reset(seed=0)
        state = own_state(first)
        joined = len(agents) * max(agent.features for agent in agents)
        size = joined if state is None else len(state)
        self._config = config
        self._spec = spec = make_spec(scenario, first, config, agents, size, state is not None)
        b, n = n_arenas, spec.n_robots
        self._obs: FloatArray = np.zeros((b, n, spec.obs_size), dtype=np.float32)
        self._state: FloatArray = np.zeros((b, spec.state_size), dtype=np.float32)
        self._available: BoolArray = np.ones((b, n, spec.n_actions), dtype=np.bool_)
        self._positions_m: FloatArray = np.full((b, n, 2), np.nan, dtype=np.float32)
        self._running: BoolArray = np.zeros(b, dtype=np.bool_)
        self._result = StepResult(np.zeros(b), *(np.zeros(b, dtype=np.bool_) for _ in range(3)))
        made = [first, *(build(config, more) for _ in range(b - 1))]
        self._arenas = [
            ForeignArena(
                env,
                agents,
                spec,
                config,
                Rows(self._obs[i], self._state[i], self._available[i]),
                state is not None,
            )
            for i, env in enumerate(made)
        ]

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def config(self) -> PettingZooConfig:
        """The scenario's configuration."""
        return self._config

    @property
    def n_arenas(self) -> int:
        return len(self._arenas)

    @property
    def obs(self) -> FloatArray:
        return self._obs

    @property
    def state(self) -> FloatArray:
        return self._state

    @property
    def available(self) -> BoolArray:
        return self._available

    @property
    def positions_m(self) -> FloatArray:
        """(B, n, 2) not a number: PettingZoo does not tell where agents are."""
        return self._positions_m

    @property
    def running(self) -> BoolArray:
        """(B,) arenas whose episode has started and not ended."""
        return self._running

    def alive(self, arena: int) -> BoolArray:
        """(n,) whose agent is still in the episode."""
        return self._arenas[arena].alive

    def reset(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        for arena, episode in zip(arenas.tolist(), episodes.tolist(), strict=True):
            self._arenas[arena].begin(seed, episode)
            self._running[arena] = True

    def step(self, actions: IntArray) -> StepResult:
        self._check(actions)
        result = self._result
        for array in (result.reward, result.terminated, result.truncated, result.success):
            array.fill(0)
        for i in np.flatnonzero(self._running).tolist():
            done = self._arenas[i].step(actions[i])
            result.reward[i], result.success[i] = done.reward, done.success
            result.terminated[i], result.truncated[i] = done.terminated, done.truncated
        self._running &= ~(result.terminated | result.truncated)
        return result

    def picture(self, arena: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) how the environment draws itself now.

        Raises:
            UserError: it does not.
        """
        drawn: Any = self._arenas[arena].env.render()
        if not isinstance(drawn, np.ndarray) or drawn.ndim != 3 or drawn.shape[2] < 3:
            raise UserError(
                f"scenario {self._spec.scenario!r}: render() gives no picture with "
                'render_mode="rgb_array"'
            )
        return np.ascontiguousarray(drawn[..., :3], dtype=np.uint8)

    def close(self) -> None:
        for arena in self._arenas:
            arena.env.close()

    def _check(self, actions: IntArray) -> None:
        shape = (self.n_arenas, self._spec.n_robots)
        if actions.shape != shape or actions.dtype.kind != "i":
            raise ValueError(
                f"actions have shape {actions.shape} and dtype {actions.dtype}; "
                f"expected {shape} and int32"
            )
        for i in np.flatnonzero(self._running).tolist():
            for robot, action in enumerate(actions[i].tolist()):
                mask = self._available[i, robot]
                if not 0 <= action < len(mask) or not mask[action]:
                    raise ValueError(
                        f"action {action} of {self._spec.robots[robot]} in arena {i} is not "
                        f"available; available: {np.flatnonzero(mask).tolist()}"
                    )
