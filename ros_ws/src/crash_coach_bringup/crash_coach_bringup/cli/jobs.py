"""Runs trainings side by side, one single-threaded process each, with a progress bar each."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
import traceback
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn

from crash_coach_bringup.cli import signals
from crash_coach_bringup.cli.output import console, surroundings
from crash_coach_common.contract import UserError
from crash_coach_common.loading import loading
from crash_coach_common.spawned import hear, start_deaf
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

    from policy_pkg.train.config import TrainConfig

POLL_S = 0.2
SAVE_S = 120.0  # for a checkpoint with a large replay, on a slow disk


@dataclass(frozen=True)
class Job:
    """One training run."""

    name: str
    config: TrainConfig
    out_dir: Path
    resume: bool


@dataclass(frozen=True)
class Message:
    """What a training process tells its parent."""

    job: int
    kind: str  # "progress", "done", "stopped" or "failed"
    content: Any  # ProgressReport, TrainSummary, or the error's text


def _work(index: int, job: Job, parent: int, out: Queue[Message]) -> None:
    """A training process; ends by itself where its parent is gone."""
    interrupted = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    hear()
    # Imported here: only training processes need torch.
    with loading():
        from policy_pkg.train.run import EndedEarly, train

    def report(progress: Any) -> None:
        if os.getppid() != parent:
            os._exit(1)
        out.put(Message(index, "progress", progress))

    try:
        summary = train(
            *(job.config, job.out_dir, job.resume), progress=report, stopped=interrupted.is_set
        )
    except EndedEarly:
        out.put(Message(index, "stopped", None))
    except UserError as error:
        out.put(Message(index, "failed", str(error)))
    except Exception as error:  # noqa: BLE001 - a defect's traceback belongs to the parent's output
        out.put(Message(index, "failed", surroundings(error) or traceback.format_exc()))
    else:
        out.put(Message(index, "done", summary))


def _progress_bars() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:3.0f} %"),
        TextColumn("{task.fields[figures]}"),
        console=console,
    )


def _figures(report: Any) -> str:
    """One line of a ProgressReport."""
    parts = [f"alpha {report.alpha:.3f}"]
    if report.success_rate is not None:
        parts.append(f"success {report.success_rate:.2f}")
    if report.steps_per_s is not None and report.eta_s is not None:
        minutes, seconds = divmod(int(report.eta_s), 60)
        parts += [f"{report.steps_per_s:,.0f} steps/s", f"left {minutes}:{seconds:02d}"]
    return "  ".join(parts)


class _Runner:
    """Starts jobs as workers become free and gathers what they say."""

    def __init__(self, jobs: list[Job], workers: int, bars: Progress) -> None:
        self.jobs = jobs
        self.workers = workers
        self.bars = bars
        self.context = multiprocessing.get_context("spawn")
        self.messages: Queue[Message] = self.context.Queue()
        self.waiting = list(range(len(jobs)))
        self.running: dict[int, BaseProcess] = {}
        self.tasks: dict[int, TaskID] = {}
        self.results: dict[int, Any] = {}
        self.errors: dict[int, str] = {}

    def start_free(self) -> None:
        while self.waiting and len(self.running) < self.workers:
            index = self.waiting.pop(0)
            job = self.jobs[index]
            self.tasks[index] = self.bars.add_task(job.name, total=1.0, figures="starting")
            process = self.context.Process(
                target=_work, args=(index, job, os.getpid(), self.messages), daemon=True
            )
            start_deaf(process)
            self.running[index] = process

    def take(self, message: Message) -> None:
        task = self.tasks[message.job]
        if message.kind == "progress":
            report = message.content
            if report.warning:
                console.print(f"[yellow]{self.jobs[message.job].name}: {report.warning}[/yellow]")
            self.bars.update(task, completed=report.steps / report.total_steps)
            self.bars.update(task, figures=_figures(report))
            return
        if message.kind == "done":
            self.results[message.job] = message.content
            self.bars.update(task, completed=1.0)
        elif message.kind == "stopped":
            self.bars.update(task, figures="stopped")
        else:
            self.errors[message.job] = message.content
            self.bars.update(task, figures="[red]failed[/red]")
        self.running.pop(message.job).join()

    def reap(self) -> None:
        """A process that died without a word, say by the kernel's memory killer."""
        for index, process in list(self.running.items()):
            if not process.is_alive() and self.messages.empty():
                self.errors[index] = f"the training process died, exit code {process.exitcode}"
                self.bars.update(self.tasks[index], figures="[red]died[/red]")
                del self.running[index]

    def stop(self) -> None:
        """Lets every run save where it stands, and says how to go on; a second Ctrl-C ends it."""
        for process in self.running.values():
            if process.pid is not None and process.is_alive():
                os.kill(process.pid, signal.SIGINT)  # those in the terminal's group have it twice
        end_s = time.monotonic() + SAVE_S
        while self.running and time.monotonic() < end_s:
            try:
                self.take(self.messages.get(timeout=POLL_S))
            except queue.Empty:
                self.reap()
        for job in self.jobs:
            console.print(tell_stopped(job.out_dir), markup=False, highlight=False, soft_wrap=True)

    def run(self) -> None:
        """Raises KeyboardInterrupt after Ctrl-C, when every run has saved."""
        try:
            # A flag: the first message loads torch, in which an exception would leave a ruin.
            with signals.noted() as interrupted:
                while (self.waiting or self.running) and not interrupted():
                    self.start_free()
                    try:
                        self.take(self.messages.get(timeout=POLL_S))
                    except queue.Empty:
                        self.reap()
            if interrupted():
                self.stop()
                raise KeyboardInterrupt
        finally:
            for process in self.running.values():
                process.terminate()
                process.join()


def tell_stopped(run: Path) -> str:
    """Where an interrupted run stands, and how it goes on."""
    made = list_checkpoints(run / CHECKPOINTS)
    if not made:
        return f"{run}: interrupted before there was anything to save"
    steps = int(made[-1].name.removeprefix("step_"))
    return f"{run}: saved at {steps:,} steps; the same command with --resume goes on from there"


def run_jobs(jobs: list[Job], workers: int | None = None) -> list[Any]:
    """Trains every job, at most one per core at a time.

    Returns:
        Each job's TrainSummary, in the order of ``jobs``.

    Raises:
        UserError: some failed; the others were finished first. Names each with its error.
    """
    workers = workers or len(os.sched_getaffinity(0))
    with _progress_bars() as bars:
        runner = _Runner(jobs, workers, bars)
        runner.run()
    if runner.errors:
        lines = [f"{jobs[index].name}: {text}" for index, text in sorted(runner.errors.items())]
        raise UserError("\n".join(lines))
    return [runner.results[index] for index in range(len(jobs))]
