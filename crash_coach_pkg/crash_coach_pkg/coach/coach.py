"""The coach: plans each episode's crashes with its strategy, which it tells how episodes went."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from crash_coach_common.contract import BoolArray, EnvSpec, UserError
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.draws import among, check_team, draw_faults, draw_victims, most_crashed
from crash_coach_pkg.coach.strategies import find_strategy, make_strategy, strategy_names
from crash_coach_pkg.coach.strategies.base import (
    BlockOver,
    Candidates,
    Draws,
    EpisodeOver,
    Progress,
    State,
)
from crash_coach_pkg.coach.victims import episode_rng
from crash_coach_pkg.plan import CrashPlan, Planner
from crash_coach_pkg.team import TeamSpec

Decision = Literal["raise", "lower", "keep"]


@dataclass(frozen=True)
class BlockRecord:
    """One evaluation block. The crash fraction counts training robots-episodes since the last."""

    rate: float  # alpha_t, in force up to this block
    cap: int
    crashed_fraction: float | None  # of the candidates, as planned; None: no episode was counted
    episodes: int  # counted for crashed_fraction
    success_rate: float  # e_t
    decision: Decision
    new_rate: float  # alpha_{t+1}

    def __str__(self) -> str:
        return (
            f"success rate {self.success_rate:.3f}, crash rate {self.rate:.4f} -> "
            f"{self.new_rate:.4f} ({self.decision})"
        )


class Coach:
    """Plans crashes for a team.

    Args:
        config: the settings.
        team: whom it plans for.
        seed: keys every draw together with the episode, and the random actions of the plans.

    Raises:
        UserError: settings that this team cannot keep, or a negative seed.
    """

    def __init__(self, config: CoachConfig, team: TeamSpec, seed: int) -> None:
        check_team(config, team)
        if not 0 <= seed < 2**63:
            raise UserError(f"seed {seed} is not in 0..2^63-1")
        self._config = config
        self._team = team
        self._candidates = team.of_role(config.victim_role)
        self._seed = seed
        self._strategy = make_strategy(config.strategy, config.settings, self._whom())
        self._revision = 0
        self._episodes = 0
        self._crashed = 0

    def _whom(self) -> Candidates:
        config, n = self._config, len(self._candidates)
        return Candidates(
            n=n,
            most=min(n, most_crashed(config, self._team.n)),
            triggered=config.triggered,
            crash_rate=config.crash_rate,
            resample=config.resample,
            cap_rule=config.cap_rule,
        )

    @property
    def config(self) -> CoachConfig:
        return self._config

    @property
    def team(self) -> TeamSpec:
        return self._team

    @property
    def rate(self) -> float:
        """The nominal crash rate alpha in force."""
        return self._strategy.rate

    def reconfigured(self, config: CoachConfig, seed: int) -> Coach:
        """A coach with other settings; a strategy that stays the same one goes on from its state.
        The counts of the realised crash fraction start again.

        Raises:
            UserError: as the constructor.
        """
        coach = Coach(config, self._team, seed)
        coach._revision = self._revision + 1
        if type(coach._strategy) is type(self._strategy):
            coach._strategy.continue_from(self._strategy)
        return coach

    def check_scenario(self, spec: EnvSpec) -> None:
        """Raises UserError where the scenario does not report what the strategy reads."""
        if not self._strategy.needs_success or spec.reports_success:
            return
        others = (name for name in strategy_names() if not find_strategy(name).needs_success)
        raise UserError(
            f"scenario {spec.scenario!r} reports no success, which coach.strategy = "
            f"{self._config.strategy!r} needs; use one of: {', '.join(others)}"
        )

    @property
    def cap(self) -> int:
        """Most robots that the strategy crashes together at present."""
        return self._strategy.cap

    def plan(self, episode: int) -> CrashPlan:
        """The crashes of ``episode``: the same for the same (config, state, seed, episode)."""
        return self._planned(episode, self._seed)

    def keyed(self, seed: int) -> Planner:
        """Plans as this coach does at the time it is asked, with the draws of another seed."""
        return _Keyed(self, seed)

    def _planned(self, episode: int, seed: int) -> CrashPlan:
        mask, cap = self._mask(episode, seed)
        faults = draw_faults(self._config, self._team, mask)
        return CrashPlan(episode, self._revision, seed, self.rate, cap, faults)

    def _mask(self, episode: int, seed: int) -> tuple[BoolArray, int]:
        """(n,) victims, and how many may be faulted together."""
        config, n = self._config, self._team.n
        if config.crashes_nobody:
            return np.zeros(n, dtype=np.bool_), 0
        if config.victims or config.crashed_exactly >= 0:
            mask = draw_victims(config, self._team, episode_rng(seed, episode))
            cap = int(mask.sum())
        else:
            chosen = np.zeros(len(self._candidates), dtype=np.bool_)
            chosen[list(self._chosen(episode, seed))] = True
            mask, cap = among(self._candidates, n, chosen), self.cap
        return mask, most_crashed(config, n) if config.triggered else cap

    def _chosen(self, episode: int, seed: int) -> tuple[int, ...]:
        whom, chosen = self._strategy.candidates, self._strategy.plan(episode, Draws(seed))
        limit = whom.n if whom.triggered else whom.most
        distinct = len(set(chosen)) == len(chosen) and all(0 <= i < whom.n for i in chosen)
        if not distinct or len(chosen) > limit:
            raise ValueError(
                f"strategy {self._config.strategy!r} crashes {list(chosen)} in episode {episode}: "
                f"at most {limit} different ones of 0..{whom.n - 1} may crash"
            )
        return chosen

    def finish(self, plan: CrashPlan, success: bool, progress: Progress) -> None:
        """Tells the strategy of a training episode that is over, and counts it towards the realised
        crash fraction of the block. ``progress`` counts this episode."""
        robots = sorted({fault.robot for fault in plan.faults})
        self._episodes += 1
        self._crashed += len(robots)
        crashed = tuple(i for i, robot in enumerate(self._candidates) if robot in robots)
        if len(crashed) == len(robots):  # otherwise the plan is not of these candidates
            before = self.rate
            self._strategy.episode_over(EpisodeOver(crashed, success, progress))
            self._moved(before)

    def resume(self, rate: float, progress: Progress) -> None:
        """Goes on from the ``rate`` that another coach had in force; a strategy that does not
        depend on the rate before (fixed, curriculum) keeps its own."""
        before = self.rate
        self._strategy.take_over(rate, progress)
        self._moved(before)

    def record_block(
        self,
        success_rate: float,
        progress: Progress,
        crash_free: float | None = None,
        by_victim: tuple[float, ...] = (),
    ) -> BlockRecord:
        """Ends an evaluation block and tells the strategy, whose fields of BlockOver these are.

        Raises:
            ValueError: a success rate outside [0, 1].
        """
        for rate in (success_rate, *by_victim, *([] if crash_free is None else [crash_free])):
            if not 0 <= rate <= 1:
                raise ValueError(f"success rate {rate} is not in [0, 1]")
        old, cap, episodes = self.rate, self.cap, self._episodes
        fraction = self._crashed / (episodes * len(self._candidates)) if episodes else None
        self._strategy.block_over(BlockOver(success_rate, progress, crash_free, by_victim))
        self._moved(old)
        self._episodes = self._crashed = 0
        new = self.rate
        decision: Decision = "raise" if new > old else "lower" if new < old else "keep"
        return BlockRecord(old, cap, fraction, episodes, success_rate, decision, new)

    def _moved(self, before: float) -> None:
        rate = self.rate
        if not 0 <= rate <= 1:
            raise ValueError(
                f"strategy {self._config.strategy!r} has crash rate {rate}, not in [0, 1]"
            )
        self._revision += rate != before

    def state_dict(self) -> State:
        """What a checkpoint needs to continue bit for bit; config and seed are not part of it."""
        return {
            "strategy": self._strategy.state_dict(),
            "revision": self._revision,
            "episodes": self._episodes,
            "crashed": self._crashed,
        }

    def load_state_dict(self, state: State) -> None:
        """Raises ValueError where keys are missing or left over, or the strategy's state is bad."""
        if set(state) != set(self.state_dict()):
            raise ValueError(
                f"coach state has keys {sorted(state)}, expected {sorted(self.state_dict())}"
            )
        self._strategy.load_state_dict(state["strategy"])
        self._revision = int(state["revision"])
        self._episodes = int(state["episodes"])
        self._crashed = int(state["crashed"])


@dataclass(frozen=True)
class _Keyed:
    coach: Coach
    seed: int

    def plan(self, episode: int) -> CrashPlan:
        return self.coach._planned(episode, self.seed)
