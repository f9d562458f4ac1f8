"""What every verb shares: the console, errors as one line, results as JSON."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from crash_coach_bringup.cli.fitted_table import FittedConsole, FittedTable
from crash_coach_common.contract import UserError
from crash_coach_common.whole_output import check_output, write_whole
from policy_pkg.statistics import Estimate

console = FittedConsole()
# An OSError with one of these is no defect of ours.
SURROUNDINGS = frozenset({
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EBUSY,
    errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.EMFILE, errno.ENFILE,
})  # fmt: skip


class CliError(UserError):
    """A wrong command line."""


def write_json(path: Path | None, result: Mapping[str, Any]) -> None:
    """Writes ``result`` whole or not at all; does nothing without a path.

    Raises:
        CliError: it cannot be written.
    """
    if path is not None:
        write_file("--json", path, (json.dumps(result, indent=2) + "\n").encode())


def write_file(option: str, path: Path, content: bytes) -> None:
    """Writes ``content`` as ``whole_output`` does. Raises CliError where it cannot."""
    try:
        write_whole(path, content)
    except OSError as error:
        raise CliError(not_written(option, path, error)) from None


def not_written(option: str, path: Path, error: OSError) -> str:
    """The one line on an output that failed."""
    return f"{option} {path}: cannot be written: {error.strerror or error}"


def surroundings(error: Exception) -> str | None:
    """One line on an OSError that is a disk's, a folder's or a limit's; None for any other."""
    if not isinstance(error, OSError) or error.errno not in SURROUNDINGS:
        return None
    return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror)


@contextmanager
def done_first(write: Callable[[], None]) -> Iterator[None]:
    """Calls ``write``, then runs the body, which prints what was computed.

    In this order a table that cannot be printed costs no file; and the body runs also where the
    file could not be written, so that what was computed is seen.

    Raises:
        CliError: of ``write``; after the body.
    """
    failure: CliError | None = None
    try:
        write()
    except CliError as error:
        failure = error
    yield
    if failure is not None:
        raise failure


def written_first(path: Path | None, result: Mapping[str, Any]) -> AbstractContextManager[None]:
    """``done_first`` of ``write_json``."""
    return done_first(lambda: write_json(path, result))


def check_file_target(option: str, path: Path) -> None:
    """Refuses a file that cannot be written before the work, not after it.

    Raises:
        CliError: no folder can be there, a directory in the way, or a folder that takes no file.
    """
    try:
        check_output(path)
    except OSError as error:
        raise CliError(f"{option} {path}: {error.strerror}") from None


def check_json_target(path: Path | None) -> None:
    """As ``check_file_target``, for an optional --json."""
    if path is not None:
        check_file_target("--json", path)


def tell_note(note: str) -> None:
    """Prints what the user should know, if there is anything."""
    if note:
        console.print(note, markup=False, highlight=False)


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
