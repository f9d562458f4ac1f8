"""What a run's own record tells of its training: its last blocks, and what it cost in episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from policy_pkg.report.finished_runs import Run, read_lines
from policy_pkg.train.metrics import crashed_robot
from policy_pkg.train.run_dir import METRICS

LAST_BLOCKS = 10
COPES = 0.8  # success rate, crash-free and with each robot crashed
CRASH_FREE = "success_crash_free"
CRASH_FREE_RETURN = "return_crash_free"


@dataclass(frozen=True)
class Training:
    """Figures of a run's metrics; None where it did not keep them.

    ``blocks``: those with crash-free episodes, oldest first: (steps, success rate, mean return).
    ``coped``: of those that tested each robot crashed, oldest first: steps, and whether the team
    succeeded in COPES of the episodes of each condition. ``episodes``: that it learned from.
    ``evaluation_episodes``: that its blocks played besides.
    """

    blocks: tuple[tuple[int, float, float], ...]
    coped: tuple[tuple[int, bool], ...]
    episodes: int | None
    evaluation_episodes: int | None

    @property
    def last_blocks(self) -> float | None:
        """Mean crash-free success rate of the last LAST_BLOCKS blocks; None with fewer."""
        if len(self.blocks) < LAST_BLOCKS:
            return None
        return float(np.mean([rate for _, rate, _ in self.blocks[-LAST_BLOCKS:]]))


def training_of(run: Run) -> Training:
    """Read from metrics.jsonl.

    Raises:
        RunError: it is damaged.
    """
    lines = read_lines(run.path / METRICS)
    blocks = tuple(
        (_steps(line), float(line[CRASH_FREE]), float(line[CRASH_FREE_RETURN]))
        for line in lines
        if line.get(CRASH_FREE) is not None and line.get(CRASH_FREE_RETURN) is not None
    )
    coped = tuple((_steps(line), copes) for line in lines if (copes := _copes(line)) is not None)
    if not lines or "episodes" not in lines[-1]:  # of a run on recordings
        return Training(blocks, coped, None, None)
    played = sum(_block_episodes(line, run.settings) for line in lines)
    return Training(blocks, coped, int(lines[-1]["episodes"]), played)


def _victims(line: Mapping[str, Any]) -> list[str]:
    """The keys of a block's success with one robot crashed."""
    return [key for key in line if crashed_robot(key)]


def _copes(line: Mapping[str, Any]) -> bool | None:
    """None for a block that did not test each robot crashed, or not crash-free."""
    victims = _victims(line)
    rates: list[Any] = [line.get(key) for key in (CRASH_FREE, *victims)]
    if not victims or None in rates:
        return None
    return all(rate >= COPES for rate in rates)


def _steps(line: Mapping[str, Any]) -> int:
    """Of the environment; of a run on recordings, which has none, gradient steps."""
    return int(line["env_steps"] if "env_steps" in line else line["gradient_steps"])


def _block_episodes(line: Mapping[str, Any], settings: Mapping[str, Any]) -> int:
    """How many episodes a block played.

    Its crash-free half is the block itself where nobody crashed in it.
    """
    count = int(settings["test_episodes"])
    if settings.get("test_crash_free") and line.get("block_crashed"):
        count *= 2
    return count + len(_victims(line)) * int(settings.get("test_victim_episodes") or 0)
