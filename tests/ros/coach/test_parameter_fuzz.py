"""Random calls to every parameter of coach, gate and sim: each is refused with a reason or
applied whole, the node lives, and the coach's next plan is what its parameters say."""

from __future__ import annotations

from functools import partial

import pytest
from coach_graph import ROBOTS, Team, graph
from crash_coach_interfaces.msg import CrashPlan
from node_process import Child
from parameter_fuzzer import Fuzzer
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import parameter_value_to_python
from sim_driver import Driver, sim

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.live_coach import ControlSettings
from crash_coach_pkg.coach.parameters import Value, build_settings, parameter_specs
from crash_coach_pkg.faults import mode_names
from crash_coach_pkg.ros.convert import plan_from_message
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(ROBOTS, ("scout", "scout", "hauler"), 0.1)
WORDS = (
    *mode_names(), "stay", *ROBOTS, "none", "fixed", "fixed", "adaptive", "curriculum", "ceil",
    "floor", "authors", "next_step", "next_episode", "scout", "hauler", "",
)  # fmt: skip
SIZES = [30, pytest.param(5000, marks=pytest.mark.soak)]


def settings_of(values: dict[str, ParameterValue]) -> ControlSettings:
    """Must not fail: what a node holds is a configuration."""
    held: dict[str, Value] = {}
    for spec in parameter_specs():
        value = parameter_value_to_python(values[spec.name])
        held[spec.name] = tuple(value) if isinstance(value, list) else value
    return build_settings(held, TEAM)


def check_plan(team: Team, episode: int, settings: ControlSettings) -> None:
    """The plan of a new episode is the core's under the same settings."""

    def there() -> bool:
        return bool(team.plans) and team.plans[-1].episode == episode

    team.announce(episode, 0)
    team.until(there, f"plan of episode {episode}")
    message: CrashPlan = team.plans[-1]
    assert (message.seed, message.lease_s) == (settings.seed, settings.lease_s)
    plan = plan_from_message(message, ROBOTS)
    if not settings.enabled:
        assert not plan.faults
    elif settings.coach.strategy in ("none", "fixed"):
        assert plan.faults == Coach(settings.coach, TEAM, settings.seed).plan(episode).faults


def check_life(*processes: Child) -> None:
    for process in processes:
        if process.poll() is not None:
            raise AssertionError(f"a node ended: {process.communicate(timeout=10)[1]}")


@pytest.mark.parametrize("calls", SIZES)
def test_coach(ros_env: dict[str, str], calls: int) -> None:
    roles = {"roles": TEAM.roles, "dt_s": TEAM.dt_s}
    with graph(ros_env, **roles) as g:
        alive = partial(check_life, g.coach, g.gate)
        fuzzer = Fuzzer(g.team.node, g.team.executor, "/coach", WORDS, alive, seed=1)
        for call in range(calls):
            check_plan(g.team, call, settings_of(fuzzer.once()))
            g.team.plans.clear()
        assert fuzzer.applied > calls // 10
        assert fuzzer.refused > calls // 10


@pytest.mark.parametrize("calls", SIZES)
def test_gate(ros_env: dict[str, str], calls: int) -> None:
    with graph(ros_env, strategy="fixed", victims=("robot_2",)) as g:
        alive = partial(check_life, g.coach, g.gate)
        fuzzer = Fuzzer(g.team.node, g.team.executor, "/gate", WORDS, alive, seed=2)
        for call in range(calls):
            fuzzer.once()
            if call % 10 == 0:
                faulted = [outcome.faulted for outcome in g.team.step(call, 0)]
                assert faulted == [False, True, False]
        assert fuzzer.refused > calls // 2


@pytest.mark.parametrize("calls", SIZES)
def test_sim(ros_env: dict[str, str], calls: int) -> None:
    with sim(ros_env, scenario="buttons", resend_after_s=0.1) as process:
        driver = Driver()
        try:
            driver.until(lambda: driver.states)
            alive = partial(check_life, process)
            fuzzer = Fuzzer(driver.node, driver.executor, "/sim", WORDS, alive, seed=3)
            for _ in range(calls):
                fuzzer.once()
            assert fuzzer.refused > calls // 2
            before = len(driver.states)
            driver.until(lambda: len(driver.states) > before + 5)  # it still plays
        finally:
            driver.close()
