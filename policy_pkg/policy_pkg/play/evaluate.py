"""Greedy evaluation under crashes, and the results' dataclasses, which the ROS path fills too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BatchEnv, EnvSpec, IntArray, UserError
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.effects import EffectRow
from crash_coach_pkg.faults import unmet_needs
from crash_coach_pkg.plan import Planner
from crash_coach_pkg.team import TeamSpec
from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.play.arenas import ArenaArray, Arenas, Executed
from policy_pkg.play.conditions import Condition, Planned
from policy_pkg.play.teams import RecurrentTeam, ScriptedTeam, Team, offers
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.statistics import Estimate, wilson
from sim_pkg.env import Env, ScenarioLike, make_any_env, make_env
from sim_pkg.render.frames import Frames, Recorder
from sim_pkg.scripted import ConfiguredEnv, make_scripted
from sim_pkg.trajectory import CourseHash, TrajectoryHash, combine

if TYPE_CHECKING:
    from sim_pkg.foreign.pictures import Pictures

EVALUATION = 1 << 62  # beyond every seed of a training, and so of its blocks


def evaluation_seed(seed: int) -> int:
    """What keys the episodes of an evaluation with ``seed``: none that a training has played.

    Trainings are keyed by their seed as it is, their evaluation blocks by another one below 2^62.

    Raises:
        UserError: a seed that is negative, or 2^62 or more.
    """
    if not 0 <= seed < EVALUATION:
        raise UserError(f"seed {seed}: a number from 0 to 2^62 - 1 is needed for an evaluation")
    return seed | EVALUATION


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluated episode."""

    episode: int
    success: bool
    episode_return: float  # undiscounted sum of the team's rewards
    steps: int
    crashed: tuple[int, ...]  # indexes of the robots that were faulted in some step
    trajectory_hash: str
    course_hash: str  # equal for episodes that went alike, see sim_pkg.trajectory


@dataclass(frozen=True)
class Evaluation:
    """All episodes of one condition, in episode order.

    ``drawn``: as of the condition.
    ``effects``: sorted, if asked for: ACTIVE and CLEARED where a stretch of a fault begins and ends
    within its episode, EFFECT per robot-step with a command, or (OBSERVED) observation fault.
    ``reports_success``: whether the scenario tells what a success is; if not, rates mean nothing.
    """

    condition: str
    robots: tuple[str, ...]
    seed: int
    episodes: tuple[EpisodeResult, ...]
    effects: tuple[EffectRow, ...] = ()
    drawn: bool = True
    reports_success: bool = True

    @property
    def success_rate(self) -> float:
        return sum(e.success for e in self.episodes) / len(self.episodes)

    @property
    def return_mean(self) -> float:
        return float(np.mean([e.episode_return for e in self.episodes]))

    @property
    def alike(self) -> bool:
        """Whether the same episode was played again and again, with nothing left to chance.

        It is then one episode, and no interval says anything about it.
        """
        courses = {e.course_hash for e in self.episodes}
        left = self.drawn and not all(len(e.crashed) == len(self.robots) for e in self.episodes)
        return len(self.episodes) > 1 and len(courses) == 1 and not left

    @property
    def success(self) -> Estimate:
        """The success rate with Wilson's 95 % interval; without any width where ``alike``."""
        if self.alike:
            return Estimate(self.success_rate, self.success_rate, self.success_rate)
        return wilson(sum(e.success for e in self.episodes), len(self.episodes))

    def summary(self) -> dict[str, Any]:
        """JSON values. ``return_std`` is the sample's; ``crashed_fraction`` is per robot.

        ``success_ci95`` is null where the episodes are ``alike``, and with ``success_rate`` where
        the scenario reports no success.
        """
        returns = np.array([e.episode_return for e in self.episodes])
        interval = self.success
        crashed = sum(len(e.crashed) for e in self.episodes)
        known = self.reports_success and not self.alike
        return {
            "success_rate": self.success_rate if self.reports_success else None,
            "success_ci95": [interval.low, interval.high] if known else None,
            "return_mean": self.return_mean,
            "return_std": float(returns.std(ddof=1)) if len(returns) > 1 else 0.0,
            "steps_mean": float(np.mean([e.steps for e in self.episodes])),
            "crashed_fraction": crashed / (len(self.episodes) * len(self.robots)),
            "episodes": len(self.episodes),
            "alike": self.alike,
            "trajectory_hash": combine(e.trajectory_hash for e in self.episodes),
        }


