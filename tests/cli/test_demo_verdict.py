"""What the demo says of what it found."""

from __future__ import annotations

from pathlib import Path

import pytest

from crash_coach_bringup.cli.verbs.demo import Results, crash_conditions, judge
from policy_pkg.play.evaluate import EpisodeResult, Evaluation

ROBOTS = ("robot_1", "robot_2")


def results(plain: str, coached: str) -> Results:
    """Successes of each team, one letter per condition: y or n."""
    found: Results = {}
    for method, letters in (("qmix", plain), ("adaptive", coached)):
        for condition, letter in zip(crash_conditions(ROBOTS), letters, strict=True):
            one = EpisodeResult(0, letter == "y", 0.0, 5, (), "", "")
            evaluation = Evaluation(condition.name, ROBOTS, 0, (one,))
            found.setdefault(method, []).append((condition, evaluation))
    return found


@pytest.mark.parametrize(
    ("plain", "coached", "holds", "parts"),
    [
        ("ynn", "yyy", True, ["copes with each", "fails with robot_1 mute and with robot_2 mute"]),
        ("yny", "yyy", True, ["is as good until a robot crashes, but fails with robot_1 mute."]),
        ("yyy", "yyy", True, ["so, this time, does the plain team"]),
        ("nnn", "yyy", True, ["same 1,000 steps, fails with robot_1"]),
        ("ynn", "yyn", False, ["The coached team FAILED: robot_2 mute.", "total_steps=2000"]),
        ("yyy", "nyy", False, ["FAILED: crash-free.", "--out runs/demo_longer"]),
    ],
)
def test_it_says_what_was_found(plain: str, coached: str, holds: bool, parts: list[str]) -> None:
    found = judge(results(plain, coached), 1000, Path("runs/demo"))
    assert found.holds is holds
    for part in parts:
        assert part in found.text
