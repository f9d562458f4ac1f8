"""Playing a fault scenario: the same episodes with the faults and without."""

from __future__ import annotations

from pathlib import Path

from crash_coach_bringup.cli.options import Layout, Via
from crash_coach_bringup.cli.output import CliError
from crash_coach_common.contract import EnvSpec
from crash_coach_common.strict_yaml import ConfigError
from crash_coach_pkg.coach.fault_scenario import FaultScenario, ScenarioPlanner
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.team import TeamSpec
from policy_pkg.play.conditions import Planned, crash_free
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluate, evaluation_seed
from policy_pkg.play.target import Target
from policy_pkg.report.verdict import FaultRun, judge_run
from sim_pkg.env import ScenarioLike, make_any_env


def check_scenario(faults: FaultScenario, scenario: ScenarioLike, values: bool = True) -> EnvSpec:
    """Holds the file against a scenario; returns what that promises.

    Args:
        values: whether the team tells what it values least.

    Raises:
        ConfigError: unknown or wrong scenario, or faults out of its reach.
    """
    spec = make_any_env(scenario, 1).spec
    if not spec.reports_success:
        raise ConfigError(
            f"scenario {spec.scenario!r} reports no success, by which faults are judged: it needs "
            "success_return or success_info"
        )
    offered = ACTION_OFFERS if values else ACTION_OFFERS - {"worst"}
    faults.check(TeamSpec.of(spec), spec.episode_limit, offered)
    return spec


def play(
    faults: FaultScenario, target: Target, episodes: int, seed: int, via: Via, layout: Layout
) -> FaultRun:
    """Plays episodes 0 .. ``episodes`` - 1 twice and judges them.

    Raises:
        ConfigError: as check_scenario.
        UserError: as the evaluations, or a scripted team over ROS.
    """
    scripted = isinstance(target.team, Scripted)
    if via is Via.ros and scripted:
        raise CliError(f"--via ros: {target.name} has no nodes; scripted teams play in the core")
    spec = check_scenario(faults, target.source, values=not scripted)
    seed = evaluation_seed(seed)
    planner = ScenarioPlanner(faults, TeamSpec.of(spec), seed)
    if via is Via.ros:
        faulted, free = _play_via_ros(faults, target, episodes, seed, layout)
    else:
        planned = Planned(
            faults.path.stem, lambda team, key: ScenarioPlanner(faults, team, key), planner.draws
        )
        faulted = evaluate(target.team, target.source, planned, episodes, seed, effects=True)
        free = evaluate(target.team, target.source, crash_free(), episodes, seed)
    return judge_run(faults, planner, faulted, free, spec.dead_actions)


def _play_via_ros(
    faults: FaultScenario, target: Target, episodes: int, seed: int, layout: Layout
) -> tuple[Evaluation, Evaluation]:
    from crash_coach_bringup.ros.evaluation import evaluate_via_ros

    faulted, free = (
        evaluate_via_ros(Path(target.name), target.file, condition, episodes, seed, layout.value)
        for condition in (faults.path, crash_free())
    )
    return faulted, free
