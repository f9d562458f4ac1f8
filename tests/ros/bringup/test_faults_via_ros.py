"""A fault scenario over ROS: the same episodes, events and verdicts as in one process."""

from __future__ import annotations

from pathlib import Path

from crash_coach_bringup.cli.faults.play import play
from crash_coach_bringup.cli.options import Layout, Via
from crash_coach_pkg.coach.fault_scenario import load_fault_scenario
from policy_pkg.play.target import load_target
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

# Command and observation faults together; a fault from its start step, a hazard, a condition.
FILE = """
description: several at once
scenario: buttons
faults:
  - {crash_mode: adversarial, crashed_exactly: 1, start_step: 2, duration_steps: 5}
  - {crash_mode: drop, hazard_rate_hz: 0.2, duration_steps: 2}
  - {crash_mode: blind, victims: [robot_2], start_step: 3}
  - {crash_mode: freeze, victims: [robot_1], near_point_m: [1.5, 7.5], near_radius_m: 6.0,
     duration_steps: 4}
expect:
  - effects: {at_least: 0.1}
  - success_rate: {at_least: 1.0}
"""


def test_ros_gives_the_same_events_and_verdicts(tmp_path: Path) -> None:
    path = tmp_path / "several.yaml"
    path.write_text(FILE)
    checkpoint = tmp_path / "step_000000000"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=1)
    target = load_target(str(checkpoint), "buttons")
    scenario = load_fault_scenario(path)
    core = play(scenario, target, 3, 5, Via.core, Layout.single)
    assert play(scenario, target, 3, 5, Via.ros, Layout.single) == core
    assert {(row.entry, row.mode) for row in core.faulted.effects} == {
        (0, "adversarial"),
        (1, "drop"),
        (2, "blind"),
        (3, "freeze"),
    }
