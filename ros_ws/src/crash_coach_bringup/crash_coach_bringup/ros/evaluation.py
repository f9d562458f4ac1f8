"""Evaluation over ROS: the same episodes as policy_pkg.play.evaluate, played by a real graph."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.collector import Collector, EvaluationError
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    PATIENT_LEASE_S,
    Layout,
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.fault_scenario import ScenarioPlanner, load_fault_scenario
from crash_coach_pkg.faults import unmet_needs
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.faults.base import Need
from crash_coach_pkg.plan import Planner
from crash_coach_pkg.team import TeamSpec
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation
from policy_pkg.team_name import scripted_name


def evaluate_via_ros(
    checkpoint: Path,
    scenario: str,
    condition: Condition | Path,
    episodes: int,
    seed: int,
    layout: Layout = "nodes",
    log_dir: Path | None = None,
) -> Evaluation:
    """Plays episodes 0 .. ``episodes`` - 1 in lock-step on a ROS domain of its own.

    ``checkpoint``: also ``scripted:NAME``. ``condition``: crashes of a coach, or a fault scenario's
    file. Equal arguments give the results of policy_pkg.play.evaluate.evaluate with effects, bit
    for bit. The nodes' logs go to ``log_dir``; None: to a temporary folder that is kept after an
    error.

    Raises:
        EvaluationError: a node died, a plan was refused, or other robots crashed than it says.
        WaitError: the graph did not start, or an episode did not end, in time.
        UserError: as graph.check_team, or a condition that this team cannot keep.
    """
    if episodes < 1:
        raise UserError(f"episodes = {episodes}: at least 1 is needed")
    with reserve_domain() as domain, _logs(log_dir) as logs:
        options = UpOptions(
            scenario=scenario,
            checkpoint=checkpoint,
            layout=layout,
            seed=seed,
            autostart=False,
            coach=condition.crash if isinstance(condition, Condition) else CoachConfig(),
            fault_scenario=condition if isinstance(condition, Path) else None,
            domain=domain,
            lease_s=PATIENT_LEASE_S,
            log_dir=logs,
        )
        team = check_team(options)
        name, planner, drawn = _planner(condition, team, seed, _offers(checkpoint))
        processes = graph_processes(options, team)
        with Supervisor(processes, logs, graph_environment(domain), throughput=True) as graph:

            def check() -> None:
                for ended in graph.wait(0.0):
                    raise EvaluationError(ended.describe())

            with graph_client("crash_coach_evaluation", domain, check) as client:
                collector = Collector(client, planner, team.robots)
                results = tuple(collector.play(episode) for episode in range(episodes))
                effects = collector.effects()
    return Evaluation(name, team.robots, seed, results, effects, drawn)


def _offers(checkpoint: Path) -> frozenset[Need]:
    return ACTION_OFFERS if scripted_name(checkpoint) is None else ACTION_OFFERS - {"worst"}


def _planner(
    condition: Condition | Path, team: TeamSpec, seed: int, offers: frozenset[Need]
) -> tuple[str, Planner, bool]:
    """The condition's name, what the coach node is going to plan, and whether it may be drawn."""
    if isinstance(condition, Path):
        faults = load_fault_scenario(condition)
        planner = ScenarioPlanner(faults, team, seed)
        return condition.stem, planner, planner.draws
    try:
        coach = Coach(condition.crash, team, seed)
    except ValueError as error:
        raise UserError(f"condition {condition.name!r}: {error}") from error
    if reason := unmet_needs(condition.crash.crash_mode, offers):
        raise UserError(f"condition {condition.name!r}: {reason}")
    return condition.name, coach, condition.drawn


@contextmanager
def _logs(log_dir: Path | None) -> Iterator[Path]:
    if log_dir is not None:
        yield log_dir
        return
    folder = Path(tempfile.mkdtemp(prefix="crash_coach_logs_"))
    yield folder
    shutil.rmtree(folder)  # not reached after an error: the log is what explains it
