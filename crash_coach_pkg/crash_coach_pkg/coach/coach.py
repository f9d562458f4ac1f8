"""The coach: keeps the crash rate, plans each episode's crashes, records evaluation blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from crash_coach_common.contract import BoolArray, UserError
from crash_coach_pkg.coach.config import CoachConfig, TeamSpec
from crash_coach_pkg.coach.draws import among, check_team, draw_faults, draw_victims, most_crashed
from crash_coach_pkg.coach.strategies import Progress, make_strategy
from crash_coach_pkg.coach.victims import crash_cap, draw_mask, episode_rng
from crash_coach_pkg.plan import CrashPlan

JsonScalar = int | float
Decision = Literal["raise", "lower", "keep"]


class Planner(Protocol):
    """What decides the faults of each episode: a Coach, or a fault scenario's planner."""

    def plan(self, episode: int) -> CrashPlan:
        """Of ``episode``: the same whenever, and in whatever order, it is asked for."""
        ...


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
        self._strategy = make_strategy(config)
        self._rate = self._strategy.initial_rate
        self._revision = 0
        self._episodes = 0
        self._crashed = 0

    @property
    def config(self) -> CoachConfig:
        return self._config

    @property
    def team(self) -> TeamSpec:
        return self._team

    @property
    def rate(self) -> float:
        """The nominal crash rate alpha in force."""
        return self._rate

    def reconfigured(self, config: CoachConfig, seed: int) -> Coach:
        """A coach with other settings that goes on from this one's rate.

        Another strategy, or another rate to start from (fixed), starts at its own; alpha_max
        holds at once. The counts of the realised crash fraction start again.

        Raises:
            UserError: as the constructor.
        """
        coach = Coach(config, self._team, seed)
        coach._revision = self._revision + 1
        same = config.strategy == self._config.strategy
        if same and coach._rate == self._strategy.initial_rate:
            coach._rate = coach._below_ceiling(self._rate)
        return coach

    def _below_ceiling(self, rate: float) -> float:
        """A rate that was in force before; alpha_max does not concern strategy ``fixed``."""
        ceiling = self._config.alpha_max
        constant = self._config.strategy in ("none", "fixed")
        return rate if constant or ceiling is None else min(rate, ceiling)

    @property
    def needs_success(self) -> bool:
        """Whether the strategy reads success rates: refuse environments that report none."""
        return self._strategy.needs_success

    @property
    def cap(self) -> int:
        """Most robots that a draw at the present rate may crash."""
        c, n = self._config, len(self._candidates)
        limit = most_crashed(c, self._team.n)
        return crash_cap(c.cap_rule, n, self._rate, limit, c.resample)

    def plan(self, episode: int) -> CrashPlan:
        """The crashes of ``episode``: the same for the same (config, rate, seed, episode)."""
        mask, cap = self._mask(episode)
        faults = draw_faults(self._config, self._team, mask)
        return CrashPlan(episode, self._revision, self._seed, self._rate, cap, faults)

    def _mask(self, episode: int) -> tuple[BoolArray, int]:
        """(n,) victims, and how many may be faulted together."""
        config, n = self._config, self._team.n
        if config.strategy == "none" and not config.victims:
            return np.zeros(n, dtype=np.bool_), 0
        rng = episode_rng(self._seed, episode)
        by_rate = not self._everybody and not config.victims and config.crashed_exactly < 0
        if by_rate:
            drawn = draw_mask(rng, len(self._candidates), self._rate, self.cap)
            mask, cap = among(self._candidates, n, drawn), self.cap
        else:
            mask = draw_victims(config, self._team, rng)
            cap = int(mask.sum())
        return mask, most_crashed(config, n) if config.triggered else cap

    @property
    def _everybody(self) -> bool:
        """Whether a hazard or condition chooses among all candidates, without a draw before it."""
        config = self._config
        return config.triggered and config.strategy == "fixed" and config.crash_rate == 0

    def count(self, plan: CrashPlan) -> None:
        """Counts a training episode towards the realised crash fraction of the block."""
        self._episodes += 1
        self._crashed += len({fault.robot for fault in plan.faults})

    def advance(self, progress: Progress) -> None:
        """Lets strategies that follow training progress move the rate."""
        self._set_rate(self._strategy.next_rate(self._rate, None, progress))

    def resume(self, rate: float, progress: Progress) -> None:
        """Goes on from the ``rate`` that another coach had in force; a strategy that does not
        depend on the rate before (fixed, curriculum) keeps its own."""
        self._set_rate(self._below_ceiling(self._strategy.next_rate(rate, None, progress)))

    def record_block(self, success_rate: float, progress: Progress) -> BlockRecord:
        """Ends an evaluation block with its success rate e_t and moves the rate.

        Raises:
            ValueError: a success rate outside [0, 1].
        """
        if not 0 <= success_rate <= 1:
            raise ValueError(f"success rate {success_rate} is not in [0, 1]")
        old, cap, episodes = self._rate, self.cap, self._episodes
        fraction = self._crashed / (episodes * len(self._candidates)) if episodes else None
        self._set_rate(self._strategy.next_rate(old, success_rate, progress))
        self._episodes = self._crashed = 0
        decision: Decision = (
            "raise" if self._rate > old else "lower" if self._rate < old else "keep"
        )
        return BlockRecord(old, cap, fraction, episodes, success_rate, decision, self._rate)

    def _set_rate(self, rate: float) -> None:
        if not 0 <= rate <= 1:
            raise ValueError(
                f"strategy {self._config.strategy!r} returned crash rate {rate}, not in [0, 1]"
            )
        if rate != self._rate:
            self._rate = rate
            self._revision += 1

    def state_dict(self) -> dict[str, JsonScalar]:
        """What a checkpoint needs to continue bit for bit; config and seed are not part of it."""
        return {
            "rate": self._rate,
            "revision": self._revision,
            "episodes": self._episodes,
            "crashed": self._crashed,
        }

    def load_state_dict(self, state: dict[str, JsonScalar]) -> None:
        """Raises ValueError where keys are missing or left over, or the rate is out of range."""
        if set(state) != set(self.state_dict()):
            raise ValueError(
                f"coach state has keys {sorted(state)}, expected {sorted(self.state_dict())}"
            )
        rate = float(state["rate"])
        if not 0 <= rate <= 1:
            raise ValueError(f"coach state: rate {rate} is not in [0, 1]")
        self._rate = rate
        self._revision = int(state["revision"])
        self._episodes = int(state["episodes"])
        self._crashed = int(state["crashed"])
