"""`crash-coach train`: one run, or several side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crash_coach_bringup.cli.jobs import Job, run_jobs
from crash_coach_bringup.cli.output import CliError, console, table
from policy_pkg.train.config import load_train_config

if TYPE_CHECKING:
    from policy_pkg.train.progress import RunSummary


def plan_jobs(
    configs: list[str], out: Path, overrides: list[str], seeds: list[int], resume: bool
) -> list[Job]:
    """One job per configuration and seed; ``out`` itself for one, folders below it for more."""
    chosen: list[int | None] = [*seeds] if seeds else [None]
    single = len(configs) == 1 and len(chosen) == 1
    jobs: dict[Path, Job] = {}
    for seed in chosen:  # all configurations of a seed first: what is finished can be compared
        for config_name in configs:
            config = load_train_config(config_name, overrides, seed)
            name = f"{Path(config_name).stem}-s{config.seed}"
            folder = out if single else out / name
            if folder in jobs:
                raise CliError(f"two runs would both be written to {folder}: name each run once")
            jobs[folder] = Job(name, config, folder, resume)
    return list(jobs.values())


def train(
    config: Annotated[
        list[str],
        typer.Argument(help="Configuration: a name such as buttons/qmix, or a YAML file."),
    ],
    out: Annotated[Path, typer.Option(help="Run directory; with several runs, their parent.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: replaces settings, e.g. coach.strategy=deck"),
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Seed; several give several runs.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the newest checkpoint.")
    ] = False,
) -> None:
    """Trains a team. Several configurations or seeds run side by side, a process per core."""
    jobs = plan_jobs(config, out, override or [], seed or [], resume)
    show(jobs, run_jobs(jobs))
    for job in jobs:
        console.print(f"  checkpoint: {job.out_dir}", soft_wrap=True)


def show(jobs: list[Job], summaries: list[RunSummary]) -> None:
    """What each run came to; success is that of its last evaluation block."""
    columns = ["run", "steps", "episodes", "gradient steps", "success", "crash-free", "minutes"]
    rows = table("Trained", columns)
    for job, summary in zip(jobs, summaries, strict=True):
        last = [summary.last_block.get(key) for key in ("success_rate", "success_crash_free")]
        rows.add_row(
            job.name,
            f"{summary.steps:,}",
            f"{summary.episodes:,}",
            f"{summary.gradient_steps:,}",
            *("–" if rate is None else f"{100 * float(rate):.1f} %" for rate in last),
            f"{summary.wall_s / 60:.1f}",
        )
    console.print(rows)
