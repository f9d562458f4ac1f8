"""Training on somebody else's environment: resumed, made longer, and without successes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_run import SMALL

from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import crash_free
from policy_pkg.play.evaluate import evaluate
from policy_pkg.report.finished_runs import read_runs
from policy_pkg.report.kept_evaluations import Evaluations
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run import train
from policy_pkg.train.run_dir import RunError, kept_scenario, scenario_of

SUPPORT = Path(__file__).resolve().parents[2] / "support"
AGENT = "checkpoints/step_000001200/agent.safetensors"


@pytest.fixture(scope="module", autouse=True)
def importable() -> Iterator[None]:
    sys.path.insert(0, str(SUPPORT))
    yield
    sys.path.remove(str(SUPPORT))


def corridor(rules: dict[str, Any] | None = None, **changes: Any) -> TrainConfig:
    told = {"stay_action": 0, "success_info": "all_through"} if rules is None else rules
    scenario = {"scenario": "pettingzoo:corridor_env:Corridor", "env_args": {"length": 5}}
    return TrainConfig.model_validate({**SMALL, **scenario, "env_rules": told, **changes})


def test_a_run_that_is_made_longer_is_one_that_always_was(tmp_path: Path) -> None:
    train(corridor(), tmp_path / "whole")
    train(corridor(total_steps=600), tmp_path / "half")
    with pytest.raises(RunError, match="total_steps = 600, not 300"):
        train(corridor(total_steps=300), tmp_path / "half", resume=True)
    train(corridor(), tmp_path / "half", resume=True)
    assert (tmp_path / "half" / AGENT).read_bytes() == (tmp_path / "whole" / AGENT).read_bytes()
    told = json.loads((tmp_path / "half" / "run.json").read_text())
    assert told["config"]["total_steps"] == 1200
    assert told["extended"] == [{"total_steps": 600}]
    (run,) = read_runs([tmp_path / "half"])
    assert run.finished


def test_an_environment_that_does_not_repeat_itself_is_found_out(tmp_path: Path) -> None:
    config = corridor(scenario="pettingzoo:corridor_env:Unseeded", total_steps=606)
    train(config, tmp_path / "run")
    longer = config.model_copy(update={"total_steps": 1200})
    with pytest.raises(UserError, match=r"does not repeat the episodes|ends an episode earlier"):
        train(longer, tmp_path / "run", resume=True)


def test_without_a_rule_success_is_not_told(tmp_path: Path) -> None:
    config = corridor({"stay_action": 0}, coach={}, total_steps=300)
    train(config, tmp_path / "run")
    bundle = load_policy(tmp_path / "run")
    found = evaluate(bundle, scenario_of(bundle), crash_free(), 2, seed=0)
    assert found.summary()["success_rate"] is None
    (run,) = read_runs([tmp_path / "run"])
    with pytest.raises(UserError, match=r"success_return or env_rules\.success_info"):
        Evaluations(tmp_path / "kept", 2, 0).result(run, [crash_free()], lambda condition: None)
    with pytest.raises(UserError, match=r"reports no success, which coach\.strategy"):
        train(corridor({"stay_action": 0}), tmp_path / "other")


def test_the_run_keeps_arguments_and_rules(tmp_path: Path) -> None:
    config = corridor(total_steps=300)
    train(config, tmp_path / "run")
    kept = kept_scenario(tmp_path / "run")
    assert kept is not None
    assert kept.sha256 == config.scenario_source().sha256
    foreign = kept.foreign()
    assert foreign is not None
    assert (foreign.env_args, foreign.success_info) == ({"length": 5}, "all_through")
