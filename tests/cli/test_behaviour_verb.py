"""`crash-coach behaviour`: figures of trained teams, and errors that say what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from in_process import refused, typed

SHARE = Path(__file__).parents[2] / "results" / "recipe" / "share"
TEAMS = [str(SHARE / "qmix-s0"), str(SHARE / "adaptive-s0")]


def test_two_teams_beside_each_other(tmp_path: Path) -> None:
    out = tmp_path / "behaviour.json"
    asked = ("--victims", "robot_1", "--episodes", "1", "--json", str(out))
    done = typed("behaviour", *TEAMS, *asked)
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text())["rows"]
    # On the grid-world nobody is hit and nobody dies.
    assert {row["measure"] for row in rows} == {"crashed distance", "crashed life"}
    assert {row["method"] for row in rows} == {"qmix", "adaptive"}
    lives = {row["method"]: row["values"][0] for row in rows if row["measure"] == "crashed life"}
    assert lives["qmix"] == 20  # it never succeeds: the episode ends at its limit, 20 s
    assert lives["adaptive"] < 20
    assert "crashed life" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((), "nothing to measure"),
        (("nowhere",), "neither a run nor a folder of runs"),
        ((TEAMS[0], "--crashed", "3"), "--crashed 3: the team has 2 robots"),
        ((TEAMS[0], "--victims", "robot_9"), "--victims robot_9: unknown robot"),
    ],
)
def test_what_is_wrong_is_said(arguments: tuple[str, ...], reason: str) -> None:
    assert reason in refused("behaviour", *arguments)
