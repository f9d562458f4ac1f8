"""What a strategy is: who crashes in an episode, and what it learns from how episodes went.

A strategy is a class with a name, a schema of settings and a few methods; the coach asks it for
every episode's crashes, tells it of every training episode and evaluation block that is over, and
keeps its state in checkpoints. docs/adding_a_strategy.md walks through one of your own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from crash_coach_pkg.coach.victims import CapRule, crash_cap, episode_rng

State = dict[str, Any]


class StrategySettings(BaseModel):
    """Base of a strategy's settings: numbers, each with a range, a description and a unit.

    Write a field as ``Field(default=..., ge=..., le=..., description="...",
    json_schema_extra={"unit": "episodes"})``; "1" is the unit of what has none.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


S = TypeVar("S", bound=StrategySettings)


@dataclass(frozen=True)
class Candidates:
    """Whom a strategy may crash: robots 0..n-1 of the team, or of the coach's victim_role.

    ``most``: how many of them together (max_crashed, min_alive). ``triggered``: a hazard or a
    condition strikes those whom the strategy names, of whom there may then be more.
    ``crash_rate``, ``resample``, ``cap_rule``: the coach's settings of these names.
    """

    n: int
    most: int
    triggered: bool = False
    crash_rate: float = 0.0
    resample: bool = True
    cap_rule: CapRule = "ceil"

    def cap(self, rate: float) -> int:
        """Most candidates that a draw at crash rate ``rate`` may crash."""
        return crash_cap(self.cap_rule, self.n, rate, self.most, self.resample)


@dataclass(frozen=True)
class Draws:
    """The random numbers of one seed; what is drawn for a number hangs on nothing else."""

    seed: int

    def of_episode(self, episode: int) -> np.random.Generator:
        return episode_rng(self.seed, episode)

    def of(self, stream: int, number: int) -> np.random.Generator:
        """For what concerns several episodes; ``stream`` (1 and up) separates different uses."""
        return episode_rng(self.seed, number, stream)


@dataclass(frozen=True)
class Progress:
    """Where training stands. ``total_steps`` 0: unknown (a live graph)."""

    env_steps: int
    total_steps: int
    episodes: int


@dataclass(frozen=True)
class EpisodeOver:
    """A training episode that is over. ``crashed``: the candidates that its plan named."""

    crashed: tuple[int, ...]
    success: bool
    progress: Progress


@dataclass(frozen=True)
class BlockOver:
    """An evaluation block that is over: success rates of greedy episodes, in [0, 1].

    ``success_rate``: e_t, under crashes that the strategy planned. ``crash_free``: without any;
    None: not played. ``by_victim``: each robot of the team crashed alone; empty: not played.
    """

    success_rate: float
    progress: Progress
    crash_free: float | None = None
    by_victim: tuple[float, ...] = ()


class Strategy(ABC, Generic[S]):
    """Everything that moves is in ``state_dict``; ``plan`` changes nothing and hangs on nothing but
    (state, draws, episode): whatever is played side by side, a run can be repeated and resumed."""

    name: ClassVar[str]
    summary: ClassVar[str]
    """One line for the docs: who crashes."""
    Settings: ClassVar[type[StrategySettings]] = StrategySettings
    crashes: ClassVar[bool] = True
    """False: nobody, unless victims are named."""
    needs_success: ClassVar[bool] = False
    """Whether it reads successes: scenarios that report none are refused."""
    reads_blocks: ClassVar[bool] = False
    """Whether it reads those of evaluation blocks."""

    def __init__(self, settings: S, candidates: Candidates) -> None:
        self.settings = settings
        self.candidates = candidates

    @property
    @abstractmethod
    def rate(self) -> float:
        """The nominal crash rate alpha in force: the mean share of candidates that crash."""
        ...

    @property
    def cap(self) -> int:
        """Most candidates that it crashes together at present."""
        return self.candidates.most

    @abstractmethod
    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        """The candidates that crash in ``episode``; no more than ``candidates.most``."""
        ...

    def episode_over(self, over: EpisodeOver) -> None:
        """Told of every training episode, in the order in which they end."""

    def block_over(self, over: BlockOver) -> None:
        """Told of every evaluation block."""

    def take_over(self, rate: float, progress: Progress) -> None:
        """Goes on from the crash rate of a coach that died, of which nothing else is left."""

    def continue_from(self, before: Self) -> None:
        """Goes on from the state of the same strategy with other settings or candidates."""
        self.load_state_dict(before.state_dict())

    def needs_length(self) -> str | None:
        """Why it cannot work where the length of training is unknown; None: it can."""
        return None

    def state_dict(self) -> State:
        """JSON values."""
        return {}

    def load_state_dict(self, state: State) -> None:
        """Raises ValueError for the state of something else."""
        self.check_keys(state)

    def check_keys(self, state: State) -> None:
        """Raises ValueError unless ``state`` has the keys of ``state_dict``."""
        expected = sorted(self.state_dict())
        if sorted(state) != expected:
            raise ValueError(
                f"state of strategy {self.name} has keys {sorted(state)}, expected {expected}"
            )
