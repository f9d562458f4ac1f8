"""One arena's episode under faults of any mode and trigger, as the gate would carry them out."""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray, EnvSpec, FloatArray, IntArray, stay_action
from crash_coach_pkg.effects import OBSERVED, WITHHELD, EffectKind, EffectRow
from crash_coach_pkg.faults import fault_mode, is_observation_mode, mode_code
from crash_coach_pkg.faults.action_tools import UNTOLD, ActionTools
from crash_coach_pkg.faults.batch_faults import MUTE_CODE, RANDOM_CODE
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.plan import CrashPlan, TriggerKind
from crash_coach_pkg.schedule import World


def is_static(plan: CrashPlan) -> bool:
    """Whether a table of modes says it all, so that batches of arenas can be faulted at once."""
    return all(
        fault.trigger.kind == TriggerKind.STEP
        and fault_mode(fault.mode).code in (MUTE_CODE, RANDOM_CODE)
        for fault in plan.faults
    )


class InjectedArena:
    """Per step: ``enter``, ``see`` where ``changes_observations``, ``command``.

    Args:
        log: where to put what happens, in order; None: nowhere.
    """

    def __init__(self, plan: CrashPlan, spec: EnvSpec, log: list[EffectRow] | None) -> None:
        self.changes_observations = any(is_observation_mode(f.mode) for f in plan.faults)
        self.needs_worst = any("worst" in fault_mode(f.mode).needs for f in plan.faults)
        self.log = log
        self._spec = spec
        self._episode = plan.episode
        self._team: TeamFaults[int] = TeamFaults(plan, spec.n_robots)

    def enter(self, step: int, world: World) -> None:
        """Goes on to ``step``."""
        changes = self._team.enter(step, world)
        if self.log is None:
            return
        for change in changes:
            kind: EffectKind = "ACTIVE" if change.began else "CLEARED"
            robot, entry = self._spec.robots[change.fault.robot], change.fault.entry
            self.log.append(EffectRow(self._episode, step, kind, robot, change.mode, entry))

    def see(self, obs: FloatArray) -> FloatArray:
        """(n, O) observations -> (n, O) what the policies see of them."""
        seen = np.stack([self._team.observation(i, row) for i, row in enumerate(obs)])
        if self.log is not None:
            for robot, name in enumerate(self._spec.robots):
                if mode := self._team.observation_mode(robot):
                    entry = self._team.observation_entry(robot)
                    self.log.append(
                        EffectRow(
                            self._episode, self._team.step, "EFFECT", name, mode, entry,
                            applied=OBSERVED,
                        )
                    )  # fmt: skip
        return seen

    def command(
        self, intent: IntArray, available: BoolArray, worst: IntArray | None
    ) -> tuple[IntArray, IntArray]:
        """(n,) intended -> (n,) executed actions, and (n,) codes of the faults in force.

        available: (n, A); worst: (n,) least valued available actions, or UNTOLD.
        """
        executed = stay_action(available, self._spec.stay_actions)
        codes = np.zeros_like(executed)
        for robot in range(self._spec.n_robots):
            told = UNTOLD if worst is None else int(worst[robot])
            tools = ActionTools(available[robot], told)
            effect = self._team.command(robot, int(intent[robot]), tools)
            codes[robot] = mode_code(effect.mode)
            if effect.passed is not None:
                executed[robot] = effect.passed
            if self.log is not None and self._team.command_mode(robot):
                applied = WITHHELD if effect.passed is None else effect.passed
                name = self._spec.robots[robot]
                self.log.append(
                    EffectRow(
                        self._episode, self._team.step, "EFFECT", name, effect.mode, effect.entry,
                        int(intent[robot]), applied,
                    )
                )  # fmt: skip
        return executed, codes
