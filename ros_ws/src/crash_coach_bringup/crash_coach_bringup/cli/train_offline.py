"""`crash-coach train-offline`: one run on recorded episodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from crash_coach_bringup.cli.output import CliError, console
from policy_pkg.bags.problems import Problem
from policy_pkg.train.bag_dataset import load_episodes
from policy_pkg.train.offline_config import load_offline_config

if TYPE_CHECKING:
    from policy_pkg.train.offline import OfflineReport


def _tell(problem: Problem) -> None:
    console.print(f"[yellow]{problem}[/yellow]", soft_wrap=True)


class _Bar:
    """Shows OfflineReports in a progress bar."""

    def __init__(self, bars: Progress, task: TaskID) -> None:
        self._bars, self._task = bars, task

    def show(self, report: OfflineReport) -> None:
        if report.warning:
            console.print(f"[yellow]{report.warning}[/yellow]", soft_wrap=True)
        figures = f"{report.steps_per_s:,.0f} gradient steps/s"
        if report.success_crash_free is not None:
            figures = f"success {report.success_crash_free:.2f}  {figures}"
        done = report.gradient_steps / report.total_steps
        self._bars.update(self._task, completed=done, figures=figures)


def train_offline(
    config: Annotated[
        str,
        typer.Argument(
            help="Configuration: a name such as offline/conservative_qmix, or a YAML file."
        ),
    ],
    bags: Annotated[
        list[Path],
        typer.Argument(metavar="BAG...", help="Recordings, or folders of recordings."),
    ],
    out: Annotated[Path, typer.Option(help="Run directory.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: replaces settings, e.g. learner.lr=1e-3"),
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Seed.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the newest checkpoint.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse recordings with any problem.")
    ] = False,
) -> None:
    """Trains a team on recorded episodes, without a simulator."""
    if seed and len(seed) > 1:
        raise CliError(f"--seed {' '.join(map(str, seed))}: one run takes one seed")
    settings = load_offline_config(config, override or [], seed[0] if seed else None)
    # Imported here: the other verbs do without torch.
    from policy_pkg.train import offline

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24))
    with Progress(*columns, TextColumn("{task.fields[figures]}"), console=console) as bars:
        bar = _Bar(bars, bars.add_task(out.name, total=1.0, figures="reading"))
        summary = offline.train_offline(
            settings,
            load_episodes(bags, strict, _tell),
            out,
            resume=resume,
            progress=bar.show,
            sources=[str(path) for path in bags],
        )
    console.print(
        f"{summary.gradient_steps:,} gradient steps on {summary.episodes:,} episodes "
        f"in {summary.wall_s:.0f} s"
    )
    console.print(f"  checkpoint: {out}", soft_wrap=True)
