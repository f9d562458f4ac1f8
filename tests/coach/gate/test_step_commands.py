"""The commands of a step, kept until all of its robots are decided."""

from __future__ import annotations

from crash_coach_pkg.gate.step_commands import StepCommands


def test_a_step_goes_out_whole() -> None:
    step = StepCommands(3)
    assert step.decided((0, 0), 1, b"1") == []
    assert step.decided((0, 0), 0, b"0") == []
    assert step.decided((0, 0), 2, b"2") == [(1, b"1"), (0, b"0"), (2, b"2")]
    assert step.decided((0, 1), 2, b"3") == []


def test_a_withheld_command_counts_and_is_not_sent() -> None:
    step = StepCommands(2)
    assert step.decided((0, 0), 0, b"0") == []
    assert step.decided((0, 0), 1, None) == [(0, b"0")]


def test_a_newer_step_lets_go_of_the_one_before() -> None:
    step = StepCommands(3)
    assert step.decided((0, 0), 0, b"0") == []
    assert step.decided((0, 0), 1, b"1") == []
    # Two robots it was, so two it is.
    assert step.decided((0, 1), 0, b"2") == [(0, b"0"), (1, b"1")]
    assert step.decided((0, 1), 1, b"3") == [(0, b"2"), (1, b"3")]
    # A third one comes late: nothing is left to wait for.
    assert step.decided((0, 1), 2, b"4") == [(2, b"4")]
    assert step.decided((0, 2), 0, b"5") == []
    assert step.decided((0, 2), 1, b"6") == []
    assert step.decided((0, 2), 2, b"7") == [(0, b"5"), (1, b"6"), (2, b"7")]
