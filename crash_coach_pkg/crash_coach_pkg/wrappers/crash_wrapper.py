"""Any PettingZoo ParallelEnv with crashes: a coach plans them, the same faults carry them out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from crash_coach_common.contract import BoolArray, UserError
from crash_coach_pkg.coach.coach import BlockRecord, Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.strategies.base import Progress
from crash_coach_pkg.faults import is_observation_mode, unmet_needs
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS, UNTOLD, ActionTools
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.plan import CrashPlan, TriggerKind
from crash_coach_pkg.schedule import World
from crash_coach_pkg.team import TeamSpec
from crash_coach_pkg.wrappers.masked import OBSERVATION, inner, inner_space, is_masked, mask_of


class CrashWrapper(BaseParallelWrapper):  # type: ignore[misc]
    """Crashes agents of ``env`` in each episode as a coach plans it.

    Observations, rewards and ends are the environment's own. ``infos`` of each agent additionally
    say ``crashed``, whether a fault was in force on it in this step, and ``executed_action``, which
    a learner has to learn from (after ``reset``: False, and the stay action). Agents of the faults
    are numbered as in ``possible_agents``; in ``coach`` they are called by their names, with ``_``
    for what is neither letter nor digit.

    Args:
        env: with Discrete actions, and for faults of observations with Box observations (or a dict
            of ``observation`` and ``action_mask``).
        coach: its settings, as a CoachConfig or a mapping of its keys; or a Coach that several
            wrappers share, as those for training and for evaluation blocks do.
        stay_action: what a muted agent does; where its action mask forbids that, the first action
            that is allowed.
        seed: of a coach that is made here.
        dt_s: seconds per step, for hazard rates.
        tells_worst: ``worst_actions`` will be set before each step, as mode adversarial needs.

    Raises:
        UserError: settings that the environment cannot keep.
    """

    def __init__(
        self,
        env: Any,
        coach: CoachConfig | Mapping[str, Any] | Coach,
        stay_action: int,
        seed: int = 0,
        dt_s: float = 1.0,
        tells_worst: bool = False,
    ) -> None:
        super().__init__(env)
        self._agents_of_plan = list(env.possible_agents)
        for agent in self._agents_of_plan:
            _check_actions(agent, env.action_space(agent), stay_action)
        self.coach = coach if isinstance(coach, Coach) else _coach(env, coach, seed, dt_s)
        self._check_faults(tells_worst)
        self._stay = stay_action
        self._episode = -1
        self._episodes_done = 0
        self._step = 0
        self._return = 0.0
        self._plan: CrashPlan | None = None
        self._faults: TeamFaults[int] | None = None
        self._masks: dict[Any, BoolArray] = {}
        self.worst_actions: dict[Any, int] = {}
        """By agent: the action that its policy values least now, for mode adversarial."""

    def _check_faults(self, tells_worst: bool) -> None:
        config = self.coach.config
        if self.coach.team.n != len(self._agents_of_plan):
            raise UserError(
                f"the coach plans for {self.coach.team.n} robots, the environment has "
                f"{len(self._agents_of_plan)} agents"
            )
        offers = ACTION_OFFERS if tells_worst else ACTION_OFFERS - {"worst"}
        if reason := unmet_needs(config.crash_mode, offers):
            raise UserError(f"crash_mode {config.crash_mode!r}: {reason} (tells_worst)")
        if config.near_radius_m > 0:
            raise UserError("near_radius_m: PettingZoo does not tell where agents are")
        for agent in self._agents_of_plan:
            space = self.env.observation_space(agent)
            if is_observation_mode(config.crash_mode) and not isinstance(
                inner_space(space), spaces.Box
            ):
                raise UserError(
                    f"crash_mode {config.crash_mode!r} changes observations: agent {agent!r} "
                    f"observes {space}, a Box is needed"
                )

    @property
    def plan(self) -> CrashPlan | None:
        """The crashes of the episode under way; None before the first."""
        return self._plan

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Any, Any], dict[Any, dict[str, Any]]]:
        """Starts an episode; with a seed, its crashes follow from the seed and the crash rate."""
        observations, infos = self.env.reset(seed=seed, options=options)
        if seed is None:
            self._episode += 1
        else:
            self._episode = int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1
        plan = self.coach.plan(self._episode)
        if any(fault.trigger.kind == TriggerKind.NEAR for fault in plan.faults):
            raise UserError("a fault near a point: PettingZoo does not tell where agents are")
        self._plan = plan
        self._faults = TeamFaults(plan, len(self._agents_of_plan))
        self._step, self._return = 0, 0.0
        self.worst_actions = {}
        # The keys that each step has: TorchRL takes from the first infos which there are.
        idle = {"crashed": False, "executed_action": self._stay}
        return self._seen(observations, infos), self._told(infos, dict.fromkeys(infos, idle))

    def step(self, actions: dict[Any, int]) -> Any:
        """One step, in which crashed agents do what their faults say."""
        faults = self._begun()
        executed = {
            agent: self._execute(faults, agent, action) if agent in self.env.agents else action
            for agent, action in actions.items()
        }
        down = {a: bool(faults.mode(self._agents_of_plan.index(a))) for a in executed}
        self._crashing([agent for agent in executed if down[agent]])
        observations, rewards, terminations, truncations, infos = self.env.step(executed)
        self._step += 1
        self._return += float(sum(rewards.values()))
        seen = self._seen(observations, infos)
        told = {
            agent: {"crashed": down[agent], "executed_action": executed[agent]}
            for agent in executed
        }
        return seen, rewards, terminations, truncations, self._told(infos, told)

    def end_episode(self, success: bool, env_steps: int, total_steps: int = 0) -> None:
        """Tells the coach of the finished training episode.

        Args:
            success: of the episode.
            env_steps: of training so far; total_steps: of all training, 0: unknown.
        """
        self._begun()
        assert self._plan is not None
        self._episodes_done += 1
        progress = Progress(env_steps, total_steps, self._episodes_done)
        self.coach.finish(self._plan, success, progress)

    def end_block(self, success_rate: float, env_steps: int, total_steps: int = 0) -> BlockRecord:
        """Tells the coach the success rate of an evaluation block, and moves the crash rate.

        Args:
            success_rate: of greedy episodes under crashes at the present rate, in [0, 1].
            env_steps, total_steps: as of ``end_episode``.
        """
        return self.coach.record_block(
            success_rate, Progress(env_steps, total_steps, self._episodes_done)
        )

    def _crashing(self, agents: list[Any]) -> None:
        """Called before each step with the agents that a fault is in force on, for pictures."""

    def _begun(self) -> TeamFaults[int]:
        if self._faults is None:
            raise UserError("reset the environment before the first step")
        return self._faults

    def _execute(self, faults: TeamFaults[int], agent: Any, action: int) -> int:
        """What ``agent`` does instead of ``action``."""
        robot, mask = self._agents_of_plan.index(agent), self._masks[agent]
        first = int(self.env.action_space(agent).start)
        worst = self.worst_actions.get(agent)
        tools = ActionTools(mask, UNTOLD if worst is None else int(worst) - first)
        effect = faults.command(robot, int(action) - first, tools)
        if effect.passed is not None:
            return effect.passed + first
        stay = self._stay - first
        return first + (stay if mask[stay] else int(np.argmax(mask)))

    def _seen(self, observations: dict[Any, Any], infos: Mapping[Any, Any]) -> dict[Any, Any]:
        """What the policies see of the observations; notes the action masks."""
        faults = self._begun()
        faults.enter(self._step, World(_NOWHERE, self._return) if faults.needs_world else None)
        seen = dict(observations)
        for robot, agent in enumerate(self._agents_of_plan):
            if agent not in observations:
                continue
            self._masks[agent] = self._mask(agent, observations[agent], infos.get(agent, {}))
            if isinstance(inner_space(self.env.observation_space(agent)), spaces.Box):
                seen[agent] = _changed(faults, robot, observations[agent])
        return seen

    def _mask(self, agent: Any, observed: Any, info: Mapping[str, Any]) -> BoolArray:
        """(A,) the agent's available actions."""
        mask = mask_of(observed, info)
        if mask is None:
            return np.ones(int(self.env.action_space(agent).n), dtype=np.bool_)
        return np.asarray(mask).astype(np.bool_)

    def _told(
        self, infos: Mapping[Any, Mapping[str, Any]], told: Mapping[Any, Mapping[str, Any]]
    ) -> dict[Any, dict[str, Any]]:
        return {agent: {**info, **told.get(agent, {})} for agent, info in infos.items()}


