"""A trainer's link to a graph in lock-step: it starts every episode, once its weights are held."""

from __future__ import annotations

import re
import time
from collections import deque

from crash_coach_interfaces.msg import EpisodeState
from rclpy.task import Future
from std_srvs.srv import Trigger

from crash_coach_common.contract import UserError
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.ros.trainer.link import EPISODE_S, PIECES_S, START_S, GraphLink
from policy_pkg.train.live.order import Task

_RUNS = re.compile(r"episode (\d+) runs")  # what /sim/reset answers
RETRY_S = 0.05


class LockstepLink(GraphLink):
    """The next episode's weights are published while the one before is played."""

    spin_s = 0.002  # the graph waits for this process

    def _make_clients(self) -> None:
        self._tasks: deque[Task] = deque()
        self._prepared: tuple[Task, int] | None = None  # and its version
        self._starting: Task | None = None  # its reset is under way
        self._retry_s = 0.0
        self._playing: dict[int, Task] = {}  # by episode, until its pieces are complete
        self._early: dict[int, RecordedEpisode | None] = {}
        self._running = -1  # episode; -1: none
        self._ended: dict[int, float] = {}  # when, by episode
        self._next = 0
        self._greeted = False
        self._deadline_s = time.monotonic() + START_S
        self._reset = self._node.create_client(Trigger, "sim/reset")

    def _take(self, task: Task) -> None:
        self._tasks.append(task)
        self._turn()

    def _ready(self) -> None:
        self._greeted = True
        self._turn()

    def _on_held(self) -> None:
        self._turn()

    def _turn(self) -> None:
        """Prepares and starts what can be."""
        if self._prepared is None and self._starting is None and self._tasks:
            task = self._tasks.popleft()
            self._prepared = (task, self._publish(task, self._next))
            self._deadline_s = time.monotonic() + START_S
        if self._prepared is None or self._starting is not None or self._running >= 0:
            return
        task, version = self._prepared
        if self._silent(version) or not self._greeted:
            return
        if self._next == 0 and self.topics.missing(self.graph.coached):
            return
        self._prepared, self._starting = None, task
        self._ask()

    def _ask(self) -> None:
        self._deadline_s = time.monotonic() + START_S
        self._retry_s = 0.0
        self._reset.call_async(Trigger.Request()).add_done_callback(self._on_reset)

    def _on_reset(self, answer: Future) -> None:
        self._guarded(lambda: self._begin(answer.result()))

    def _begin(self, response: Trigger.Response) -> None:
        if not response.success:  # the sim still looks for its robots
            self._retry_s = time.monotonic() + RETRY_S
            self._why = str(response.message)
            return
        found = _RUNS.search(response.message)
        if found is None or self._starting is None:
            raise UserError(f"{self._name}: /sim/reset answered {response.message!r}")
        number = int(found.group(1))
        if number < self._next:
            raise UserError(
                f"{self._name}: the sim begins episode {number}, {self._next} was expected: it was "
                "restarted; resume the training"
            )
        self._playing[number], self._starting = self._starting, None
        self._next = number + 1
        self._deadline_s = time.monotonic() + EPISODE_S
        self._inbox.start_at(min(self._playing))
        if number in self._early:
            self._finished(number, self._early.pop(number))
        elif number not in self._ended:
            self._running = number
        self._turn()

    def _on_state(self, state: EpisodeState) -> None:
        if not (state.terminated or state.truncated):
            return
        self._ended.setdefault(state.episode, time.monotonic())
        if state.episode == self._running:
            self._running = -1
            self._guarded(self._turn)

    def _finished(self, number: int, recorded: RecordedEpisode | None) -> None:
        self._ended.pop(number, None)
        task = self._playing.pop(number, None)
        if task is None and self._starting is not None:  # over before /sim/reset had answered
            self._early[number] = recorded
        elif task is not None:
            self._played(task, recorded)

    def _look(self) -> None:
        now_s = time.monotonic()
        if 0 < self._retry_s <= now_s:
            self._ask()
        for number, ended_s in list(self._ended.items()):
            if now_s - ended_s > PIECES_S:
                self._ended.pop(number)
                self._inbox.give_up(number, f"{PIECES_S:g} s after its end")
        self._collect()
        waiting = self._prepared is not None or self._starting is not None or self._running >= 0
        if waiting and now_s > self._deadline_s:
            raise UserError(f"{self._name}: {self._problem()}")
        self._turn()  # discovery has no callback

    def _problem(self) -> str:
        if self._running >= 0:
            return f"episode {self._running} has no end after {EPISODE_S:g} s"
        if self._starting is not None:
            return f"/sim/reset did not begin an episode in {START_S:g} s: {self._why}"
        assert self._prepared is not None
        silent = self._silent(self._prepared[1])
        if silent:
            return f"after {START_S:g} s no policy of {', '.join(silent)} holds the weights"
        return f"after {START_S:g} s still: {'; '.join(self.topics.missing(self.graph.coached))}"

    _why = "no answer"
