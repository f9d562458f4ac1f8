"""Every scenario of ours keeps what scenarios promise; what does not is found out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from in_process import refused, typed

from crash_coach_common.contract import EnvSpec, StepResult
from sim_pkg.conformance import check_env
from sim_pkg.env import Env, make_any_env, make_env, scenario_names
from sim_pkg.foreign.config import EnvRules
from sim_pkg.scenario_source import read_scenario


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_of_ours(name: str) -> None:
    checks = check_env(lambda arenas: make_env(name, arenas), episodes=2)
    assert [check for check in checks if not check.kept] == []
    assert [check.name for check in checks] == [
        "masks", "bounds", "seeds", "leaving", "ends", "success", "speed",
    ]  # fmt: skip


class Late(Env):
    @property
    def spec(self) -> EnvSpec:
        return replace(super().spec, episode_limit=5)


class Narrow(Env):
    @property
    def spec(self) -> EnvSpec:
        return replace(super().spec, bounds=(0.0, 0.1))


class Early(Env):
    def step(self, actions: Any) -> StepResult:
        result = super().step(actions)
        return replace(result, success=np.ones_like(result.success))


class Maskless(Env):
    @property
    def available(self) -> Any:
        return np.zeros_like(super().available)


@pytest.mark.parametrize(
    ("broken", "name", "text"),
    [
        (Late, "ends", "still going on after 5 steps"),
        (Narrow, "bounds", "observation from"),
        (Early, "success", "before the end"),
        (Maskless, "masks", "without any action"),
    ],
)
def test_what_is_broken_is_found(broken: type[Env], name: str, text: str) -> None:
    def make(arenas: int) -> Env:
        env = make_env("buttons", arenas)
        env.__class__ = broken
        return env

    failed = {check.name: check.told for check in check_env(make) if not check.kept}
    assert text in failed[name]


def test_an_environment_that_ignores_its_seed() -> None:
    rules = EnvRules.model_validate({"stay_action": 0})
    for factory, kept in (("Corridor", True), ("Unseeded", False)):
        source = read_scenario(f"pettingzoo:corridor_env:{factory}", {}, rules)
        checks = check_env(lambda arenas, source=source: make_any_env(source, arenas), 6)
        assert {check.name: check.kept for check in checks}["seeds"] is kept
        assert all(check.kept for check in checks if check.name != "seeds")


def test_the_verb() -> None:
    done = typed("check-scenario", "buttons")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("ok ") == 7
    zoo = "pettingzoo:corridor_env:"
    assert typed("check-scenario", f"{zoo}Corridor", "--set", "env_rules.stay_action=0")[0] == 0
    done = typed("check-scenario", f"{zoo}Unseeded", "--set", "env_rules.stay_action=0")
    assert done.returncode == 1
    assert "FAILED seeds" in done.stdout
    assert "stay_action is missing" in refused("check-scenario", f"{zoo}Corridor")
