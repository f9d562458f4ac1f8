"""How late an injection is: parameters set through the services while steps stream by."""

from __future__ import annotations

import threading
import time

import pytest
from coach_graph import ROBOTS, WAIT_S, Graph, Key, Team, graph


class Stream(threading.Thread):
    """Lock-steps without end in a thread: episodes of ``length`` steps."""

    def __init__(self, played: Team, length: int) -> None:
        super().__init__(name="stream")
        self._team = played
        self._length = length
        self._stop_asked = threading.Event()
        self.failure: AssertionError | None = None

    def __enter__(self) -> Stream:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_asked.set()
        self.join(timeout=2 * WAIT_S)
        assert not self.is_alive(), "the stream hangs"
        if self.failure is not None:
            raise self.failure

    def run(self) -> None:
        count = 0
        try:
            while not self._stop_asked.is_set():
                self._team.step(*divmod(count, self._length))
                count += 1
        except AssertionError as failure:
            self.failure = failure

    def pass_steps(self, steps: int) -> Key:
        """Waits until so many more steps began; returns the newest then."""
        end = time.monotonic() + WAIT_S
        episode, step = self._team.newest
        goal = divmod(max(0, episode) * self._length + step + steps, self._length)
        while self._team.newest < goal:
            assert self.failure is None, self.failure
            assert time.monotonic() < end, f"the stream stands at {self._team.newest}"
            time.sleep(0.0005)
        return self._team.newest


def inject_and_clear(g: Graph, stream: Stream, victim: int, mode: str) -> None:
    """One injection under way, then a clear; every step is held against both."""
    reason = g.operator.set(
        enabled=True, victims=[ROBOTS[victim]], crash_mode=mode, apply_at="next_step"
    )
    injected = g.team.newest  # whatever is published from here on must be faulted
    assert not reason, reason
    stream.pass_steps(5)
    last = g.team.newest  # under way: its robots may be decided before or after the clear
    answer = g.operator.clear()
    assert answer.success, answer.message
    cleared = g.team.newest
    under_way = stream.pass_steps(5)
    for (episode, step, robot), outcome in list(g.team.outcomes.items()):
        key = (episode, step)
        if key >= under_way:
            continue
        if robot == victim and injected < key < last:
            assert outcome.faulted, f"{mode} is late: injected at {injected}, {key} is not faulted"
        if key > cleared or robot != victim:
            assert not outcome.faulted, f"{key} robot {robot} is faulted, cleared at {cleared}"
    for key in [key for key in list(g.team.outcomes) if key[:2] <= cleared]:
        del g.team.outcomes[key]


def run(env: dict[str, str], injections: int, length: int) -> None:
    with graph(env) as g, Stream(g.team, length) as stream:
        stream.pass_steps(5)
        for count in range(injections):
            victim = count % len(ROBOTS)
            inject_and_clear(g, stream, victim, ("mute", "random")[count // len(ROBOTS) % 2])


def test_no_injection_is_late(ros_env: dict[str, str]) -> None:
    run(ros_env, injections=50, length=10_000)


def test_no_injection_is_late_across_episodes(ros_env: dict[str, str]) -> None:
    run(ros_env, injections=9, length=7)


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_no_injection_of_a_thousand_is_late(ros_env: dict[str, str]) -> None:
    run(ros_env, injections=1000, length=500)