@dataclass(frozen=True)
class Scripted:
    """A policy of sim_pkg.scripted, by its name."""

    name: str


def evaluate(
    target: PolicyBundle | RecurrentPolicy | Scripted,
    scenario: ScenarioLike,
    condition: Condition | Planned,
    episodes: int | range,
    seed: int,
    n_arenas: int = 32,
    effects: bool = False,
) -> Evaluation:
    """Plays ``episodes``, of a number the first so many, greedily; equal arguments, equal episodes.

    Neither ``n_arenas`` nor the policy changes which episodes and crashes are drawn, so methods
    evaluated with one seed are paired. ``effects``: keep Evaluation.effects.

    Raises:
        CheckpointError: the policy does not fit the scenario.
        ConfigError: unknown or wrong scenario, or a scripted policy that does not play it.
        UserError: ``episodes`` or the condition cannot be used with this scenario or policy.
    """
    numbers = episodes if isinstance(episodes, range) else range(episodes)
    if not numbers:
        raise UserError(f"episodes = {episodes}: at least 1 is needed")
    env = make_any_env(scenario, max(1, min(n_arenas, len(numbers))))
    run = _Run(env, _team(target, env), condition, seed, [] if effects else None)
    return run.evaluation(numbers)


def evaluate_in(
    env: BatchEnv,
    policy: RecurrentPolicy,
    condition: Condition | Planned,
    episodes: range,
    seed: int,
) -> Evaluation:
    """As ``evaluate``, in an environment that nothing else uses, for any range of episodes."""
    return _Run(env, RecurrentTeam(policy, env), condition, seed).evaluation(episodes)


