"""The installed sim executable, in a process of its own, driven over topics and services."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, Observation
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sim_driver import LEFT, RIGHT, STAY, UP, Driver, Env, end_of, sim
from visualization_msgs.msg import Marker, MarkerArray

from crash_coach_common.contract import BoolArray
from sim_pkg.env import make_env
from sim_pkg.trajectory import TrajectoryHash


@pytest.fixture
def driver(ros_env: Env) -> Iterator[Driver]:
    driver = Driver()
    yield driver
    driver.close()


def scripted(robot: int, obs: Observation) -> int:
    return int(3 * robot + 7 * obs.step + obs.episode) % 5


def core_hash(episode: int, seed: int) -> tuple[str, float]:
    """The scripted episode without ROS."""
    env = make_env("buttons", 1)
    env.reset(np.array([0]), seed, np.array([episode]))
    digest, total = TrajectoryHash(seed, episode), 0.0
    for step in range(20):
        obs = Observation(episode=episode, step=step)
        actions = np.array([[scripted(i, obs) for i in range(2)]], dtype=np.int32)
        digest.observe(env.obs[0], env.state[0])
        r = env.step(actions)
        flags: BoolArray = np.array([r.terminated[0], r.truncated[0], r.success[0]])
        digest.act(actions[0], float(r.reward[0]), *flags.tolist())
        total += float(r.reward[0])
        if r.terminated[0]:
            break
    return digest.hexdigest(), total


def test_lock_step_runs_its_episodes_and_hashes_like_the_core(ros_env: Env, driver: Driver) -> None:
    driver.rule = scripted
    clocks: list[Clock] = []
    driver.node.create_subscription(Clock, "/clock", clocks.append, driver.ten)
    with sim(ros_env, seed=11, first_episode=3, episodes=4) as process:
        driver.until(lambda: len(driver.ends()) == 4)
        assert end_of(process)[0] == 0
    ends = driver.ends()
    assert [e.episode for e in ends] == [3, 4, 5, 6]
    for end in ends:
        digest, total = core_hash(end.episode, 11)
        assert (end.trajectory_hash, end.episode_return, end.seed) == (digest, total, 11)
    # Every step once, in order; time is the global step and never goes back.
    for robot in range(2):
        times = [o.header.stamp.sec for i, o in driver.seen if i == robot]
        assert times == list(range(len(times)))
    states = [s for s in driver.states if s.episode == 4]
    assert [s.step for s in states] == list(range(len(states)))
    assert len(states[0].actions) == 0
    assert states[1].actions.tolist() == [scripted(i, states[0]) for i in range(2)]
    assert not any(s.trajectory_hash for s in states[:-1])
    seconds = [c.clock.sec for c in clocks]
    assert seconds == sorted(seconds)
    first = next(o for i, o in driver.seen if i == 0 and o.episode == 4 and o.step == 0)
    assert first.last_action == -1
    np.testing.assert_array_equal(first.features, np.array([2, 1], dtype=np.float32) / 9)
    assert list(first.available_actions) == [1] * 5


def test_lock_step_at_a_pace_is_the_same_and_no_faster(ros_env: Env, driver: Driver) -> None:
    driver.rule = scripted
    with sim(ros_env, seed=11, episodes=1, pace_hz=40.0) as process:
        driver.until(lambda: driver.states)
        start = time.monotonic()
        (end,) = driver.until(driver.ends)
        took_s = time.monotonic() - start
        assert end_of(process)[0] == 0
    assert end.trajectory_hash == core_hash(0, 11)[0]
    assert took_s > (end.step - 2) / 40.0  # the first state may have been under way for long


def test_a_lost_observation_is_sent_again_and_a_duplicate_changes_nothing(
    ros_env: Env, driver: Driver
) -> None:
    dropped: set[tuple[int, int]] = set()

    def forgetful(robot: int, obs: Observation) -> int | None:
        key = (robot, obs.step)
        if obs.step in (2, 5) and key not in dropped:
            dropped.add(key)
            return None
        driver.command(robot, obs, RIGHT if robot == 0 else UP)
        return RIGHT if robot == 0 else UP  # the same once more

    driver.rule = forgetful
    with sim(ros_env, episodes=1, resend_after_s=0.1) as process:
        (end,) = driver.until(driver.ends)
        assert end_of(process)[0] == 0
    assert dropped == {(0, 2), (0, 5), (1, 2), (1, 5)}
    assert [s.step for s in driver.states] == list(range(21))
    assert all(s.actions.tolist() == [RIGHT, UP] for s in driver.states[1:])
    assert end.step == 20


def test_mutes_stay_and_are_marked(ros_env: Env, driver: Driver) -> None:
    def rule(robot: int, obs: Observation) -> int | None:
        if robot == 1 and obs.step % 2:
            driver.mute(robot, obs)
            return None
        return UP

    driver.rule = rule
    with sim(ros_env, episodes=1) as process:
        driver.until(driver.ends)
        assert end_of(process)[0] == 0
    for state in driver.states[1:]:
        muted = (state.step - 1) % 2
        assert state.crashed.tolist() == [0, muted]
        assert state.actions.tolist() == [UP, STAY if muted else UP]


def test_a_silent_robot_ends_the_episode_loudly(ros_env: Env, driver: Driver) -> None:
    driver.rule = lambda robot, obs: None if robot == 1 and obs.step == 2 else STAY
    with sim(ros_env, resend_after_s=0.05, max_resends=3) as process:
        code, errors = end_of(process, driver)
    assert code == 1
    assert "no command for robot_2 in episode 0, step 2" in errors
    (end,) = driver.until(driver.ends)
    assert end.truncated
    assert not end.success
    assert sum(1 for i, o in driver.seen if (i, o.step) == (1, 2)) == 4


def test_an_unavailable_action_is_an_error(ros_env: Env, driver: Driver) -> None:
    driver.rule = lambda robot, obs: 9 if robot == 1 else STAY
    with sim(ros_env) as process:
        code, errors = end_of(process, driver)
    assert code == 1
    assert "robot_2 sent action 9" in errors


def test_nobody_there(ros_env: Env) -> None:
    with sim(ros_env, match_timeout_s=1.5) as process:
        code, errors = end_of(process)
    assert code == 1
    assert "/robot_1/observation has no subscriber" in errors
    assert "/robot_2/command has no publisher" in errors


def test_a_second_sim_is_refused(ros_env: Env, driver: Driver) -> None:
    with sim(ros_env, max_resends=1000) as first:
        driver.until(lambda: len(driver.states) > 2)
        driver.rule = lambda robot, obs: None  # the first waits; only the second may end
        with sim(ros_env) as second:
            code, errors = end_of(second)
        assert code == 1
        assert f"another sim (process {first.pid} on" in errors
        assert first.poll() is None


def test_sigint_ends_it_cleanly(ros_env: Env, driver: Driver) -> None:
    with sim(ros_env) as process:
        driver.until(lambda: len(driver.states) > 2)
        process.send_signal(signal.SIGINT)
        code, errors = end_of(process)
    assert code == 0
    assert re.fullmatch(r"\[INFO\] \[[\d.]+\] \[sim\]: ready: buttons, lockstep\n", errors)


def test_sigterm_while_it_waits_for_robots(ros_env: Env) -> None:
    driver = Driver(())
    try:
        with sim(ros_env, match_timeout_s=60) as process:
            driver.until(lambda: driver.node.count_publishers("/sim/episode"))
            process.send_signal(signal.SIGTERM)
            code, errors = end_of(process)
    finally:
        driver.close()
    assert (code, errors) == (0, "")


def test_reset_starts_each_episode_without_autostart(ros_env: Env, driver: Driver) -> None:
    # The first episode stops at step 3, the second runs to its end.
    driver.rule = lambda robot, obs: (
        scripted(robot, obs) if obs.episode else STAY if obs.step < 3 else None
    )
    with sim(ros_env, autostart=False, episodes=2, max_resends=1000) as process:
        driver.until(lambda: driver.trigger("/sim/reset").success)
        driver.until(lambda: driver.states and driver.states[-1].step == 3)
        assert driver.trigger("/sim/reset").message == "episode 1 runs"
        (cut,) = driver.until(driver.ends)
        assert (cut.episode, cut.step, cut.truncated, cut.success) == (0, 3, True, False)
        driver.until(lambda: len(driver.ends()) == 2)
        assert end_of(process)[0] == 0
    assert driver.ends()[1].trajectory_hash == core_hash(1, 0)[0]


def test_odometry_and_markers_for_who_listens(ros_env: Env, driver: Driver) -> None:
    odometry: list[Odometry] = []
    pictures: list[MarkerArray] = []
    driver.node.create_subscription(Odometry, "/robot_2/odom", odometry.append, driver.ten)
    driver.node.create_subscription(MarkerArray, "/sim/markers", pictures.append, driver.ten)
    driver.fault = Action.FAULT_RANDOM
    driver.rule = lambda robot, obs: LEFT
    with sim(ros_env, episodes=3):
        driver.until(lambda: len(odometry) > 3 and len(pictures) > 3)
    assert odometry[0].header.frame_id == "map"
    assert odometry[0].child_frame_id == "robot_2/base_link"
    assert any(o.twist.twist.linear.x == pytest.approx(-1.0) for o in odometry)
    by_kind = {k: [m for m in pictures[2].markers if m.ns == k] for k in ("robots", "sites")}
    assert [m.type for m in by_kind["robots"]] == [Marker.CYLINDER] * 2
    assert [(m.pose.position.x, m.pose.position.y) for m in by_kind["sites"]] == [
        (4.5, 7.5),
        (5.5, 2.5),
    ]
    red = by_kind["robots"][0].color
    assert red.r > 2 * red.b


def test_real_time_tells_lost_from_muted(ros_env: Env, driver: Driver) -> None:
    reports: list[dict[str, str]] = []

    def note(message: DiagnosticArray) -> None:
        reports.append({s.hardware_id: s.values[0].value for s in message.status})

    driver.node.create_subscription(DiagnosticArray, "/diagnostics", note, driver.ten)
    driver.rule = lambda robot, obs: UP
    with sim(ros_env, mode="realtime", real_time_factor=20.0) as process:
        driver.until(lambda: reports and reports[-1] == {"robot_1": "ok", "robot_2": "ok"})
        driver.rule = lambda robot, obs: UP if robot == 0 else driver.mute(robot, obs)
        driver.until(lambda: reports[-1] == {"robot_1": "ok", "robot_2": "muted"})
        driver.rule = lambda robot, obs: UP if robot == 0 else None
        driver.until(lambda: reports[-1] == {"robot_1": "ok", "robot_2": "lost"})
        last = driver.states[-1]
        assert last.step == 0 or last.actions[1] == STAY
        driver.rule = lambda robot, obs: UP
        driver.until(lambda: reports[-1] == {"robot_1": "ok", "robot_2": "ok"})
        assert process.poll() is None


def test_real_time_keeps_its_rate_and_starts_without_a_robot(ros_env: Env) -> None:
    driver = Driver(("robot_1",))
    try:
        driver.rule = lambda robot, obs: RIGHT
        with sim(ros_env, mode="realtime", real_time_factor=20.0, match_timeout_s=1.5):
            driver.until(lambda: driver.states)
            count, start = len(driver.states), time.monotonic()
            driver.until(lambda: len(driver.states) >= count + 42)  # an episode's end is extra
            rate_hz = 40 / (time.monotonic() - start)
        assert 14.0 < rate_hz < 26.0
        assert {s.actions[1] for s in driver.states if s.step} == {STAY}
    finally:
        driver.close()
