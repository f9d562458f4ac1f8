"""A sweep's file, and the runs it stands for: methods x scenarios x seeds, with stable names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_common.strict_yaml import (
    ConfigError,
    Misplaced,
    StrictModel,
    YamlTree,
    did_you_mean,
    load_tree,
    shipped_names,
    validate,
)
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.team import TeamSpec
from policy_pkg.train.config import (
    CONFIGS_DIR,
    SWEEPS,
    Setting,
    TrainConfig,
    find_config,
    load_train_tree,
    with_settings,
)
from policy_pkg.train.loggers import Chosen
from sim_pkg.env import make_any_env
from sim_pkg.scenario_source import ScenarioSource, short_name

FULL = "full"
METHOD_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
SEED_ENDING = re.compile(r"-s\d+$")
OF_THE_SWEEP = {"scenario": "scenarios", "seed": "seeds"}

Settings = dict[str, Any]
Placed = tuple[str, Any, tuple[str, ...]]  # a setting's key and value, and where they stand


class SweepSize(StrictModel):
    """What another size of a sweep has instead; its ``set`` counts over everybody else's."""

    seeds: tuple[int, ...] | None = Field(None, min_length=1, description="instead of the sweep's")
    scenarios: tuple[str, ...] | None = Field(None, min_length=1, description="likewise")
    methods: tuple[str, ...] | None = Field(
        None, min_length=1, description="names of those that this size has; null: all"
    )
    set: Settings = Field({}, description="settings of every run of this size")
    scenario_set: dict[str, Settings] = Field(
        {}, description="settings of a scenario's runs of this size, by the scenario's name"
    )


class SweepConfig(StrictModel):
    """Every method on every scenario with every seed is a run of ``config``.

    Settings are those of a training configuration, ``learner.lr: 1e-3`` as ``--set`` has them.
    """

    config: str = Field(description="training configuration: a name, or path of a .yaml file")
    set: Settings = Field({}, description="settings of every run")
    scenario_set: dict[str, Settings] = Field(
        {}, description="settings of a scenario's runs, by its name; they count over a method's"
    )
    scenarios: tuple[str, ...] = Field(min_length=1, description="names, or paths of .yaml files")
    seeds: tuple[int, ...] = Field(min_length=1, description="training seeds")
    methods: dict[str, Settings] = Field({}, description="settings of each method, by its name")
    grid: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(
        {}, description="values of settings; each combination is a method, named after it"
    )
    sizes: dict[str, SweepSize] = Field({}, description="other sizes, by name")

    @model_validator(mode="after")
    def _scenarios_are_known(self) -> Self:
        known = [
            *self.scenarios,
            *(name for o in self.sizes.values() for name in o.scenarios or ()),
        ]
        _check_scenarios(self.scenario_set, known, ())
        for size, content in self.sizes.items():
            own = content.scenarios or self.scenarios
            _check_scenarios(content.scenario_set, own, ("sizes", size))
        return self

    @model_validator(mode="after")
    def _sizes_fit(self) -> Self:
        if FULL in self.sizes:
            raise Misplaced(("sizes", FULL), f"{FULL!r} is what stands outside sizes")
        known = list(self.all_methods())
        for size, content in self.sizes.items():
            for name in content.methods or ():
                if name not in known:
                    raise Misplaced(
                        ("sizes", size, "methods"),
                        f"unknown method {name!r}{did_you_mean(name, known)}; "
                        f"known: {', '.join(known)}",
                    )
        return self

    @model_validator(mode="after")
    def _names_can_be_folders(self) -> Self:
        if not self.methods and not self.grid:
            raise ValueError("neither methods nor a grid: nothing to compare")
        for name in self.methods:
            _check_name(name, ("methods", name))
        return self

    def all_methods(self) -> dict[str, list[Placed]]:
        """Each method's settings by its name; the grid's methods come last.

        Raises:
            Misplaced: two methods of one name, or a name that cannot be a folder's.
        """
        found: dict[str, list[Placed]] = {
            name: [(key, value, ("methods", name, key)) for key, value in settings.items()]
            for name, settings in self.methods.items()
        }
        for values in product(*self.grid.values()) if self.grid else ():
            cell = list(zip(self.grid, values, strict=True))
            name = "-".join(f"{key.split('.')[-1]}_{value}" for key, value in cell)
            _check_name(name, ("grid",))
            if name in found:
                raise Misplaced(("grid",), f"two methods are called {name!r}")
            found[name] = [(key, value, ("grid", key)) for key, value in cell]
        return found


@dataclass(frozen=True)
class SweepRun:
    """One run. ``name``: <scenario>/<method>-s<seed>, its folder in the sweep's."""

    name: str
    config: TrainConfig


def sweep_names() -> tuple[str, ...]:
    """Names of the shipped sweeps, such as ``paper/table1``; sorted."""
    return tuple(name for name in shipped_names(CONFIGS_DIR) if name.split("/")[0] in SWEEPS)


def find_sweep(source: str) -> Path:
    """The file of a shipped sweep's name, or of a path.

    Raises:
        ConfigError: neither a known name nor an existing .yaml file.
    """
    return find_config("sweep", source, sweep_names())


