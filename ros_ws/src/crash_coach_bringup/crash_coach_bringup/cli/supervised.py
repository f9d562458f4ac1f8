"""What verbs share that keep ROS nodes running: a line per event, and their logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from crash_coach_bringup.cli.output import CliError, not_written

if TYPE_CHECKING:
    from crash_coach_bringup.ros.supervisor import Event


def teller(verb: str) -> Callable[[Event], None]:
    """Prints a line per event; a death goes to stderr with the end of the node's log."""

    def show(event: Event) -> None:
        if event.kind in ("episode", "robot", "summary"):
            typer.echo(event.text)
            return
        words = [word for word in (event.kind, event.process, event.text) if word]
        typer.echo(f"{verb}: {': '.join(words)}", err=event.kind == "died")

    return show


@contextmanager
def logs_at(folder: Path) -> Iterator[None]:
    """Raises CliError where the body could not write its logs."""
    try:
        yield
    except BrokenPipeError:  # of what is printed, by whoever read it
        raise
    except OSError as error:
        raise CliError(not_written("--logs", folder, error)) from None
