"""`crash-coach profile`: what it prints is what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from crash_coach_bringup.cli.main import make_app, repeat_options
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.verbs.profile import HINTS, TITLES, hints, summary
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.profile import PARTS, Profile

CONFIG = TrainConfig.model_validate({"scenario": "buttons"})


def measured(busy: float = 0.5, **seconds: float) -> Profile:
    """1000 steps; a part takes so long, and a share ``busy`` of that of the processor."""
    spent = {**dict.fromkeys(PARTS, 0.0), **seconds}
    cpu = {part: busy * value for part, value in spent.items()}
    calls = {part: int(value > 0) for part, value in spent.items()}
    return Profile(spent, cpu, calls, 0.05, 1000, 50, 10, 0, 0.5)


def test_every_part_has_a_title_and_a_hint() -> None:
    assert set(TITLES) == set(HINTS) == set(PARTS)


def test_hints_begin_with_the_longest_part_and_leave_out_the_short_ones() -> None:
    found = hints(measured(physics=3.0, learner=6.8, coach=0.2))
    assert [line.split(":")[0] for line in found] == ["learner, 68 %", "physics, 30 %"]


def test_hints_beside_other_programs_go_by_the_processor() -> None:
    result = measured(physics=3.0, learner=6.8)
    result.cpu_seconds["learner"] = 0.5
    found = hints(result)
    assert [line.split(":")[0] for line in found] == ["physics, 75 %", "learner, 25 %"]
    waits = measured(1.0, checkpoint=5.0, learner=5.0)
    waits.cpu_seconds["checkpoint"] = 4.5  # the rest of it is the disk's
    assert [line.split(":")[0] for line in hints(waits)] == ["learner, 50 %", "checkpoints, 50 %"]


def test_the_summary_says_what_the_table_does_not() -> None:
    text = "\n".join(summary(measured(learner=8.0, physics=2.0), CONFIG))
    assert "100 steps/s: 1,000 environment steps" in text
    assert "10 gradient steps of 400.0 ms" in text
    assert "a core for 50 % of the time" in text
    assert "a core of its own 200 steps/s" in text
    assert "of the time only" not in "\n".join(summary(measured(1.0, learner=8.0), CONFIG))
    # A block of 0.5 s every 10,000 steps of 10 ms.
    assert "blocks in this time: 0; one takes 0.50 s, which every 10,000 steps is 0.5 %" in text
    assert "no checkpoint in this time; there is one every 100,000" in text
    assert "timers took about 1.0 %" in text


def command(*arguments: str) -> Result:
    return CliRunner().invoke(make_app("profile"), repeat_options(["profile", *arguments]))


def test_the_verb_writes_what_it_prints(tmp_path: Path) -> None:
    out = tmp_path / "profile.json"
    small = ("n_envs=4", "batch_episodes=2", "learner.hidden=8", "loggers.tensorboard=false")
    done = command("buttons/qmix", "--seconds", "1", "--json", str(out), "--set", *small)
    assert done.exit_code == 0, done.output
    result = json.loads(out.read_text())
    assert result["config"]["n_envs"] == 4
    assert sum(part["share"] for part in result["parts"].values()) == pytest.approx(1)
    assert sum(part["seconds"] for part in result["parts"].values()) == result["wall_s"] >= 1
    for name in TITLES.values():
        assert name in done.output
    assert f"{result['steps_per_s']:,.0f} steps/s" in done.output
    assert "what to change:" in done.output


def test_bad_input_is_named(tmp_path: Path) -> None:
    (tmp_path / "no").touch()
    nowhere = command("buttons/qmix", "--json", str(tmp_path / "no" / "x.json"))
    assert isinstance(nowhere.exception, CliError)
    assert "no is not a folder" in str(nowhere.exception)
    assert "unknown key 'n_env'" in str(command("buttons/qmix", "--set", "n_env=4").exception)
    assert "--seed 1 2" in str(command("buttons/qmix", "--seed", "1", "2").exception)
    assert command("buttons/qmix", "--seconds", "0").exit_code == 2
