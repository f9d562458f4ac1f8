"""One arena as a PettingZoo ParallelEnv."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv

from crash_coach_common.contract import EnvSpec, FloatArray, IntArray, UserError
from sim_pkg.env import make_env

if TYPE_CHECKING:
    from sim_pkg.foreign.pictures import Picture
    from sim_pkg.render.live import LiveFilm, Window

RENDER_MODES = ("rgb_array", "human")


class AvailableActions(spaces.Discrete):
    """All of a robot's actions; what is sampled without a mask is available at present."""

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.available: npt.NDArray[np.int8] = np.ones(n, dtype=np.int8)

    def sample(self, mask: Any | None = None, probability: Any | None = None) -> np.int64:
        if mask is None and probability is None:
            mask = self.available
        return super().sample(mask, probability)


class ParallelArena(ParallelEnv[str, FloatArray, int]):
    """A scenario with one arena.

    Every robot gets the team reward. ``infos[robot]`` holds ``action_mask``, (A,) int8, for the
    next step, and after the last one ``success``. ``reset`` starts episode 0 of a seed that is
    given, and the next episode of the same seed otherwise.

    Args:
        scenario: a name of ``scenario_names()``, or the path of a YAML file.
        seed: used until ``reset`` is given one.
        render_mode: ``rgb_array``: ``render`` returns the whole arena as it is; ``human``: a window
            shows it after each reset and step. None: neither.

    Raises:
        ConfigError: unknown or wrong scenario.
        UserError: an unknown render mode, or ``human`` without a display.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "crash_coach_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
    }

    def __init__(self, scenario: str | Path, seed: int = 0, render_mode: str | None = None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise UserError(
                f"render_mode {render_mode!r}: None or one of {', '.join(RENDER_MODES)}"
            )
        self._env = make_env(scenario, 1)
        self.render_mode = render_mode
        self.crashed: Collection[str] = ()
        """Robots that are drawn as crashed; whoever replaces their actions sets it."""
        self._film: LiveFilm | None = None
        self._window: Window | None = None
        if render_mode == "human":
            from sim_pkg.render.live import Window

            self._window = Window(f"{self.spec.scenario}, Crash Coach")
        self._seed = seed
        self._episode = -1
        spec = self._env.spec
        low, high = spec.bounds
        self.possible_agents = list(spec.robots)
        self.agents: list[str] = []
        self._obs_spaces: dict[str, spaces.Space[Any]] = {
            robot: spaces.Box(low, high, (spec.obs_size,), np.float32) for robot in spec.robots
        }
        self._action_spaces = {robot: AvailableActions(spec.n_actions) for robot in spec.robots}
        self.state_space = spaces.Box(low, high, (spec.state_size,), np.float32)

    @property
    def spec(self) -> EnvSpec:
        """What the scenario promises."""
        return self._env.spec

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._obs_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, FloatArray], dict[str, dict[str, Any]]]:
        if seed is not None:
            self._seed, self._episode = seed, -1
        self._episode += 1
        self._env.reset(np.zeros(1, dtype=np.intp), self._seed, np.array([self._episode]))
        self.agents = list(self.possible_agents)
        self.crashed = ()
        self._begin_film()
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, FloatArray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """One control step.

        Raises:
            ValueError: an agent without an action, or an action that is not available.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        if set(actions) != set(self.agents):
            raise ValueError(f"actions for {sorted(actions)}; expected one for each {self.agents}")
        joint = np.array([[actions[robot] for robot in self.agents]], dtype=np.int32)
        result = self._env.step(joint)
        robots = self.agents
        self._go_on(joint[0], float(result.reward[0]))
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        infos = self._infos()
        if terminated or truncated:
            for info in infos.values():
                info["success"] = bool(result.success[0])
        observations = self._observations()
        rewards = dict.fromkeys(robots, float(result.reward[0]))
        terminations = dict.fromkeys(robots, terminated)
        truncations = dict.fromkeys(robots, truncated)
        if terminated or truncated:
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def state(self) -> FloatArray:
        """(S,) the global state."""
        return self._env.state[0].copy()

    def render(self) -> Picture | None:
        """(H, W, 3) uint8 with ``rgb_array``; None with ``human``: its window shows it already."""
        if self.render_mode is None:
            raise UserError(f"render: make it with a render_mode, one of {', '.join(RENDER_MODES)}")
        if self._film is None:
            raise UserError("render: reset the environment first")
        return None if self._window is not None else self._film.picture()

    def close(self) -> None:
        if self._window is not None:
            self._window.close()

    def _begin_film(self) -> None:
        if self.render_mode is None:
            return
        # Imported here: training should not wait for matplotlib.
        from sim_pkg.render.live import LiveFilm

        self._film = LiveFilm(self._env, self._seed, self._episode)
        self._show()

    def _go_on(self, actions: IntArray, reward: float) -> None:
        if self._film is not None:
            crashed = np.isin(self.possible_agents, list(self.crashed))
            self._film.step(actions, crashed, reward)
            self._show()

    def _show(self) -> None:
        if self._window is not None and self._film is not None:
            self._window.show(self._film.picture())

    def _observations(self) -> dict[str, FloatArray]:
        return {robot: self._env.obs[0, i].copy() for i, robot in enumerate(self.agents)}

    def _infos(self) -> dict[str, dict[str, Any]]:
        masks: npt.NDArray[np.int8] = self._env.available[0].astype(np.int8)
        for i, robot in enumerate(self.possible_agents):
            self._action_spaces[robot].available = masks[i]
        return {robot: {"action_mask": masks[i]} for i, robot in enumerate(self.agents)}
