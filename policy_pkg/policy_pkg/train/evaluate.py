"""Greedy evaluation under crashes, and the results' dataclasses, which the ROS path fills too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_pkg.coach import Coach
from crash_coach_pkg.config import CoachConfig
from crash_coach_pkg.plan import CrashPlan
from policy_pkg.act import greedy
from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.arenas import ArenaArray, Arenas, Executed
from policy_pkg.train.statistics import wilson
from sim_pkg.contract import BatchEnv, UserError
from sim_pkg.env import make_env
from sim_pkg.trajectory import TrajectoryHash, combine


@dataclass(frozen=True)
class Condition:
    """Under which crashes a policy is evaluated."""

    name: str
    crash: CoachConfig


def crash_free() -> Condition:
    return Condition("crash-free", CoachConfig())


def at_rate(rate: float, mode: str = "mute") -> Condition:
    """Every robot crashes on its own with probability ``rate``; no re-sampling (the paper's)."""
    settings = {"crash_rate": rate, "crash_mode": mode, "resample": False}
    return _fixed(f"rate {rate:g}", settings)


def exactly(count: int, mode: str = "mute") -> Condition:
    """``count`` uniformly drawn robots crash in every episode."""
    return _fixed(f"{count} crashed", {"crashed_exactly": count, "crash_mode": mode})


def named(victims: Sequence[str], mode: str = "mute") -> Condition:
    """These robots crash in every episode."""
    settings = {"victims": tuple(victims), "crash_mode": mode}
    return _fixed(f"{', '.join(victims)} {mode}", settings)


def _fixed(name: str, settings: dict[str, Any]) -> Condition:
    return Condition(name, CoachConfig.model_validate({"strategy": "fixed", **settings}))


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluated episode."""

    episode: int
    success: bool
    episode_return: float  # undiscounted sum of the team's rewards
    steps: int
    crashed: tuple[int, ...]  # indexes of the robots that the plan faults
    trajectory_hash: str
    positions_m: npt.NDArray[np.float32] | None = None  # (T+1, n, 2), where it was asked for


@dataclass(frozen=True)
class Evaluation:
    """All episodes of one condition, in episode order."""

    condition: str
    robots: tuple[str, ...]
    seed: int
    episodes: tuple[EpisodeResult, ...]

    @property
    def success_rate(self) -> float:
        return sum(e.success for e in self.episodes) / len(self.episodes)

    @property
    def return_mean(self) -> float:
        return float(np.mean([e.episode_return for e in self.episodes]))

    def summary(self) -> dict[str, Any]:
        """JSON values. ``return_std`` is the sample's; ``crashed_fraction`` is per robot."""
        returns = np.array([e.episode_return for e in self.episodes])
        interval = wilson(sum(e.success for e in self.episodes), len(self.episodes))
        crashed = sum(len(e.crashed) for e in self.episodes)
        return {
            "success_rate": self.success_rate,
            "success_ci95": [interval.low, interval.high],
            "return_mean": self.return_mean,
            "return_std": float(returns.std(ddof=1)) if len(returns) > 1 else 0.0,
            "steps_mean": float(np.mean([e.steps for e in self.episodes])),
            "crashed_fraction": crashed / (len(self.episodes) * len(self.robots)),
            "episodes": len(self.episodes),
            "trajectory_hash": combine(e.trajectory_hash for e in self.episodes),
        }


def evaluate(
    target: PolicyBundle | RecurrentPolicy,
    scenario: str | Path,
    condition: Condition,
    episodes: int,
    seed: int,
    n_arenas: int = 32,
    record_positions: bool = False,
) -> Evaluation:
    """Plays episodes 0 .. ``episodes`` - 1 greedily; equal arguments give equal episodes.

    Neither ``n_arenas`` nor the policy changes which episodes and crashes are drawn, so methods
    evaluated with one seed are paired.

    Raises:
        CheckpointError: the policy does not fit the scenario.
        ConfigError: unknown or wrong scenario.
        UserError: ``episodes`` or the condition cannot be used with this scenario.
    """
    if episodes < 1:
        raise UserError(f"episodes = {episodes}: at least 1 is needed")
    env = make_env(scenario, max(1, min(n_arenas, episodes)))
    if isinstance(target, PolicyBundle):
        target.check_spec(env.spec)
    policy = target.policy if isinstance(target, PolicyBundle) else target
    return evaluate_in(env, policy, condition, range(episodes), seed, record_positions)


def evaluate_in(
    env: BatchEnv,
    policy: RecurrentPolicy,
    condition: Condition,
    episodes: range,
    seed: int,
    record_positions: bool = False,
) -> Evaluation:
    """As ``evaluate``, in an environment that nothing else uses, for any range of episodes."""
    robots = env.spec.robots
    try:
        coach = Coach(condition.crash, robots, seed)
    except ValueError as error:
        raise UserError(f"condition {condition.name!r}: {error}") from error
    run = _Run(env, policy, coach, seed, record_positions)
    results = run.play(episodes)
    return Evaluation(condition.name, robots, seed, tuple(results))


class _Run:
    """Plays a list of episodes, every arena taking the next one when it is free."""

    def __init__(
        self,
        env: BatchEnv,
        policy: RecurrentPolicy,
        coach: Coach,
        seed: int,
        record_positions: bool,
    ) -> None:
        self._env = env
        self._seed = seed
        self._record_positions = record_positions
        self._arenas = Arenas(env, policy, coach.plan, seed)
        self._hashes: dict[int, TrajectoryHash] = {}
        self._returns = np.zeros(env.n_arenas, dtype=np.float64)
        self._positions: dict[int, list[npt.NDArray[np.float32]]] = {}

    def play(self, episodes: range) -> list[EpisodeResult]:
        waiting = list(episodes)
        free: ArenaArray = np.arange(self._env.n_arenas)
        results: list[EpisodeResult] = []
        while waiting or self._arenas.running.any():
            self._start(free[: len(waiting)], waiting)
            intent = greedy(self._arenas.values(), self._env.available)
            self._observe()
            done = self._arenas.execute(intent)
            self._account(done)
            free = self._arenas.count_step(done.result)
            results += [self._result(int(arena), done) for arena in free]
        return sorted(results, key=lambda result: result.episode)

    def _start(self, arenas: ArenaArray, waiting: list[int]) -> None:
        """Takes as many episodes off ``waiting`` as there are arenas for them."""
        episodes = waiting[: len(arenas)]
        del waiting[: len(arenas)]
        self._arenas.start(arenas, np.array(episodes, dtype=np.int64))
        self._returns[arenas] = 0.0
        for arena, episode in zip(arenas.tolist(), episodes, strict=True):
            self._hashes[arena] = TrajectoryHash(self._seed, episode)
            self._positions[arena] = []

    def _observe(self) -> None:
        obs, state = self._env.obs, self._env.state
        for arena in np.flatnonzero(self._arenas.running).tolist():
            self._hashes[arena].observe(obs[arena], state[arena])
            self._note_position(arena)

    def _note_position(self, arena: int) -> None:
        if self._record_positions:
            self._positions[arena].append(self._env.positions_m[arena].copy())

    def _account(self, done: Executed) -> None:
        result = done.result
        for arena in np.flatnonzero(self._arenas.running).tolist():
            self._returns[arena] += result.reward[arena]
            self._hashes[arena].act(
                done.actions[arena],
                float(result.reward[arena]),
                bool(result.terminated[arena]),
                bool(result.truncated[arena]),
                bool(result.success[arena]),
            )

    def _result(self, arena: int, done: Executed) -> EpisodeResult:
        self._note_position(arena)
        plan = self._arenas.plans[arena]
        positions = self._positions[arena]
        return EpisodeResult(
            episode=int(self._arenas.episodes[arena]),
            success=bool(done.result.success[arena]),
            episode_return=float(self._returns[arena]),
            steps=int(self._arenas.steps[arena]),
            crashed=_faulted(plan),
            trajectory_hash=self._hashes[arena].hexdigest(),
            positions_m=np.stack(positions) if positions else None,
        )


def _faulted(plan: CrashPlan | None) -> tuple[int, ...]:
    return () if plan is None else tuple(sorted({fault.robot for fault in plan.faults}))
