"""All of a live training run that changes while it runs; knows nothing of ROS, files and clocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from safetensors.numpy import save as to_bytes

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_pkg.coach.coach import BlockRecord
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.episode import Sizes
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.play.evaluate import EpisodeResult, Evaluation
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import Means, Value
from policy_pkg.train.session import (
    LEARNER_MEANS,
    SAMPLING,
    TRAIN_MEANS,
    Block,
    Counters,
    block_line,
    generator,
)
from sim_pkg.trajectory import CourseHash


class LiveSession:
    """Learns from the episodes that graphs play.

    Args:
        config: of the run; ``n_envs`` graphs.
        spec: of the team.
    """

    def __init__(self, config: TrainConfig, spec: EnvSpec) -> None:
        self.config, self.spec = config, spec
        for key, off in (("explore_hold", 1), ("test_victim_episodes", 0)):
            if (value := getattr(config, key)) != off:
                raise UserError(
                    f"{key} {value}: must be {off} in live training, whose policy nodes explore "
                    "step by step and whose blocks the coach's node plans"
                )
        sizes = Sizes.of(spec)
        self.learner = Learner(config.learner, sizes, config.seed)
        self.replay = Replay(config.replay_episodes, sizes, config.replay_strata)
        self.sampling = generator(config.seed, SAMPLING)
        self.counters, self.means = Counters(), Means()
        self.next_episodes = [0] * config.n_envs
        """The number behind the last episode seen of each graph."""
        self._planned = [0, 0]  # training robots since the last block: crashing, all
        self._agent = (-1, b"")

    @property
    def agent(self) -> bytes:
        """The online agent net, in safetensors' format."""
        if self._agent[0] != self.learner.updates:
            arrays = {name: a.copy() for name, a in self.learner.agent_weights().items()}
            self._agent = (self.learner.updates, to_bytes(arrays))
        return self._agent[1]

    @property
    def epsilon(self) -> float:
        return self.config.epsilon(self.counters.env_steps)

    @property
    def block_due(self) -> bool:
        return self.counters.block_due(self.config.total_steps)

    @property
    def finished(self) -> bool:
        """All steps are done, and the block behind them."""
        done = self.counters
        return done.next_block_steps > done.env_steps >= self.config.total_steps

    def saw(self, graph: int, recorded: RecordedEpisode) -> None:
        """Call with every episode of a graph.

        Raises:
            UserError: it is of another team.
        """
        if recorded.robots != self.spec.robots:
            raise UserError(f"an episode of {recorded.robots}, training {self.spec.robots}")
        self.next_episodes[graph] = max(self.next_episodes[graph], recorded.number + 1)

    def learn(self, recorded: RecordedEpisode) -> None:
        """Takes a training episode and the gradient steps that it gives credit for.

        Raises:
            DivergedError: from the learner.
            UserError: it does not fit the scenario.
        """
        done, config, episode = self.counters, self.config, recorded.episode
        try:
            self.replay.add(episode, recorded.success)
        except ValueError as error:
            raise UserError(
                f"episode {recorded.number} does not fit scenario {config.scenario!r}: {error}"
            ) from error
        done.env_steps += episode.length
        done.episodes += 1
        self._planned[0] += len(_victims(recorded))
        self._planned[1] += len(recorded.robots)
        figures = (
            float(recorded.success),
            float(episode.reward.sum(dtype=np.float64)),
            float(episode.length),
        )
        self.means.add(dict(zip(TRAIN_MEANS, figures, strict=True)))
        if len(self.replay) < config.batch_episodes:
            return
        done.credit += config.updates_per_episode
        while done.credit >= 1:
            done.credit -= 1
            batch = self.replay.sample(self.sampling, config.batch_episodes)
            self.means.add(self.learner.update(batch, episodes=done.episodes))

    def end_block(self, played: Sequence[RecordedEpisode]) -> dict[str, Value]:
        """The metrics of a block of greedy episodes.

        The coach decides elsewhere, after this: ``decision`` and ``new_alpha`` are null, and the
        next line's ``alpha`` tells. Without crashes the block is the crash-free one as well.
        """
        config, robots = self.config, self.spec.robots
        evaluation = Evaluation("block", robots, config.seed, tuple(map(_result, played)))
        crashed = any(result.crashed for result in evaluation.episodes)
        block = Block(evaluation, None if crashed or not config.test_crash_free else evaluation)
        plan = played[0].plan
        crashing, planned = self._planned
        rate, cap = (plan.rate, plan.cap) if plan is not None else (0.0, 0)
        record = BlockRecord(
            rate=rate,
            cap=cap,
            crashed_fraction=crashing / planned if planned else None,
            episodes=planned // len(robots),
            success_rate=evaluation.success_rate,
            decision="keep",
            new_rate=rate,
        )
        self._planned = [0, 0]
        self.counters.close_block(config.test_interval_steps)
        means = self.means.take(TRAIN_MEANS + LEARNER_MEANS)
        updates, reports = self.learner.updates, self.spec.reports_success
        line = block_line(config, self.counters, updates, record, block, means, reports)
        return {**line, "decision": None, "new_alpha": None}

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
            "next_episodes": list(self.next_episodes),
            "planned": list(self._planned),
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
        if self.config.checkpoint_replay:
            self.replay.load_state_dict(tensors["replay"])
        self.sampling.bit_generator.state = values["sampling"]
        self.means.load_state_dict(values["means"])
        self.next_episodes = [int(number) for number in values["next_episodes"]]
        self._planned = [int(count) for count in values["planned"]]
        self.counters = counters


def _victims(recorded: RecordedEpisode) -> set[int]:
    plan = recorded.plan
    return set() if plan is None else {fault.robot for fault in plan.faults}


def _result(recorded: RecordedEpisode) -> EpisodeResult:
    episode = recorded.episode
    course = CourseHash()
    for step in range(episode.length):
        course.observe(episode.state[step])
        course.act(episode.actions[step], float(episode.reward[step]))
    return EpisodeResult(
        episode=recorded.number,
        success=recorded.success,
        episode_return=float(episode.reward.sum(dtype=np.float64)),
        steps=episode.length,
        crashed=tuple(int(robot) for robot in np.flatnonzero(episode.faults.any(axis=0))),
        trajectory_hash=recorded.trajectory_hash,
        course_hash=course.finish(recorded.success),
    )
