"""Evaluation blocks: when one is due, what was played in it, its line of metrics."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from crash_coach_pkg.coach.coach import BlockRecord
from policy_pkg.play.evaluate import Evaluation
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import Value


@dataclass
class Schedule:
    """When blocks are due: at step 0, whenever a multiple of an interval is passed, at the end."""

    blocks: int = 0
    next_block_steps: int = 0

    def due(self, steps: int) -> bool:
        return steps >= self.next_block_steps

    def finished(self, steps: int, total_steps: int) -> bool:
        """All steps are done, and the block behind them."""
        return self.next_block_steps > steps >= total_steps

    def close(self, steps: int, interval_steps: int, total_steps: int) -> None:
        """A block was played at ``steps``."""
        self.blocks += 1
        self.next_block_steps = (steps // interval_steps + 1) * interval_steps
        self.bound(steps, total_steps)

    def bound(self, steps: int, total_steps: int) -> None:
        """The next block comes at ``total_steps`` at the latest."""
        if steps < total_steps:
            self.next_block_steps = min(self.next_block_steps, total_steps)


@dataclass
class Counters(Schedule):
    """Where a run stands. ``credit`` is the gradient steps owed, below 1 between steps."""

    env_steps: int = 0
    episodes: int = 0
    credit: float = 0.0

    def to_json(self) -> dict[str, int | float]:
        return asdict(self)


@dataclass(frozen=True)
class Block:
    """The greedy episodes of one evaluation block."""

    crashed: Evaluation  # crashes as the coach plans them now
    crash_free: Evaluation | None  # the same episodes without crashes
    victims: tuple[Evaluation, ...] = ()  # one per robot, which alone crashes

    @property
    def conditions(self) -> tuple[Evaluation, ...]:
        """All that were played, each once."""
        free = () if self.crash_free in (None, self.crashed) else (self.crash_free,)
        return (*free, self.crashed, *self.victims)

    @property
    def worst_success(self) -> float:
        """Success rate under the worst of the conditions."""
        return min(played.success_rate for played in self.conditions)

    @property
    def rank(self) -> tuple[float, ...]:
        """Orders blocks: of blocks with crashes, which tell more than those without, the one whose
        worst condition is best; then by the mean over conditions."""
        crashed = any(episode.crashed for played in self.conditions for episode in played.episodes)
        mean = float(np.mean([played.success_rate for played in self.conditions]))
        return float(crashed), self.worst_success, mean


def block_line(
    config: TrainConfig,
    done: Counters,
    updates: int,
    record: BlockRecord,
    block: Block,
    means: dict[str, float | None],
    reports_success: bool,
) -> dict[str, Value]:
    """A block's line of metrics; see policy_pkg.train.metrics. Changes ``means``."""
    if not reports_success:
        means["train_success_rate"] = None
    summary, free = block.crashed.summary(), block.crash_free
    return {
        "env_steps": done.env_steps,
        "episodes": done.episodes,
        "gradient_steps": updates,
        "epsilon": config.epsilon(done.env_steps),
        "alpha": record.rate,
        "cap": record.cap,
        "crashed_fraction": record.crashed_fraction,
        "success_rate": record.success_rate if reports_success else None,
        "return_mean": summary["return_mean"],
        "steps_mean": summary["steps_mean"],
        "block_crashed": summary["crashed_fraction"],
        "decision": record.decision,
        "new_alpha": record.new_rate,
        "success_crash_free": free.success_rate if free and reports_success else None,
        "return_crash_free": free.return_mean if free else None,
        "success_worst": block.worst_success if reports_success else None,
        **{
            f"success_{played.robots[i]}_crashed": played.success_rate if reports_success else None
            for i, played in enumerate(block.victims)
        },
        **means,
        "updates_per_episode": config.updates_per_episode,
    }
