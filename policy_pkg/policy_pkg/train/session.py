"""All of a training run that changes while it runs, and the evaluation beside it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from crash_coach_common.contract import BatchEnv, EnvSpec, UserError
from crash_coach_pkg.coach.coach import BlockRecord, Coach
from crash_coach_pkg.coach.config import TeamSpec
from crash_coach_pkg.coach.strategies import Progress
from crash_coach_pkg.faults import unmet_needs
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.plan import CrashPlan
from policy_pkg.episode import Sizes
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.play.conditions import Condition, crash_free, named
from policy_pkg.play.evaluate import Evaluation, evaluate_in
from policy_pkg.play.rollout import Finished, Rollout
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import Means, Value

TEST_ARENAS = 32
_TEST_KEY = 0x7E57
EXPLORATION, SAMPLING = 1, 2  # streams of the run's seed

TRAIN_MEANS = ("train_success_rate", "train_return_mean", "train_steps_mean")
LEARNER_MEANS = ("loss", "grad_norm", "td_error_abs", "q_taken_mean", "target_mean")


@dataclass
class Counters:
    """Where a run stands. ``credit`` is the gradient steps owed, below 1 between steps."""

    env_steps: int = 0
    episodes: int = 0
    blocks: int = 0
    next_block_steps: int = 0
    credit: float = 0.0

    def to_json(self) -> dict[str, int | float]:
        return asdict(self)

    def block_due(self, total_steps: int) -> bool:
        """At step 0, whenever a multiple of the interval is passed, and at the end."""
        return self.env_steps >= min(self.next_block_steps, total_steps)

    def close_block(self, interval_steps: int) -> None:
        self.blocks += 1
        self.next_block_steps = (self.env_steps // interval_steps + 1) * interval_steps


def generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, stream])))


@dataclass(frozen=True)
class Block:
    """The greedy episodes of one evaluation block."""

    crashed: Evaluation  # crashes drawn at the coach's rate
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


@dataclass
class Session:
    """Collects, learns and tests; knows nothing of files and clocks.

    Args:
        config: of the run.
        env: for training; its arenas are this session's alone.
        test_env: for evaluation blocks.

    Raises:
        UserError: the coach's settings do not fit the scenario.
    """

    config: TrainConfig
    env: BatchEnv
    test_env: BatchEnv
    counters: Counters = field(default_factory=Counters)
    means: Means = field(default_factory=Means)

    def __post_init__(self) -> None:
        config, spec = self.config, self.env.spec
        try:
            self.coach = Coach(config.coach, TeamSpec.of(spec), config.seed)
        except ValueError as error:
            raise UserError(f"coach of scenario {spec.scenario!r}: {error}") from error
        if self.coach.needs_success and not spec.reports_success:
            raise UserError(
                f"scenario {spec.scenario!r} reports no success, which coach.strategy = "
                f"{config.coach.strategy!r} needs; use none, fixed or curriculum"
            )
        if reason := unmet_needs(config.coach.crash_mode, ACTION_OFFERS):
            raise UserError(f"coach of scenario {spec.scenario!r}: {reason}")
        sizes = Sizes.of(spec)
        self.learner = Learner(config.learner, sizes, config.seed)
        self.policy = RecurrentPolicy(self.learner.agent_weights(), spec.n_robots, spec.n_actions)
        self.replay = Replay(config.replay_episodes, sizes, config.replay_strata)
        self.best: tuple[float, ...] | None = None
        """Rank of the best block so far."""
        self.best_is_now = False
        """Whether that is the last one."""
        self.sampling = generator(config.seed, SAMPLING)
        exploration = generator(config.seed, EXPLORATION)
        self.rollout = Rollout(
            *(self.env, self.policy, self._plan, config.seed, exploration), config.explore_hold
        )

    @property
    def spec(self) -> EnvSpec:
        return self.env.spec

    @property
    def progress(self) -> Progress:
        done = self.counters
        return Progress(done.env_steps, self.config.total_steps, done.episodes)

    @property
    def finished(self) -> bool:
        return self.counters.env_steps >= self.config.total_steps

    @property
    def block_due(self) -> bool:
        return self.counters.block_due(self.config.total_steps)

    def _plan(self, episode: int) -> CrashPlan:
        return self.coach.plan(episode)  # looked up at each call: a profile times it

    def collect(self) -> None:
        """One step in every arena; learns after each episode that it ended, as PyMARL does.

        Raises:
            DivergedError: from the learner.
        """
        done = self.counters
        updates = self.learner.updates
        finished = self.rollout.step(self.config.epsilon(done.env_steps))
        done.env_steps += self.rollout.n_arenas
        for episode in finished:
            self._take(episode)
            self._learn()
        if self.learner.updates != updates:
            self.policy.set_weights(self.learner.agent_weights())

    def _take(self, finished: Finished) -> None:
        self.replay.add(finished.episode, finished.success)
        self.counters.episodes += 1
        self.coach.count(finished.plan)
        self.coach.advance(self.progress)
        results = (
            float(finished.success),
            float(finished.episode.reward.sum(dtype=np.float64)),
            float(finished.episode.length),
        )
        self.means.add(dict(zip(TRAIN_MEANS, results, strict=True)))

    def _learn(self) -> None:
        if len(self.replay) < self.config.batch_episodes:
            return
        self.counters.credit += self.config.updates_per_episode
        while self.counters.credit >= 1:
            self.counters.credit -= 1
            batch = self.replay.sample(self.sampling, self.config.batch_episodes)
            self.means.add(self.learner.update(batch, episodes=self.counters.episodes))

    def test(self) -> Block:
        """Plays the block's episodes greedily; each block has episodes of its own."""
        count = self.config.test_episodes
        episodes = range(self.counters.blocks * count, (self.counters.blocks + 1) * count)
        crash = self.config.coach
        if crash.strategy != "none":
            at_rate = {"strategy": "fixed", "crash_rate": self.coach.rate}
            crash = crash.model_copy(update=at_rate)
        block = self._play(Condition("block", crash), episodes)
        victims = self._victims()
        if not self.config.test_crash_free:
            return Block(block, None, victims)
        if not any(episode.crashed for episode in block.episodes):
            return Block(block, block, victims)  # the same seeds: the same episodes
        return Block(block, self._play(crash_free(), episodes), victims)

    def _victims(self) -> tuple[Evaluation, ...]:
        """Each robot alone crashed, in the coach's mode and for whole episodes."""
        count, crash = self.config.test_victim_episodes, self.config.coach
        episodes = range(self.counters.blocks * count, (self.counters.blocks + 1) * count)
        return tuple(
            self._play(named((robot,), crash.crash_mode, crash.crash_parameters), episodes)
            for robot in (self.env.spec.robots if count else ())
        )

    def _play(self, condition: Condition, episodes: range) -> Evaluation:
        seed = self.config.seed ^ _TEST_KEY
        return evaluate_in(self.test_env, self.policy, condition, episodes, seed)

    def end_block(self, block: Block) -> dict[str, Value]:
        """Tells the coach e_t; returns the block's line of metrics."""
        done, config = self.counters, self.config
        self.best_is_now = self.best is None or block.rank >= self.best
        if self.best_is_now:
            self.best = block.rank
        record = self.coach.record_block(block.crashed.success_rate, self.progress)
        done.close_block(config.test_interval_steps)
        means = self.means.take(TRAIN_MEANS + LEARNER_MEANS)
        updates, reports_success = self.learner.updates, self.env.spec.reports_success
        return block_line(config, done, updates, record, block, means, reports_success)

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        """Tensor files by stem, and JSON values."""
        learner, learner_values = self.learner.state_dict()
        rollout, rollout_values = self.rollout.state_dict()
        tensors = {"agent": self.learner.agent_weights(), "learner": learner, "rollout": rollout}
        if self.config.checkpoint_replay:
            tensors["replay"] = self.replay.state_dict()
        values = {
            "coach": self.coach.state_dict(),
            "learner": learner_values,
            "rollout": rollout_values,
            "sampling": dict(self.sampling.bit_generator.state),
            "means": self.means.state_dict(),
            "best": self.best,
        }
        return tensors, values

    def load_state_dict(
        self, tensors: dict[str, dict[str, Any]], values: dict[str, Any], counters: Counters
    ) -> None:
        """Continues from what ``state_dict`` gave; only for a session not yet used.

        Raises:
            ValueError, KeyError: it is of something else, or incomplete.
        """
        self.learner.load_state_dict(tensors["learner"], values["learner"])
        self.policy.set_weights(self.learner.agent_weights())
        self.rollout.load_state_dict(tensors["rollout"], values["rollout"])
        if self.config.checkpoint_replay:
            self.replay.load_state_dict(tensors["replay"])
        self.coach.load_state_dict(values["coach"])
        self.sampling.bit_generator.state = values["sampling"]
        self.means.load_state_dict(values["means"])
        self.best = None if values["best"] is None else tuple(map(float, values["best"]))
        self.counters = counters
