"""A sim is started again while gate, coach and policies go on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from coach_graph import process
from crash_coach_interfaces.msg import Action
from sim_driver import ROBOTS, Driver, Env, end_of, sim

from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env


@pytest.fixture
def driver(ros_env: Env) -> Iterator[Driver]:
    """Only listens here."""
    driver = Driver()
    driver.rule = lambda robot, observation: None
    yield driver
    driver.close()


@contextmanager
def all_but_the_sim(env: Env, folder: Path, lockstep: bool) -> Iterator[None]:
    """Robot 2 is under a random fault in every episode."""
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=4)
    with ExitStack() as stack:
        stack.enter_context(process(env, "gate", robots=ROBOTS, lockstep=lockstep))
        fault = {"victims": ROBOTS[1:], "crash_mode": "random", "seed": 11}
        stack.enter_context(process(env, "coach", robots=ROBOTS, **fault))
        stack.enter_context(process(env, "team", "policy_pkg", checkpoint=checkpoint))
        yield


def play(env: Env, driver: Driver, first_episode: int, episodes: int) -> list[str]:
    """A sim from its start to its end, in lock-step; the episodes' hashes."""
    driver.states.clear()
    options = {"seed": 11, "autostart": False, "resend_after_s": 0.3}
    with sim(env, first_episode=first_episode, episodes=episodes, **options) as process:
        for count in range(1, episodes + 1):  # one by one: the driver has to meet the sim first
            driver.until(lambda: driver.trigger("/sim/reset").success)
            driver.until(lambda expected=count: len(driver.ends()) == expected)
        assert end_of(process, driver)[0] == 0
    ends = driver.ends()
    assert [end.episode for end in ends] == list(range(first_episode, first_episode + episodes))
    assert all(list(end.crashed) == [0, 1] for end in ends)
    return [end.trajectory_hash for end in ends]


def test_the_same_episodes_again(ros_env: Env, driver: Driver, tmp_path: Path) -> None:
    with all_but_the_sim(ros_env, tmp_path, lockstep=True):
        later = play(ros_env, driver, 1, 2)
        first = play(ros_env, driver, 0, 2)
        assert first[1] == later[0]
        assert play(ros_env, driver, 0, 2) == first
    assert len({*first, *later}) == 3


@pytest.mark.soak
def test_in_real_time_the_team_drives_on(ros_env: Env, driver: Driver, tmp_path: Path) -> None:
    got: list[Action] = []
    for robot in ROBOTS:
        driver.node.create_subscription(Action, f"/{robot}/command", got.append, driver.ten)
    realtime = {"mode": "realtime", "real_time_factor": 10.0}
    with all_but_the_sim(ros_env, tmp_path, lockstep=False):
        # An episode takes 2 s. Killed in the middle of one, begun anew, and an earlier one.
        for first in (30, 30, 20):
            driver.spin(0.3)  # what is still under way
            got.clear()
            with sim(ros_env, first_episode=first, **realtime):
                driver.until(
                    lambda first=first: (
                        {a.fault != 0 for a in got if first <= a.episode < first + 10}
                        == {False, True}
                    )
                )
