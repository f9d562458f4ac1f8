"""Recorded episodes as a fixed data set in memory: checked, ordered, bounded.

Episodes are ordered by their seed, number and content, so that the same recordings give the same
data set whatever files they lie in and in whatever order those are named.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import EnvSpec, UserError
from policy_pkg.bags.about import same_scenario
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.replay import Replay

Array = npt.NDArray[Any]
MIB = 2**20


class Recorded(Protocol):
    """What is needed of a recorded episode; ``bags.dataset.RecordedEpisode`` is one."""

    @property
    def robots(self) -> tuple[str, ...]: ...
    @property
    def episode(self) -> Episode: ...
    @property
    def intents(self) -> npt.NDArray[np.int32]: ...  # (T, n) what policies wanted; -1: unknown
    @property
    def success(self) -> bool: ...
    @property
    def seed(self) -> int: ...
    @property
    def number(self) -> int: ...
    @property
    def scenario(self) -> str: ...  # name or file; "": not known


class DataError(UserError):
    """Recordings that cannot be learned from as asked."""


@dataclass(frozen=True)
class FixedData:
    """N episodes. ``crashed``: (N,) how many robots had a fault in force at some step."""

    robots: tuple[str, ...]
    episodes: Replay
    crashed: npt.NDArray[np.int64]
    success_rate: float
    duplicates: int  # episodes that another one equals bit for bit, seed and number included
    sha256: str  # of all episodes in their order

    @property
    def sizes(self) -> Sizes:
        return self.episodes.sizes

    def __len__(self) -> int:
        return len(self.episodes)


@dataclass(frozen=True)
class _Entry:
    """An episode that was read, and what it is sorted by."""

    key: tuple[int, int, str]
    episode: Episode
    success: bool


def load_data(
    recorded: Iterable[Recorded],
    spec: EnvSpec | None,
    memory_limit_mib: int,
    numbers: tuple[int, int] | None = None,
) -> FixedData:
    """Reads every episode, or those whose number is in ``numbers``, first and last.

    Args:
        recorded: in any order; consumed one at a time.
        spec: of the scenario that they must fit; None: not known, then the first one sets the
            sizes, and the longest one the episode limit.
        memory_limit_mib: of the data set; while it is read it may take twice as much.

    Raises:
        DataError: there is no episode, one does not fit the scenario or the others or contradicts
            itself, or they take more memory than allowed.
    """
    sizes = None if spec is None else Sizes.of(spec)
    robots = () if spec is None else spec.robots
    name = "the first episode" if spec is None else f"scenario {spec.scenario!r}"
    entries: list[_Entry] = []
    longest = 0
    for one in recorded:
        if numbers is not None and not numbers[0] <= one.number <= numbers[1]:
            continue
        if sizes is None:
            sizes, robots = _sizes_of(one.episode), one.robots
        longest = max(longest, one.episode.length)
        if spec is None:
            sizes = replace(sizes, episode_limit=longest)
        if spec is not None and not same_scenario(one.scenario, spec.scenario):
            raise DataError(
                f"{_where(one)} was recorded on scenario {one.scenario!r}, not on "
                f"{spec.scenario!r} as the configuration says"
            )
        _check(one, robots, sizes, name)
        entries.append(_entry(one))
        _check_bound(sizes, len(entries), memory_limit_mib)
    if sizes is None or not entries:
        which = "" if numbers is None else f" numbered {numbers[0]} to {numbers[1]}"
        raise DataError(
            f"the recordings hold no complete episode{which}: there is nothing to learn from"
        )
    entries.sort(key=lambda entry: entry.key)
    return _fixed(robots, deque(entries), sizes)


def _sizes_of(episode: Episode) -> Sizes:
    for name, axes in (("obs", 3), ("state", 2), ("available", 3)):
        array: Array = getattr(episode, name)
        if array.ndim != axes:
            raise DataError(f"the first episode's {name} has the shape {array.shape}")
    return Sizes(
        n_robots=episode.obs.shape[1],
        n_actions=episode.available.shape[2],
        obs_size=episode.obs.shape[2],
        state_size=episode.state.shape[1],
        episode_limit=episode.length,
    )


def _where(one: Recorded) -> str:
    return f"episode {one.number} of seed {one.seed}"


def _check(one: Recorded, robots: tuple[str, ...], sizes: Sizes, name: str) -> None:
    """Raises DataError naming the episode, what is wrong with it and what it had to fit."""
    episode, where = one.episode, _where(one)
    if one.robots != robots:
        raise DataError(
            f"{where} has {len(one.robots)} robots ({', '.join(one.robots)}), "
            f"{name} has {len(robots)} ({', '.join(robots)})"
        )
    try:
        episode.check(sizes)
    except ValueError as error:
        raise DataError(f"{where} does not fit {name}: {error}") from error
    for array_name in ("obs", "state", "reward"):
        bad = np.argwhere(~np.isfinite(getattr(episode, array_name)))
        if len(bad):
            raise DataError(f"{where}: {array_name} is not finite at step {bad[0][0]}")
    _check_actions(one, where)


def _check_actions(one: Recorded, where: str) -> None:
    episode = one.episode
    executed = episode.actions[:, :, np.newaxis]
    allowed = np.take_along_axis(episode.available[:-1], executed, 2)[:, :, 0]
    wrong = np.argwhere(~allowed)
    if len(wrong):
        step, robot = wrong[0]
        raise DataError(
            f"{where}, step {step}, {one.robots[robot]}: executed action "
            f"{episode.actions[step, robot]}, which was not available"
        )
    if one.intents.shape != episode.actions.shape:
        raise DataError(
            f"{where}: intents have the shape {one.intents.shape}, actions {episode.actions.shape}"
        )
    differ = (one.intents != episode.actions) & (one.intents >= 0)
    wrong = np.argwhere(differ & (episode.faults == 0))
    if len(wrong):
        step, robot = wrong[0]
        raise DataError(
            f"{where}, step {step}, {one.robots[robot]}: wanted action {one.intents[step, robot]} "
            f"and executed {episode.actions[step, robot]} without a fault"
        )


def _entry(one: Recorded) -> _Entry:
    digest = hashlib.sha256()
    episode = one.episode
    digest.update(f"{episode.length} {episode.terminated} {one.success}".encode())
    for field in fields(Episode):
        if field.name != "terminated":
            digest.update(np.ascontiguousarray(getattr(episode, field.name)).tobytes())
    return _Entry((one.seed, one.number, digest.hexdigest()), episode, one.success)


def _check_bound(sizes: Sizes, count: int, memory_limit_mib: int) -> None:
    """The ring keeps a place of full length for every episode."""
    per_step = 4 * sizes.n_robots + 4 + sizes.n_robots
    per_row = sizes.n_robots * (4 * sizes.obs_size + sizes.n_actions) + 4 * sizes.state_size
    limit = sizes.episode_limit
    needed = count * ((limit + 1) * per_row + limit * per_step)
    if needed > memory_limit_mib * MIB:
        raise DataError(
            f"{count} episodes of up to {limit} steps take {needed / MIB:.1f} MiB, more than "
            f"memory_limit_mib {memory_limit_mib}: raise that key, or give fewer recordings"
        )


def _fixed(robots: tuple[str, ...], entries: deque[_Entry], sizes: Sizes) -> FixedData:
    """Moves the entries into the ring, which frees them one by one."""
    count = len(entries)
    keys = {entry.key for entry in entries}
    digest = hashlib.sha256("\n".join(str(entry.key) for entry in entries).encode())
    successes = sum(entry.success for entry in entries)
    ring, crashed = Replay(count, sizes), np.zeros(count, np.int64)
    for index in range(count):
        episode = entries.popleft().episode
        ring.add(episode)
        crashed[index] = np.count_nonzero(episode.faults.any(axis=0))
    return FixedData(
        robots=robots,
        episodes=ring,
        crashed=crashed,
        success_rate=successes / count,
        duplicates=count - len(keys),
        sha256=digest.hexdigest(),
    )
