"""The sim node's logic without ROS: decisions per step, newest commands, sessions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sim_pkg.env import make_env
from sim_pkg.lockstep import Decisions, Health
from sim_pkg.realtime import NewestCommands
from sim_pkg.session import NO_ACTION, Session
from sim_pkg.trajectory import TrajectoryHash

ROBOTS = ("robot_1", "robot_2", "robot_3")
STAY = np.array([4, 4, 4], dtype=np.int32)
ALL = np.ones((3, 5), dtype=np.bool_)


def opened(episode: int = 2, step: int = 7) -> Decisions:
    decisions = Decisions(ROBOTS)
    decisions.open(episode, step, STAY, ALL)
    return decisions


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_arrival_order_cannot_matter(order: tuple[int, ...]) -> None:
    decisions = opened()
    for count, robot in enumerate(order):
        assert not decisions.complete
        assert len(decisions.undecided) == 3 - count
        if robot == 1:
            assert decisions.mute(1, 2, 7)
        else:
            assert decisions.command(robot, 2, 7, action=robot, fault=2 * (robot == 2))
    assert decisions.complete
    assert decisions.actions.tolist() == [0, 4, 2]
    assert decisions.crashed.tolist() == [0, 1, 1]
    assert decisions.health == [Health.OK, Health.MUTED, Health.FAULTED]


def test_stale_and_duplicate_decisions_do_not_count() -> None:
    decisions = opened()
    assert not decisions.command(0, 2, 6, 1, 0)
    assert not decisions.command(0, 1, 7, 1, 0)
    assert not decisions.mute(0, 2, 8)
    assert decisions.command(0, 2, 7, 1, 0)
    assert not decisions.command(0, 2, 7, 3, 0)
    assert not decisions.mute(0, 2, 7)
    assert decisions.actions[0] == 1
    assert decisions.crashed[0] == 0
    decisions.close()
    assert not decisions.command(1, 2, 7, 1, 0)
    assert not decisions.complete


def test_unavailable_commands_are_refused() -> None:
    decisions = Decisions(ROBOTS)
    available = ALL.copy()
    available[1, 2] = False
    decisions.open(0, 0, STAY, available)
    for action in (2, 5, -1):
        with pytest.raises(ValueError, match=rf"robot_2 sent action {action}.*\[0, 1, 3, 4\]"):
            decisions.command(1, 0, 0, action, 0)
    assert decisions.undecided == [0, 1, 2]


def test_resends_are_counted_and_end_loudly() -> None:
    decisions = opened()
    decisions.command(0, 2, 7, 1, 0)
    assert decisions.resend(2) == [1, 2]
    decisions.mute(1, 2, 7)
    assert decisions.resend(2) == [2]
    with pytest.raises(TimeoutError, match=r"robot_3 in episode 2, step 7.*sent 3 times"):
        decisions.resend(2)
    decisions.command(2, 2, 7, 1, 0)
    assert decisions.resend(0) == []
    decisions.open(2, 8, STAY, ALL)
    assert decisions.resend(1) == [0, 1, 2]


def test_real_time_tells_the_newest_the_muted_and_the_lost() -> None:
    newest = NewestCommands(ROBOTS, cmd_timeout_s=3.0)
    newest.open(1)
    newest.command(0, 1, 0, action=2, fault=0, now_s=10.0)
    newest.command(1, 1, 0, action=3, fault=2, now_s=10.0)
    newest.mute(2, 1, now_s=10.0)
    newest.command(2, 0, 0, action=1, fault=0, now_s=11.0)  # of another episode
    assert newest.sample(STAY, ALL, now_s=12.9) == []
    assert newest.health == [Health.OK, Health.FAULTED, Health.MUTED]
    assert newest.actions.tolist() == [2, 3, 4]
    assert newest.crashed.tolist() == [0, 1, 1]
    newest.sample(STAY, ALL, now_s=13.0)
    assert newest.health == [Health.LOST] * 3
    assert newest.actions.tolist() == [4, 4, 4]
    assert newest.crashed.tolist() == [0, 0, 0]


def test_real_time_follows_the_newer_of_command_and_mute() -> None:
    newest = NewestCommands(ROBOTS, cmd_timeout_s=3.0)
    newest.open(0)
    newest.command(0, 0, 0, 2, 0, now_s=1.0)
    newest.mute(0, 0, now_s=2.0)
    newest.sample(STAY, ALL, now_s=2.1)
    assert (newest.actions[0], newest.health[0]) == (4, Health.MUTED)
    newest.command(0, 0, 1, 3, 0, now_s=2.2)
    newest.sample(STAY, ALL, now_s=2.3)
    assert (newest.actions[0], newest.health[0]) == (3, Health.OK)
    newest.open(1)
    newest.sample(STAY, ALL, now_s=2.4)
    assert newest.health[0] is Health.LOST


def test_real_time_refuses_an_unavailable_command() -> None:
    newest = NewestCommands(ROBOTS, cmd_timeout_s=3.0)
    newest.open(0)
    newest.command(1, 0, 0, 9, 0, now_s=1.0)
    assert "robot_2 sent action 9" in newest.sample(STAY, ALL, now_s=1.1)[0]
    assert newest.actions[1] == 4
    assert newest.health[1] is Health.LOST


def test_a_session_counts_and_hashes() -> None:
    session = Session(make_env("buttons", 1), seed=9, first_episode=5)
    nobody = np.zeros(2, dtype=np.uint8)
    session.begin()
    assert (session.episode, session.step, session.last_actions.tolist()) == (5, 0, [NO_ACTION] * 2)
    expected = TrajectoryHash(9, 5)
    actions = np.array([3, 2], dtype=np.int32)
    for reward, end in ((-1.0, False), (-1.0, False), (10.0, True)):
        expected.observe(session.obs, session.state)
        session.advance(actions, nobody)
        expected.act(actions, reward, end, False, end)
    assert session.success
    assert session.terminated
    assert not session.running
    assert session.episode_return == 8.0
    assert session.trajectory_hash == expected.hexdigest()
    session.begin()
    assert (session.episode, session.global_step, session.episode_return) == (6, 3, 0.0)
    session.advance(session.stay(), np.array([0, 1], dtype=np.uint8))
    assert session.crashed.tolist() == [0, 1]
    session.cut()
    assert (session.truncated, session.success, session.running) == (True, False, False)
    assert len(session.trajectory_hash) == 64
    session.begin()
    assert session.crashed.tolist() == [0, 0]
    with pytest.raises(RuntimeError, match="episode 7 is still running"):
        session.begin()


def test_late_and_duplicate_commands_are_counted() -> None:
    decisions = opened()
    decisions.command(0, 2, 6, 1, 0)
    for _ in range(3):
        decisions.command(0, 2, 7, 1, 0)
    assert (decisions.late, decisions.duplicates) == ([1, 0, 0], [2, 0, 0])

    newest = NewestCommands(ROBOTS, cmd_timeout_s=3.0)
    newest.open(1)
    newest.command(0, 1, 0, 2, 0, now_s=1.0)
    newest.command(0, 1, 0, 2, 0, now_s=1.1)
    newest.observed(1)
    newest.command(0, 1, 1, 2, 0, now_s=1.2)
    newest.command(1, 1, 0, 3, 0, now_s=1.2)  # late, and the newest all the same
    newest.command(2, 0, 9, 3, 0, now_s=1.2)
    assert (newest.late, newest.duplicates) == ([0, 1, 1], [1, 0, 0])
    newest.sample(np.zeros(3, np.int32), np.ones((3, 5), np.bool_), now_s=1.3)
    assert newest.actions.tolist() == [2, 3, 0]
