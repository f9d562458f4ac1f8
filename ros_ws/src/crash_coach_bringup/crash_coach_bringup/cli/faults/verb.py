"""`crash-coach faults`: fault scenarios, played and judged."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from crash_coach_bringup.cli.faults.docs import generated, update
from crash_coach_bringup.cli.faults.play import check_scenario, play
from crash_coach_bringup.cli.faults.report import Played, check_target, measured, write
from crash_coach_bringup.cli.options import MOST_EPISODES, Layout, LayoutOption, Via, ViaOption
from crash_coach_bringup.cli.output import (
    CliError,
    check_file_target,
    console,
    done_first,
    table,
    tell_note,
    write_file,
)
from crash_coach_bringup.cli.playing import ALIKE
from crash_coach_pkg.coach.fault_scenario import (
    FaultScenario,
    fault_scenario_names,
    find_fault_scenario,
    load_fault_scenario,
)
from policy_pkg.play.target import HELP, load_target
from policy_pkg.report.verdict import FaultRun

COLOURS = {"passed": "green", "failed": "red", "error": "red"}
app = typer.Typer(
    help="Fault scenarios: what a team has to stand, and whether it does.", no_args_is_help=True
)
FileArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="A YAML file, or the name of a shipped one.")
]
ScenarioOption = Annotated[
    str | None, typer.Option(help="Scenario name or YAML file; default: the file's, the team's.")
]


def show(title: str, run: FaultRun) -> None:
    rows = table(title, ["expected", "measured (95 % interval)", "verdict"])
    for verdict in run.verdicts:
        status = verdict.finding.status
        # Text: what is in brackets is no markup.
        texts = Text(verdict.wanted), Text(measured(verdict)), Text(status, COLOURS[status])
        rows.add_row(*texts)
    console.print(rows)
    if run.faulted.alike:
        console.print(ALIKE, soft_wrap=True)


def read(file: str) -> FaultScenario:
    return load_fault_scenario(find_fault_scenario(file))


@app.command("run")
def run_verb(
    file: FileArgument,
    policy: Annotated[str, typer.Option(help=HELP)],
    scenario: ScenarioOption = None,
    episodes: Annotated[int, typer.Option(help="Pairs.", min=1, max=MOST_EPISODES)] = 64,
    seed: Annotated[int, typer.Option(help="Seed of episodes and faults.", min=0)] = 0,
    via: ViaOption = Via.core,
    layout: LayoutOption = Layout.nodes,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the report, JUnit XML, effect log, figures.")
    ] = None,
) -> None:
    """Plays episodes with the faults and without; exits with 1 unless all expectations hold."""
    faults = read(file)
    if not faults.expect:
        raise CliError(
            f"{faults.path} expects nothing, and nothing judged is no pass: add `expect`"
        )
    if out is not None:
        check_target(out)
    target = load_target(policy, scenario or faults.config.scenario)
    tell_note(target.note)
    began, start_s = datetime.now(UTC), time.monotonic()
    run = play(faults, target, episodes, seed, via, layout)
    played = Played(
        name=faults.path.stem,
        description=faults.config.description,
        team=policy,
        scenario=target.scenario,
        via=via.value,
        layout=layout.value if via is Via.ros else None,
        seed=seed,
        episodes=episodes,
        began=began,
        seconds=time.monotonic() - start_s,
    )
    how = f"{episodes} episodes, seed {seed}, via {via}"
    with done_first(lambda: None if out is None else write(out, played, run)):
        show(f"{played.name}: {policy} on {target.scenario}, {how}", run)
    if out is not None:
        console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)
    if not run.passed:
        raise typer.Exit(1)


@app.command("check")
def check_verb(file: FileArgument, scenario: ScenarioOption = None) -> None:
    """Reads a file and holds it against a scenario's robots, without playing."""
    faults = read(file)
    against = scenario or faults.config.scenario
    if against is not None:
        check_scenario(faults, against)
    what = f"faults: {len(faults.faults)}, expectations: {len(faults.expect)}"
    with_whom = f"fits {against}" if against else "not held against a scenario (--scenario)"
    line = f"{faults.path}: {what}; {with_whom}"
    console.print(line, markup=False, highlight=False, soft_wrap=True)


@app.command("list")
def list_verb() -> None:
    """The shipped fault scenarios."""
    rows = table("fault scenarios", ["name", "scenario", "description"])
    for name in fault_scenario_names():
        config = read(name).config
        rows.add_row(name, config.scenario or "any", Text(config.description, justify="left"))
    console.print(rows)


@app.command("docs")
def docs_verb(
    page: Annotated[
        Path | None, typer.Option(help="Write the tables into this page instead.")
    ] = None,
) -> None:
    """Every mode, setting and expectation, installed modes included, as Markdown."""
    if page is None:
        typer.echo("\n\n".join(generated().values()))
        return
    check_file_target("--page", page)
    try:
        text = update(page.read_text("utf-8"))
    except UnicodeDecodeError:
        raise CliError(f"--page {page}: not UTF-8 text") from None
    except OSError as error:
        raise CliError(f"--page {page}: {error.strerror}") from None
    write_file("--page", page, text.encode())
