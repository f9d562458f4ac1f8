"""Acting one observation at a time: what every policy node does, without ROS.

An Agent holds the memory of some or all robots of a team: the recurrent state of the episode,
the last answer, and the observations that wait for the rest of their step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, FloatArray, IntArray, UserError

Stamp = TypeVar("Stamp")
UInt8Array = npt.NDArray[np.uint8]


class Policy(Protocol):
    """What the agent needs of policy_pkg.policy.RecurrentPolicy."""

    def initial_hidden(self, rows: int) -> FloatArray: ...

    def forward(
        self, obs: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]: ...


class Explorer(Protocol):
    """What the agent needs of policy_pkg.act.Exploration."""

    @property
    def epsilon(self) -> float: ...

    def choose(
        self, best: IntArray, available: BoolArray, robots: IntArray, episode: int, step: int
    ) -> IntArray: ...


class ObservationError(UserError):
    """An observation that this policy cannot have been trained for."""


class Sensed(NamedTuple, Generic[Stamp]):
    """One robot's observation. features: (O,) float32; available: (A,) 0 or 1."""

    episode: int
    step: int
    last_action: int  # executed in the step before, -1 at step 0
    features: FloatArray
    available: UInt8Array
    stamp: Stamp  # given back with the answer, untouched


class Answer(NamedTuple, Generic[Stamp]):
    robot: int  # index among the agent's robots
    episode: int
    step: int
    action: int
    worst_action: int  # available action that the policy values least
    stamp: Stamp


class Agent(Generic[Stamp]):
    """Answers observations of ``robots``, a part of the team or all of it.

    An observation that was answered before gets the same answer and leaves the recurrent
    state alone. Those of one step are answered together, in one forward pass, as soon as all
    are there; what is incomplete is answered when a later observation of a robot that
    already waits shows that the rest will not come.
    """

    def __init__(
        self,
        policy: Policy,
        team: Sequence[str],
        robots: Sequence[str],
        obs_size: int,
        n_actions: int,
        best_and_worst: Callable[[FloatArray, BoolArray], list[tuple[int, int]]],
    ) -> None:
        """Raises UserError for a robot that is not of the team."""
        for name in robots:
            if name not in team:
                raise UserError(
                    f"robot {name!r} is not of this checkpoint's team: {', '.join(team)}"
                )
        self.robots = tuple(robots)
        self.gaps = 0
        """Observations whose predecessor was never seen: the recurrent state misses a step."""
        self.exploration: Explorer | None = None
        """Replaces some of the best actions; None: never."""
        self._policy = policy
        self._best_and_worst = best_and_worst
        n = len(self.robots)
        self._index = np.array([list(team).index(name) for name in self.robots], dtype=np.int32)
        self._obs = np.zeros((n, obs_size), dtype=np.float32)
        self._available = np.zeros((n, n_actions), dtype=np.bool_)
        self._last_action = np.full(n, -1, dtype=np.int32)
        self._hidden = policy.initial_hidden(n).copy()
        self._answers: list[Answer[Stamp] | None] = [None] * n
        self._waiting: dict[int, Sensed[Stamp]] = {}
        self._waiting_key = (-1, -1)

    def receive(self, robot: int, sensed: Sensed[Stamp]) -> list[Answer[Stamp]]:
        """Takes the observation of ``robots[robot]``; returns what can be answered now.

        Raises:
            ObservationError: wrong sizes, a last action that does not exist, no action
                available, or features that are not finite.
        """
        self._check(robot, sensed)
        done = self._answers[robot]
        if done is not None and done.episode == sensed.episode:
            if done.step == sensed.step:
                return [done]
            if done.step > sensed.step > 0:
                return []  # that step is over, nobody waits for its answer
        key = (sensed.episode, sensed.step)
        if key == self._waiting_key and robot in self._waiting:
            return self._answer_waiting()
        late = key != self._waiting_key and len(self._waiting) > 0
        ready = self._answer_waiting() if late else []
        self._accept(robot, sensed, key)
        if len(self._waiting) == len(self.robots):
            ready += self._answer_waiting()
        return ready

    def _check(self, robot: int, sensed: Sensed[Stamp]) -> None:
        name = self.robots[robot]
        obs_size, n_actions = self._obs.shape[1], self._available.shape[1]
        if sensed.features.shape[0] != obs_size:
            raise ObservationError(
                f"observation of {name}: expected {obs_size} features, "
                f"got {sensed.features.shape[0]}"
            )
        if sensed.available.shape[0] != n_actions:
            raise ObservationError(
                f"observation of {name}: expected {n_actions} available_actions, "
                f"got {sensed.available.shape[0]}"
            )
        if not sensed.available.tobytes().strip(b"\0"):
            raise ObservationError(f"observation of {name}: no action is available")
        if not -1 <= sensed.last_action < n_actions:
            raise ObservationError(
                f"observation of {name}: last_action {sensed.last_action} is not in "
                f"[-1, {n_actions - 1}]"
            )

    def _accept(self, robot: int, sensed: Sensed[Stamp], key: tuple[int, int]) -> None:
        self._waiting[robot] = sensed
        self._waiting_key = key
        self._obs[robot] = sensed.features
        self._available[robot] = sensed.available
        self._last_action[robot] = sensed.last_action
        done = self._answers[robot]
        if sensed.step == 0:
            self._hidden[robot] = 0.0
        elif done is None or (done.episode, done.step + 1) != key:
            self.gaps += 1
            if done is None or done.episode != sensed.episode:
                self._hidden[robot] = 0.0

    def _answer_waiting(self) -> list[Answer[Stamp]]:
        waiting, self._waiting = self._waiting, {}
        if len(waiting) == len(self.robots):
            actions = self._act(slice(None))
            order = range(len(self.robots))
            return [self._remember(i, waiting[i], *actions[i]) for i in order]
        rows = sorted(waiting)
        actions = self._act(np.array(rows))
        return [self._remember(i, waiting[i], *a) for i, a in zip(rows, actions, strict=True)]

    def _act(self, rows: slice | npt.NDArray[np.intp]) -> list[tuple[int, int]]:
        """Advances the recurrent state of ``rows``; returns their best and worst actions."""
        q, hidden = self._policy.forward(
            self._obs[rows], self._last_action[rows], self._index[rows], self._hidden[rows]
        )
        available = self._available[rows]
        if not math.isfinite(q.sum()):  # one call of numpy's: a value is not, or all are huge
            self._check_values(rows, q)
        self._hidden[rows] = hidden
        chosen = self._best_and_worst(q, available)
        if self.exploration is None or self.exploration.epsilon <= 0:
            return chosen
        best = np.array([action for action, _ in chosen], dtype=np.int32)
        best = self.exploration.choose(best, available, self._index[rows], *self._waiting_key)
        return [(action, worst) for action, (_, worst) in zip(best.tolist(), chosen, strict=True)]

    def _check_values(self, rows: slice | npt.NDArray[np.intp], q: FloatArray) -> None:
        usable = np.isfinite(q).all(axis=1)
        if not usable.all():
            robot = int(np.arange(len(self.robots))[rows][np.argmin(usable)])
            raise ObservationError(
                f"observation of {self.robots[robot]}: the action values are not finite; features "
                f"{self._obs[robot].tolist()}"
            )

    def _remember(
        self, robot: int, sensed: Sensed[Stamp], action: int, worst: int
    ) -> Answer[Stamp]:
        answer = Answer(robot, sensed.episode, sensed.step, action, worst, sensed.stamp)
        self._answers[robot] = answer
        return answer
