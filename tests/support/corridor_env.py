"""A PettingZoo environment in which everything occurs that others' environments may have.

Agents walk along a corridor and leave it at its end. They observe vectors of different lengths
beside an action mask, their actions start at another number than 0, and the slow one has fewer.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

STAY, STEP, LEAP = 1, 2, 3


class Corridor(ParallelEnv[str, Any, int]):
    metadata: ClassVar[dict[str, Any]] = {"name": "corridor_v0", "render_fps": 4}

    def __init__(
        self, length: int = 6, max_steps: int = 20, render_mode: str | None = None
    ) -> None:
        self.length, self.max_steps, self.render_mode = length, max_steps, render_mode
        self.possible_agents = ["slow-1", "quick-2"]
        self.agents: list[str] = []
        self._sizes = {"slow-1": 2, "quick-2": 3}
        self.state_space = spaces.Box(0.0, float(max(length, max_steps)), (3,), np.float64)
        self._choices = dict(self._sizes)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        inner = spaces.Box(-1.0, float(self.length), (self._sizes[agent],), np.float64)
        mask = spaces.Box(0, 1, (self._choices[agent],), np.int8)
        return spaces.Dict({"observation": inner, "action_mask": mask})

    def action_space(self, agent: str) -> Any:
        return spaces.Discrete(self._choices[agent], start=STAY)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.places = {agent: int(rng.integers(0, 3)) for agent in self.agents}
        self.steps = 0
        return self._observed(self.agents), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        assert set(actions) == set(self.agents), (actions, self.agents)
        self.steps += 1
        acting = self.agents
        for agent, action in actions.items():
            assert self._mask(agent)[action - STAY], (agent, action)
            self.places[agent] = min(self.length, self.places[agent] + action - STAY)
        there = {agent: self.places[agent] >= self.length for agent in acting}
        late = self.steps >= self.max_steps
        rewards = {agent: 1.0 if there[agent] else -0.1 for agent in acting}
        self.agents = [agent for agent in acting if not there[agent] and not late]
        truncations = {agent: late and not there[agent] for agent in acting}
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in acting}
        if not self.agents:
            done = all(place >= self.length for place in self.places.values())
            infos[acting[0]]["all_through"] = done
        return self._observed(acting), rewards, there, truncations, infos

    def state(self) -> Any:
        return np.array([*self.places.values(), self.steps], dtype=np.float64)

    def render(self) -> Any:
        picture = np.zeros((9, 4 * self.length + 9, 3), dtype=np.uint8)
        for row, place in enumerate(self.places.values()):
            picture[4 * row : 4 * row + 3, 4 * place : 4 * place + 3] = 200
        return picture

    def _observed(self, agents: list[str]) -> dict[str, Any]:
        return {
            agent: {
                "observation": np.array(
                    [self.places[agent], self.steps / self.max_steps, 1.0][: self._sizes[agent]]
                ),
                "action_mask": self._mask(agent),
            }
            for agent in agents
        }

    def _mask(self, agent: str) -> Any:
        """A leap is possible from even places only."""
        n = self._choices[agent]
        mask = np.ones(n, dtype=np.int8)
        if n > 2:
            mask[LEAP - STAY] = self.places[agent] % 2 == 0
        return mask


class Unseeded(Corridor):
    """An environment that does not repeat its episodes."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(None, options)


class Continuous(Corridor):
    def action_space(self, agent: str) -> Any:
        return spaces.Box(-1, 1, (2,))