_NOWHERE: npt.NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)


def _coach(env: Any, config: CoachConfig | Mapping[str, Any], seed: int, dt_s: float) -> Coach:
    names = [re.sub(r"\W", "_", str(agent), flags=re.ASCII) for agent in env.possible_agents]
    robots = tuple(f"agent_{name}" if name[:1].isdigit() else name for name in names)
    roles = tuple(re.sub(r"_?\d+$", "", robot) or robot for robot in robots)
    return Coach(coach_settings(config), TeamSpec(robots, roles, dt_s), seed)


def coach_settings(config: CoachConfig | Mapping[str, Any]) -> CoachConfig:
    """Raises UserError for an unknown key or a wrong value."""
    if isinstance(config, CoachConfig):
        return config
    try:
        return CoachConfig.model_validate(dict(config))
    except ValueError as error:
        raise UserError(f"coach: {error}") from error


def _check_actions(agent: Any, space: Any, stay_action: int) -> None:
    if not isinstance(space, spaces.Discrete):
        raise UserError(f"agent {agent!r} has actions {space}: Discrete ones are needed")
    if not space.contains(stay_action):
        raise UserError(f"stay_action {stay_action}: agent {agent!r} has actions {space}")


def _changed(faults: TeamFaults[int], robot: int, observed: Any) -> Any:
    """``observed``, of a Box or beside an action mask, as the faults let it be seen."""
    whole = np.asarray(inner(observed))
    features = whole.astype(np.float32).ravel()
    seen = faults.observation(robot, features)
    if seen is features:
        return observed
    changed = seen.reshape(whole.shape).astype(whole.dtype)
    return {**observed, OBSERVATION: changed} if is_masked(observed) else changed