def load_sweep(path: Path, size: str = FULL) -> list[SweepRun]:
    """The runs of a sweep, all of a seed before the next: what is finished can be compared.

    Raises:
        ConfigError: names the file, the line and the key of the first thing that is wrong.
    """
    tree = load_tree(path)
    return _Expansion(tree, validate(tree, SweepConfig), size).runs()


class _Expansion:
    """Of one size of a sweep."""

    def __init__(self, tree: YamlTree, sweep: SweepConfig, size: str) -> None:
        if size != FULL and size not in sweep.sizes:
            known = ", ".join([FULL, *sweep.sizes])
            raise ConfigError(f"{tree.path}: no size {size!r}; known: {known}")
        self._tree = tree
        self._sweep = sweep
        self._size = sweep.sizes.get(size, SweepSize.model_validate({}))
        self._inside = ("sizes", size) if size != FULL else ()
        try:
            self._base = load_train_tree(sweep.config)
        except ConfigError as error:
            raise ConfigError(f"{tree.where(('config',))}: {error}") from error

    def runs(self) -> list[SweepRun]:
        scenarios = self._chosen("scenarios")
        seeds = self._chosen("seeds")
        found: dict[str, SweepRun] = {}
        for seed, scenario in product(seeds, scenarios):
            for method, settings in self._methods(scenario):
                run = self._run(method, settings, scenario, seed)
                if run.name in found:
                    raise ConfigError(f"{self._tree.path}: two runs are called {run.name}")
                found[run.name] = run
        self._check_different(found.values())
        return list(found.values())

    def _chosen(self, key: str) -> Sequence[Any]:
        own = getattr(self._size, key)
        return own if own is not None else getattr(self._sweep, key)

    def _methods(self, scenario: str) -> Iterator[tuple[str, list[Setting]]]:
        """Each method's settings on a scenario; the later ones count."""
        common = self._settings(self._sweep.set, ("set",))
        last = [
            *self._of_scenario(self._sweep, scenario, ()),
            *self._settings(self._size.set, (*self._inside, "set")),
            *self._of_scenario(self._size, scenario, self._inside),
        ]
        methods = self._sweep.all_methods()
        for name in self._size.methods or methods:
            own = [self._setting(key, value, place) for key, value, place in methods[name]]
            yield name, [*common, *own, *last]

    def _of_scenario(
        self, level: SweepConfig | SweepSize, scenario: str, inside: tuple[str, ...]
    ) -> list[Setting]:
        place = (*inside, "scenario_set", scenario)
        return self._settings(level.scenario_set.get(scenario, {}), place)

    def _settings(self, settings: Mapping[str, Any], place: tuple[str, ...]) -> list[Setting]:
        return [self._setting(key, value, (*place, key)) for key, value in settings.items()]

    def _setting(self, key: str, value: Any, place: tuple[str, ...]) -> Setting:
        where = self._tree.where(place)
        if key in OF_THE_SWEEP:
            raise ConfigError(f"{where}: {key} is no setting of a sweep: use {OF_THE_SWEEP[key]}")
        return Setting(key, value, where)

    def _run(self, method: str, settings: list[Setting], scenario: str, seed: int) -> SweepRun:
        own = [
            Setting("scenario", scenario, self._where_of("scenarios", scenario)),
            Setting("seed", seed, self._where_of("seeds", seed)),
        ]
        name = f"{short_name(scenario)}/{method}-s{seed}"
        config = validate(with_settings(self._base, [*settings, *own]), TrainConfig)
        try:
            check_fits(config)
        except UserError as error:
            raise ConfigError(f"{self._tree.path}: {name}: {error}") from error
        return SweepRun(name, config)

    def _where_of(self, key: str, value: Any) -> str:
        place = self._inside if getattr(self._size, key) is not None else ()
        index = list(self._chosen(key)).index(value)
        return self._tree.where((*place, key, index))

    def _check_different(self, runs: Iterable[SweepRun]) -> None:
        seen: dict[str, str] = {}
        for run in runs:
            other = seen.setdefault(run.config.model_dump_json(), run.name)
            if other != run.name:
                raise ConfigError(
                    f"{self._tree.path}: {other} and {run.name} are one and the same configuration"
                )


def check_fits(config: TrainConfig) -> None:
    """Raises UserError where the scenario or a logger is unknown, or the coach does not fit."""
    Chosen(config.loggers)
    spec = _spec(config.scenario_source())
    Coach(config.coach, TeamSpec.of(spec), config.seed).check_scenario(spec)


@cache
def _spec(scenario: ScenarioSource) -> EnvSpec:
    return make_any_env(scenario, 1).spec


def _check_scenarios(
    settings: Mapping[str, Settings], known: Sequence[str], inside: tuple[str, ...]
) -> None:
    for name in settings:
        if name not in known:
            raise Misplaced(
                (*inside, "scenario_set", name),
                f"no runs on scenario {name!r}{did_you_mean(name, known)}; "
                f"scenarios: {', '.join(known)}",
            )


def _check_name(name: str, place: tuple[str, ...]) -> None:
    if not METHOD_NAME.fullmatch(name) or SEED_ENDING.search(name):
        raise Misplaced(
            place,
            f"method {name!r} cannot be a folder's name: letters, digits, '_', '.' and '-', and "
            "not the ending -s<number> of a seed",
        )
