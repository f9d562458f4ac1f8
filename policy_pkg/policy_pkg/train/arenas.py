"""Episodes under way in a batch of arenas: what rollouts and evaluation have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_pkg.gate import apply_faults
from crash_coach_pkg.plan import CrashPlan
from policy_pkg.train.teams import Team
from sim_pkg.contract import (
    BatchEnv,
    EpisodeArray,
    IntArray,
    StepResult,
    stay_action,
)

ArenaArray = npt.NDArray[np.intp]
ModeArray = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Executed:
    """One control step of all arenas."""

    actions: IntArray  # (B, n) executed, after the faults
    modes: ModeArray  # (B, n) crash Mode in force
    result: StepResult


class Arenas:
    """Runs B episodes side by side, each at a step of its own.

    Args:
        env: its arenas are this object's alone.
        team: told which episodes start; its weights may change between steps.
        plan: the crash plan of an episode, asked when the episode starts.
        seed: of the environment; with the episode's number it determines the episode.
    """

    def __init__(
        self,
        env: BatchEnv,
        team: Team,
        plan: Callable[[int], CrashPlan],
        seed: int,
    ) -> None:
        self.env = env
        self.spec = env.spec
        self._team = team
        self._plan = plan
        self._seed = seed
        arenas, robots = env.n_arenas, env.spec.n_robots
        self.steps: EpisodeArray = np.zeros(arenas, dtype=np.int64)
        self.episodes: EpisodeArray = np.zeros(arenas, dtype=np.int64)
        self.running = np.zeros(arenas, dtype=np.bool_)
        self.plans: list[CrashPlan | None] = [None] * arenas
        self.last_action: IntArray = np.full((arenas, robots), -1, dtype=np.int32)
        # One step more than an episode has: an arena that ended and waits is at its last step + 1.
        limit = env.spec.episode_limit + 1
        self._modes: ModeArray = np.zeros((arenas, limit, robots), dtype=np.uint8)
        self._crash_seed = 0
        self._index = np.arange(arenas)

    def start(self, arenas: ArenaArray, episodes: EpisodeArray) -> None:
        """Starts ``episodes[i]`` in ``arenas[i]`` under the crash plan of that episode."""
        self.start_planned(arenas, [self._plan(int(episode)) for episode in episodes])

    def start_planned(self, arenas: ArenaArray, plans: list[CrashPlan]) -> None:
        """Starts episodes under plans that were made before."""
        if len(arenas) == 0:
            return
        episodes = np.array([plan.episode for plan in plans], dtype=np.int64)
        self.env.reset(arenas, self._seed, episodes)
        self.steps[arenas] = 0
        self.episodes[arenas] = episodes
        self.running[arenas] = True
        self.last_action[arenas] = -1
        self._team.begin(arenas, self._seed, episodes)
        for arena, plan in zip(arenas, plans, strict=True):
            self.plans[arena] = plan
            self._crash_seed = plan.seed
            self._fill_modes(int(arena), plan)

    def _fill_modes(self, arena: int, plan: CrashPlan) -> None:
        self._modes[arena] = 0
        for fault in plan.faults:
            end = fault.start_step + fault.duration_steps if fault.duration_steps else None
            self._modes[arena, fault.start_step : end, fault.robot] = fault.mode

    def execute(self, intent: IntArray) -> Executed:
        """Applies the faults to (B, n) intended actions and advances every running arena."""
        modes = self.current_modes()
        actions = intent
        if modes.any():
            available = self.env.available
            stay = stay_action(available, self.spec.stay_actions)
            actions = apply_faults(
                intent, modes, available, stay, self._crash_seed, self.episodes, self.steps
            )
        return self.advance(actions, modes)

    def current_modes(self) -> ModeArray:
        """(B, n) crash Mode in force at each arena's next step."""
        return self._modes[self._index, self.steps]

    def advance(self, actions: IntArray, modes: ModeArray) -> Executed:
        """Executes (B, n) actions as they are."""
        result = self.env.step(actions)
        self.last_action[:] = actions
        return Executed(actions, modes, result)

    def count_step(self, result: StepResult) -> ArenaArray:
        """Counts the step; returns the arenas whose episode it ended, in ascending order."""
        self.steps += self.running
        ended = np.flatnonzero((result.terminated | result.truncated) & self.running)
        self.running[ended] = False
        return ended
