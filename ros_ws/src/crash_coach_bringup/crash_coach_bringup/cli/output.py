"""What every verb shares: the console, errors as one line, results as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from crash_coach_bringup.cli.fitted_table import FittedConsole, FittedTable
from crash_coach_common.contract import UserError
from policy_pkg.statistics import Estimate

console = FittedConsole()


class CliError(UserError):
    """A wrong command line."""


def write_json(path: Path | None, result: Mapping[str, Any]) -> None:
    """Writes ``result`` whole or not at all; does nothing without a path.

    Raises:
        CliError: the folder does not exist or cannot be written.
    """
    if path is None:
        return
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "w") as out:
            json.dump(result, out, indent=2)
            out.write("\n")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise CliError(f"--json {path}: {error.strerror}: {error.filename}") from None


def check_file_target(option: str, path: Path) -> None:
    """Refuses a file that cannot be written before the work, not after it.

    Raises:
        CliError: a missing folder, or a directory in the way.
    """
    if not path.absolute().parent.is_dir():
        raise CliError(f"{option} {path}: there is no folder {path.absolute().parent}")
    if path.is_dir():
        raise CliError(f"{option} {path}: is a directory")


def check_json_target(path: Path | None) -> None:
    """As ``check_file_target``, for an optional --json."""
    if path is not None:
        check_file_target("--json", path)


def table(title: str, columns: list[str]) -> FittedTable:
    """A table whose first column is text and whose others are figures."""
    out = FittedTable(title=title, title_justify="left")
    for index, column in enumerate(columns):
        out.add_column(column, justify="left" if index == 0 else "right")
    return out


def points(cost: Estimate) -> str:
    """'+83.2 (+75.0..+88.9)', of a cost in points of success; without a width only the first."""
    low, middle, high = (
        f"{round(100 * value, 9) + 0.0:+.1f}".replace("-", "−")
        for value in (cost.low, cost.value, cost.high)
    )
    return middle if low == high else f"{middle} ({low}..{high})"


def percent_ci(rate: float, interval: Sequence[float] | None) -> str:
    """'87.5 % (79.0..93.1)'; without an interval, of an episode that is always the same:
    '0.0 % (1 episode)'"""
    if interval is None:
        return f"{100 * rate:.1f} % (1 episode)"
    return f"{100 * rate:.1f} % ({100 * interval[0]:.1f}..{100 * interval[1]:.1f})"
