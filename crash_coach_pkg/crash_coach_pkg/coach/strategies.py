"""How the crash rate follows training: alpha_{t+1} = F(alpha_t, e_t, ...) behind one protocol.

A strategy is a pure function with constants; the Coach keeps the rate. To add one, write a class
with these members and either call ``register("mine", MyStrategy)`` or name its factory in an
entry point of the group ``crash_coach.strategies``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol

from crash_coach_common.contract import UserError

if TYPE_CHECKING:
    from crash_coach_pkg.coach.config import CoachConfig

ENTRY_POINT_GROUP = "crash_coach.strategies"
CURRICULUM_ALPHA_MAX = 0.1  # the authors' code
ADAPTIVE_ALPHA_MAX = 1.0  # the paper has no ceiling


@dataclass(frozen=True)
class Progress:
    """Where training stands. ``total_steps`` 0: unknown (a live graph)."""

    env_steps: int
    total_steps: int
    episodes: int


class Strategy(Protocol):
    @property
    def initial_rate(self) -> float:
        """Crash rate before the first call, in [0, 1]."""
        ...

    @property
    def needs_success(self) -> bool:
        """Whether it reads e_t, so that the environment must report success."""
        ...

    def next_rate(self, rate: float, success_rate: float | None, progress: Progress) -> float:
        """The rate from here on.

        Args:
            rate: alpha_t.
            success_rate: e_t of the complete evaluation block that just ended, in [0, 1]; None
                between blocks.
            progress: of training.
        """
        ...


@dataclass(frozen=True)
class Fixed:
    """alpha is constant. With rate 0 this is also the strategy ``none``."""

    initial_rate: float
    needs_success: bool = False

    def next_rate(self, rate: float, success_rate: float | None, progress: Progress) -> float:
        return self.initial_rate


@dataclass(frozen=True)
class Curriculum:
    """alpha grows linearly from 0 to alpha_max and stays there.

    By ``delta`` per finished episode, or, where delta is None, in environment steps so that
    alpha_max is reached at ``fraction`` of training (the authors' code).
    """

    alpha_max: float
    fraction: float
    delta: float | None
    initial_rate: float = 0.0
    needs_success: bool = False

    def next_rate(self, rate: float, success_rate: float | None, progress: Progress) -> float:
        if self.delta is not None:
            return min(self.alpha_max, self.delta * progress.episodes)
        if progress.total_steps <= 0:
            raise UserError(
                "strategy curriculum: the length of training is unknown (total_steps = "
                f"{progress.total_steps}); set curriculum_delta, the increment per episode"
            )
        done = progress.env_steps / (self.fraction * progress.total_steps)
        return self.alpha_max * min(1.0, done)


@dataclass(frozen=True)
class Adaptive:
    """alpha += rho (1[e_t >= beta] - alpha), at most alpha_max (the paper's adaptive coach)."""

    beta: float
    rho: float
    alpha_max: float
    initial_rate: float = 0.0
    needs_success: bool = True

    def next_rate(self, rate: float, success_rate: float | None, progress: Progress) -> float:
        if success_rate is None:
            return rate
        passed = 1.0 if success_rate >= self.beta else 0.0
        return min(self.alpha_max, rate + self.rho * (passed - rate))


StrategyFactory = Callable[["CoachConfig"], Strategy]


def _curriculum(config: CoachConfig) -> Strategy:
    alpha_max = CURRICULUM_ALPHA_MAX if config.alpha_max is None else config.alpha_max
    return Curriculum(alpha_max, config.curriculum_fraction, config.curriculum_delta)


def _adaptive(config: CoachConfig) -> Strategy:
    alpha_max = ADAPTIVE_ALPHA_MAX if config.alpha_max is None else config.alpha_max
    return Adaptive(config.beta, config.rho, alpha_max)


_FACTORIES: dict[str, StrategyFactory] = {
    "none": lambda config: Fixed(0.0),
    "fixed": lambda config: Fixed(config.crash_rate),
    "curriculum": _curriculum,
    "adaptive": _adaptive,
}


def register(name: str, factory: StrategyFactory) -> None:
    """Makes ``strategy: name`` known to every CoachConfig of this process.

    Raises:
        ValueError: the name is taken.
    """
    if name in _FACTORIES:
        raise ValueError(f"a coaching strategy named {name!r} is registered already")
    _FACTORIES[name] = factory


def strategy_names() -> tuple[str, ...]:
    """Built-in, registered and installed (entry point) strategies."""
    installed = (point.name for point in entry_points(group=ENTRY_POINT_GROUP))
    return tuple(dict.fromkeys((*_FACTORIES, *installed)))


def is_strategy(name: str) -> bool:
    return name in _FACTORIES or name in strategy_names()


def make_strategy(config: CoachConfig) -> Strategy:
    """Raises UserError where the name is not known."""
    factory = _FACTORIES.get(config.strategy)
    if factory is not None:
        return factory(config)
    for point in entry_points(group=ENTRY_POINT_GROUP, name=config.strategy):
        loaded: StrategyFactory = point.load()
        return loaded(config)
    known = ", ".join(strategy_names())
    raise UserError(f"unknown coaching strategy {config.strategy!r}; one of: {known}")
