"""Which team is meant: a trained one, by its folder, or `scripted:NAME`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import PolicyBundle, load_policy
from policy_pkg.play.evaluate import Scripted
from sim_pkg.env import make_env

SCRIPTED = "scripted:"
HELP = "Run directory (RUN@best: its best checkpoint), checkpoint directory, or scripted:NAME."


@dataclass(frozen=True)
class Target:
    """A team, and the scenario and robots it plays with."""

    name: str
    team: PolicyBundle | Scripted
    scenario: str
    robots: tuple[str, ...]


def load_target(name: str, scenario: str | None) -> Target:
    """The team that the command line names.

    Raises:
        CheckpointError: no checkpoint there, or a broken one.
        UserError: a scripted team without a scenario.
        ConfigError: unknown or wrong scenario.
    """
    if not name.startswith(SCRIPTED):
        bundle = load_policy(Path(name))
        return Target(name, bundle, scenario or bundle.scenario, bundle.robots)
    if scenario is None:
        raise UserError(f"{name}: --scenario is needed; only a trained team knows its own")
    robots = make_env(scenario, 1).spec.robots
    return Target(name, Scripted(name.removeprefix(SCRIPTED)), scenario, robots)
