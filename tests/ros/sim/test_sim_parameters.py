"""Parameters of the sim node: each wrong one is named, with what would be right."""

from __future__ import annotations

import pytest
import rclpy
from sim_driver import Env, end_of, sim

from crash_coach_common.contract import UserError
from sim_pkg.ros.sim_node import SimNode


def test_a_bad_start_is_one_line_and_exit_code_1(ros_env: Env) -> None:
    with sim(ros_env, senario="buttons") as process:
        code, errors = end_of(process)
    assert code == 1
    assert errors.startswith(
        "sim: error: unknown parameter 'senario' (did you mean 'scenario'?) of sim; known: "
    )
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("resend_afters:=1.0", r"unknown parameter 'resend_afters' .*'resend_after_s'"),
        ("resend_after_s:=.nan", "parameter resend_after_s = nan"),
        ("mode:=fast", "parameter mode = 'fast'"),
        ("seed:=-1", "parameter seed = -1"),
        ("seed:=true", "parameter seed = True: .* integer"),
        ("autostart:=1", "parameter autostart = 1: .* boolean"),
        ("episodes:=many", "parameter episodes = 'many'"),
        ("scenario:=butons", r"unknown scenario 'butons' \(did you mean 'buttons'\?\)"),
    ],
)
def test_bad_parameters(ros_env: Env, parameters: str, message: str) -> None:
    rclpy.init(args=["--ros-args", "-p", parameters])
    try:
        with pytest.raises(UserError, match=message):
            SimNode()
    finally:
        rclpy.shutdown()


def test_whole_numbers_do_for_seconds(ros_env: Env) -> None:
    rclpy.init(args=["--ros-args", "-p", "resend_after_s:=1"])
    try:
        node = SimNode()
        assert node.get_parameter("resend_after_s").value == 1
        node.destroy_node()
    finally:
        rclpy.shutdown()
