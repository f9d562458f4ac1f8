"""`crash-coach behaviour`: what teams do differently, measured over the same episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from crash_coach_bringup.cli.options import (
    MODE,
    MOST_EPISODES,
    ModeOption,
    ParamOption,
    conditions,
    mode_parameters,
)
from crash_coach_bringup.cli.output import (
    CliError,
    check_json_target,
    console,
    table,
    written_first,
)
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import evaluation_seed, record
from policy_pkg.report.behaviour import MEASURES, Behaviour, averaged, compare, measured
from policy_pkg.report.finished_runs import Run, find_runs, read_runs
from policy_pkg.report.kept_evaluations import arena
from policy_pkg.statistics import Estimate

AT_ONCE = 64  # episodes that are kept before they are measured; about 100 kB each


def behaviour(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN", help="Runs, or folders of runs; RUN@best: their best."),
    ] = None,
    crashed: Annotated[
        int, typer.Option(help="Exactly so many robots crash, drawn anew each episode.", min=0)
    ] = 1,
    victims: Annotated[
        list[str] | None, typer.Option(help="ROBOT ...: instead, these robots in every episode.")
    ] = None,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    episodes: Annotated[
        int, typer.Option(help="Episodes per run.", min=1, max=MOST_EPISODES)
    ] = 128,
    seed: Annotated[int, typer.Option(help="Of the episodes, the same for every run.", min=0)] = 0,
    json: Annotated[Path | None, typer.Option(help="Also write the figures to this file.")] = None,
) -> None:
    """Measures what teams do under a crash: focus, distances, who takes the damage.

    Runs with equal settings are seeds of one method. Differences are to the first method named,
    paired by seed.
    """
    check_json_target(json)
    if not folders:
        raise CliError("nothing to measure: name runs or folders of runs")
    parameters = mode_parameters(mode, param or [])
    runs = read_runs(find_runs(folders))
    under = {}
    for run in runs:
        who = ([], victims) if victims else ([crashed], [])
        robots = arena(run.source)[0]
        (under[run.scenario],) = conditions(robots, [], *who, mode, parameters)
    found = []
    for run in runs:
        console.print(f"{run.path}: {under[run.scenario].name}", markup=False, soft_wrap=True)
        found.append((run, _measure(run, under[run.scenario], episodes, seed)))
    rows = compare(found)
    about: dict[str, Any] = {"seed": seed, "key": evaluation_seed(seed), "episodes": episodes}
    about |= {"mode": mode, "parameters": parameters}
    with written_first(json, {**about, "rows": [asdict(row) for row in rows]}):
        for scenario, condition in under.items():
            here = [row for row in rows if row.scenario == scenario]
            _show(f"{scenario}, {condition.name}: {episodes} episodes of each run", here)


def _measure(run: Run, condition: Condition, episodes: int, seed: int) -> dict[str, float]:
    """Each measure's mean over the episodes, of which at most AT_ONCE are in memory."""
    bundle, key = load_policy(run.checkpoint), evaluation_seed(seed)
    found = []
    for first in range(0, episodes, AT_ONCE):
        some = range(first, min(first + AT_ONCE, episodes))
        found += [measured(frames) for frames in record(bundle, run.source, condition, some, key)]
    return averaged(found)


def _span(estimate: Estimate | None) -> str:
    return "" if estimate is None else f" ({estimate.low:.3g}..{estimate.high:.3g})"


def _show(title: str, rows: Sequence[Behaviour]) -> None:
    out = table(title, ["measure", "method", "mean (95 %)", "difference (95 %)", "p"])
    for row in rows:
        apart = row.difference
        out.add_row(
            f"{row.measure}, {row.unit}",
            row.method,
            f"{np.mean(row.values):.3g}{_span(row.interval)}",
            "–" if apart is None else f"{apart.value:+.3g}{_span(apart)}",
            "–" if row.p is None else f"{row.p:.3f}",
        )
    console.print(out)
    for measure in MEASURES:
        if any(row.measure == measure.name for row in rows):
            console.print(f"{measure.name}: {measure.description}", markup=False, soft_wrap=True)
