"""The environment's contract: what simulator, coach and policies know of each other.

Frames and units: REP-103 axes (x east, y north), metres, seconds. Array shapes use
B arenas, n robots, O observation features, S state features, A actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
RewardArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
EpisodeArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class UserError(ValueError):
    """Something the user can mend; the text names the thing, the place and what is right.

    Command lines and nodes print it as one line and exit with 1. Every other exception is a
    defect and keeps its traceback.
    """


@dataclass(frozen=True)
class EnvSpec:
    """What a scenario promises; constant while an environment lives.

    ``stay_actions`` are the scenario's no-move actions in order of preference; in every
    reachable situation at least one of them is available to every robot. ``bounds`` are the
    lowest and highest value that any observation or state feature can take. ``roles`` has one name
    per robot: faults may be aimed at a role. ``reports_success``, ``reports_positions``: whether
    ``StepResult.success`` and ``BatchEnv.positions_m`` mean anything. ``dead_actions``: those that
    only a robot has which can do nothing else any more.
    """

    scenario: str
    robots: tuple[str, ...]
    roles: tuple[str, ...]
    action_names: tuple[str, ...]
    stay_actions: tuple[int, ...]
    obs_size: int
    state_size: int
    episode_limit: int
    dt_s: float
    bounds: tuple[float, float]
    reports_success: bool = True
    reports_positions: bool = True
    dead_actions: tuple[int, ...] = ()

    @property
    def n_robots(self) -> int:
        return len(self.robots)

    @property
    def n_actions(self) -> int:
        return len(self.action_names)


@dataclass(frozen=True)
class StepResult:
    """Outcome of one control step; buffers of the environment, valid until its next call.

    ``terminated``: the task ended here, no bootstrapping. ``truncated``: cut short from
    outside the task. ``success`` is meaningful where one of them is set.
    """

    reward: RewardArray  # (B,) team reward
    terminated: BoolArray  # (B,)
    truncated: BoolArray  # (B,)
    success: BoolArray  # (B,)


class BatchEnv(Protocol):
    """B independent arenas of one scenario, each reset and ended on its own.

    The arrays are the environment's own buffers: read them before the next call, write never.
    An episode is determined by ``(seed, episode)`` and the actions, bit for bit, whatever B is.
    """

    @property
    def spec(self) -> EnvSpec: ...
    @property
    def n_arenas(self) -> int: ...
    @property
    def obs(self) -> FloatArray:
        """(B, n, O) observations before the next step."""
        ...

    @property
    def state(self) -> FloatArray:
        """(B, S) global state before the next step."""
        ...

    @property
    def available(self) -> BoolArray:
        """(B, n, A) actions that the next step accepts; no row is all false."""
        ...

    @property
    def positions_m(self) -> FloatArray:
        """(B, n, 2) x, y of each robot."""
        ...

    def reset(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Starts episode ``episodes[i]`` in arena ``arenas[i]``."""
        ...

    def step(self, actions: IntArray) -> StepResult:
        """Advances every running arena by one control step of ``spec.dt_s``.

        actions: (B, n); rows of arenas that are not running are ignored, and those arenas
        report reward 0 and no flag.

        Raises:
            ValueError: wrong shape, or an action that is not available.
        """
        ...


def stay_action(available: BoolArray, stay_actions: tuple[int, ...]) -> IntArray:
    """(..., A) availability -> (...) the preferred no-move action that is available."""
    stays = np.asarray(stay_actions, dtype=np.int32)
    stay: IntArray = stays[np.argmax(available[..., stays], axis=-1)]
    return stay
