"""How figures look, and how they are written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crash_coach_bringup.cli.output import (
    CliError,
    not_written,
)
from crash_coach_common.whole_output import whole_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg")

STEPS = {"env_steps": "environment steps", "gradient_steps": "gradient steps"}

# Okabe and Ito's palette, without its yellow, which is too light for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

Dash = Literal["-", "--", "-.", ":"]

DASHES: tuple[Dash, ...] = ("-", "--", "-.", ":")

MARKS = ("o", "s", "D", "^")

INK = "#333333"


def style(index: int) -> tuple[str, Dash]:
    """Colour and line style of a group."""
    return COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]


def mark(index: int) -> str:
    """Of a group's points: another one where ``style``'s colours begin anew."""
    return MARKS[index // len(COLOURS) % len(MARKS)]


def save(figure: Figure, path: Path, kind: str) -> None:
    """Writes ``path`` whole or not at all; the same curves give the same file.

    Raises:
        CliError: it cannot be written.
    """
    from matplotlib import rc_context

    metadata = {"Date": None} if kind == "svg" else {}
    try:
        with rc_context({"svg.hashsalt": "crash-coach"}), whole_output(path) as temporary:
            figure.savefig(temporary, format=kind, metadata=metadata)
    except OSError as error:
        raise CliError(not_written("--out", path, error)) from None
