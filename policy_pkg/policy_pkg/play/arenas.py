"""Episodes under way in a batch of arenas: what rollouts and evaluation have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import (
    BatchEnv,
    EpisodeArray,
    FloatArray,
    IntArray,
    StepResult,
    UserError,
    stay_action,
)
from crash_coach_pkg.effects import EffectRow
from crash_coach_pkg.faults import mode_code, unmet_needs
from crash_coach_pkg.faults.batch_faults import apply_faults
from crash_coach_pkg.plan import CrashPlan, TriggerKind
from crash_coach_pkg.schedule import World
from policy_pkg.play.injected import InjectedArena, is_static
from policy_pkg.play.teams import Team, ValuingTeam, offers

ArenaArray = npt.NDArray[np.intp]
ModeArray = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Executed:
    """One control step of all arenas."""

    intent: IntArray  # (B, n) actions that the team wanted
    actions: IntArray  # (B, n) executed, after the faults
    modes: ModeArray  # (B, n) code of the fault in force, 0: none
    result: StepResult


class Arenas:
    """Runs B episodes side by side, each at a step of its own.

    Per step: ``sense``, let the team act on it, ``worst``, ``execute``, ``count_step``.

    Args:
        env: its arenas are this object's alone.
        team: told which episodes start; its weights may change between steps.
        plan: the crash plan of an episode, asked when the episode starts.
        seed: of the environment; with the episode's number it determines the episode.
        log: where to put what faults do; None: nowhere.
    """

    def __init__(
        self,
        env: BatchEnv,
        team: Team,
        plan: Callable[[int], CrashPlan],
        seed: int,
        log: list[EffectRow] | None = None,
    ) -> None:
        self.env = env
        self.spec = env.spec
        self._team = team
        self._plan = plan
        self._seed = seed
        arenas, robots = env.n_arenas, env.spec.n_robots
        self.steps: EpisodeArray = np.zeros(arenas, dtype=np.int64)
        self.episodes: EpisodeArray = np.zeros(arenas, dtype=np.int64)
        self.returns = np.zeros(arenas, dtype=np.float64)
        """(B,) undiscounted returns so far."""
        self.running = np.zeros(arenas, dtype=np.bool_)
        self.plans: list[CrashPlan | None] = [None] * arenas
        self.last_action: IntArray = np.full((arenas, robots), -1, dtype=np.int32)
        # One step more than an episode has: an arena that ended and waits is at its last step + 1.
        limit = env.spec.episode_limit + 1
        # The table of faults of arenas whose plan is static; the others are injected one by one.
        self._modes: ModeArray = np.zeros((arenas, limit, robots), dtype=np.uint8)
        self._crash_seeds = np.zeros((arenas, 1), dtype=np.uint64)
        self._injected: dict[int, InjectedArena] = {}
        self._log = log
        self._index = np.arange(arenas)

    def start(self, arenas: ArenaArray, episodes: EpisodeArray) -> None:
        """Starts ``episodes[i]`` in ``arenas[i]`` under the crash plan of that episode."""
        self.start_planned(arenas, [self._plan(int(episode)) for episode in episodes])

    def start_planned(self, arenas: ArenaArray, plans: list[CrashPlan]) -> None:
        """Starts episodes under plans that were made before.

        Raises:
            UserError: a plan asks for a fault that this team's commands cannot have.
        """
        if len(arenas) == 0:
            return
        episodes = np.array([plan.episode for plan in plans], dtype=np.int64)
        self.env.reset(arenas, self._seed, episodes)
        self.steps[arenas] = 0
        self.episodes[arenas] = episodes
        self.returns[arenas] = 0.0
        self.running[arenas] = True
        self.last_action[arenas] = -1
        self._team.begin(arenas, self._seed, episodes)
        for arena, plan in zip(arenas, plans, strict=True):
            self.plans[arena] = plan
            self._inject(int(arena), plan)

    def _inject(self, arena: int, plan: CrashPlan) -> None:
        if not self.spec.reports_positions and any(
            fault.trigger.kind == TriggerKind.NEAR for fault in plan.faults
        ):
            raise UserError(
                f"episode {plan.episode}: scenario {self.spec.scenario!r} does not tell where its "
                "robots are: near_radius_m (a fault's condition) cannot be used"
            )
        for mode in {fault.mode for fault in plan.faults}:
            if reason := unmet_needs(mode, offers(self._team)):
                raise UserError(f"episode {plan.episode}: {reason}")
        self._modes[arena] = 0
        self._injected.pop(arena, None)
        if self._log is None and is_static(plan):
            self._crash_seeds[arena] = plan.seed
            self._fill_modes(arena, plan)
        else:
            self._injected[arena] = InjectedArena(plan, self.spec, self._log)

    def _fill_modes(self, arena: int, plan: CrashPlan) -> None:
        for fault in plan.faults:
            end = fault.start_step + fault.duration_steps if fault.duration_steps else None
            self._modes[arena, fault.start_step : end, fault.robot] = mode_code(fault.mode)

    def sense(self) -> FloatArray:
        """(B, n, O) what the team sees before the next step; to be called once in every step."""
        obs = seen = self.env.obs
        for arena in self._injecting():
            injected = self._injected[arena]
            injected.enter(int(self.steps[arena]), self._world(arena))
            if injected.changes_observations:
                seen = seen.copy() if seen is obs else seen
                seen[arena] = injected.see(obs[arena])
        return seen

    def sense_end(self, arena: int) -> FloatArray:
        """(n, O) what the team would see where ``arena``'s episode has just ended."""
        obs: FloatArray = self.env.obs[arena]
        injected = self._injected.get(arena)
        if injected is None or not injected.changes_observations:
            return obs
        injected.log = None  # there is no such robot-step
        injected.enter(int(self.steps[arena]), self._world(arena))
        return injected.see(obs)

    def _injecting(self) -> list[int]:
        return [arena for arena in self._injected if self.running[arena]]

    def _world(self, arena: int) -> World:
        return World(self.env.positions_m[arena], float(self.returns[arena]))

    def worst(self) -> IntArray | None:
        """(B, n) the actions that the team valued least when it last acted; None: not needed."""
        if not any(self._injected[arena].needs_worst for arena in self._injecting()):
            return None
        assert isinstance(self._team, ValuingTeam)  # checked when the episode started
        return self._team.worst(self.env.available)

    def execute(self, intent: IntArray, worst: IntArray | None = None) -> Executed:
        """Applies the faults to (B, n) intended actions and advances every running arena.

        worst: as ``worst`` gave it.
        """
        modes: ModeArray = self._modes[self._index, self.steps]
        actions = intent
        available = self.env.available
        if modes.any():
            stay = stay_action(available, self.spec.stay_actions)
            actions = apply_faults(
                intent, modes, available, stay, self._crash_seeds, self.episodes, self.steps
            )
        if self._injected:
            actions = actions.copy()
            for arena in self._injecting():
                told = None if worst is None else worst[arena]
                executed = self._injected[arena].command(intent[arena], available[arena], told)
                actions[arena], modes[arena] = executed
        result = self.env.step(actions)
        self.last_action[:] = actions
        self.returns += result.reward
        return Executed(intent, actions, modes, result)

    def count_step(self, result: StepResult) -> ArenaArray:
        """Counts the step; returns the arenas whose episode it ended, in ascending order."""
        self.steps += self.running
        ended = np.flatnonzero((result.terminated | result.truncated) & self.running)
        self.running[ended] = False
        return ended
