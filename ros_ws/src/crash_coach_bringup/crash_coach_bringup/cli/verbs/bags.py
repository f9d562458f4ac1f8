"""`crash-coach bags`: what recordings hold, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.output import (
    check_json_target,
    console,
    percent_ci,
    table,
    write_json,
    written_first,
)
from policy_pkg.bags.bag import Bag, find_bags
from policy_pkg.bags.dataset import BagReading, BagSummary
from policy_pkg.bags.problems import Problem, Severity
from policy_pkg.statistics import wilson

app = typer.Typer(
    help="What recordings hold, and what is wrong with them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
Folders = Annotated[
    list[Path], typer.Argument(metavar="DIR...", help="Recordings, or folders of recordings.")
]
JsonOption = Annotated[Path | None, typer.Option(help="Also write the result to this file.")]


def read(bag: Bag) -> tuple[BagSummary, list[Problem]]:
    """Reads a bag to its end."""
    problems: list[Problem] = []
    reading = BagReading(bag, problems.append)
    for _ in reading.episodes():
        pass
    return reading.summary, problems


def as_json(summary: BagSummary, problems: Sequence[Problem]) -> dict[str, Any]:
    told = [{**asdict(problem), "severity": problem.severity.value} for problem in problems]
    return {**asdict(summary), "problems": told}


def _counts(counts: dict[str, int], empty: str) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items())) or empty


def show(summary: BagSummary, problems: Sequence[Problem]) -> None:
    about = summary.about
    rows = table(summary.name, ["", "recording"])
    success = "no episode"
    if summary.episodes:
        rate = wilson(summary.successes, summary.episodes)
        success = percent_ci(rate.value, (rate.low, rate.high))
    incomplete = sum(problem.severity is Severity.INCOMPLETE for problem in problems)
    for name, value in (
        ("scenario", about.scenario if about is not None and about.scenario else "not told"),
        ("robots", ", ".join(summary.robots) or "none"),
        ("files", str(summary.files)),
        ("duration", f"{summary.duration_s:.1f} s"),
        ("messages", f"{summary.messages:,}"),
        ("repeated, out of order", f"{summary.repeated:,}, {summary.disordered:,}"),
        ("complete episodes", f"{summary.episodes:,} ({summary.steps:,} steps)"),
        ("success (95 % interval)", success),
        ("episodes with crashes", f"{summary.crashed_episodes:,}"),
        ("crashed robot-steps", _counts(summary.crashed_robot_steps, "none")),
        ("dropped while recording", _drops(summary)),
        ("gaps", f"{incomplete}"),
        ("damage", f"{len(problems) - incomplete}"),
    ):
        rows.add_row(name, value)
    console.print(rows)


def _drops(summary: BagSummary) -> str:
    if summary.about is None:
        return "not told"
    return _counts(dict(summary.about.drops), "none")


def info(folders: Folders, json: JsonOption = None) -> None:
    """Robots, episodes, success, crashes by mode, gaps and drops of each recording."""
    check_json_target(json)
    found = [read(bag) for bag in find_bags(folders)]
    with written_first(json, {"bags": [as_json(*each) for each in found]}):
        for each in found:
            show(*each)


def check(
    folders: Folders,
    strict: Annotated[
        bool, typer.Option("--strict", help="Incomplete episodes are problems too.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """One line per problem; exit code 1 if there are any.

    An incomplete episode, as where a recording was stopped, is told as a note; so are messages
    that come again or out of order, which cost nothing.
    """
    check_json_target(json)
    count, results = 0, []
    for bag in find_bags(folders):
        summary, problems = read(bag)
        for problem in problems:
            counts = strict or problem.severity is Severity.DAMAGED
            count += counts
            typer.echo(f"{'problem' if counts else 'note'}: {problem}")
        drops = dict(summary.about.drops) if summary.about is not None else {}
        if drops:
            count += 1
            typer.echo(f"problem: {bag.name}: the recorder dropped {_counts(drops, '')}")
        for number, what in (
            (summary.repeated, "say nothing new of a robot-step"),
            (summary.disordered, "are out of order"),
        ):
            if number:
                typer.echo(f"note: {bag.name}: {number} messages {what}; nothing is lost by that")
        typer.echo(f"{bag.name}: {summary.episodes} complete episodes")
        results.append(as_json(summary, problems))
    write_json(json, {"bags": results, "problems": count})
    raise typer.Exit(1 if count else 0)


app.command("info")(info)
app.command("check")(check)
