"""Configs of `train-offline`: the shipped ones, and what a wrong one says."""

from __future__ import annotations

from pathlib import Path

import pytest

from crash_coach_common.strict_yaml import ConfigError, load_tree
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.train.config import load_train_config, train_config_names
from policy_pkg.train.offline.config import OfflineConfig, load_offline_config, offline_config_names
from sim_pkg.env import make_env

SHIPPED = Path(__file__).resolve().parents[4] / "configs" / "train"


@pytest.mark.parametrize("name", offline_config_names())
def test_every_shipped_config_loads_and_names_a_scenario(name: str) -> None:
    config = load_offline_config(name)
    assert config.scenario is not None
    assert make_env(config.scenario, 1).spec.n_robots >= 1
    assert config == load_offline_config(SHIPPED / f"{name}.yaml")


def test_the_two_kinds_of_configs_are_kept_apart() -> None:
    assert "offline/qmix" in offline_config_names()
    assert not set(offline_config_names()) & set(train_config_names())
    with pytest.raises(ConfigError, match="no training config 'offline/qmix'"):
        load_train_config("offline/qmix")
    with pytest.raises(ConfigError, match=r"no training config 'buttons/qmix'.*offline/qmix"):
        load_offline_config("buttons/qmix")


def test_the_full_file_shows_every_key_with_its_default() -> None:
    name = "offline/conservative_qmix"
    tree = load_tree(SHIPPED / f"{name}.yaml")
    assert set(tree.values) == set(OfflineConfig.model_fields)
    assert set(tree.values["learner"]) == set(LearnerConfig.model_fields)
    plain = load_offline_config(name, ["learner.conservative_weight=0"])
    assert plain == load_offline_config("offline/qmix")
    assert plain == OfflineConfig.model_validate({"scenario": "buttons"})
    cloning = load_offline_config("offline/behaviour_cloning")
    assert cloning.model_copy(update={"method": "q_learning"}) == plain


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["crash_rate=0.1"], "crash_rate 0.1 has no effect with crash_weighting none"),
        (["crash_weighting=resample"], "crash_weighting resample needs a crash_rate"),
        (["test_crashed=[0]"], r"test_crashed \[0\]: must be different numbers from 1 on"),
        (["test_crashed=[1, 1]"], r"test_crashed \[1, 1\]"),
        (["method=behaviour_cloning"], "conservative_weight 1 has no effect"),
        (["gradient_step=5"], "gradient_steps"),
        (["learner.conservative_weight=-1"], "conservative_weight"),
        (["memory_limit_mib=0"], "memory_limit_mib"),
    ],
)
def test_a_wrong_setting_is_named(overrides: list[str], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        load_offline_config("offline/conservative_qmix", overrides)
