"""`crash-coach evaluate`: what a trained team achieves, crash-free and with crashes."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.options import (
    MODE,
    CrashedOption,
    ModeOption,
    ParamOption,
    conditions,
    mode_parameters,
)
from crash_coach_bringup.cli.output import (
    CliError,
    check_json_target,
    console,
    percent_ci,
    points,
    table,
    tell_note,
    written_first,
)
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluation_seed
from policy_pkg.play.evaluate_processes import evaluate_on
from policy_pkg.play.target import HELP, Target, load_target
from policy_pkg.statistics import Estimate, difference
from sim_pkg.trajectory import combine

MOST_EPISODES = 1_000_000
MOST_PROCESSES = 1024
COST = "cost: how much lower success is than crash-free, in points (95 % interval)."
ALIKE = "1 episode: all went alike and nothing in them is left to chance, so there is no interval."


class Via(StrEnum):
    core = "core"
    ros = "ros"


class Layout(StrEnum):
    nodes = "nodes"
    team = "team"
    single = "single"


ViaOption = Annotated[
    Via,
    typer.Option(help="Played here, or by a real ROS graph in lock-step, with the same results."),
]
LayoutOption = Annotated[
    Layout,
    typer.Option(help="With --via ros: a process per node, one for the team, or a single process."),
]
ProcessesOption = Annotated[
    int,
    typer.Option(
        help="How many processes share the episodes; changes no result.",
        min=1,
        max=MOST_PROCESSES,
    ),
]


EachRobotOption = Annotated[
    bool, typer.Option("--each-robot", help="Each robot alone, in every episode: who hurts most.")
]


def play(
    target: Target,
    conditions: list[Condition],
    episodes: int,
    seed: int,
    processes: int,
    via: Via,
    layout: Layout,
) -> list[Evaluation]:
    """Each condition's evaluation, in processes of this machine or as a ROS graph.

    Raises:
        CliError: a scripted team over ROS, or several graphs.
    """
    tell_note(target.note)
    if via is Via.core:
        return evaluate_on(processes, target.team, target.source, conditions, episodes, seed)
    if processes > 1:
        raise CliError(f"--processes {processes}: with --via ros one graph plays all episodes")
    if isinstance(target.team, Scripted):
        raise CliError(f"--via ros: {target.name} has no nodes; scripted teams play in the core")
    from crash_coach_bringup.ros.evaluation import evaluate_via_ros

    checkpoint, scenario = Path(target.name), target.file
    return [
        evaluate_via_ros(checkpoint, scenario, condition, episodes, seed, layout.value)
        for condition in conditions
    ]


def cost(free: Evaluation, crashed: Evaluation) -> Estimate:
    """How much lower the success rate is than ``free``'s."""
    return difference(free.success, crashed.success)


def _crash_free(results: list[tuple[Condition, Evaluation]]) -> Evaluation | None:
    """What a crash costs is counted from; None where nobody knows what a success is."""
    free = (result for condition, result in results if condition.crashed == 0)
    return next((result for result in free if result.reports_success), None)


def show(title: str, results: list[tuple[Condition, Evaluation]]) -> None:
    """Victims come last, those first that cost most."""
    free = _crash_free(results)
    others = [each for each in results if not each[0].victim]
    victims = sorted((r for r in results if r[0].victim), key=lambda r: r[1].success_rate)
    columns = ["condition", "success (95 % interval)", "cost", "return", "steps", "crashed"]
    rows = table(title, columns)
    for condition, result in others + victims:
        figures = result.summary()
        spread = "" if result.alike else f" ± {figures['return_std']:.2f}"
        rows.add_row(
            condition.name,
            percent_ci(figures["success_rate"], figures["success_ci95"])
            if result.reports_success
            else "not told",
            "–" if free in (None, result) else points(cost(free, result)),
            f"{figures['return_mean']:.2f}{spread}",
            f"{figures['steps_mean']:.1f}",
            f"{100 * figures['crashed_fraction']:.1f} %",
        )
    console.print(rows)
    if free is not None and len(results) > 1:
        console.print(COST, soft_wrap=True)
    if any(result.alike for _, result in results):
        console.print(ALIKE, soft_wrap=True)


def as_json(results: list[tuple[Condition, Evaluation]]) -> list[dict[str, Any]]:
    """Each condition's summary and episodes."""
    return [
        {
            "name": condition.name,
            "crash": condition.crash.model_dump(mode="json"),
            **result.summary(),
            **_cost_json(results, condition, result),
            "per_episode": [asdict(episode) for episode in result.episodes],
        }
        for condition, result in results
    ]


def _cost_json(
    results: list[tuple[Condition, Evaluation]], condition: Condition, result: Evaluation
) -> dict[str, Any]:
    """``cost`` and its interval, of a condition with crashes beside a crash-free one."""
    free = _crash_free(results)
    if free is None or condition.crashed == 0:
        return {}
    found = cost(free, result)
    return {"cost": found.value, "cost_ci95": [found.low, found.high]}


def evaluate(
    team: Annotated[str, typer.Argument(metavar="TEAM", help=HELP)],
    scenario: Annotated[
        str | None, typer.Option(help="Scenario name or YAML file; default: the trained team's.")
    ] = None,
    episodes: Annotated[
        int, typer.Option(help="Episodes per condition.", min=1, max=MOST_EPISODES)
    ] = 128,
    crash_rate: Annotated[
        list[float] | None,
        typer.Option(help="R ...: each robot crashes with probability R, drawn each episode."),
    ] = None,
    crashed: CrashedOption = None,
    victims: Annotated[
        list[str] | None, typer.Option(help="ROBOT ...: all of these robots, in every episode.")
    ] = None,
    each_robot: EachRobotOption = False,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    processes: ProcessesOption = 1,
    via: ViaOption = Via.core,
    layout: LayoutOption = Layout.nodes,
    seed: Annotated[
        int, typer.Option(help="Of the episodes, the victims and random actions.", min=0)
    ] = 0,
    json: Annotated[Path | None, typer.Option(help="Also write the result to this file.")] = None,
) -> None:
    """Tells how a team does under crashes, or crash-free without a crash option.

    Trained teams act greedily. Every rate, every number and the victims together are a row each;
    beside them stands what the crashes cost, against the same episodes without crashes.
    """
    check_json_target(json)
    parameters = mode_parameters(mode, param or [])
    target = load_target(team, scenario)
    name = target.scenario
    who = crash_rate or [], crashed or [], victims or []
    asked = conditions(target.robots, *who, mode, parameters, each_robot=each_robot)
    played = play(target, asked, episodes, evaluation_seed(seed), processes, via, layout)
    results = list(zip(asked, played, strict=True))
    summaries = as_json(results)
    trajectory_hash = combine(row["trajectory_hash"] for row in summaries)
    result: dict[str, Any] = {"team": team, "scenario": name, "via": via.value}
    result["layout"] = layout.value if via is Via.ros else None
    result |= {"seed": seed, "key": evaluation_seed(seed), "episodes": episodes}
    result |= {"mode": mode, "parameters": parameters}
    result |= {"trajectory_hash": trajectory_hash, "conditions": summaries}
    with written_first(json, result):
        show(f"{team} on {name}: {episodes} episodes each, seed {seed}, via {via}", results)
        console.print(f"trajectory hash {trajectory_hash}", soft_wrap=True)
