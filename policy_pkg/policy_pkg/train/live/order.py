"""Which episodes graphs play with which weights, and in which order they are learned from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.train.config import TrainConfig

LAG = 1
"""Rounds of episodes that are under way while those before them are learned from."""


class Learns(Protocol):
    """What an order needs of a session."""

    @property
    def config(self) -> TrainConfig: ...
    @property
    def epsilon(self) -> float: ...
    @property
    def agent(self) -> bytes: ...
    @property
    def finished(self) -> bool: ...
    @property
    def tests_next(self) -> bool: ...
    def saw(self, graph: int, recorded: RecordedEpisode) -> None: ...
    def learn(self, recorded: RecordedEpisode) -> None: ...


@dataclass(frozen=True)
class Task:
    """What a graph is to play next.

    ``episodes``: how many; 0: until another task comes. ``agent``: the net, as a policy gets it.
    """

    number: int
    graph: int
    test: bool
    episodes: int
    epsilon: float
    agent: bytes


class Order(Protocol):
    """Turns episodes into tasks. ``block``: the episodes of a block, once it is whole, until they
    are taken; then it begins anew."""

    block: list[RecordedEpisode]

    def __init__(self, session: Learns) -> None: ...

    def begin(self) -> list[Task]:
        """The first tasks; none where nothing is left to do."""
        ...

    def played(self, task: Task, recorded: RecordedEpisode | None) -> list[Task]:
        """Call with every episode of a task, None for one that was lost; returns new tasks."""
        ...


class Lockstep:
    """One episode per task, the graphs in turn; the same seed gives the same run.

    Episode e of a graph is played with the weights learned from all episodes of all graphs up to
    e - 1 - LAG, whatever arrives when. An evaluation block begins when all episodes before it have
    been learned from, and ends before the next one starts.
    """

    def __init__(self, session: Learns) -> None:
        self._session = session
        self._issued = self._done = 0
        self._arrived: dict[int, tuple[Task, RecordedEpisode | None]] = {}
        self._testing: list[RecordedEpisode] = []
        self.block: list[RecordedEpisode] = []
        self._turn = 0

    def begin(self) -> list[Task]:
        session, config = self._session, self._session.config
        if session.finished:
            return []
        self._turn = 0
        if session.tests_next:
            return [self._issue(test=True) for _ in range(config.test_episodes)]
        return [self._issue(test=False) for _ in range(config.n_envs * (1 + LAG))]

    def _issue(self, test: bool) -> Task:
        session = self._session
        epsilon = 0.0 if test else session.epsilon
        task = Task(self._issued, self._turn, test, 1, epsilon, session.agent)
        self._issued += 1
        self._turn = (self._turn + 1) % session.config.n_envs
        return task

    def played(self, task: Task, recorded: RecordedEpisode | None) -> list[Task]:
        self._arrived[task.number] = (task, recorded)
        tasks: list[Task] = []
        while self._done in self._arrived:
            arrived = self._arrived.pop(self._done)
            self._done += 1
            tasks += self._take(*arrived)
        return tasks

    def _take(self, task: Task, recorded: RecordedEpisode | None) -> list[Task]:
        if recorded is not None:
            self._session.saw(task.graph, recorded)
        if task.test:
            return self._take_test(recorded)
        if recorded is not None:
            self._session.learn(recorded)
        if self._session.tests_next:
            return self.begin() if self._issued == self._done else []
        return [self._issue(test=False)]

    def _take_test(self, recorded: RecordedEpisode | None) -> list[Task]:
        if recorded is None:
            return [self._issue(test=True)]  # another one in its place
        self._testing.append(recorded)
        if self._issued == self._done:
            self.block, self._testing = self._testing, []
        return []


class RealTime:
    """The newest weights for graphs that go on by themselves."""

    def __init__(self, session: Learns) -> None:
        self._session = session
        self._issued = 0
        self._tested: list[RecordedEpisode] = []
        self._testing = 0  # episodes of the block that are still to come
        self.block: list[RecordedEpisode] = []

    def begin(self) -> list[Task]:
        session = self._session
        if session.finished:
            return []
        graphs = range(session.config.n_envs)
        if not session.tests_next:
            return [self._issue(graph, test=False, episodes=0) for graph in graphs]
        self._testing = count = session.config.test_episodes
        shares = [count // len(graphs) + (graph < count % len(graphs)) for graph in graphs]
        return [
            self._issue(graph, test=True, episodes=share)
            for graph, share in zip(graphs, shares, strict=True)
            if share
        ]

    def _issue(self, graph: int, test: bool, episodes: int) -> Task:
        session = self._session
        epsilon = 0.0 if test else session.epsilon
        task = Task(self._issued, graph, test, episodes, epsilon, session.agent)
        self._issued += 1
        return task

    def played(self, task: Task, recorded: RecordedEpisode | None) -> list[Task]:
        if recorded is not None:
            self._session.saw(task.graph, recorded)
        if task.test:
            return self._take_test(recorded)
        if recorded is None:
            return []
        self._session.learn(recorded)
        return [] if self._testing else self.begin()

    def _take_test(self, recorded: RecordedEpisode | None) -> list[Task]:
        self._testing -= 1
        if recorded is not None:
            self._tested.append(recorded)
        if self._testing:
            return []
        self.block, self._tested = self._tested, []
        return [] if self.block else self.begin()  # all were lost: once more
