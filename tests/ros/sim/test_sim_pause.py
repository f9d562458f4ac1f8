"""/sim/pause and /sim/step of the installed sim, in lock-step and in real time."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest
from sim_driver import STAY, UP, Driver, Env, sim
from std_srvs.srv import SetBool


@pytest.fixture
def driver(ros_env: Env) -> Iterator[Driver]:
    driver = Driver()
    yield driver
    driver.close()


def test_pause_and_single_steps(ros_env: Env, driver: Driver) -> None:
    with sim(ros_env, max_resends=1000) as process:
        driver.until(lambda: len(driver.states) > 3)
        assert not driver.trigger("/sim/step").success
        assert driver.call("/sim/pause", SetBool, SetBool.Request(data=True)).success
        driver.spin(0.3)
        before = len(driver.states)

        def grown(count: int) -> bool:
            return len(driver.states) >= count

        driver.spin(0.5)
        assert len(driver.states) == before
        for extra in (1, 2, 3):
            assert driver.trigger("/sim/step").success
            driver.until(partial(grown, before + extra))
            driver.spin(0.2)
            # A step that ends an episode also shows the next one's start.
            new = driver.states[before:]
            assert sum(1 for s in new if s.step > 0) == extra
        assert driver.call("/sim/pause", SetBool, SetBool.Request(data=False)).success
        driver.until(lambda: len(driver.states) > before + 10)
        assert process.poll() is None


def test_a_pause_in_real_time_neither_loses_nor_unmutes_anybody(
    ros_env: Env, driver: Driver
) -> None:
    driver.rule = lambda robot, obs: UP if robot == 0 else driver.mute(robot, obs)

    def pause(on: bool) -> None:
        assert driver.call("/sim/pause", SetBool, SetBool.Request(data=on)).success

    # Commands count for 0.6 s, the pause lasts twice as long.
    with sim(ros_env, mode="realtime", real_time_factor=5.0):
        driver.until(lambda: len(driver.states) > 6)
        for _ in range(2):
            pause(True)
            driver.spin(1.2)
            assert driver.states[-1].step > 0, "the pause was to be in mid-episode"
            before = len(driver.states)
            pause(False)
            driver.until(lambda n=before: len(driver.states) >= n + 3)
            for state in driver.states[before : before + 3]:
                if state.step:  # the first state of an episode tells of no step
                    assert list(state.actions) == [UP, STAY]
                    assert list(state.crashed) == [0, 1]
