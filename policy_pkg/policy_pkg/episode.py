"""One finished episode as arrays, and the sizes that all of training shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import EnvSpec


@dataclass(frozen=True)
class Sizes:
    """Sizes of a scenario: n robots, A actions, O observation and S state features."""

    n_robots: int
    n_actions: int
    obs_size: int
    state_size: int
    episode_limit: int
    stay_actions: tuple[int, ...] = (0,)

    @classmethod
    def of(cls, spec: EnvSpec) -> Self:
        return cls(
            n_robots=spec.n_robots,
            n_actions=spec.n_actions,
            obs_size=spec.obs_size,
            state_size=spec.state_size,
            episode_limit=spec.episode_limit,
            stay_actions=spec.stay_actions,
        )

    @property
    def input_size(self) -> int:
        """Features of the agent net: observation, last action one-hot, robot one-hot."""
        return self.obs_size + self.n_actions + self.n_robots


@dataclass(frozen=True)
class Episode:
    """An episode of T steps, T >= 1. Entry T of the first three is the situation at the end."""

    obs: npt.NDArray[np.float32]  # (T+1, n, O)
    state: npt.NDArray[np.float32]  # (T+1, S)
    available: npt.NDArray[np.bool_]  # (T+1, n, A)
    actions: npt.NDArray[np.int32]  # (T, n), as executed: a crash shows here
    reward: npt.NDArray[np.float32]  # (T,), of the team
    faults: npt.NDArray[np.uint8]  # (T, n), fault modes, 0 = none
    terminated: bool  # of the last step; False: truncated, its end bootstraps

    @property
    def length(self) -> int:
        """T, the number of steps."""
        return int(self.reward.shape[0])

    def check(self, sizes: Sizes) -> None:
        """Raises ValueError naming the array that does not fit ``sizes``, or a bad action."""
        steps, n = self.length, sizes.n_robots
        if not 1 <= steps <= sizes.episode_limit:
            raise ValueError(f"episode has {steps} steps; must be 1 to {sizes.episode_limit}")
        expected: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "obs": ((steps + 1, n, sizes.obs_size), np.float32),
            "state": ((steps + 1, sizes.state_size), np.float32),
            "available": ((steps + 1, n, sizes.n_actions), np.bool_),
            "actions": ((steps, n), np.int32),
            "reward": ((steps,), np.float32),
            "faults": ((steps, n), np.uint8),
        }
        for name, (shape, dtype) in expected.items():
            array: npt.NDArray[np.generic] = getattr(self, name)
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(
                    f"episode.{name} is {array.dtype} {array.shape}; "
                    f"must be {np.dtype(dtype)} {shape}"
                )
        low, high = int(self.actions.min()), int(self.actions.max())
        if low < 0 or high >= sizes.n_actions:
            wrong = low if low < 0 else high
            raise ValueError(f"episode.actions holds {wrong}; must be 0 to {sizes.n_actions - 1}")
