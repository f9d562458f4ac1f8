"""The command line in this process, without the second that it takes to start."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple
from unittest.mock import patch

from crash_coach_bringup.cli.main import main
from crash_coach_bringup.cli.output import console


class Done(NamedTuple):
    """As subprocess.CompletedProcess."""

    returncode: int
    stdout: str
    stderr: str


def typed(*arguments: str) -> Done:
    """What ``crash-coach`` would have done; a defect's exception is the test's."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    argv = patch.object(sys, "argv", ["crash-coach", *arguments])
    wide = patch.object(console, "_width", 160)  # whatever $COLUMNS was when it was made
    with argv, wide, redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def refused(*arguments: str) -> str:
    """The lines with which the command refuses."""
    done = typed(*arguments)
    assert done.returncode in (1, 2), done.stdout + done.stderr
    return done.stderr
