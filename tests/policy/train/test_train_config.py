"""Training configs: the shipped ones, overrides, and what a wrong one says."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from crash_coach_common.strict_yaml import ConfigError, load_tree
from policy_pkg.train.config import TrainConfig, load_train_config, train_config_names
from sim_pkg.env import make_env

SHIPPED = Path(__file__).resolve().parents[3] / "configs" / "train"


@pytest.mark.parametrize("name", train_config_names())
def test_every_shipped_config_loads_and_names_a_scenario(name: str) -> None:
    config = load_train_config(name)
    assert make_env(config.scenario, 1).spec.n_robots >= 1
    assert (
        config == load_train_config(f"{name}.yaml") == load_train_config(SHIPPED / f"{name}.yaml")
    )


def keys(model: type[BaseModel]) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, field in model.model_fields.items():
        kind = field.annotation
        section = isinstance(kind, type) and issubclass(kind, BaseModel)
        found[name] = keys(kind) if section else None  # type: ignore[arg-type]
    return found


def test_the_full_file_shows_every_key_with_its_default() -> None:
    def shape(values: dict[str, object]) -> dict[str, object]:
        # An empty mapping is a value: of crash_parameters, whose keys are the mode's.
        return {k: shape(v) if v and isinstance(v, dict) else None for k, v in values.items()}

    tree = load_tree(SHIPPED / "buttons" / "qmix.yaml")
    assert shape(tree.values) == keys(TrainConfig)
    assert load_train_config("buttons/qmix") == TrainConfig.model_validate({"scenario": "buttons"})


def test_the_two_methods_differ_by_the_coach_only() -> None:
    for plain, coached in (("qmix", "adaptive"), ("demo_qmix", "demo_adaptive")):
        one, other = (load_train_config(f"buttons/{name}") for name in (plain, coached))
        assert (other.coach.strategy, other.coach.settings.beta) == ("adaptive", 0.75)
        assert other.model_copy(update={"coach": one.coach}) == one


def test_overrides_are_yaml_values_and_the_seed_wins() -> None:
    config = load_train_config(
        "buttons/qmix",
        ["total_steps=5_000", "learner.lr=1e-3", "coach.victims=[robot_2]", "seed=4"],
        seed=9,
    )
    assert (config.total_steps, config.learner.lr, config.seed) == (5000, 1e-3, 9)
    assert config.coach.victims == ("robot_2",)
    assert (
        load_train_config("buttons/adaptive", ["coach.adaptive.rho=0.5"]).coach.strategy
        == "adaptive"
    )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "coach.beta=1",
            r"--set coach\.beta=1: unknown key 'beta' of the coach \(did you mean 'adaptive\.beta'",
        ),
        ("coach.minalive=1", r"--set coach\.minalive=1: .*'minalive'.*did you mean 'min_alive'"),
        (
            "total_step=1",
            r"--set total_step=1: unknown key 'total_step' \(did you mean 'total_steps'",
        ),
        (
            "coach.adaptive.beta=1.5",
            r"--set coach\.adaptive\.beta=1\.5: strategy adaptive: setting beta = 1\.5: ",
        ),
        ("coach.adaptive.beta=.nan", r"--set coach\.adaptive\.beta=\.nan: .*setting beta = nan"),
        ("coach.adaptive.rho=true", r"setting rho = True: a number is needed"),
        ("n_envs=many", r"--set n_envs=many: n_envs = 'many'"),
        ("n_envs", r"--set n_envs: expected key=value"),
        ("=3", r"--set =3: expected key=value"),
        ("seed.x=3", r"--set seed\.x=3: 'seed' is a value, not a section"),
        ("n_envs=[1", r"--set n_envs=\[1: '\[1' is not a YAML value"),
        (
            "replay_weights=importance",
            r"with --set replay_weights=importance: replay_weights importance has no effect with",
        ),
        (
            "batch_episodes=6000",
            r"with --set batch_episodes=6000: batch_episodes 6000 is more",
        ),
        ("epsilon_start=0.01", r"epsilon_finish 0\.05 is above epsilon_start 0\.01"),
        (
            "learner.crashed_loss=drop",
            r"with --set learner\.crashed_loss=drop: learner: ",
        ),
    ],
)
def test_a_wrong_override_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_train_config("buttons/qmix", [override])


def test_a_wrong_file_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("scenario: buttons\nlearner:\n  gama: 0.9\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:3: unknown key 'learner\.gama'.*gamma"):
        load_train_config(path)
    # A right override does not take the blame for the file.
    with pytest.raises(ConfigError, match=r"mine\.yaml:3: unknown key"):
        load_train_config(path, ["learner.gamma=0.9"])
    path.write_text("total_steps: 10\n")
    with pytest.raises(ConfigError, match="key 'scenario' is missing"):
        load_train_config(path)


def test_an_unknown_config_lists_the_known() -> None:
    with pytest.raises(ConfigError, match=r"'buttons/qmixx'.*did you mean 'buttons/qmix'.*known: "):
        load_train_config("buttons/qmixx")


def test_epsilon_falls_linearly_then_stays() -> None:
    config = load_train_config("buttons/qmix", ["epsilon_anneal_steps=100"])
    assert [config.epsilon(steps) for steps in (0, 50, 100, 10**6)] == pytest.approx(
        [1.0, 0.525, 0.05, 0.05]
    )
