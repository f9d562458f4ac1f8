"""A run of episodes in one arena, step by step: counters, return, trajectory hash.

What the sim node does without ROS, and what an evaluation of a single arena does: the same bits.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, FloatArray, IntArray, stay_action
from sim_pkg.env import Env
from sim_pkg.trajectory import TrajectoryHash

NO_ACTION = -1
"""Last action of a robot that has not acted yet in this episode."""


class Session:
    """Episodes ``first_episode``, ``first_episode + 1``, ... of an environment with one arena.

    Attributes:
        episode: number of the running (or last) episode; step: control steps done in it.
        global_step: control steps done in all episodes; never reset.
        last_actions: (n,) int32 actions executed in the last step, NO_ACTION at step 0.
        crashed: (n,) uint8, 1 where the last step was faulted.
        reward, episode_return, terminated, truncated, success: after the last step.
        trajectory_hash: of the episode, once it has ended; empty before.
    """

    def __init__(self, env: Env, seed: int, first_episode: int) -> None:
        n = env.spec.n_robots
        self.env = env
        self.seed = seed
        self.episode = first_episode
        self.step = 0
        self.global_step = 0
        self.running = False
        self.begun = 0
        self.last_actions: IntArray = np.full(n, NO_ACTION, dtype=np.int32)
        self.crashed: npt.NDArray[np.uint8] = np.zeros(n, dtype=np.uint8)
        self.reward = 0.0
        self.episode_return = 0.0
        self.terminated = self.truncated = self.success = False
        self.trajectory_hash = ""
        self._first_episode = first_episode
        self._hash = TrajectoryHash(seed, first_episode)

    @property
    def obs(self) -> FloatArray:
        """(n, O) what the robots observe now."""
        obs: FloatArray = self.env.obs[0]
        return obs

    @property
    def state(self) -> FloatArray:
        """(S,) global state now."""
        state: FloatArray = self.env.state[0]
        return state

    @property
    def available(self) -> BoolArray:
        """(n, A) actions that the next step accepts."""
        available: BoolArray = self.env.available[0]
        return available

    def stay(self) -> IntArray:
        """(n,) the no-move action of each robot: what a robot without a command executes."""
        return stay_action(self.available, self.env.spec.stay_actions)

    def begin(self) -> None:
        """Starts the next episode. Call only while none runs."""
        if self.running:
            raise RuntimeError(f"episode {self.episode} is still running")
        self.episode = self._first_episode + self.begun
        self.begun += 1
        self.env.reset(np.zeros(1, dtype=np.intp), self.seed, np.array([self.episode]))
        self.step = 0
        self.last_actions[:] = NO_ACTION
        self.crashed[:] = 0
        self.reward = self.episode_return = 0.0
        self.terminated = self.truncated = self.success = False
        self.trajectory_hash = ""
        self._hash = TrajectoryHash(self.seed, self.episode)
        self._hash.observe(self.obs, self.state)
        self.running = True

    def advance(self, actions: IntArray, crashed: npt.NDArray[np.uint8]) -> None:
        """One control step. actions: (n,) int32; crashed: (n,) 1 where a fault made the action.

        Raises:
            ValueError: an action that is not available.
        """
        result = self.env.step(actions[None, :])
        self.reward = float(result.reward[0])
        self.terminated = bool(result.terminated[0])
        self.truncated = bool(result.truncated[0])
        self.success = bool(result.success[0])
        self.episode_return += self.reward
        self.last_actions[:] = actions
        self.crashed[:] = crashed
        self.step += 1
        self.global_step += 1
        self._hash.act(actions, self.reward, self.terminated, self.truncated, self.success)
        if self.terminated or self.truncated:
            self._end()
        else:
            self._hash.observe(self.obs, self.state)

    def cut(self) -> None:
        """Ends the running episode from outside: truncated, no success."""
        if not self.running:
            raise RuntimeError("no episode is running")
        self.truncated = True
        self._end()

    def _end(self) -> None:
        self.running = False
        self.trajectory_hash = self._hash.hexdigest()
