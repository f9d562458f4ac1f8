"""`crash-coach train-offline`: one run on recorded episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from crash_coach_bringup.cli import signals
from crash_coach_bringup.cli.jobs import tell_stopped
from crash_coach_bringup.cli.output import CliError, console
from crash_coach_common.loading import loading
from policy_pkg.bags.dataset import load_episodes
from policy_pkg.bags.problems import Problem
from policy_pkg.train.offline.config import OfflineConfig, load_offline_config

if TYPE_CHECKING:
    from policy_pkg.train.progress import ProgressReport


def _tell(problem: Problem) -> None:
    console.print(f"[yellow]{problem}[/yellow]", soft_wrap=True)


class _Bar:
    """Shows ProgressReports in a progress bar."""

    def __init__(self, bars: Progress, task: TaskID) -> None:
        self._bars, self._task = bars, task

    def show(self, report: ProgressReport) -> None:
        if report.warning:
            console.print(f"[yellow]{report.warning}[/yellow]", soft_wrap=True)
        figures = f"{report.steps_per_s:,.0f} gradient steps/s"
        if report.success_crash_free is not None:
            figures = f"success {report.success_crash_free:.2f}  {figures}"
        done = report.steps / report.total_steps
        self._bars.update(self._task, completed=done, figures=figures)


def plan_runs(
    config: str, out: Path, overrides: list[str], seeds: list[int]
) -> dict[Path, OfflineConfig]:
    """Run directory -> its settings; ``out`` itself for one seed, folders below it for more."""
    if len(seeds) < 2:
        settings = load_offline_config(config, overrides, seeds[0] if seeds else None)
        return {out: settings}
    if len(set(seeds)) < len(seeds):
        raise CliError(f"--seed {' '.join(map(str, seeds))}: a seed comes twice")
    return {
        out / f"{Path(config).stem}-s{seed}": load_offline_config(config, overrides, seed)
        for seed in seeds
    }


def train_offline(
    config: Annotated[
        str,
        typer.Argument(help="A name such as offline/conservative_qmix, or a YAML file."),
    ],
    bags: Annotated[
        list[Path],
        typer.Argument(metavar="BAG...", help="Recordings, or folders of recordings."),
    ],
    out: Annotated[Path, typer.Option(help="Run directory; with several seeds, their parent.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: replaces settings, e.g. learner.lr=1e-3"),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(help="Seed; several give several runs, one after another."),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on from the newest checkpoint; what is finished stays."),
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse recordings with any problem.")
    ] = False,
    repeated: Annotated[
        bool,
        typer.Option("--repeated", help="Take episodes that are recorded twice as often as that."),
    ] = False,
) -> None:
    """Trains a team on recorded episodes, without a simulator. Recordings are read once."""
    runs = plan_runs(config, out, override or [], seed or [])
    train_runs(runs, bags, resume, strict, repeated)


def train_runs(
    runs: Mapping[Path, OfflineConfig],
    bags: Sequence[Path],
    resume: bool,
    strict: bool,
    repeated: bool,
) -> None:
    """One run after another, whose configs differ in nothing but the seed.

    Raises:
        CliError: an episode that is there twice, unless ``repeated``.
        UserError: as ``policy_pkg.train.offline.run``.
    """
    # Imported here: the other verbs do without torch.
    with loading():
        from policy_pkg.train.offline import run as offline
        from policy_pkg.train.run import EndedEarly

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24))
    with Progress(*columns, TextColumn("{task.fields[figures]}"), console=console) as bars:
        tasks = {run: bars.add_task(run.name, total=1.0, figures="waiting") for run in runs}
        data = offline.read_data(next(iter(runs.values())), load_episodes(bags, strict, _tell))
        if data.duplicates and not repeated:
            raise CliError(
                f"{data.duplicates} of {len(data)} episodes repeat another one (same seed, number "
                "and content): a recording is named twice; name it once, or give --repeated"
            )
        for run, settings in runs.items():
            with signals.noted() as interrupted:
                try:
                    summary = offline.train_offline(
                        settings,
                        data,
                        run,
                        resume=resume,
                        progress=_Bar(bars, tasks[run]).show,
                        sources=[str(path) for path in bags],
                        stopped=interrupted,
                    )
                except EndedEarly:
                    console.print(tell_stopped(run), markup=False, soft_wrap=True)
                    raise KeyboardInterrupt from None
            steps, episodes = summary.gradient_steps, summary.episodes
            console.print(
                f"{steps:,} gradient steps on {episodes:,} episodes in {summary.wall_s:.0f} s"
            )
            console.print(f"  checkpoint: {run}", soft_wrap=True)
