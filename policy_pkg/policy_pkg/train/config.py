"""Training settings: the schema, and strict loading of a file with ``--set`` overrides."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from crash_coach_common.contract import UserError
from crash_coach_common.strict_yaml import (
    ConfigError,
    StrictModel,
    YamlTree,
    did_you_mean,
    load_tree,
    parse_value,
    shipped_names,
    validate,
)
from crash_coach_pkg.coach.config import CoachConfig
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.strata import Strata, Weights
from policy_pkg.train.loggers import Chosen
from sim_pkg.foreign.config import EnvRules
from sim_pkg.scenario_source import NO_RULES, ScenarioSource, read_scenario

CONFIGS_DIR = Path(__file__).parent.parent / "configs"
OFFLINE = "offline"  # its folder is that of `train-offline`
TRAINING = "training config"
SWEEPS = ("paper", "recipe")  # their folders are those of `sweep`

SettingsT = TypeVar("SettingsT", bound="RunSettings")


def _with_defaults(loggers: dict[str, Any]) -> dict[str, bool | dict[str, Any]]:
    for name, told in loggers.items():
        if not isinstance(told, bool | dict):
            raise ValueError(f"{name} = {told!r}: must be true, false, or the logger's options")
    told = {name: True if options == {} else options for name, options in loggers.items()}
    return {"tensorboard": True, **told}


class RunSettings(StrictModel):
    """What every training run has, whatever it learns from."""

    loggers: Annotated[dict[str, Any], AfterValidator(_with_defaults)] = Field(
        {},
        validate_default=True,
        description="who is told of the metrics beside metrics.jsonl, by name: tensorboard (unless "
        "it is false), mlflow, another package's; true, false, or its options",
    )


class TrainConfig(RunSettings):
    """One training run. The defaults are those of ``configs/train/buttons/qmix.yaml``, which says
    what each key is for."""

    scenario: str = Field(
        description="shipped scenario's name, path of a .yaml file, or "
        "pettingzoo:PACKAGE.MODULE:FACTORY"
    )
    env_args: dict[str, Any] = Field(
        {},
        exclude_if=lambda args: not args,
        description="of a pettingzoo: scenario: keyword arguments of its factory",
    )
    env_rules: EnvRules = Field(
        NO_RULES,
        exclude_if=lambda rules: rules == NO_RULES,
        description="of a pettingzoo: scenario: what it does not say of itself",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="keys everything that is drawn")
    total_steps: int = Field(2_000_000, ge=1, description="environment steps, all arenas counted")
    n_envs: int = Field(8, ge=1, le=4096, description="arenas that run side by side")
    updates_per_episode: float = Field(
        0.125, gt=0, le=64, description="gradient steps per finished episode; credit adds up"
    )
    batch_episodes: int = Field(32, ge=1, description="episodes of one gradient step")
    replay_episodes: int = Field(5_000, ge=1, description="episodes that the replay keeps")
    replay_strata: Strata = Field(
        "none",
        description="draw half of the episodes evenly over strata: by which robots crashed, or by "
        "outcome (that and success); none: uniformly",
    )
    replay_weights: Weights = Field(
        "none",
        description="importance: an episode counts in the loss by 1 / (N p), p its chance to be "
        "drawn from N; strata then change how often it is seen, not how much it counts",
    )
    epsilon_start: float = Field(1.0, ge=0, le=1, description="exploration at the start")
    epsilon_finish: float = Field(0.05, ge=0, le=1, description="exploration after annealing")
    epsilon_anneal_steps: int = Field(
        50_000, ge=1, description="environment steps over which epsilon falls linearly"
    )
    explore_hold: int = Field(
        1,
        ge=1,
        le=1_000,
        description="longest random action, control steps: drawn once, then held; 1: drawn anew",
    )
    test_interval_steps: int = Field(
        10_000, ge=1, description="environment steps between two evaluation blocks"
    )
    test_episodes: int = Field(32, ge=1, description="greedy episodes of an evaluation block")
    test_crash_free: bool = Field(
        True, description="play each block's episodes without crashes too, for the learning curve"
    )
    test_victim_episodes: int = Field(
        0,
        ge=0,
        description="greedy episodes per block and robot, in which it alone crashes; 0: none",
    )
    checkpoint_interval_steps: int = Field(
        100_000, ge=1, description="environment steps between two checkpoints, at block ends"
    )
    checkpoint_replay: bool = Field(
        True, description="save the replay: without it, resuming starts with an empty one"
    )
    learner: LearnerConfig = LearnerConfig.model_validate({})
    coach: CoachConfig = CoachConfig()

    @model_validator(mode="after")
    def _batch_fits_replay(self) -> Self:
        if self.batch_episodes > self.replay_episodes:
            raise ValueError(
                f"batch_episodes {self.batch_episodes} is more than replay_episodes "
                f"{self.replay_episodes}: learning would never start"
            )
        return self

    @model_validator(mode="after")
    def _weights_need_strata(self) -> Self:
        if self.replay_weights != "none" and self.replay_strata == "none":
            raise ValueError(
                f"replay_weights {self.replay_weights} has no effect with replay_strata none: all "
                "episodes are drawn alike"
            )
        return self

    @model_validator(mode="after")
    def _epsilon_falls(self) -> Self:
        if self.epsilon_finish > self.epsilon_start:
            raise ValueError(
                f"epsilon_finish {self.epsilon_finish} is above epsilon_start {self.epsilon_start}"
            )
        return self

    def scenario_source(self) -> ScenarioSource:
        """Raises ConfigError where the scenario is unknown or takes no env_args."""
        return read_scenario(self.scenario, self.env_args, self.env_rules)

    def epsilon(self, env_steps: int) -> float:
        """Linear from ``epsilon_start`` to ``epsilon_finish``, then constant."""
        done = min(1.0, env_steps / self.epsilon_anneal_steps)
        return self.epsilon_start + (self.epsilon_finish - self.epsilon_start) * done


def graph_seed(seed: int, graph: int) -> int:
    """Of the ``graph``-th sim and its exploration: graphs play different episodes."""
    if graph == 0:
        return seed
    return int(np.random.SeedSequence([seed, graph]).generate_state(1, np.uint64)[0]) >> 1


@dataclass(frozen=True)
class Setting:
    """``key=value`` or ``section.key=value``; ``place``: what an error calls it."""

    key: str
    value: Any
    place: str


@dataclass(frozen=True)
class _Overridden(YamlTree):
    """A tree in which some values come from elsewhere: ``overrides`` says where, by their keys."""

    overrides: dict[tuple[str, ...], str] = field(default_factory=dict)

    def where(self, location: tuple[int | str, ...]) -> str:
        for keys, place in self.overrides.items():
            if location[: len(keys)] == keys:
                return place
        # A whole section is wrong: what was overridden in it may be the reason, or not.
        inside = [
            place for keys, place in self.overrides.items() if keys[: len(location)] == location
        ]
        return " with ".join([super().where(location), *inside])


def config_names(offline: bool) -> tuple[str, ...]:
    """Names of the shipped configs of `train`, or of `train-offline`; sorted."""
    folders = [(name, name.split("/")[0]) for name in shipped_names(CONFIGS_DIR)]
    if offline:
        return tuple(name for name, folder in folders if folder == OFFLINE)
    return tuple(name for name, folder in folders if folder not in (OFFLINE, *SWEEPS))


def train_config_names() -> tuple[str, ...]:
    """Names of the shipped training configs, such as ``buttons/qmix``; sorted."""
    return config_names(offline=False)


def load_train_config(
    source: str | Path, overrides: Sequence[str] = (), seed: int | None = None
) -> TrainConfig:
    """Reads a training config; as ``load_config``."""
    return load_config(TrainConfig, train_config_names(), source, overrides, seed)


def load_config(
    model: type[SettingsT],
    known: tuple[str, ...],
    source: str | Path,
    overrides: Sequence[str],
    seed: int | None,
) -> SettingsT:
    """Reads a config of ``model``, which has a key ``seed``.

    Args:
        known: names of the shipped ones.
        source: a shipped config's name, with or without ``.yaml``, or a path.
        overrides: ``key=value`` or ``section.key=value``; values are read as YAML.
        seed: replaces the config's.

    Raises:
        ConfigError: names the file and line or the override, the key, the value, what is right.
    """
    given = [_parse(text) for text in [*overrides, *([] if seed is None else [f"seed={seed}"])]]
    tree = with_settings(load_tree(find_config(TRAINING, source, known)), given)
    config = validate(tree, model)
    try:
        Chosen(config.loggers)
    except UserError as error:
        raise ConfigError(f"{tree.where(('loggers',))}: {error}") from error
    return config


def load_train_tree(source: str | Path) -> YamlTree:
    """A training config, for ``with_settings`` and ``validate``; found as by ``load_config``."""
    return load_tree(find_config(TRAINING, source, train_config_names()))


def with_settings(base: YamlTree, settings: Iterable[Setting]) -> YamlTree:
    """A copy of ``base`` with these values, later ones over earlier ones.

    Raises:
        ConfigError: a key that leads into a value.
    """
    values = deepcopy(base.values)
    given: dict[tuple[str, ...], str] = {}
    for setting in settings:
        keys = _apply(values, setting)
        given.pop(keys, None)
        given[keys] = setting.place
    return _Overridden(base.path, values, base.lines, given)


def find_config(what: str, source: str | Path, known: tuple[str, ...]) -> Path:
    """The file of a shipped config, with or without ``.yaml``, or of a path.

    Raises:
        ConfigError: neither a known name nor an existing .yaml file; calls it a ``what``.
    """
    name = str(source).removesuffix(".yaml")
    if name in known and not Path(source).is_file():
        return CONFIGS_DIR / f"{name}.yaml"
    path = Path(source)
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    raise ConfigError(
        f"no {what} {str(source)!r}{did_you_mean(name, known)}; "
        f"known: {', '.join(known)}, or the path of a .yaml file"
    )


def _parse(text: str) -> Setting:
    """A setting of the command line."""
    key, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"--set {text}: expected key=value or section.key=value")
    try:
        return Setting(key.strip(), parse_value(value), f"--set {text}")
    except ConfigError as error:
        raise ConfigError(f"--set {text}: {error}") from error


def _apply(values: dict[str, Any], setting: Setting) -> tuple[str, ...]:
    """Puts one setting into ``values``; returns the keys that lead to it."""
    keys = tuple(setting.key.split("."))
    if not all(keys):
        raise ConfigError(f"{setting.place}: expected key=value or section.key=value")
    place = values
    for part in keys[:-1]:
        place = place.setdefault(part, {})
        if not isinstance(place, dict):
            raise ConfigError(f"{setting.place}: {part!r} is a value, not a section")
    place[keys[-1]] = deepcopy(setting.value)
    return keys
