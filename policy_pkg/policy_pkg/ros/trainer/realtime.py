"""A trainer's link to a graph in real time, which goes on whether the trainer is there or not."""

from __future__ import annotations

import time

from crash_coach_interfaces.msg import EpisodeState

from crash_coach_common.contract import UserError
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.ros.trainer.link import START_S, GraphLink
from policy_pkg.train.live.order import Task

AHEAD = 2  # episodes: the one that runs, and the one that may begin before weights arrive
UNSEEN = -1


class RealTimeLink(GraphLink):
    """Weights count from the next episode on. Those of a block count from an announced episode
    on, and the block's episodes are those behind it, if every policy held them in time."""

    def _make_clients(self) -> None:
        self._newest = UNSEEN
        self._training: Task | None = None
        self._test: Task | None = None
        self._asked = (0, 0)  # version and first episode of the block's weights
        self._window = range(0)  # episodes of the block
        self._told_s = time.monotonic()

    def _take(self, task: Task) -> None:
        if task.test:
            self._test = task
            self._announce()
        else:
            self._test, self._window, self._training = None, range(0), task
            self._publish(task, 0)

    def _announce(self) -> None:
        assert self._test is not None
        first = 0 if self._newest == UNSEEN else self._newest + AHEAD
        self._asked = (self._publish(self._test, first), first)

    def _ready(self) -> None:
        pass

    def _on_held(self) -> None:
        version, first = self._asked
        if self._test is None or self._window or self._silent(version) or self._newest >= first:
            return
        self._window = range(first, first + self._test.episodes)

    def _on_state(self, state: EpisodeState) -> None:
        self._told_s = time.monotonic()
        if state.episode < self._newest and state.step == 0:
            self._guarded(self._refuse_restart)
        elif state.episode > self._newest:
            joined_late = self._newest == UNSEEN and (state.episode, state.step) != (0, 0)
            self._newest = state.episode
            if joined_late:  # the graph ran before
                self._window = range(0)
            if self._test is not None and not self._window and self._newest >= self._asked[1]:
                self._announce()

    def _refuse_restart(self) -> None:
        raise UserError(
            f"{self._name}: its episodes begin anew: the sim was restarted; resume the training"
        )

    def _finished(self, number: int, recorded: RecordedEpisode | None) -> None:
        task = self._test if number in self._window else self._training
        if task is not None:
            self._played(task, recorded)

    def _look(self) -> None:
        if time.monotonic() - self._told_s < START_S:
            return
        self._told_s = time.monotonic()
        silent = self._silent(self._asked[0]) if self._test is not None else []
        who = f"; no policy of {', '.join(silent)} holds the weights" if silent else ""
        self._node.get_logger().warning(f"{self._name}: silent for {START_S:g} s{who}")
