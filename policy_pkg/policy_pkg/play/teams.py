"""Whatever acts for B teams at once: a trained policy with its memory, or a scripted one."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BatchEnv, BoolArray, EpisodeArray, FloatArray, IntArray
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.faults.base import Need
from policy_pkg.act import greedy, least_valued
from policy_pkg.policy import RecurrentPolicy
from sim_pkg.scripted import ScriptedPolicy


class Team(Protocol):
    """Acts in every arena of one environment."""

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        """Forgets ``arenas``: episode ``episodes[i]`` starts in ``arenas[i]``."""
        ...

    def act(self, obs: FloatArray, available: BoolArray, last_action: IntArray) -> IntArray:
        """(B, n) what each robot wants to do; goes on by a step.

        obs: (B, n, O); available: (B, n, A); last_action: (B, n) as executed, -1 at first.
        """
        ...


@runtime_checkable
class ValuingTeam(Team, Protocol):
    """A team that knows what its actions are worth."""

    def worst(self, available: BoolArray) -> IntArray:
        """(B, n) the available action that each robot valued least when it last acted."""
        ...


def offers(team: Team) -> frozenset[Need]:
    """What fault modes may ask of this team's commands."""
    return ACTION_OFFERS if isinstance(team, ValuingTeam) else ACTION_OFFERS - {"worst"}


class RecurrentTeam:
    """A trained policy; ``hidden`` is (B * n, H). The policy's weights may change."""

    def __init__(self, policy: RecurrentPolicy, env: BatchEnv) -> None:
        b, n = env.n_arenas, env.spec.n_robots
        self._policy = policy
        self._shape = (b, n)
        self._robot: IntArray = np.tile(np.arange(n, dtype=np.int32), b)
        self.hidden = policy.initial_hidden(b * n)
        self._values: FloatArray = np.zeros((b, n, policy.sizes.actions), dtype=np.float32)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self.hidden.reshape(self._shape[0], -1)[arenas] = 0.0

    def values(self, obs: FloatArray, last_action: IntArray) -> FloatArray:
        """(B, n, A) the action values; advances the hidden states by one step."""
        b, n = self._shape
        q, self.hidden = self._policy.forward(
            obs.reshape(b * n, -1), last_action.reshape(-1), self._robot, self.hidden
        )
        self._values = q.reshape(b, n, -1)
        return self._values

    def act(self, obs: FloatArray, available: BoolArray, last_action: IntArray) -> IntArray:
        """Greedily."""
        return greedy(self.values(obs, last_action), available)

    def worst(self, available: BoolArray) -> IntArray:
        return least_valued(self._values, available)


class ScriptedTeam:
    """A scripted policy."""

    def __init__(self, policy: ScriptedPolicy, env: BatchEnv) -> None:
        self._policy = policy
        self._actions: IntArray = np.zeros((env.n_arenas, env.spec.n_robots), dtype=np.int32)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self._policy.begin(arenas, seed, episodes)

    def act(self, obs: FloatArray, available: BoolArray, last_action: IntArray) -> IntArray:
        self._policy.act(obs, available, self._actions)
        return self._actions
