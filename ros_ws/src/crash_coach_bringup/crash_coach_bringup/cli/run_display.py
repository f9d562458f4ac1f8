"""A sweep as it goes: a live table in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from policy_pkg.sweep.folder import RunProgress
from policy_pkg.sweep.sweep import Event, Snapshot

LINE_INTERVAL_S = 60.0  # between two plain lines of progress
MOST_ROWS = 20  # of the live table


def duration(seconds: float | None) -> str:
    """'3:25 h', '12 min', '40 s', or '?'"""
    if seconds is None:
        return "?"
    minutes = int(seconds // 60)
    if minutes >= 60:
        return f"{minutes // 60}:{minutes % 60:02d} h"
    return f"{minutes} min" if minutes else f"{int(seconds)} s"


def summary(snapshot: Snapshot) -> str:
    """One line on the whole sweep."""
    running = sum(each is not None for each in snapshot.running.values())
    waiting = snapshot.waiting + len(snapshot.running) - running
    return (
        f"{snapshot.done} of {snapshot.runs} runs done, {snapshot.failed} failed, "
        f"{running} running, {waiting} waiting; "
        f"{snapshot.steps_per_s:,.0f} steps/s, {snapshot.steps_left:,} steps left, "
        f"about {duration(snapshot.eta_s)}"
    )


def figures(progress: RunProgress | None) -> list[str]:
    """steps, speed, time left, crash rate, success rate"""
    if progress is None:
        return ["waiting to start", "", "", "", ""]
    left = progress.total_steps - progress.env_steps
    eta_s = left / progress.steps_per_s if progress.steps_per_s > 0 else None
    success = "" if progress.success_rate is None else f"{progress.success_rate:.2f}"
    return [
        f"{progress.env_steps:,} of {progress.total_steps:,}",
        f"{progress.steps_per_s:,.0f}",
        duration(eta_s),
        f"{progress.alpha:.3f}",
        success,
    ]


class Display:
    """Prints events at once; ``live`` is None where there is no terminal."""

    def __init__(self, console: Console, live: Live | None) -> None:
        self._console = console
        self._live = live
        self._next_line_s = time.monotonic() + LINE_INTERVAL_S

    def tell(self, event: Event) -> None:
        text = f"{event.name}: {event.kind}" + (f": {event.text}" if event.text else "")
        clock = time.strftime("%H:%M:%S")
        self._console.print(f"{clock} {text}", markup=False, highlight=False, soft_wrap=True)

    def watch(self, snapshot: Snapshot) -> None:
        if self._live is not None:
            self._live.update(_table(snapshot))
        elif time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + LINE_INTERVAL_S
            clock = time.strftime("%H:%M:%S")
            self._console.print(f"{clock} {summary(snapshot)}", highlight=False, soft_wrap=True)


def _table(snapshot: Snapshot) -> Group:
    out = Table(box=None, pad_edge=False)
    for index, name in enumerate(["run", "steps", "steps/s", "left", "alpha", "success"]):
        out.add_column(name, justify="left" if index == 0 else "right")
    rows = sorted(snapshot.running.items(), key=lambda each: each[1] is None)
    for name, progress in rows[:MOST_ROWS]:
        out.add_row(Text(name), *figures(progress))
    return Group(out, Text(summary(snapshot)))


@contextmanager
def display(console: Console) -> Iterator[Display]:
    """For the time of a sweep."""
    if not console.is_terminal:
        yield Display(console, None)
        return
    with Live(console=console, refresh_per_second=2, transient=True) as live:
        yield Display(console, live)