def record(
    target: PolicyBundle | RecurrentPolicy | Scripted,
    scenario: ScenarioLike,
    condition: Condition | Planned,
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

    run = _Run(env, _team(target, env), condition, seed, recorder=recorder)
    run.evaluation(episodes)
    return sorted(run.recorded, key=lambda frames: frames.episode)


def record_pictures(
    target: PolicyBundle | RecurrentPolicy | Scripted,
    scenario: ScenarioLike,
    condition: Condition | Planned,
    episode: int,
    seed: int,
) -> Pictures:
    """As ``record``, of one episode of a pettingzoo: environment, which draws itself.

    Raises:
        UserError: as ``evaluate``, or the environment does not draw itself.
    """
    # Imported here: nothing else needs what draws.
    from sim_pkg.foreign.pictures import PictureRecorder, Pictures

    env = make_any_env(scenario, 1, pictures=True)
    if isinstance(env, Env):
        raise UserError(f"scenario {env.spec.scenario!r} is no pettingzoo: environment")

    def recorder(arena: int, episode: int) -> PictureRecorder:
        return PictureRecorder(env, arena, seed, episode)

    run = _Run(env, _team(target, env), condition, seed, recorder=recorder)
    run.evaluation(range(episode, episode + 1))
    env.close()
    (pictures,) = run.recorded
    assert isinstance(pictures, Pictures)
    return pictures


class EpisodeRecorder(Protocol):
    """Keeps what can be drawn of an arena's episode."""

    def step(
        self, intents: IntArray, actions: IntArray, faults: npt.NDArray[np.uint8], reward: float
    ) -> None:
        """After a control step. (n,) wanted and executed actions, and codes of faults in force."""
        ...

    def finish(self, success: bool, trajectory_hash: str) -> Any:
        """What was kept, when the episode has ended."""
        ...


def _team(target: PolicyBundle | RecurrentPolicy | Scripted, env: ConfiguredEnv) -> Team:
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
        condition: Condition | Planned,
        seed: int,
        effects: list[EffectRow] | None = None,
        recorder: Callable[[int, int], EpisodeRecorder] | None = None,
    ) -> None:
        self._env = env
        self._team = team
        self._condition = condition
        self._seed = seed
        self._effects = effects
        planner = _planner(condition, team, env.spec, seed)
        self._arenas = Arenas(env, team, planner.plan, seed, effects)
        self._hashes: dict[int, TrajectoryHash] = {}
        self._courses: dict[int, CourseHash] = {}
        self._faulted = np.zeros((env.n_arenas, env.spec.n_robots), dtype=np.bool_)
        self._recorder = recorder
        self._recorders: dict[int, EpisodeRecorder] = {}  # by arena, where a recorder was given
        self.recorded: list[Any] = []  # what the recorders kept of the episodes that have ended

    def evaluation(self, episodes: range) -> Evaluation:
        """Plays and sums up."""
        waiting = list(episodes)
        free: ArenaArray = np.arange(self._env.n_arenas)
        results: list[EpisodeResult] = []
        while waiting or self._arenas.running.any():
            self._start(free[: len(waiting)], waiting)
            seen = self._arenas.sense()
            intent = self._team.act(seen, self._env.available, self._arenas.last_action)
            self._observe()
            done = self._arenas.execute(intent, self._arenas.worst())
            self._account(done)
            free = self._arenas.count_step(done.result)
            results += [self._result(int(arena), done) for arena in free]
        results.sort(key=lambda result: result.episode)
        return Evaluation(
            self._condition.name,
            self._env.spec.robots,
            self._seed,
            tuple(results),
            tuple(sorted(self._effects or ())),
            self._condition.drawn,
            self._env.spec.reports_success,
        )

    def _start(self, arenas: ArenaArray, waiting: list[int]) -> None:
        """Takes as many episodes off ``waiting`` as there are arenas for them."""
        episodes = waiting[: len(arenas)]
        del waiting[: len(arenas)]
        self._arenas.start(arenas, np.array(episodes, dtype=np.int64))
        self._faulted[arenas] = False
        for arena, episode in zip(arenas.tolist(), episodes, strict=True):
            self._hashes[arena] = TrajectoryHash(self._seed, episode)
            self._courses[arena] = CourseHash()
            if self._recorder is not None:
                self._recorders[arena] = self._recorder(arena, episode)

    def _observe(self) -> None:
        obs, state = self._env.obs, self._env.state
        for arena in np.flatnonzero(self._arenas.running).tolist():
            self._hashes[arena].observe(obs[arena], state[arena])
            self._courses[arena].observe(state[arena])

    def _account(self, done: Executed) -> None:
        result = done.result
        self._faulted |= done.modes != 0
        for arena in np.flatnonzero(self._arenas.running).tolist():
            reward = float(result.reward[arena])
            self._hashes[arena].act(
                done.actions[arena],
                reward,
                bool(result.terminated[arena]),
                bool(result.truncated[arena]),
                bool(result.success[arena]),
            )
            self._courses[arena].act(done.actions[arena], reward)
            if arena in self._recorders:
                self._recorders[arena].step(
                    done.intent[arena], done.actions[arena], done.modes[arena], reward
                )

    def _result(self, arena: int, done: Executed) -> EpisodeResult:
        success = bool(done.result.success[arena])
        trajectory_hash = self._hashes[arena].hexdigest()
        if arena in self._recorders:
            self.recorded.append(self._recorders.pop(arena).finish(success, trajectory_hash))
        return EpisodeResult(
            episode=int(self._arenas.episodes[arena]),
            success=success,
            episode_return=float(self._arenas.returns[arena]),
            steps=int(self._arenas.steps[arena]),
            crashed=tuple(np.flatnonzero(self._faulted[arena]).tolist()),
            trajectory_hash=trajectory_hash,
            course_hash=self._courses[arena].finish(success),
        )


def _planner(condition: Condition | Planned, team: Team, spec: EnvSpec, seed: int) -> Planner:
    try:
        if isinstance(condition, Planned):
            return condition.planner(TeamSpec.of(spec), seed)
        coach = Coach(condition.crash, TeamSpec.of(spec), seed)
    except ValueError as error:
        raise UserError(f"condition {condition.name!r}: {error}") from error
    if reason := unmet_needs(condition.crash.crash_mode, offers(team)):
        raise UserError(f"condition {condition.name!r}: {reason}")
    return coach
