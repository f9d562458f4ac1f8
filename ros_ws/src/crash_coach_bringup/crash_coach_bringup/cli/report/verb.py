"""`crash-coach report`: many runs evaluated alike; tables and figures over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.options import (
    MODE,
    MOST_EPISODES,
    DurationOption,
    ModeOption,
    ParamOption,
    StartOption,
    conditions,
    mode_parameters,
    timed,
)
from crash_coach_bringup.cli.output import CliError, console, write_file, write_json, written_first
from crash_coach_bringup.cli.report.findings import Findings
from crash_coach_bringup.cli.report.other_tables import as_csv, as_latex
from crash_coach_bringup.cli.report.page import page
from crash_coach_bringup.cli.report.time_left import TimeLeft
from policy_pkg.play.conditions import Condition, crash_free, named
from policy_pkg.play.evaluate import evaluation_seed
from policy_pkg.report.finished_runs import (
    Run,
    find_runs,
    has_begun,
    methods_of,
    read_runs,
)
from policy_pkg.report.kept_evaluations import Evaluations, Result, arena
from policy_pkg.report.marl_eval import as_marl_eval

CRASHED = (0, 1, 2)
RATES = (0.01, 0.05, 0.1)


def asked(
    robots: tuple[str, ...],
    crashed: Sequence[int] | None,
    rates: Sequence[float] | None,
    each_robot: bool | None,
    mode: str,
    parameters: Mapping[str, float],
) -> list[Condition]:
    """The conditions, exact numbers first; without any option all that a result should state.

    What a victim costs needs the crash-free episodes.
    """
    if not crashed and not rates and not each_robot:
        crashed, rates = [k for k in CRASHED if k <= len(robots)], RATES
        each_robot = each_robot is None
    elif each_robot and 0 not in (crashed or []):
        crashed = [0, *(crashed or [])]
    counts, drawn = list(crashed or []), list(rates or [])
    if not counts and not drawn:
        found = []
    else:
        found = conditions(robots, drawn, counts, [], mode, parameters)
        found = [*found[len(drawn) :], *found[: len(drawn)]]
    found = [crash_free() if c.crashed == 0 else c for c in found]
    if each_robot:
        found += [named([robot], mode, parameters) for robot in robots]
    return found


FoldersArgument = Annotated[
    list[Path] | None,
    typer.Argument(metavar="DIR", help="Runs, folders of runs; DIR@best: their best checkpoints."),
]
CrashedOption = Annotated[
    list[int] | None,
    typer.Option(help="K ...: exactly K robots crash, drawn anew each episode. [default: 0 1 2]"),
]
RateOption = Annotated[
    list[float] | None,
    typer.Option(
        help="R ...: each robot crashes with probability R; with --crashed also estimated from "
        "its results. [default: 0.01 0.05 0.1, or none where another crash option is given]"
    ),
]
EachRobotOption = Annotated[
    bool | None,
    typer.Option(
        "--each-robot/--no-each-robot",
        help="Also each robot alone, in every episode: who hurts most. "
        "[default: yes, or no where another crash option is given]",
        show_default=False,
    ),
]
OutOption = Annotated[
    Path, typer.Option(help="Folder for the tables and figures; goes on where it was left.")
]
EpisodesOption = Annotated[
    int, typer.Option(help="Episodes per run and condition.", min=1, max=MOST_EPISODES)
]
TrajectoriesOption = Annotated[
    int | None,
    typer.Option(help="SEED: draw the first episode of every method's run with that seed."),
]
AgainstOption = Annotated[
    list[str] | None,
    typer.Option(help="METHOD ...: also the differences of all others to these, paired by seed."),
]


CsvOption = Annotated[bool, typer.Option("--csv", help="Also table.csv, a line per row.")]
LatexOption = Annotated[
    bool, typer.Option("--latex", help="Also table.tex, the methods' table for booktabs.")
]


@dataclass(frozen=True)
class Extra:
    """What is written only if asked for; ``trajectories``: of the runs with that seed."""

    csv: bool
    latex: bool
    trajectories: int | None


def report(
    folders: FoldersArgument = None,
    out: OutOption = Path("report"),
    episodes: EpisodesOption = 128,
    crashed: CrashedOption = None,
    crash_rate: RateOption = None,
    each_robot: EachRobotOption = None,
    mode: ModeOption = MODE,
    param: ParamOption = None,
    start: StartOption = 0,
    duration_steps: DurationOption = 0,
    seed: Annotated[int, typer.Option(help="Of the episodes, the same for every run.", min=0)] = 0,
    against: AgainstOption = None,
    trajectories: TrajectoriesOption = None,
    csv: CsvOption = False,
    latex: LatexOption = False,
) -> None:
    """Compares methods over seeds: evaluates many runs alike.

    Runs with equal settings are seeds of one method, which is called what their folders are.
    """
    parameters = mode_parameters(mode, param or [])
    runs, waiting = _begun(folders or [])
    _check_methods(against or [], runs)
    who, steps = (crashed, crash_rate, each_robot), (start, duration_steps)
    wanted = {
        run.scenario: timed(asked(arena(run.source)[0], *who, mode, parameters), *steps)
        for run in runs
    }
    exact = any(c.crashed is not None for found in wanted.values() for c in found)
    rates = crash_rate or ([] if crashed or each_robot else RATES)
    about = {
        "episodes": episodes,
        "seed": seed,
        "key": evaluation_seed(seed),
        "mode": mode,
        "parameters": parameters,
        "start_step": start,
        "duration_steps": duration_steps,
        "against": against or [],
        "without_checkpoint": [str(path) for path in waiting],
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        results = _play(runs, wanted, Evaluations(out / "evaluations", episodes, seed))
        findings = Findings.of(about, results, list(rates) if exact else [])
        _write(out, findings, results, Extra(csv, latex, trajectories))
    except OSError as error:
        raise CliError(f"--out {out}: {error.strerror}: {error.filename}") from error


def _begun(folders: list[Path]) -> tuple[list[Run], list[Path]]:
    """The runs, and those that have no checkpoint yet."""
    if not folders:
        raise CliError("nothing to report on: name runs or folders of runs")
    paths = find_runs(folders)
    waiting = [path for path in paths if not has_begun(path)]
    runs = read_runs(path for path in paths if path not in waiting)
    if not runs:
        raise CliError(f"none of {len(waiting)} runs has a checkpoint yet, as {waiting[0]}")
    return runs, waiting


def _check_methods(against: Sequence[str], runs: Sequence[Run]) -> None:
    methods = methods_of(runs)
    for name in against:
        if name not in methods:
            raise CliError(f"--against {name}: no such method; there are {', '.join(methods)}")


def _play(
    runs: Sequence[Run], wanted: Mapping[str, Sequence[Condition]], evaluations: Evaluations
) -> list[Result]:
    """Plays what is not kept; says what, how far it is, and how long the rest will take."""
    total = sum(evaluations.lacking(run, wanted[run.scenario]) for run in runs)
    clock = TimeLeft(total)

    results = []
    for run in runs:

        def say(condition: Condition, run: Run = run) -> None:
            best = " (best)" if run.is_best else ""
            text = f"{clock.next()} {run.path}{best} on {run.scenario}: {condition.name}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)

        results.append(evaluations.result(run, wanted[run.scenario], say))
    return results


def _write(out: Path, findings: Findings, results: Sequence[Result], extra: Extra) -> None:
    """Tables, JSON and figures."""
    text = page(findings)
    tables = {"table.md": text}
    if extra.csv:
        tables["table.csv"] = as_csv(findings.rows)
    if extra.latex:
        tables["table.tex"] = as_latex(findings.rows)
    with written_first(out / "results.json", findings.to_json()):
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    write_json(out / "marl_eval.json", as_marl_eval(results))
    for name, content in tables.items():
        write_file("--out", out / name, content.encode())
    # Imported here: no other verb should wait for matplotlib.
    from crash_coach_bringup.cli.report import figures as report_figures

    drawn = report_figures.write(findings, [result.run for result in results], out)
    if extra.trajectories is not None:
        seeds = extra.trajectories, findings.about["seed"]
        drawn.append(report_figures.trajectories(results, *seeds, out))
    written = (out / name for name in (*tables, "results.json", "marl_eval.json"))
    for path in (*written, *drawn):
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
