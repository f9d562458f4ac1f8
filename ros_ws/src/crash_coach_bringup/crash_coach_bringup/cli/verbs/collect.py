"""`crash-coach collect`: keeps of finished runs what reports and evaluations need."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.output import CliError, console
from policy_pkg.report.collect import collect as collect_run
from policy_pkg.report.finished_runs import find_runs


def collect(
    runs: Annotated[Path, typer.Argument(metavar="RUNS", help="A run, or a folder of runs.")],
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Where copies are kept.")],
) -> None:
    """Copies run.json, metrics, timing and the last agent of finished runs; names the others."""
    kept = 0
    for run in find_runs([runs]):
        try:
            refused = collect_run(run, results)
        except OSError as error:
            raise CliError(f"{results / run.name} cannot be written: {error}") from error
        kept += refused is None
        text = refused or f"{run}: kept in {results / run.name}"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    if not kept:
        raise CliError(f"{runs}: none of its runs is finished")
