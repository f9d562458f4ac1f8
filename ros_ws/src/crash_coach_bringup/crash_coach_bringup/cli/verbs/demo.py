"""`crash-coach demo`: train two teams, run them as ROS graphs, crash robots, read off the cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.jobs import Job, run_jobs
from crash_coach_bringup.cli.options import Layout
from crash_coach_bringup.cli.output import console, percent_ci, table, written_first
from crash_coach_bringup.cli.playing import ALIKE, as_json
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import Condition, crash_free, named
from policy_pkg.play.evaluate import Evaluation, evaluation_seed
from policy_pkg.train.config import load_train_config

METHODS = {"qmix": "buttons/demo_qmix", "adaptive": "buttons/demo_adaptive"}
COLOURS = {"qmix": "tab:green", "adaptive": "tab:orange"}  # the paper's
TITLES = {"qmix": "plain QMIX", "adaptive": "coached, adaptive"}

Results = dict[str, list[tuple[Condition, Evaluation]]]


def crash_conditions(robots: tuple[str, ...]) -> list[Condition]:
    """Crash-free, then each robot muted on its own."""
    return [crash_free(), *(named([name]) for name in robots)]


def train_teams(out: Path, overrides: list[str], seed: int | None) -> None:
    """Trains what is not trained yet, both teams side by side; finished runs are kept."""
    jobs = []
    for method, name in METHODS.items():
        config = load_train_config(name, overrides, seed)
        jobs.append(Job(TITLES[method], config, out / method, resume=True))
    console.print(f"Training on {jobs[0].config.scenario!r}, one process per team:")
    run_jobs(jobs)


def run_graphs(out: Path, episodes: int, seed: int, layout: Layout) -> Results:
    """Each team as a ROS graph under each condition."""
    from crash_coach_bringup.ros.evaluation import evaluate_via_ros

    results: Results = {}
    for method in METHODS:
        bundle = load_policy(out / method)
        for condition in crash_conditions(bundle.robots):
            console.print(f"ROS graph: {TITLES[method]}, {condition.name} ...")
            result = evaluate_via_ros(
                out / method,
                bundle.scenario,
                condition,
                episodes,
                evaluation_seed(seed),
                layout.value,
            )
            results.setdefault(method, []).append((condition, result))
    return results


def show(results: Results) -> None:
    rows = table(
        "Measured over ROS",
        ["team", "crash", "success (95 % interval)", "return", "steps"],
    )
    for method, evaluations in results.items():
        for condition, result in evaluations:
            figures = result.summary()
            rows.add_row(
                TITLES[method],
                condition.name,
                percent_ci(figures["success_rate"], figures["success_ci95"]),
                f"{figures['return_mean']:.2f}",
                f"{figures['steps_mean']:.1f}",
            )
        rows.add_section()
    console.print(rows)
    if any(result.alike for evaluations in results.values() for _, result in evaluations):
        console.print(ALIKE, soft_wrap=True)


@dataclass(frozen=True)
class Finding:
    """What the demo found. ``holds``: the coached team coped with everything."""

    holds: bool
    text: str


def judge(results: Results, steps: int, out: Path) -> Finding:
    """In one sentence, what the crashes cost each team; where the coached team failed, what to do.

    steps: of each training.
    """
    failed = {
        method: [condition.name for condition, found in evaluations if found.success_rate < 1]
        for method, evaluations in results.items()
    }
    if failed["adaptive"]:
        longer = out.with_name(out.name + "_longer")
        return Finding(
            False,
            f"The coached team FAILED: {'; '.join(failed['adaptive'])}. {steps:,} steps did not "
            "teach it everything; train for twice as long with\n"
            f"    crash-coach demo --out {longer} --set total_steps={2 * steps}\n"
            "or with another seed: --train-seed 1 and another --out.",
        )
    crashes = [name for name in failed["qmix"] if name != crash_free().name]
    coped = "The team trained with crashes copes with each of them"
    if not crashes:
        return Finding(True, f"{coped}; so, this time, does the plain team, with the same learner.")
    alike = "" if crash_free().name in failed["qmix"] else " is as good until a robot crashes, but"
    return Finding(
        True,
        f"{coped}; the plain team, with the same learner and the same {steps:,} steps,{alike} "
        f"fails with {' and with '.join(crashes)}.",
    )


def summary(results: Results, found: Finding, out: Path, seed: int) -> dict[str, Any]:
    return {
        "scenario": "buttons",
        "seed": seed,
        "coached_team_copes": found.holds,
        "finding": found.text,
        "methods": {
            method: {"checkpoint": str(out / method), "conditions": as_json(evaluations)}
            for method, evaluations in results.items()
        },
    }


def console_line(out: Path) -> str:
    """How to look at both teams."""
    teams = " ".join(str(out / method) for method in METHODS)
    return f"See both, and crash robots by a click: crash-coach console {teams}"


def demo(
    out: Annotated[Path, typer.Option(help="Folder for runs, figures, pictures.")] = Path(
        "runs/demo"
    ),
    episodes: Annotated[
        int, typer.Option(help="Episodes per team and crash; two show that all are alike.", min=1)
    ] = 2,
    seed: Annotated[int, typer.Option(help="Seed of the evaluation.", min=0)] = 0,
    train_seed: Annotated[int | None, typer.Option(help="Seed of the trainings.")] = None,
    layout: Annotated[Layout, typer.Option(help="How the ROS graph is spread.")] = Layout.nodes,
    override: Annotated[
        list[str] | None, typer.Option("--set", help="key=value ...: replaces training settings.")
    ] = None,
) -> None:
    """Trains a plain and a coached team on `buttons`, crashes each robot, shows what it costs.

    Exit code 1 where the coached team fails in any of it.
    """
    out.mkdir(parents=True, exist_ok=True)
    train_teams(out, override or [], train_seed)
    results = run_graphs(out, episodes, seed, layout)
    bundle = load_policy(out / "adaptive")
    found = judge(results, int(bundle.meta["config"]["total_steps"]), out)
    with written_first(out / "summary.json", summary(results, found, out, seed)):
        show(results)
    picture = out / "trajectories.png"
    # Imported here: matplotlib takes its time.
    from crash_coach_bringup.cli.picture import TeamResults, draw_first_episodes

    draw_first_episodes(
        [
            TeamResults(TITLES[method], COLOURS[method], load_policy(out / method), found)
            for method, found in results.items()
        ],
        load_policy(out / "qmix").scenario,
        picture,
    )
    console.print("Everything lies here:")
    for what, where in (
        ("team trained plainly", out / "qmix"),
        ("coached team", out / "adaptive"),
        ("figures", out / "summary.json"),
        ("trajectories", picture),
    ):
        console.print(f"  {what:<21}{where}", soft_wrap=True)
    console.print()
    console.print(found.text, style="green" if found.holds else "bold red", soft_wrap=True)
    console.print(console_line(out), soft_wrap=True)
    if not found.holds:
        raise typer.Exit(1)
