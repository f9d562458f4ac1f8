"""Episodes as they go by: who was crashed in each, how it ended, and what crashes cost.

Events and the ends of episodes come on different topics, in any order: an episode is settled a
moment after its end.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crash_coach_common.natural import natural
from policy_pkg.statistics import mean_interval, wilson

SETTLE_S = 0.5
"""How long after an episode's end events of it are still awaited."""

MOST_GROUPS = 12


@dataclass(frozen=True)
class Played:
    """An episode from its beginning to its end."""

    episode: int
    crashed: tuple[str, ...]  # robots that a fault was in force on, in robot order
    modes: tuple[str, ...]  # of these faults, each once, sorted
    success: bool
    episode_return: float
    steps: int

    def __str__(self) -> str:
        who = ", ".join(self.crashed) + f" ({', '.join(self.modes)})" if self.crashed else "nobody"
        done = "success" if self.success else "no success"
        return (
            f"episode {self.episode}: {done}, return {self.episode_return:.2f}, "
            f"{self.steps} steps; crashed: {who}"
        )


@dataclass
class EpisodeBook:
    """Told of beginnings, faults and ends, it gives the episodes that were seen whole.

    Times are a steady clock's, in seconds.
    """

    _begun: set[int] = field(default_factory=set)
    _faulted: dict[int, set[tuple[str, str]]] = field(default_factory=dict)
    _ended: deque[tuple[float, int, bool, float, int]] = field(default_factory=deque)
    _settled: int = -1

    def begin(self, episode: int) -> None:
        """An episode starts; the same or an earlier one where the sim was started anew."""
        if episode <= self._settled:
            self._settled = episode - 1
            self._faulted = {k: v for k, v in self._faulted.items() if k >= episode}
        self._begun = {k for k in self._begun if k >= episode - 1} | {episode}

    def faulted(self, episode: int, robot: str, mode: str) -> None:
        """A fault is in force on ``robot``."""
        if episode > self._settled:
            self._faulted.setdefault(episode, set()).add((robot, mode))

    def end(
        self, episode: int, success: bool, episode_return: float, steps: int, now_s: float
    ) -> None:
        """An episode is over; one whose beginning was not seen does not count."""
        if episode in self._begun:
            self._begun.discard(episode)
            self._ended.append((now_s, episode, success, episode_return, steps))

    def settled(self, now_s: float, wait_s: float = SETTLE_S) -> Iterator[Played]:
        """Episodes of which nothing more is to come."""
        while self._ended and now_s - self._ended[0][0] >= wait_s:
            _, episode, success, episode_return, steps = self._ended.popleft()
            self._settled = max(self._settled, episode)
            faults = self._faulted.pop(episode, set())
            crashed = tuple(sorted({robot for robot, _ in faults}, key=natural))
            modes = tuple(sorted({mode for _, mode in faults}))
            self._faulted = {k: v for k, v in self._faulted.items() if k > episode}
            yield Played(episode, crashed, modes, success, episode_return, steps)


@dataclass
class _Group:
    successes: int = 0
    steps: array[int] = field(default_factory=lambda: array("l"))
    returns: array[float] = field(default_factory=lambda: array("d"))


class Costs:
    """Success and return of the episodes watched, crash-free and by who was crashed how."""

    def __init__(self) -> None:
        self._groups: dict[tuple[tuple[str, ...], tuple[str, ...]], _Group] = {}

    def add(self, played: Played) -> None:
        group = self._groups.setdefault((played.crashed, played.modes), _Group())
        group.successes += played.success
        group.steps.append(played.steps)
        group.returns.append(played.episode_return)

    def forget(self) -> None:
        """Counts anew."""
        self._groups.clear()

    def rows(self, together: bool = True) -> list[dict[str, Any]]:
        """JSON values, crash-free first, then by how many were crashed, most episodes first.

        ``crashed``: names, and ``modes`` of their faults; where there are more than MOST_GROUPS
        different ones, their number; null for all episodes ``together``, the last row.
        ``success`` and ``return``: value, low and high end of a 95 % interval (Wilson's; Student's
        t, null where one episode gives none). ``alike``: all episodes ended alike; they may be one
        episode again and again, of which no interval says anything.
        """
        groups = self._groups
        if len(groups) <= MOST_GROUPS:
            order = sorted(
                groups,
                key=lambda k: (len(k[0]), -len(groups[k].returns), [*map(natural, k[0])], k[1]),
            )
            rows = [
                {"crashed": list(k[0]), "modes": list(k[1]), **_summary([groups[k]])} for k in order
            ]
        else:
            sizes = sorted({len(crashed) for crashed, _ in groups})
            rows = [
                {"crashed": n, **_summary([g for k, g in groups.items() if len(k[0]) == n])}
                for n in sizes
            ]
        if together and len(rows) > 1:
            rows.append({"crashed": None, **_summary(list(groups.values()))})
        return rows


def _summary(groups: Sequence[_Group]) -> dict[str, Any]:
    returns = np.concatenate([np.array(group.returns) for group in groups])
    steps = np.concatenate([np.array(group.steps) for group in groups])
    n, successes = len(returns), sum(group.successes for group in groups)
    success = wilson(successes, n)
    told: list[float | None] = [float(returns.mean()), None, None]
    alike = n > 1 and successes in (0, n) and np.ptp(returns) == 0 and np.ptp(steps) == 0
    if n > 1 and not alike:
        mean = mean_interval(returns)
        told = [mean.value, mean.low, mean.high]
    return {
        "episodes": n,
        "success": [success.value, success.low, success.high],
        "return": told,
        "steps": float(steps.mean()),
        "alike": bool(alike),
    }
