"""The demo's picture: the evaluated episodes, played again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from crash_coach_bringup.cli.picture import TeamResults, draw_first_episodes
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import crash_free, named
from policy_pkg.play.evaluate import evaluate
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env


def test_it_draws_the_evaluated_episodes_and_no_others(tmp_path: Path) -> None:
    write_untrained(tmp_path / "step_000000000", make_env("buttons", 1).spec, seed=1)
    bundle = load_policy(tmp_path / "step_000000000")
    asked = (crash_free(), named(["robot_1"], "random"))
    results = [(c, evaluate(bundle, "buttons", c, 2, 7)) for c in asked]
    team = TeamResults("untrained", "tab:green", bundle, results)
    draw_first_episodes([team], "buttons", tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")

    condition, evaluation = results[1]
    other = (condition, replace(evaluation, seed=8))
    with pytest.raises(RuntimeError, match="untrained, robot_1 random: episode 0 has"):
        draw_first_episodes([replace(team, results=[other])], "buttons", tmp_path / "other.png")
    assert not (tmp_path / "other.png").exists()
