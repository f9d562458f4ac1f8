"""What gates say of each robot's stream of commands."""

from __future__ import annotations

from crash_coach_pkg.gate.health import Decided, Report, RobotState, TeamHealth

TIMEOUT_S = 0.5


def report(health: TeamHealth, mode: str, now_s: float) -> Report:
    return health.reports([Decided(mode, 3, 14)], now_s)[0]


def test_a_robot_is_ok_muted_or_lost() -> None:
    health = TeamHealth(1, TIMEOUT_S)
    health.heard(0, 10.0)
    assert report(health, "", 10.4).state is RobotState.OK
    assert report(health, "freeze", 10.4).text == "muted by plan (freeze)"
    assert report(health, "", 10.5).state is RobotState.LOST
    health.heard(0, 10.6)
    assert report(health, "", 10.7).state is RobotState.OK


def test_time_stands_while_the_sim_does() -> None:
    """A pause of any length loses nobody, neither in it nor as the sim goes on; silence does."""
    health = TeamHealth(2, TIMEOUT_S)

    def step(now_s: float, *robots: int) -> None:
        health.sim_moved(now_s)
        for robot in robots:
            health.heard(robot, now_s + 0.01)

    def states(now_s: float) -> list[RobotState]:
        return [r.state for r in health.reports([Decided(), Decided()], now_s)]

    for k in range(10):
        step(0.1 * k, 0, 1)
    assert states(0.95) == [RobotState.OK, RobotState.OK]
    for now_s in (1.5, 60.0, 7200.0):  # paused
        assert states(now_s) == [RobotState.OK, RobotState.OK]
    assert "stands still" in report(health, "", 60.0).text
    step(7200.1)  # a single step, not answered yet; then on
    assert states(7200.1) == [RobotState.OK, RobotState.OK]
    for k in range(10):
        step(7300.0 + 0.1 * k, 0)  # robot 1 stays silent
    assert states(7300.95) == [RobotState.OK, RobotState.LOST]
    assert report(health, "", 7300.95).text == "ok"
    assert states(9000.0) == [RobotState.OK, RobotState.LOST]  # and a pause does not bring it back


def test_a_step_that_takes_long_counts_in_part() -> None:
    """Steps further apart than half the timeout: a silent robot is lost, if later."""
    health = TeamHealth(1, TIMEOUT_S)
    health.sim_moved(0.0)
    health.heard(0, 0.01)
    for k in (1, 2, 3):
        health.sim_moved(float(k))
    assert report(health, "", 3.0).state is RobotState.LOST


def test_a_silent_robot_is_lost_even_where_a_plan_mutes_it() -> None:
    health = TeamHealth(1, TIMEOUT_S)
    assert report(health, "mute", 0.0).state is RobotState.LOST
    health.heard(0, 1.0)
    assert report(health, "mute", 2.0).text == "lost: no command in time"


def test_programs_read_state_mode_episode_step_and_age() -> None:
    health = TeamHealth(1, TIMEOUT_S)
    assert dict(report(health, "", 0.0).values)["command_age_s"] == "never"
    health.heard(0, 1.0)
    assert dict(report(health, "mute", 1.25).values) == {
        "state": "muted", "mode": "mute", "episode": "3", "step": "14", "command_age_s": "0.250",
    }  # fmt: skip


def test_intruders_are_named_while_they_are_there() -> None:
    health = TeamHealth(1, TIMEOUT_S)
    health.heard(0, 1.0)
    health.intruders(0, ("/other (gid 01)",))
    shown = report(health, "", 1.1)
    assert "somebody else publishes on its command topic: /other (gid 01)" in shown.text
    assert dict(shown.values)["intruders"] == "/other (gid 01)"
    health.intruders(0, ())
    assert report(health, "", 1.1).text == "ok"
