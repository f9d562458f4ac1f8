"""What an environment is built from: a scenario's text, wherever it lies, and a copy of it.

A scenario is named by a shipped name, by the path of a YAML file, or as
``pettingzoo:PACKAGE.MODULE:FACTORY``. A copy keeps everything that the repository or another
folder may change later, so that a run can be evaluated years after and elsewhere.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crash_coach_common.strict_yaml import ConfigError, YamlTree, parse_tree, read_text, validate
from sim_pkg.foreign.config import KIND as FOREIGN
from sim_pkg.foreign.config import PREFIX, EnvRules, PettingZooConfig
from sim_pkg.scenario_files import find_scenario
from sim_pkg.scenarios.skirmish.config import UNITS_FILE

NO_ARGS: Mapping[str, Any] = {}
NO_RULES = EnvRules.model_validate({})


@dataclass(frozen=True)
class ScenarioSource:
    """A scenario as it was when it was read.

    ``name``: as it was asked for. ``path``: where the text lies, or would lie. ``units``: the text
    of the unit types that a skirmish stands on; None: those of this program.
    """

    name: str
    path: Path
    text: str
    units: str | None = None

    @property
    def sha256(self) -> str:
        """Of everything that it is built from."""
        sha = hashlib.sha256(self.text.encode())
        if self.units is not None:
            sha.update(b"\0" + self.units.encode())
        return sha.hexdigest()

    @property
    def kind(self) -> str:
        """Raises ConfigError where the file names none."""
        kind = self.tree().values.get("kind")
        if isinstance(kind, str):
            return kind
        raise ConfigError(f"{self.tree().where(('kind',))}: kind = {kind!r}: a kind's name")

    def tree(self) -> YamlTree:
        """Raises ConfigError where the text is no YAML mapping."""
        tree = parse_tree(self.path, self.text)
        if self.units is not None and self.units != read_text(UNITS_FILE):
            units = parse_tree(self.path.with_name(UNITS_FILE.name), self.units)
            tree.values["standard"] = units.values
        return tree

    def foreign(self) -> PettingZooConfig | None:
        """The configuration of a PettingZoo environment; None: a scenario of ours.

        Raises:
            ConfigError: a wrong file.
        """
        return validate(self.tree(), PettingZooConfig) if self.kind == FOREIGN else None

    def write(self, folder: Path) -> Path:
        """Copies it to ``folder``; returns its YAML file there, from which it can be read again."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{short_name(self.name)}.yaml"
        path.write_text(self.text, encoding="utf-8")
        if self.units is not None:
            (folder / UNITS_FILE.name).write_text(self.units, encoding="utf-8")
        return path


def read_scenario(
    scenario: str | Path, env_args: Mapping[str, Any] = NO_ARGS, env_rules: EnvRules = NO_RULES
) -> ScenarioSource:
    """Reads the scenario of that name, path or reference.

    Args:
        env_args, env_rules: of a PettingZoo environment; they count over what its file says.

    Raises:
        ConfigError: unknown, unreadable, or arguments for a scenario that takes none.
    """
    name = str(scenario)
    if name.startswith(PREFIX):
        values: dict[str, Any] = {"kind": FOREIGN, "environment": name.removeprefix(PREFIX)}
        return _with(name, Path(name), values, env_args, env_rules)
    path = find_scenario(scenario)
    source = ScenarioSource(name, path, read_text(path))
    kind = source.tree().values.get("kind")
    given = [*env_args, *env_rules.model_dump(exclude_defaults=True)]
    if kind == FOREIGN and given:
        return _with(name, path, source.tree().values, env_args, env_rules)
    if given:
        raise ConfigError(
            f"scenario {name!r} is of kind {kind!r}: {given[0]!r} has no meaning there: env_args "
            f"and env_rules are for {PREFIX}PACKAGE.MODULE:FACTORY"
        )
    if kind == "skirmish":
        beside = path.with_name(UNITS_FILE.name)
        units = beside if beside.is_file() else UNITS_FILE
        return ScenarioSource(name, path, source.text, read_text(units))
    return source


def _with(
    name: str,
    path: Path,
    values: Mapping[str, Any],
    env_args: Mapping[str, Any],
    env_rules: EnvRules,
) -> ScenarioSource:
    rules = env_rules.model_dump(mode="json", exclude_defaults=True)
    arguments = {**values.get("env_args", {}), **env_args}
    merged = {**values, **rules, "env_args": arguments}
    # JSON is YAML.
    return ScenarioSource(name, path, json.dumps(merged, indent=1) + "\n")


def short_name(scenario: str) -> str:
    """What a file or folder of it is called: "3m" of skirmish/3m, "simple_spread_v3" of
    pettingzoo:mpe2.simple_spread_v3:parallel_env."""
    if scenario.startswith(PREFIX):
        return scenario.removeprefix(PREFIX).partition(":")[0].split(".")[-1]
    return Path(scenario).name.removesuffix(".yaml").removesuffix(".yml")
