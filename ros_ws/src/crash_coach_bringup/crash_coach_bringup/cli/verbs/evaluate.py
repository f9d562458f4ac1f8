"""`crash-coach evaluate`: what a trained team achieves, crash-free and with crashes."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.options import (
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
    table,
    write_json,
)
from crash_coach_bringup.cli.target import HELP, Target, load_target
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, Scripted
from policy_pkg.play.evaluate_processes import evaluate_on
from sim_pkg.trajectory import combine

MOST_EPISODES = 1_000_000
MOST_PROCESSES = 1024
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
    if via is Via.core:
        return evaluate_on(processes, target.team, target.scenario, conditions, episodes, seed)
    if processes > 1:
        raise CliError(f"--processes {processes}: with --via ros one graph plays all episodes")
    if isinstance(target.team, Scripted):
        raise CliError(f"--via ros: {target.name} has no nodes; scripted teams play in the core")
    from crash_coach_bringup.ros.evaluation import evaluate_via_ros

    checkpoint, scenario = Path(target.name), target.scenario
    return [
        evaluate_via_ros(checkpoint, scenario, condition, episodes, seed, layout.value)
        for condition in conditions
    ]


def show(title: str, results: list[tuple[Condition, Evaluation]]) -> None:
    rows = table(title, ["condition", "success (95 % interval)", "return", "steps", "crashed"])
    for condition, result in results:
        figures = result.summary()
        spread = "" if result.alike else f" ± {figures['return_std']:.2f}"
        rows.add_row(
            condition.name,
            percent_ci(figures["success_rate"], figures["success_ci95"]),
            f"{figures['return_mean']:.2f}{spread}",
            f"{figures['steps_mean']:.1f}",
            f"{100 * figures['crashed_fraction']:.1f} %",
        )
    console.print(rows)
    if any(result.alike for _, result in results):
        console.print(ALIKE, soft_wrap=True)


def as_json(results: list[tuple[Condition, Evaluation]]) -> list[dict[str, Any]]:
    """Each condition's summary and episodes."""
    return [
        {
            "name": condition.name,
            "crash": condition.crash.model_dump(mode="json"),
            **result.summary(),
            "per_episode": [asdict(episode) for episode in result.episodes],
        }
        for condition, result in results
    ]


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
    mode: ModeOption = "stay",
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

    Trained teams act greedily. Every rate, every number and the victims together are a row each.
    """
    check_json_target(json)
    parameters = mode_parameters(mode, param or [])
    target = load_target(team, scenario)
    name = target.scenario
    asked = conditions(
        target.robots, crash_rate or [], crashed or [], victims or [], mode, parameters
    )
    played = play(target, asked, episodes, seed, processes, via, layout)
    results = list(zip(asked, played, strict=True))
    show(f"{team} on {name}: {episodes} episodes each, seed {seed}, via {via}", results)
    summaries = as_json(results)
    trajectory_hash = combine(row["trajectory_hash"] for row in summaries)
    console.print(f"trajectory hash {trajectory_hash}", soft_wrap=True)
    result: dict[str, Any] = {"team": team, "scenario": name, "via": via.value}
    result["layout"] = layout.value if via is Via.ros else None
    result |= {"seed": seed, "episodes": episodes, "mode": mode, "parameters": parameters}
    write_json(json, {**result, "trajectory_hash": trajectory_hash, "conditions": summaries})
