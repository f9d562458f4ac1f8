"""The coach around an environment of your own: crashes, their rate, and what a learner sees.

    pip install ./ros_ws/src/crash_coach_common "./crash_coach_pkg[wrappers]"
    python examples/crashes_in_your_environment.py

Put your ParallelEnv in the place of Meeting and your learner in the place of the random actions.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from crash_coach_pkg.wrappers import CrashWrapper, MultiAgentView

STAY, LEFT, RIGHT = 0, 1, 2
BLOCKS, BLOCK_EPISODES = 5, 20


class Meeting(ParallelEnv):
    """Three agents on a line have to meet in one cell."""

    metadata: ClassVar[dict[str, Any]] = {"name": "meeting_v0"}

    def __init__(self) -> None:
        self.possible_agents = ["ann", "bob", "cleo"]
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(-9.0, 9.0, (2,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.cells = dict(zip(self.agents, rng.integers(0, 10, 3).tolist(), strict=True))
        self.steps = 0
        return self._observed(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        for agent, action in actions.items():
            move = {STAY: 0, LEFT: -1, RIGHT: 1}[int(action)]
            self.cells[agent] = min(9, max(0, self.cells[agent] + move))
        self.steps += 1
        acting, met = self.agents, len(set(self.cells.values())) == 1
        late = self.steps >= 15 and not met
        self.agents = [] if met or late else acting
        return (
            self._observed(), dict.fromkeys(acting, float(met)), dict.fromkeys(acting, met),
            dict.fromkeys(acting, late), {agent: {"success": met} for agent in acting},
        )  # fmt: skip

    def _observed(self) -> dict[str, Any]:
        """How far the two others are."""
        return {
            one: np.array(
                [cell - self.cells[one] for name, cell in self.cells.items() if name != one],
                dtype=np.float32,
            )
            for one in self.possible_agents
        }


def act(index: int, observation: Any) -> int:
    """A hand-written policy: all go to ann, who waits. Without bob or cleo all is lost."""
    way = 0.0 if index == 0 else float(observation[0])
    return STAY if way == 0 else RIGHT if way > 0 else LEFT


def main() -> None:
    coach = {"strategy": "adaptive", "adaptive": {"beta": 0.5, "rho": 0.3}}
    env = CrashWrapper(Meeting(), coach, stay_action=STAY, seed=1)
    view = MultiAgentView(env, stay_action=STAY, episode_limit=15)
    steps = 0
    for block in range(BLOCKS):
        successes = 0
        for episode in range(BLOCK_EPISODES):
            observations, _ = view.reset(seed=block * BLOCK_EPISODES + episode)
            over = False
            while not over:
                chosen = [act(index, seen) for index, seen in enumerate(observations)]
                # A learner takes the rewards, and infos["executed_action"] for what was chosen.
                observations, _, terminated, truncated, _ = view.step(chosen)
                over, steps = terminated or truncated, steps + 1
            successes += terminated
            env.end_episode(bool(terminated), env_steps=steps)
        record = env.end_block(successes / BLOCK_EPISODES, env_steps=steps)
        print(
            f"block {block}: success {record.success_rate:.2f} at crash rate {record.rate:.2f}, "
            f"crashed {record.crashed_fraction:.2f}, next crash rate {record.new_rate:.2f}"
        )


if __name__ == "__main__":
    main()
