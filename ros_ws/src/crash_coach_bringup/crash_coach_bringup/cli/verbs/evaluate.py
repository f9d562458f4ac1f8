"""`crash-coach evaluate`: what a trained team achieves, crash-free and with crashes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.options import (
    MODE,
    MOST_EPISODES,
    CrashedOption,
    DurationOption,
    EachRobotOption,
    Layout,
    LayoutOption,
    ModeOption,
    ParamOption,
    ProcessesOption,
    StartOption,
    Via,
    ViaOption,
    conditions,
    mode_parameters,
    timed,
)
from crash_coach_bringup.cli.output import (
    check_json_target,
    console,
    percent_ci,
    points,
    table,
    written_first,
)
from crash_coach_bringup.cli.playing import ALIKE, as_json, cost, crash_free_of, play
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, evaluation_seed
from policy_pkg.play.target import HELP, load_target
from sim_pkg.trajectory import combine

RateOption = Annotated[
    list[float] | None,
    typer.Option(help="R ...: each robot crashes with probability R, drawn each episode."),
]
VictimsOption = Annotated[
    list[str] | None, typer.Option(help="ROBOT ...: all of these robots, in every episode.")
]
COST = "cost: how much lower success is than crash-free, in points (95 % interval)."


def show(title: str, results: list[tuple[Condition, Evaluation]]) -> None:
    """Victims come last, those first that cost most."""
    free = crash_free_of(results)
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


def evaluate(
    team: Annotated[str, typer.Argument(metavar="TEAM", help=HELP)],
    scenario: Annotated[
        str | None, typer.Option(help="Scenario name or YAML file; default: the trained team's.")
    ] = None,
    episodes: Annotated[
        int, typer.Option(help="Episodes per condition.", min=1, max=MOST_EPISODES)
    ] = 128,
    crash_rate: RateOption = None,
    crashed: CrashedOption = None,
    victims: VictimsOption = None,
    each_robot: EachRobotOption = False,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    start: StartOption = 0,
    duration_steps: DurationOption = 0,
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
    asked = timed(asked, start, duration_steps)
    played = play(target, asked, episodes, evaluation_seed(seed), processes, via, layout)
    results = list(zip(asked, played, strict=True))
    summaries = as_json(results)
    trajectory_hash = combine(row["trajectory_hash"] for row in summaries)
    result: dict[str, Any] = {"team": team, "scenario": name, "via": via.value}
    result["layout"] = layout.value if via is Via.ros else None
    result |= {"seed": seed, "key": evaluation_seed(seed), "episodes": episodes}
    result |= {"mode": mode, "parameters": parameters}
    result |= {"start_step": start, "duration_steps": duration_steps}
    result |= {"trajectory_hash": trajectory_hash, "conditions": summaries}
    with written_first(json, result):
        show(f"{team} on {name}: {episodes} episodes each, seed {seed}, via {via}", results)
        console.print(f"trajectory hash {trajectory_hash}", soft_wrap=True)
