"""Greedy evaluation under crashes, and the results' dataclasses, which the ROS path fills too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crash_coach_pkg.coach import Coach
from crash_coach_pkg.config import CoachConfig
from crash_coach_pkg.plan import CrashPlan
from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.arenas import ArenaArray, Arenas, Executed
from policy_pkg.train.statistics import wilson
from policy_pkg.train.teams import RecurrentTeam, ScriptedTeam, Team
from sim_pkg.contract import BatchEnv, UserError
from sim_pkg.env import Env, make_env
from sim_pkg.frames import Frames, Recorder
from sim_pkg.scripted import make_scripted
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


@dataclass(frozen=True)
class Scripted:
    """A policy of sim_pkg.scripted, by its name."""

    name: str


def evaluate(
    target: PolicyBundle | RecurrentPolicy | Scripted,
    scenario: str | Path,
    condition: Condition,
    episodes: int,
    seed: int,
    n_arenas: int = 32,
) -> Evaluation:
    """Plays episodes 0 .. ``episodes`` - 1 greedily; equal arguments give equal episodes.

    Neither ``n_arenas`` nor the policy changes which episodes and crashes are drawn, so methods
    evaluated with one seed are paired.

    Raises:
        CheckpointError: the policy does not fit the scenario.
        ConfigError: unknown or wrong scenario, or a scripted policy that does not play it.
        UserError: ``episodes`` or the condition cannot be used with this scenario.
    """
    if episodes < 1:
        raise UserError(f"episodes = {episodes}: at least 1 is needed")
    env = make_env(scenario, max(1, min(n_arenas, episodes)))
    run = _Run(env, _team(target, env), condition, seed)
    return run.evaluation(range(episodes))


def evaluate_in(
    env: BatchEnv, policy: RecurrentPolicy, condition: Condition, episodes: range, seed: int
) -> Evaluation:
    """As ``evaluate``, in an environment that nothing else uses, for any range of episodes."""
    return _Run(env, RecurrentTeam(policy, env), condition, seed).evaluation(episodes)


def record(
    target: PolicyBundle | RecurrentPolicy | Scripted,
    scenario: str | Path,
    condition: Condition,
    episodes: range,
    seed: int,
    n_arenas: int = 32,
) -> list[Frames]:
    """Plays episodes as ``evaluate`` does, and keeps what can be drawn of each; in their order.

    Raises:
        As ``evaluate``.
    """
    env = make_env(scenario, max(1, min(n_arenas, len(episodes))))

    def recorder(arena: int, episode: int) -> Recorder:
        return Recorder(env, arena, seed, episode)

    run = _Run(env, _team(target, env), condition, seed, recorder)
    run.evaluation(episodes)
    return sorted(run.frames, key=lambda frames: frames.episode)


def _team(target: PolicyBundle | RecurrentPolicy | Scripted, env: Env) -> Team:
    if isinstance(target, Scripted):
        return ScriptedTeam(make_scripted(target.name, env), env)
    if isinstance(target, PolicyBundle):
        target.check_spec(env.spec)
        target = target.policy
    return RecurrentTeam(target, env)


class _Run:
    """Plays a list of episodes, every arena taking the next one when it is free."""

    def __init__(
        self,
        env: BatchEnv,
        team: Team,
        condition: Condition,
        seed: int,
        recorder: Callable[[int, int], Recorder] | None = None,
    ) -> None:
        try:
            coach = Coach(condition.crash, env.spec.robots, seed)
        except ValueError as error:
            raise UserError(f"condition {condition.name!r}: {error}") from error
        self._env = env
        self._team = team
        self._condition = condition
        self._seed = seed
        self._arenas = Arenas(env, team, coach.plan, seed)
        self._hashes: dict[int, TrajectoryHash] = {}
        self._returns = np.zeros(env.n_arenas, dtype=np.float64)
        self._recorder = recorder
        self._recorders: dict[int, Recorder] = {}  # by arena, where a recorder was given
        self.frames: list[Frames] = []  # of the episodes that have ended

    def evaluation(self, episodes: range) -> Evaluation:
        """Plays and sums up."""
        waiting = list(episodes)
        free: ArenaArray = np.arange(self._env.n_arenas)
        results: list[EpisodeResult] = []
        while waiting or self._arenas.running.any():
            self._start(free[: len(waiting)], waiting)
            intent = self._team.act(self._env.obs, self._env.available, self._arenas.last_action)
            self._observe()
            done = self._arenas.execute(intent)
            self._account(done)
            free = self._arenas.count_step(done.result)
            results += [self._result(int(arena), done) for arena in free]
        results.sort(key=lambda result: result.episode)
        return Evaluation(self._condition.name, self._env.spec.robots, self._seed, tuple(results))

    def _start(self, arenas: ArenaArray, waiting: list[int]) -> None:
        """Takes as many episodes off ``waiting`` as there are arenas for them."""
        episodes = waiting[: len(arenas)]
        del waiting[: len(arenas)]
        self._arenas.start(arenas, np.array(episodes, dtype=np.int64))
        self._returns[arenas] = 0.0
        for arena, episode in zip(arenas.tolist(), episodes, strict=True):
            self._hashes[arena] = TrajectoryHash(self._seed, episode)
            if self._recorder is not None:
                self._recorders[arena] = self._recorder(arena, episode)

    def _observe(self) -> None:
        obs, state = self._env.obs, self._env.state
        for arena in np.flatnonzero(self._arenas.running).tolist():
            self._hashes[arena].observe(obs[arena], state[arena])

    def _account(self, done: Executed) -> None:
        result = done.result
        for arena in np.flatnonzero(self._arenas.running).tolist():
            reward = float(result.reward[arena])
            self._returns[arena] += reward
            self._hashes[arena].act(
                done.actions[arena],
                reward,
                bool(result.terminated[arena]),
                bool(result.truncated[arena]),
                bool(result.success[arena]),
            )
            if arena in self._recorders:
                self._recorders[arena].step(done.modes[arena] != 0, reward)

    def _result(self, arena: int, done: Executed) -> EpisodeResult:
        success = bool(done.result.success[arena])
        trajectory_hash = self._hashes[arena].hexdigest()
        if arena in self._recorders:
            self.frames.append(self._recorders.pop(arena).finish(success, trajectory_hash))
        return EpisodeResult(
            episode=int(self._arenas.episodes[arena]),
            success=success,
            episode_return=float(self._returns[arena]),
            steps=int(self._arenas.steps[arena]),
            crashed=_faulted(self._arenas.plans[arena]),
            trajectory_hash=trajectory_hash,
        )


def _faulted(plan: CrashPlan | None) -> tuple[int, ...]:
    return () if plan is None else tuple(sorted({fault.robot for fault in plan.faults}))
