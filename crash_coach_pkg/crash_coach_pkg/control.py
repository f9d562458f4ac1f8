"""The coach node's pure core: follows episodes, moves the rate, revises the plan on request."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from crash_coach_pkg.coach import BlockRecord, Coach
from crash_coach_pkg.config import CoachConfig
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan
from crash_coach_pkg.strategies import Progress


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
        default=32, ge=1, le=1_000_000, description="Adaptive: episodes per evaluation block."
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
        robots: names of the team, in robot order.
        revision: the first plan's is larger.

    Raises:
        UserError: settings that this team cannot keep.
    """

    def __init__(self, settings: ControlSettings, robots: tuple[str, ...], revision: int) -> None:
        self._robots = robots
        self._settings = settings
        self._coach = Coach(settings.coach, robots, settings.seed)
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

    def finish(self, success: bool) -> BlockRecord | None:
        """Call when the running episode ended; returns the record of a block that is complete.

        Episodes count while the coach is enabled; a second call for the same episode is ignored.
        """
        if self._ended or self._plan is None:
            return None
        self._ended = True
        if not self._settings.enabled:
            return None
        self._finished += 1
        progress = Progress(env_steps=0, total_steps=0, episodes=self._finished)
        self._coach.count(self._plan)
        self._coach.advance(progress)
        self._block.append(success)
        if len(self._block) < self._settings.block_episodes:
            return None
        rate = sum(self._block) / len(self._block)
        self._block.clear()
        return self._coach.record_block(rate, progress)

    def configure(self, settings: ControlSettings, now: bool) -> CrashPlan | None:
        """Takes new settings; with ``now``, returns a plan for what is left of the episode.

        A change of the coach's own settings starts a new evaluation block; the rate goes on from
        where it is unless another strategy, or another fixed rate, is chosen.
        """
        old = self._settings
        if settings.coach != old.coach or settings.seed != old.seed:
            self._coach = self._coach.reconfigured(settings.coach, settings.seed)
            self._block.clear()
        self._settings = settings
        if not now or self._plan is None:
            return None
        plan = self._draw(self._plan.episode)
        faults = tuple(replace(fault, start_step=NEXT_STEP) for fault in plan.faults)
        return self._revise(replace(plan, faults=faults))

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
        """Whether a plan with this revision came from here."""
        return self._first_revision < revision <= self._revision

    def overtake(self, revision: int) -> CrashPlan | None:
        """Another coach's revision was seen in force; returns a plan above it, if need be."""
        if self._plan is None or revision <= self._plan.revision:
            return None
        self._revision = max(self._revision, revision)
        return self._revise(self._plan)

    def _draw(self, episode: int) -> CrashPlan:
        plan = self._coach.plan(episode)
        return plan if self._settings.enabled else replace(plan, cap=0, faults=())

    def _revise(self, plan: CrashPlan) -> CrashPlan:
        self._revision += 1
        self._plan = replace(plan, revision=self._revision)
        return self._plan
