"""Fault scenarios: a YAML file of faults and of what is expected of the team under them.

What is wrong in a file, or does not fit a team, is refused before anything starts, with the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from crash_coach_common.contract import UserError
from crash_coach_common.strict_yaml import (
    ConfigError,
    StrictModel,
    YamlTree,
    find_shipped,
    load_tree,
    shipped_names,
    validate,
)
from crash_coach_pkg.coach.config import FaultConfig
from crash_coach_pkg.coach.draws import (
    check_team,
    draw_faults,
    draw_victims,
    left_to_chance,
    most_crashed,
)
from crash_coach_pkg.coach.expectations import Expectation
from crash_coach_pkg.faults import unmet_needs
from crash_coach_pkg.faults.base import Need
from crash_coach_pkg.plan import CrashPlan, Fault
from crash_coach_pkg.team import TeamSpec

FAULTS_DIR = Path(__file__).parents[1] / "configs" / "faults"
_STREAM = 0xFA017  # keeps the draws of a file's entries apart from the coach's


class FaultScenarioConfig(StrictModel):
    """The file."""

    description: str = Field(min_length=1, description="One line: what is tried.")
    scenario: str | None = Field(
        default=None,
        description="The scenario (name or path) that the file is meant for; null: any.",
    )
    faults: tuple[FaultConfig, ...] = Field(
        min_length=1, description="Entries; each says who, when and how, and draws on its own."
    )
    expect: tuple[Expectation, ...] = Field(
        default=(), description="What `crash-coach faults run` judges; it refuses a file without."
    )


@dataclass(frozen=True)
class FaultScenario:
    """A file that was read, and where its keys are in it."""

    config: FaultScenarioConfig
    tree: YamlTree

    @property
    def path(self) -> Path:
        return self.tree.path

    @property
    def faults(self) -> tuple[FaultConfig, ...]:
        return self.config.faults

    @property
    def expect(self) -> tuple[Expectation, ...]:
        return self.config.expect

    def check(
        self,
        team: TeamSpec,
        episode_limit: int | None = None,
        offered: frozenset[Need] | None = None,
    ) -> None:
        """Holds the faults against a team.

        Args:
            episode_limit: steps of the scenario's longest episode; None: unknown.
            offered: what modes may ask of the team's commands; None: unknown.

        Raises:
            ConfigError: a victim, role, limit, step or mode that is out of reach, with its line.
        """
        for entry, fault in enumerate(self.faults):
            if episode_limit is not None and fault.start_step >= episode_limit:
                raise self._error(
                    entry,
                    f"start_step {fault.start_step} is never reached: episodes have at most "
                    f"{episode_limit} steps, the last is {episode_limit - 1}",
                )
            if offered is not None and (reason := unmet_needs(fault.crash_mode, offered)):
                raise self._error(entry, f"crash_mode: {reason}")
            try:
                check_team(fault, team)
            except UserError as error:
                raise self._error(entry, str(error)) from error
        self._check_together(team)

    def _check_together(self, team: TeamSpec) -> None:
        """Limits hold for the whole file: entries may not break each other's."""
        limit = self.most_crashed(team.n)
        for entry, fault in enumerate(self.faults):
            at_once = [
                other
                for other in self.faults
                if not other.triggered and _covers(other, fault.start_step)
            ]
            count = min(team.n, _most_victims(at_once, team))
            if not fault.triggered and count > limit:
                raise self._error(
                    entry,
                    f"up to {count} robots are faulted together from step {fault.start_step} on, "
                    f"but min_alive and max_crashed of the entries allow {limit} of {team.n}",
                )

    def most_crashed(self, n: int) -> int:
        """Robots of n that may be faulted together: what the strictest entry allows."""
        return min(most_crashed(fault, n) for fault in self.faults)

    def _error(self, entry: int, text: str) -> ConfigError:
        """With the line of the key that ``text`` names first, or else of the entry."""
        keys = self.tree.values["faults"][entry]
        named = min((key for key in keys if key in text), key=text.index, default=None)
        location = ("faults", entry) if named is None else ("faults", entry, named)
        return ConfigError(f"{self.tree.where(location)}: faults.{entry}: {text}")


def _covers(fault: FaultConfig, step: int) -> bool:
    end = fault.start_step + fault.duration_steps
    return fault.start_step <= step and (not fault.duration_steps or step < end)


def _most_victims(faults: list[FaultConfig], team: TeamSpec) -> int:
    """Robots that these can concern at most: the named ones, and those that each one draws."""
    named = {name for fault in faults for name in fault.victims}
    drawn = 0
    for fault in faults:
        if not fault.victims:
            candidates = len(team.of_role(fault.victim_role))
            every = min(candidates, most_crashed(fault, team.n))
            drawn += every if fault.crashed_exactly < 0 else fault.crashed_exactly
    return len(named) + drawn


def load_fault_scenario(path: Path) -> FaultScenario:
    """Reads a file.

    Raises:
        ConfigError: it cannot be read, or says something that the schema does not allow.
    """
    tree = load_tree(path)
    return FaultScenario(validate(tree, FaultScenarioConfig), tree)


def fault_scenario_names() -> tuple[str, ...]:
    """The shipped files, sorted."""
    return shipped_names(FAULTS_DIR)


def find_fault_scenario(name: str) -> Path:
    """The file of a shipped name, or of a path.

    Raises:
        ConfigError: neither a known name nor an existing file.
    """
    return find_shipped("fault scenario", FAULTS_DIR, name)


class ScenarioPlanner:
    """Plans a fault scenario's episodes for a team.

    Args:
        seed: keys every entry's draws together with the episode and the entry, and the plans.

    Raises:
        ConfigError: as FaultScenario.check.
        UserError: a negative seed.
    """

    def __init__(self, scenario: FaultScenario, team: TeamSpec, seed: int) -> None:
        scenario.check(team)
        if not 0 <= seed < 2**63:
            raise UserError(f"seed {seed} is not in 0..2^63-1")
        self._scenario = scenario
        self._team = team
        self._seed = seed
        self._cap = scenario.most_crashed(team.n)

    @property
    def draws(self) -> bool:
        """Whether any entry leaves something to chance."""
        return any(left_to_chance(fault, self._team) for fault in self._scenario.faults)

    def plan(self, episode: int) -> CrashPlan:
        """The faults of all entries: the same for the same (file, team, seed, episode)."""
        faults: list[Fault] = []
        for entry, config in enumerate(self._scenario.faults):
            mask = draw_victims(config, self._team, self._rng(episode, entry))
            faults += draw_faults(config, self._team, mask, entry)
        return CrashPlan(episode, 0, self._seed, 0.0, self._cap, tuple(faults))

    def _rng(self, episode: int, entry: int) -> np.random.Generator:
        key = np.array([self._seed ^ _STREAM, episode], dtype=np.uint64)
        # The counter's highest word: streams that no draw can run into.
        counter = np.array([0, 0, 0, entry], dtype=np.uint64)
        return np.random.Generator(np.random.Philox(key=key, counter=counter))
