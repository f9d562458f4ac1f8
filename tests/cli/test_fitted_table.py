"""Tables on terminals of any width: no figure is ever cut."""

from __future__ import annotations

import io
import re

import pytest

from crash_coach_bringup.cli.fitted_table import FILE_COLUMNS, FittedConsole
from crash_coach_bringup.cli.output import table

FIGURES = ("81.2 % (64.7..91.1)", "+34.4 (+10.9..+53.1)", "19.16 ± 1.78", "1,200,000")
NAMES = ("crash-free", "robot_12 random", "rate 0.1, re-weighted")


def printed(columns: int | None) -> list[str]:
    """The lines of a table of FIGURES on a terminal of that width; None: through a pipe."""
    rows = table("32 episodes each", ["condition", "success (95 %)", "cost", "return", "steps"])
    for name in NAMES:
        rows.add_row(name, *FIGURES)
    out = io.StringIO()
    FittedConsole(file=out, width=columns, force_terminal=columns is not None).print(rows)
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).splitlines()


@pytest.mark.parametrize("columns", [30, 40, 60, 80, 100, 120, None])
def test_no_figure_is_cut(columns: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    lines = printed(columns)
    text = " ".join(lines)
    assert "…" not in text
    for figure in FIGURES:
        for word in figure.split():
            assert text.count(word) >= len(NAMES)
    assert max(map(len, lines)) <= (columns or FILE_COLUMNS)
    is_table = any(line.startswith("┏") for line in lines)
    assert is_table == (columns is None or columns >= 80)
    if not is_table:
        assert lines.count("  steps: 1,200,000") == len(NAMES)
    if columns is None:  # every row is one line
        assert sum(all(figure in line for figure in FIGURES) for line in lines) == len(NAMES)
