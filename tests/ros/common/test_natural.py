"""Names in the order that people expect."""

from __future__ import annotations

from crash_coach_common.natural import natural


def test_numbers_are_compared_as_numbers() -> None:
    names = ["qmix-s10", "qmix-s2", "robot_10", "robot_9b", "robot_9", "", "7", "x²", "a-s1"]
    assert sorted(names, key=natural) == [
        *("", "7", "a-s1", "qmix-s2", "qmix-s10", "robot_9", "robot_9b", "robot_10", "x²")
    ]
