"""A scripted team one observation at a time: what a policy node does without a checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic

import numpy as np

from crash_coach_common.contract import IntArray, UserError
from policy_pkg.agent import Answer, Explorer, ObservationError, Sensed, Stamp
from sim_pkg.env import make_env
from sim_pkg.scripted import ScriptedPolicy, make_scripted

NOT_TOLD = -1  # a scripted policy values no action


class ScriptedAgent(Generic[Stamp]):
    """Answers observations of ``robots``, each on its own, as policy_pkg.agent.Agent does.

    The actions are those of the same team in one process: a scripted policy takes each robot's
    action from that robot's observation, mask, index and memory. So each robot has a policy of its
    own here, in which the rest of the team sees what it sees. A robot that missed steps acts as if
    it had seen in them what it sees now.

    Args:
        robots: empty: the whole team.
        seed: the sim's, of what the policy draws.

    Raises:
        UserError: unknown scenario, policy or robot.
    """

    def __init__(self, name: str, scenario: str, robots: Sequence[str], seed: int) -> None:
        env = make_env(scenario, 1)
        spec = env.spec
        for robot in robots:
            if robot not in spec.robots:
                raise UserError(f"robot {robot!r} is not of {scenario}: {', '.join(spec.robots)}")
        self.robots = tuple(robots) or spec.robots
        self.exploration: Explorer | None = None
        """Replaces some of the actions; None: never."""
        self._seed = seed
        self._index = [spec.robots.index(robot) for robot in self.robots]
        self._policies: list[ScriptedPolicy] = [make_scripted(name, env) for _ in self.robots]
        self.n_robots = spec.n_robots  # of the team
        self._sizes = (spec.obs_size, spec.n_actions)
        self._actions: IntArray = np.zeros((1, spec.n_robots), dtype=np.int32)
        self._answers: list[Answer[Stamp] | None] = [None] * len(self.robots)

    def receive(self, robot: int, sensed: Sensed[Stamp]) -> list[Answer[Stamp]]:
        """Takes the observation of ``robots[robot]``; returns its answer.

        Raises:
            ObservationError: wrong sizes, or no action available.
        """
        self._check(robot, sensed)
        done = self._answers[robot]
        if done is not None and done.episode == sensed.episode:
            if done.step == sensed.step:
                return [done]
            if done.step > sensed.step > 0:
                return []  # that step is over, nobody waits for its answer
        policy, last = self._policies[robot], -1
        if done is None or done.episode != sensed.episode or sensed.step == 0:
            policy.begin(np.array([0]), self._seed, np.array([sensed.episode]))
        else:
            last = done.step
        n = self._actions.shape[1]
        obs = np.repeat(sensed.features[None, None], n, axis=1)
        available = np.repeat(sensed.available[None, None].astype(np.bool_), n, axis=1)
        for _ in range(sensed.step - last):
            policy.act(obs, available, self._actions)
        action = self._actions[0, self._index[robot]]
        if self.exploration is not None:
            one = np.array([self._index[robot]], dtype=np.int32)
            (action,) = self.exploration.choose(
                np.array([action], np.int32), available[0, :1], one, sensed.episode, sensed.step
            )
        answer = Answer(robot, sensed.episode, sensed.step, int(action), NOT_TOLD, sensed.stamp)
        self._answers[robot] = answer
        return [answer]

    def _check(self, robot: int, sensed: Sensed[Stamp]) -> None:
        found = (sensed.features.shape[0], sensed.available.shape[0])
        if found != self._sizes:
            raise ObservationError(
                f"observation of {self.robots[robot]}: expected {self._sizes[0]} features and "
                f"{self._sizes[1]} available_actions, got {found[0]} and {found[1]}"
            )
        if not sensed.available.any():
            raise ObservationError(f"observation of {self.robots[robot]}: no action is available")
