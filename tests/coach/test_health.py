"""What gates say of each robot's stream of commands."""

from __future__ import annotations

from crash_coach_pkg.health import Decided, Report, RobotState, TeamHealth

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
