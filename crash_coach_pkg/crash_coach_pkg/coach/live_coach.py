"""The coach node's pure core: follows episodes, tells the strategy, revises the plan on request."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.coach import BlockRecord, Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.strategies.base import Progress
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Planner
from crash_coach_pkg.team import TeamSpec

AHEAD = 1000
"""Revisions left free above another coach's when this one takes over. The other goes on counting
from where it is: were the next number taken, both would soon publish the same one, and each would
take the other's plan for its own."""


class ControlSettings(BaseModel):
    """Settings of a coach in a live graph."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    enabled: bool = Field(
        default=True,
        description="False: nobody crashes, from the next step on; /coach/clear_all sets it so.",
    )
    apply_at: Literal["next_episode", "next_step"] = Field(
        default="next_episode",
        description="When a change counts: from the next_episode, or also in the running one from "
        "the next_step; the call then returns once the gate has armed it. start_step counts for "
        "the episodes after.",
    )
    lease_s: float = Field(
        default=1.0,
        ge=0.2,
        le=60,
        description="The gate clears every fault when the coach is silent for longer, seconds.",
    )
    seed: int = Field(
        default=0, ge=0, lt=2**63, description="Keys every draw, together with the episode."
    )
    block_episodes: int = Field(
        default=32, ge=1, le=1_000_000, description="Episodes per evaluation block."
    )
    success_from: Literal["episodes", "trainer"] = Field(
        default="episodes",
        description="Where a block's success rate comes from: the last block_episodes "
        "episodes, or /trainer/blocks, the evaluation blocks of live training.",
    )
    coach: CoachConfig = Field(default_factory=CoachConfig, description="Who crashes, and how.")


@dataclass(frozen=True)
class Snapshot:
    """What a refused change goes back to."""

    settings: ControlSettings
    coach: Coach
    plan: CrashPlan | None


class Control:
    """Plans for the episode that runs.

    Args:
        settings: at start.
        team: whom it plans for.
        revision: the first plan's is larger.
        scenario: plans every episode instead of the coach, whose settings then count for nothing.

    Raises:
        UserError: settings that this team cannot keep.
    """

    def __init__(
        self,
        settings: ControlSettings,
        team: TeamSpec,
        revision: int,
        scenario: Planner | None = None,
    ) -> None:
        self._settings = settings
        self._coach = Coach(settings.coach, team, settings.seed)
        self._scenario = scenario
        self._first_revision = revision
        self._revision = revision
        self._plan: CrashPlan | None = None
        self._ended = True  # whether the running episode's end was seen
        self._finished = 0
        self._block: list[bool] = []

    @property
    def settings(self) -> ControlSettings:
        return self._settings

    @property
    def plan(self) -> CrashPlan | None:
        """Of the running episode; None before the first."""
        return self._plan

    @property
    def rate(self) -> float:
        return self._coach.rate

    def follow(self, episode: int) -> CrashPlan | None:
        """Call with every episode state; returns the plan of an episode that is new."""
        if self._plan is not None and self._plan.episode == episode:
            return None
        self._ended = False
        return self._revise(self._draw(episode))

    def adopt(self, plan: CrashPlan) -> CrashPlan | None:
        """Takes over a plan that a coach before this one left in force; call before ``follow``.

        Returns the same faults under a newer revision; None where there never was a plan
        (revision 0) or this coach has one already. The rate goes on from the plan's, and the
        plan's episode counts as that many finished ones. What a lease or /coach/clear_all ended
        is ended until the next episode: such a plan has no faults.
        """
        if self._plan is not None or plan.revision == 0:
            return None
        self._count_above(plan.revision)
        self._ended = False
        self._finished = plan.episode
        if self._scenario is None:
            self._coach.resume(plan.rate, self._progress())
        return self._revise(plan)

    def finish(self, success: bool) -> BlockRecord | None:
        """Call when the running episode ended; returns the record of a block that is complete.

        Episodes count while the coach is enabled; a second call for the same episode is ignored.
        A fault scenario has no blocks.
        """
        if self._ended or self._plan is None:
            return None
        self._ended = True
        if not self._settings.enabled or self._scenario is not None:
            return None
        self._finished += 1
        progress = self._progress()
        self._coach.finish(self._plan, success, progress)
        if self._settings.success_from == "trainer":
            return None
        self._block.append(success)
        if len(self._block) < self._settings.block_episodes:
            return None
        rate = sum(self._block) / len(self._block)
        self._block.clear()
        return self._coach.record_block(rate, progress)

    def evaluated(self, success_rate: float) -> BlockRecord | None:
        """Call with a trainer's block; None where blocks come from elsewhere, or count for nothing.

        Raises:
            UserError: a success rate outside [0, 1].
        """
        if not 0 <= success_rate <= 1:
            raise UserError(f"success rate {success_rate} of a trainer's block is not in [0, 1]")
        settings = self._settings
        if settings.success_from != "trainer" or not settings.enabled or self._scenario is not None:
            return None
        return self._coach.record_block(success_rate, self._progress())

    def configure(self, settings: ControlSettings, now: bool) -> CrashPlan | None:
        """Takes new settings; with ``now``, returns a plan for what is left of the episode.

        A change of the coach's own settings starts a new evaluation block; a strategy goes on from
        its state unless another one is chosen.
        """
        old = self._settings
        if settings.coach != old.coach or settings.seed != old.seed:
            self._coach = self._coach.reconfigured(settings.coach, settings.seed)
            self._block.clear()
        self._settings = settings
        if not now or self._plan is None:
            return None
        plan = self._draw(self._plan.episode)
        if self._scenario is None:  # a scenario's faults keep their steps
            faults = tuple(replace(fault, start_step=NEXT_STEP) for fault in plan.faults)
            plan = replace(plan, faults=faults)
        return self._revise(plan)

    def armed(self, revision: int, step: int) -> None:
        """The gate carries ``revision`` out from ``step`` on: publishing it again, even as part of
        a newer revision, must not start its faults anew."""
        if self._plan is not None and self._plan.revision == revision:
            self._plan = self._plan.resolved(step)

    def snapshot(self) -> Snapshot:
        return Snapshot(self._settings, self._coach, self._plan)

    def restore(self, snapshot: Snapshot) -> CrashPlan | None:
        """Undoes a change that no gate took; returns the plan to publish."""
        self._settings, self._coach = snapshot.settings, snapshot.coach
        self._block.clear()
        if self._plan is None:
            return None
        before = snapshot.plan
        if before is None or before.episode != self._plan.episode:
            return self._revise(self._draw(self._plan.episode))
        return self._revise(before)

    def published(self, revision: int) -> bool:
        """Whether a plan with this revision came from here, since this coach last took over."""
        return self._first_revision < revision <= self._revision

    def overtake(self, revision: int) -> CrashPlan | None:
        """Another coach's revision was seen in force; returns a plan above it, if need be."""
        if self._plan is None or revision <= self._plan.revision:
            return None
        self._count_above(revision)
        return self._revise(self._plan)

    def _count_above(self, revision: int) -> None:
        self._first_revision = self._revision = max(self._revision, revision + AHEAD)

    def _progress(self) -> Progress:
        return Progress(env_steps=0, total_steps=0, episodes=self._finished)

    def _draw(self, episode: int) -> CrashPlan:
        planner: Planner = self._coach if self._scenario is None else self._scenario
        plan = planner.plan(episode)
        return plan if self._settings.enabled else replace(plan, cap=0, faults=())

    def _revise(self, plan: CrashPlan) -> CrashPlan:
        self._revision += 1
        self._plan = replace(plan, revision=self._revision)
        return self._plan
