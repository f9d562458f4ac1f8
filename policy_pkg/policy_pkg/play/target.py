"""Which team is meant: a trained one, by its folder, or `scripted:NAME`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import PolicyBundle, load_policy
from policy_pkg.play.evaluate import Scripted
from policy_pkg.team_name import scripted_name
from policy_pkg.train.run_dir import found_now, scenario_of
from sim_pkg.env import ScenarioLike, make_any_env
from sim_pkg.foreign.config import PREFIX, EnvRules
from sim_pkg.scenario_source import ScenarioSource, read_scenario

HELP = "Run directory (RUN@best: its best checkpoint), checkpoint directory, or scripted:NAME."


@dataclass(frozen=True)
class Target:
    """A team, and the scenario and robots it plays with.

    ``scenario``: what it is called. ``source``: what to make the environment of: that name, or
    where it means something else by now, the copy that the team's run keeps; ``note`` says so.
    """

    name: str
    team: PolicyBundle | Scripted
    scenario: str
    source: ScenarioLike
    robots: tuple[str, ...]
    note: str = ""

    @property
    def file(self) -> str:
        """The scenario's name or file, for the nodes of a graph."""
        source = self.source
        return str(source.path.resolve() if isinstance(source, ScenarioSource) else source)


def load_target(name: str, scenario: str | None) -> Target:
    """The team that the command line names.

    Raises:
        CheckpointError: no checkpoint there, or a broken one.
        UserError: a scripted team without a scenario.
        ConfigError: unknown or wrong scenario.
    """
    scripted = scripted_name(name)
    if scripted is None:
        return _trained(name, scenario)
    if scenario is None:
        raise UserError(f"{name}: --scenario is needed; only a trained team knows its own")
    robots = make_any_env(scenario, 1).spec.robots
    return Target(name, Scripted(scripted), scenario, scenario, robots)


def _trained(name: str, scenario: str | None) -> Target:
    bundle = load_policy(Path(name))
    if scenario is not None:
        source = _named(scenario, bundle)
        return Target(name, bundle, scenario, source, bundle.robots)
    source = scenario_of(bundle)
    if not isinstance(source, ScenarioSource):
        return Target(name, bundle, bundle.scenario, source, bundle.robots)
    note = ""
    if not source.name.startswith(PREFIX) and found_now(source) is not None:
        note = (
            f"scenario {source.name} has changed since {name} was trained: the copy that the run "
            f"keeps is played; --scenario {source.name} plays today's"
        )
    return Target(name, bundle, source.name, source, bundle.robots, note)


def _named(scenario: str, bundle: PolicyBundle) -> ScenarioLike:
    """A PettingZoo environment takes the arguments and rules that the team was trained with."""
    if not scenario.startswith(PREFIX):
        return scenario
    config = bundle.meta["config"]
    rules = EnvRules.model_validate(config.get("env_rules", {}))
    return read_scenario(scenario, config.get("env_args", {}), rules)
