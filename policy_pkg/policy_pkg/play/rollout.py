"""Collects whole training episodes from a batch of arenas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BatchEnv, FloatArray, IntArray, StepResult, UserError
from crash_coach_pkg.faults.action_tools import UNTOLD
from crash_coach_pkg.plan import (
    CrashPlan,
    plan_from_json,
    plan_to_json,
)
from policy_pkg.act import Explorer
from policy_pkg.checkpoint import CheckpointError
from policy_pkg.episode import Episode
from policy_pkg.play.arenas import ArenaArray, Arenas, Executed
from policy_pkg.play.teams import RecurrentTeam
from policy_pkg.policy import RecurrentPolicy

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Finished:
    """A finished episode. Its arrays are the rollout's buffers, valid until its next ``step``."""

    plan: CrashPlan
    episode: Episode
    success: bool


class Rollout:
    """Runs B arenas without a pause: an arena whose episode ended starts the next one at once.

    Episodes are numbered in the order in which they start. Everything is written once, straight
    into the buffers of the arena's episode.

    Args:
        env: its arenas are this rollout's alone.
        policy: acts; its weights may change between steps.
        plan: the crash plan of an episode, asked when the episode starts.
        seed: of the environment.
        rng: of exploration.
        explore_hold: longest random action, control steps.
    """

    def __init__(
        self,
        env: BatchEnv,
        policy: RecurrentPolicy,
        plan: Callable[[int], CrashPlan],
        seed: int,
        rng: np.random.Generator,
        explore_hold: int = 1,
    ) -> None:
        self._env = env
        self._rng = rng
        self._team = RecurrentTeam(policy, env)
        self._arenas = Arenas(env, self._team, plan, seed)
        self._explorer = Explorer(env.n_arenas, env.spec.n_robots, explore_hold)
        self._next_episode = 0
        self._waiting: ArenaArray = np.arange(env.n_arenas)
        self._index = np.arange(env.n_arenas)
        spec = env.spec
        b, t, n = env.n_arenas, spec.episode_limit, spec.n_robots
        self._obs = np.zeros((b, t + 1, n, spec.obs_size), dtype=np.float32)
        self._state = np.zeros((b, t + 1, spec.state_size), dtype=np.float32)
        self._available = np.zeros((b, t + 1, n, spec.n_actions), dtype=np.bool_)
        self._actions = np.zeros((b, t, n), dtype=np.int32)
        self._reward = np.zeros((b, t), dtype=np.float32)
        # What the episodes under way are played again from after a checkpoint.
        self._intents = np.zeros((b, t, n), dtype=np.int32)
        self._worst = np.full((b, t, n), UNTOLD, dtype=np.int32)
        self._faults = np.zeros((b, t, n), dtype=np.uint8)

    @property
    def n_arenas(self) -> int:
        return self._env.n_arenas

    def step(self, epsilon: float) -> list[Finished]:
        """One control step in every arena: ``n_arenas`` environment steps.

        Returns:
            The episodes that it ended, in ascending order of their arenas.
        """
        self._start_waiting()
        seen = self._arenas.sense()
        q = self._team.values(seen, self._arenas.last_action)
        intent = self._explorer.choose(q, self._env.available, epsilon, self._rng)
        self._record_before(seen, intent)
        worst = self._arenas.worst()
        if worst is not None:
            self._worst[self._index, self._arenas.steps] = worst
        done = self._arenas.execute(intent, worst)
        ended = self._record_after(done)
        self._waiting = ended
        return [self._finished(int(arena), done.result) for arena in ended]

    def _start_waiting(self) -> None:
        """Starts the next episodes; late, so that they see the coach's newest crash rate."""
        count = len(self._waiting)
        if count:
            self._arenas.start(
                self._waiting, np.arange(self._next_episode, self._next_episode + count)
            )
            self._explorer.begin(self._waiting)
            self._next_episode += count

    def _record_before(self, seen: FloatArray, intent: IntArray) -> None:
        """Writes what the team saw and wanted."""
        steps = self._arenas.steps
        self._obs[self._index, steps] = seen
        self._intents[self._index, steps] = intent
        self._state[self._index, steps] = self._env.state
        self._available[self._index, steps] = self._env.available

    def _record_after(self, done: Executed) -> ArenaArray:
        """Writes what was executed and what came of it; returns the arenas that ended."""
        steps = self._arenas.steps
        self._actions[self._index, steps] = done.actions
        self._faults[self._index, steps] = done.modes
        self._reward[self._index, steps] = done.result.reward
        return self._arenas.count_step(done.result)

    def _finished(self, arena: int, result: StepResult) -> Finished:
        length = int(self._arenas.steps[arena])
        self._obs[arena, length] = self._arenas.sense_end(arena)
        self._state[arena, length] = self._env.state[arena]
        self._available[arena, length] = self._env.available[arena]
        episode = Episode(
            obs=self._obs[arena, : length + 1],
            state=self._state[arena, : length + 1],
            available=self._available[arena, : length + 1],
            actions=self._actions[arena, :length],
            reward=self._reward[arena, :length],
            faults=self._faults[arena, :length],
            terminated=bool(result.terminated[arena]),
        )
        plan = self._arenas.plans[arena]
        if plan is None:
            raise RuntimeError(f"arena {arena} ended an episode that was never started")
        return Finished(plan, episode, bool(result.success[arena]))

    def state_dict(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """What continues the episodes under way bit for bit: arrays, and JSON values.

        The environment itself is not saved: its episodes are played again from what the
        team wanted, so that faults go through the same states.
        """
        arenas = self._arenas
        arrays = {
            "steps": np.where(arenas.running, arenas.steps, -1),
            "intents": self._intents,
            "worst": self._worst,
            "hidden": self._team.hidden,
            "obs": np.ascontiguousarray(self._env.obs),
            "held_action": self._explorer.action,
            "held_left": self._explorer.left,
        }
        plans = [None if p is None else plan_to_json(p) for p in arenas.plans]
        rng = dict(self._rng.bit_generator.state)
        return arrays, {"plans": plans, "next_episode": self._next_episode, "rng": rng}

    def load_state_dict(self, arrays: dict[str, Array], values: dict[str, Any]) -> None:
        """Plays the saved episodes up to where they were; only for a rollout not yet stepped.

        Raises:
            CheckpointError: the environment does not repeat what was seen.
        """
        if "intents" not in arrays:
            raise CheckpointError(
                "it was written by an earlier version, which kept no intended actions: its policy "
                "can be evaluated, but its training cannot be continued"
            )
        steps = arrays["steps"]
        plans = [None if p is None else plan_from_json(p) for p in values["plans"]]
        running = [plan if at >= 0 else None for plan, at in zip(plans, steps, strict=True)]
        try:
            self._replay(steps, running, arrays["intents"], arrays["worst"])
            same = np.array_equal(self._env.obs[steps >= 0], arrays["obs"][steps >= 0])
        except UserError:
            raise
        except ValueError:  # an action that was available then is not now
            same = False
        if not same:
            raise CheckpointError(
                f"scenario {self._env.spec.scenario!r} does not repeat the episodes under way in "
                "this checkpoint: it was changed, or this is another version or machine type"
            )
        self._team.hidden = arrays["hidden"].copy()
        self._explorer.action = arrays["held_action"].copy()
        self._explorer.left = arrays["held_left"].copy()
        self._waiting = np.flatnonzero(steps < 0)
        self._next_episode = int(values["next_episode"])
        self._rng.bit_generator.state = values["rng"]

    def _replay(
        self, steps: Array, plans: list[CrashPlan | None], intents: Array, worst: Array
    ) -> None:
        """Arenas start one after another, so that all arrive at their step together."""
        arenas = self._arenas
        longest = int(steps.max(initial=0))
        for remaining in range(longest, -1, -1):
            starting = np.flatnonzero(steps == remaining)
            arenas.start_planned(starting, [p for i in starting if (p := plans[i]) is not None])
            if remaining == 0:
                return
            seen, intent = arenas.sense(), intents[self._index, arenas.steps]
            self._record_before(seen, intent)
            told = worst[self._index, arenas.steps]
            self._worst[self._index, arenas.steps] = told
            if len(self._record_after(arenas.execute(intent, told))):
                raise CheckpointError(
                    f"scenario {self._env.spec.scenario!r} ends an episode earlier than it did "
                    "when this checkpoint was written"
                )
