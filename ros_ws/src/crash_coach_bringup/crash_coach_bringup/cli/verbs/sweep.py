"""`crash-coach sweep`: many training runs from one file, on this machine or on a cluster."""

from __future__ import annotations

import shlex
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Literal

import typer

from crash_coach_bringup.cli.output import CliError, console, table
from crash_coach_bringup.cli.run_display import display
from policy_pkg.sweep.config import FULL, find_sweep, load_sweep
from policy_pkg.sweep.local_engine import LocalEngine
from policy_pkg.sweep.sweep import Engine, Sweep


class _Signals:
    """Ctrl-C and SIGTERM are noted, not followed at once."""

    def __init__(self) -> None:
        self.number = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.number = number

    @contextmanager
    def caught(self) -> Iterator[None]:
        before = {number: signal.signal(number, self) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def default_out(path: Path, size: str) -> Path:
    return Path("runs") / (path.stem if size == FULL else f"{path.stem}-{size}")


def make_engine(kind: str, processes: int | None, address: str | None, sweep: Sweep) -> Engine:
    if kind == "local":
        if address is not None:
            raise CliError(f"--address {address}: only --engine ray has a cluster")
        return LocalEngine(processes)
    # Imported here: Ray is an extra.
    from policy_pkg.sweep.ray_engine import RayEngine

    return RayEngine(sweep.out, processes or sweep.left, address)


def sweep(
    file: Annotated[
        str, typer.Argument(help="Sweep: a name such as paper/table1, or a YAML file.")
    ],
    size: Annotated[str, typer.Option(help="full, or one of the file's sizes.")] = FULL,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the runs. [default: runs/NAME or runs/NAME-SIZE]")
    ] = None,
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="Processes here, or tasks of a Ray cluster.")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(help="Of the Ray cluster. [default: $RAY_ADDRESS, or Ray on this machine]"),
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(help="Runs at a time. [default: one per core]", min=1, max=10_000),
    ] = None,
    have: Annotated[
        list[Path] | None,
        typer.Option(help="DIR ...: finished runs there, as `collect` keeps them, count as done."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the runs and how far they are; do nothing.")
    ] = False,
) -> None:
    """Does all runs of a file that are not done yet; killed ones go on from their checkpoint."""
    path = find_sweep(file)
    for folder in have or []:
        if not folder.is_dir():
            raise CliError(f"--have {folder}: there is no such folder")
    target = (out or default_out(path, size)).absolute()
    command = ["crash-coach", *sys.argv[1:]]
    work = Sweep(load_sweep(path, size), target, have or [], command)
    if dry_run:
        _list(work)
        return
    _say_what_is_done(work)
    stopped = _Signals()
    if work.left:
        try:
            # Before the signals are caught: importing Ray sets a handler of its own.
            runner = make_engine(engine, processes, address, work)
            with stopped.caught(), display(console) as shown:
                work.work(runner, shown.tell, shown.watch, lambda: stopped.number != 0)
        except OSError as error:
            raise CliError(f"--out {target}: {error.strerror}: {error.filename}") from error
    _conclude(work, stopped.number, command)


def _list(work: Sweep) -> None:
    out = table(f"{len(work.runs)} runs in {work.out}", ["run", "state", "steps", "of"])
    for run in work.runs:
        now = work.standings[run.name]
        out.add_row(run.name, now.kind, f"{now.steps:,}", f"{run.config.total_steps:,}")
    console.print(out)
    _say_what_is_done(work)


def _say_what_is_done(work: Sweep) -> None:
    kinds = Counter(each.kind for each in work.standings.values())
    for each in work.standings.values():
        if each.remark is not None:
            _print(f"does not count: {each.remark}")
    _print(
        f"{len(work.runs)} runs in {work.out}: {kinds['finished'] + kinds['kept']} finished "
        f"({kinds['kept']} of them elsewhere), {kinds['started']} to continue, {kinds['new']} new"
    )


def _conclude(work: Sweep, stopped: int, command: list[str]) -> None:
    for name, why in work.failed.items():
        _print(f"{name} failed: {why.splitlines()[0]}")
    left = sum(not each.done for each in work.standings.values())
    if not left:
        _print(f"all {len(work.runs)} runs are finished")
        return
    how = f"{shlex.join(command)} goes on from the runs' checkpoints"
    if stopped:
        _print(f"stopped; {left} of {len(work.runs)} runs are left: {how}")
        raise typer.Exit(128 + stopped)
    raise CliError(f"{len(work.failed)} of {len(work.runs)} runs failed; mend them, then {how}")


def _print(text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)
