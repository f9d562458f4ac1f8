"""What changes while a run learns from the episodes that graphs play; knows nothing of ROS."""

from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
from safetensors.numpy import save as to_bytes

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_pkg.coach.coach import BlockRecord
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.play.evaluate import EpisodeResult, Evaluation
from policy_pkg.train.blocks import Block
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.live.order import Lockstep, Order, Task
from policy_pkg.train.metrics import Value
from policy_pkg.train.session import EpisodeSession
from sim_pkg.trajectory import CourseHash

POLL_S = 0.1  # how soon a run notices that it is to end
QUEUE_EPISODES = 10_000  # in real time a learner that is too slow falls behind by so many at most


class LiveSession(EpisodeSession):
    """Learns from the episodes that graphs play.

    Args:
        config: of the run; ``n_envs`` graphs.
        spec: of the team.
        order: which episodes are played when, and learned from in which order.
        on_tasks: told what the graphs are to play next, by the thread that calls ``advance``.
    """

    VERB: ClassVar[str] = "train-live"
    alpha = None  # the coach is a node
    best_is_now = False

    def __init__(
        self,
        config: TrainConfig,
        spec: EnvSpec,
        order: type[Order] = Lockstep,
        on_tasks: Callable[[list[Task]], None] = lambda tasks: None,
    ) -> None:
        for key, off in (("explore_hold", 1), ("test_victim_episodes", 0)):
            if (value := getattr(config, key)) != off:
                raise UserError(
                    f"{key} {value}: must be {off} in live training, whose policy nodes explore "
                    "step by step and whose blocks the coach's node plans"
                )
        super().__init__(config, spec)
        self.next_episodes = [0] * config.n_envs
        """The number behind the last episode seen of each graph."""
        self._planned = [0, 0]  # training robots since the last block: crashing, all
        self._agent = (-1, b"")
        self._order, self._on_tasks = order(self), on_tasks
        self._begun = False
        self._episodes: queue.Queue[tuple[Task, RecordedEpisode | None]] = queue.Queue(
            QUEUE_EPISODES
        )

    @property
    def agent(self) -> bytes:
        """The online agent net, in safetensors' format."""
        if self._agent[0] != self.learner.updates:
            arrays = {name: a.copy() for name, a in self.learner.agent_weights().items()}
            self._agent = (self.learner.updates, to_bytes(arrays))
        return self._agent[1]

    @property
    def tests_next(self) -> bool:
        """Whether the graphs are to play a block's episodes."""
        return self.counters.due(self.steps)

    @property
    def block_due(self) -> bool:
        """Whether they have played it."""
        return bool(self._order.block)

    def played(self, task: Task, recorded: RecordedEpisode | None) -> None:
        """An episode of ``task``; None: it was lost. From any thread; returns at once.

        Raises:
            UserError: the learner is hopelessly behind.
        """
        try:
            self._episodes.put_nowait((task, recorded))
        except queue.Full:
            raise UserError(
                f"{QUEUE_EPISODES} episodes wait for the learner: it cannot keep up; take fewer "
                "graphs or fewer updates_per_episode"
            ) from None

    def advance(self) -> None:
        """Takes the next episode, or comes back after ``POLL_S`` without one.

        Raises:
            DivergedError: from the learner.
            UserError: it is of another team, or does not fit the scenario.
        """
        if not self._begun:
            self._begun = True
            self._on_tasks(self._order.begin())
        with suppress(queue.Empty):
            self._on_tasks(self._order.played(*self._episodes.get(timeout=POLL_S)))

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
        done, episode = self.counters, recorded.episode
        try:
            self._keep(episode, recorded.success)
        except ValueError as error:
            raise UserError(
                f"episode {recorded.number} does not fit scenario {self.config.scenario!r}: {error}"
            ) from error
        done.env_steps += episode.length
        self._planned[0] += len(_victims(recorded))
        self._planned[1] += len(recorded.robots)
        self._learn()

    def end_block(self) -> dict[str, Value]:
        """The metrics of the greedy episodes that the graphs have played.

        The coach decides elsewhere, after this: ``decision`` and ``new_alpha`` are null, and the
        next line's ``alpha`` tells. Without crashes the block is the crash-free one as well.
        """
        config, robots, played = self.config, self.spec.robots, self._order.block
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
        self._order.block, self._begun = [], False
        return {**self._close(record, block), "decision": None, "new_alpha": None}

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        tensors, values = super().state_dict()
        more = {"next_episodes": list(self.next_episodes), "planned": list(self._planned)}
        return tensors, {**values, **more}

    def load_state_dict(
        self,
        tensors: dict[str, dict[str, Any]],
        values: dict[str, Any],
        counts: dict[str, Any],
    ) -> None:
        super().load_state_dict(tensors, values, counts)
        self.next_episodes = [int(number) for number in values["next_episodes"]]
        self._planned = [int(count) for count in values["planned"]]


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
