"""What changes while a run learns from the episodes that it plays itself."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from crash_coach_common.contract import BatchEnv, EnvSpec, UserError
from crash_coach_pkg.coach.coach import BlockRecord, Coach
from crash_coach_pkg.coach.strategies.base import Progress
from crash_coach_pkg.faults import unmet_needs
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.team import TeamSpec
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.play.conditions import Condition, Planned, crash_free, named
from policy_pkg.play.evaluate import Evaluation, evaluate_in
from policy_pkg.play.rollout import Finished, Rollout
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.blocks import Block, Counters, block_line
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import Means, Value
from policy_pkg.train.snapshot import Team

TEST_ARENAS = 32
TEST_KEY = 0x7E57
EXPLORATION, SAMPLING = 1, 2  # streams of the run's seed

TRAIN_MEANS = ("train_success_rate", "train_return_mean", "train_steps_mean")
LEARNER_MEANS = ("loss", "grad_norm", "td_error_abs", "q_taken_mean", "target_mean")


def generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, stream])))


class EpisodeSession:
    """What learning from episodes that come one by one needs, wherever they are played.

    Args:
        config: of the run.
        spec: of the team.
    """

    STEPS: ClassVar[str] = "env_steps"

    def __init__(self, config: TrainConfig, spec: EnvSpec) -> None:
        self.config, self.spec = config, spec
        sizes = Sizes.of(spec)
        self.learner = Learner(config.learner, sizes, config.seed)
        self.replay = Replay(config.replay_episodes, sizes, config.replay_strata)
        self.sampling = generator(config.seed, SAMPLING)
        self.counters, self.means = Counters(), Means()

    @property
    def team(self) -> Team:
        spec = self.spec
        return Team(self.config.scenario, spec.robots, spec.n_actions, spec.obs_size)

    @property
    def steps(self) -> int:
        return self.counters.env_steps

    @property
    def total_steps(self) -> int:
        return self.config.total_steps

    @property
    def episodes(self) -> int:
        return self.counters.episodes

    @property
    def epsilon(self) -> float:
        return self.config.epsilon(self.counters.env_steps)

    @property
    def finished(self) -> bool:
        return self.counters.finished(self.steps, self.total_steps)

    @property
    def stems(self) -> tuple[str, ...]:
        return ("learner", "replay") if self.config.checkpoint_replay else ("learner",)

    def _keep(self, episode: Episode, success: bool) -> None:
        """Into the replay. Raises ValueError where it does not fit."""
        self.replay.add(episode, success)
        self.counters.episodes += 1
        results = (
            float(success),
            float(episode.reward.sum(dtype=np.float64)),
            float(episode.length),
        )
        self.means.add(dict(zip(TRAIN_MEANS, results, strict=True)))

    def _learn(self) -> None:
        """The gradient steps that an episode gives credit for."""
        done, config = self.counters, self.config
        if len(self.replay) < config.batch_episodes:
            return
        done.credit += config.updates_per_episode
        while done.credit >= 1:
            done.credit -= 1
            batch = self.replay.sample(self.sampling, config.batch_episodes)
            weighted = config.replay_weights == "importance"
            weights = self.replay.importance(batch) if weighted else None
            self.means.add(self.learner.update(batch, episodes=done.episodes, weights=weights))

    def _close(self, record: BlockRecord, block: Block) -> dict[str, Value]:
        """Closes a block; its line of metrics."""
        done, config = self.counters, self.config
        done.close(done.env_steps, config.test_interval_steps, config.total_steps)
        means = self.means.take(TRAIN_MEANS + LEARNER_MEANS)
        updates, reports = self.learner.updates, self.spec.reports_success
        return block_line(config, done, updates, record, block, means, reports)

    def counts(self) -> dict[str, int | float]:
        return self.counters.to_json()

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        """Tensor files by stem, and JSON values."""
        learner, learner_values = self.learner.state_dict()
        tensors = {"agent": self.learner.agent_weights(), "learner": learner}
        if self.config.checkpoint_replay:
            tensors["replay"] = self.replay.state_dict()
        values = {
            "learner": learner_values,
            "sampling": dict(self.sampling.bit_generator.state),
            "means": self.means.state_dict(),
        }
        return tensors, values

    def load_state_dict(
        self,
        tensors: dict[str, dict[str, Any]],
        values: dict[str, Any],
        counts: dict[str, Any],
    ) -> None:
        """Continues from what ``state_dict`` and ``counts`` gave; for a session not yet used.

        Raises:
            ValueError, KeyError, TypeError: it is of something else, or incomplete.
        """
        self.learner.load_state_dict(tensors["learner"], values["learner"])
        if self.config.checkpoint_replay:
            self.replay.load_state_dict(tensors["replay"])
        self.sampling.bit_generator.state = values["sampling"]
        self.means.load_state_dict(values["means"])
        self.counters = Counters(**counts)
        self.counters.bound(self.steps, self.total_steps)


class TrainSession(EpisodeSession):
    """Collects, learns and tests; knows nothing of files and clocks.

    Args:
        config: of the run.
        env: for training; its arenas are this session's alone.
        test_env: for evaluation blocks.

    Raises:
        UserError: the coach's settings do not fit the scenario.
    """

    VERB: ClassVar[str] = "train"

    def __init__(self, config: TrainConfig, env: BatchEnv, test_env: BatchEnv) -> None:
        spec = env.spec
        try:
            self.coach = Coach(config.coach, TeamSpec.of(spec), config.seed)
        except ValueError as error:
            raise UserError(f"coach of scenario {spec.scenario!r}: {error}") from error
        self.coach.check_scenario(spec)
        if reason := unmet_needs(config.coach.crash_mode, ACTION_OFFERS):
            raise UserError(f"coach of scenario {spec.scenario!r}: {reason}")
        super().__init__(config, spec)
        self.env, self.test_env = env, test_env
        self.policy = RecurrentPolicy(self.learner.agent_weights(), spec.n_robots, spec.n_actions)
        self.best: tuple[float, ...] | None = None
        """Rank of the best block so far."""
        self.best_is_now = False
        """Whether that is the last one."""
        exploration = generator(config.seed, EXPLORATION)
        self.rollout = Rollout(
            *(env, self.policy, self._plan, config.seed, exploration), config.explore_hold
        )

    @property
    def stems(self) -> tuple[str, ...]:
        return (*super().stems, "rollout")

    @property
    def alpha(self) -> float:
        return self.coach.rate

    @property
    def progress(self) -> Progress:
        done = self.counters
        return Progress(done.env_steps, self.config.total_steps, done.episodes)

    @property
    def block_due(self) -> bool:
        return self.counters.due(self.steps)

    def _plan(self, episode: int) -> CrashPlan:
        return self.coach.plan(episode)  # looked up at each call: a profile times it

    def advance(self) -> None:
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
        self._keep(finished.episode, finished.success)
        self.coach.finish(finished.plan, finished.success, self.progress)

    def test(self) -> Block:
        """Plays the block's episodes greedily; each block has episodes of its own."""
        count = self.config.test_episodes
        episodes = range(self.counters.blocks * count, (self.counters.blocks + 1) * count)
        block = self._play(Planned("block", lambda team, seed: self.coach.keyed(seed)), episodes)
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

    def _play(self, condition: Condition | Planned, episodes: range) -> Evaluation:
        seed = self.config.seed ^ TEST_KEY
        return evaluate_in(self.test_env, self.policy, condition, episodes, seed)

    def end_block(self) -> dict[str, Value]:
        """Tells the coach e_t; returns the block's line of metrics."""
        block = self.test()
        self.best_is_now = self.best is None or block.rank >= self.best
        if self.best_is_now:
            self.best = block.rank
        free = None if block.crash_free is None else block.crash_free.success_rate
        victims = tuple(played.success_rate for played in block.victims)
        record = self.coach.record_block(block.crashed.success_rate, self.progress, free, victims)
        return self._close(record, block)

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        tensors, values = super().state_dict()
        rollout, rollout_values = self.rollout.state_dict()
        more = {"coach": self.coach.state_dict(), "rollout": rollout_values, "best": self.best}
        return {**tensors, "rollout": rollout}, {**values, **more}

    def load_state_dict(
        self,
        tensors: dict[str, dict[str, Any]],
        values: dict[str, Any],
        counts: dict[str, Any],
    ) -> None:
        super().load_state_dict(tensors, values, counts)
        self.policy.set_weights(self.learner.agent_weights())
        self.rollout.load_state_dict(tensors["rollout"], values["rollout"])
        self.coach.load_state_dict(values["coach"])
        self.best = None if values["best"] is None else tuple(map(float, values["best"]))
