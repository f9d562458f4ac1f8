"""The report's rows for other tools: CSV with a line per row, LaTeX with the methods' table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

from crash_coach_bringup.cli.report.page import overview
from policy_pkg.report.rows import Row
from policy_pkg.statistics import Estimate

COLUMNS = (
    *("map", "condition", "method", "seeds", "success", "std", "low", "high"),
    *("iqm", "iqm_low", "iqm_high", "return", "success_of_seeds"),
)
_SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


def as_csv(rows: Sequence[Row]) -> str:
    """Rates from 0 to 1; empty where there is no such figure; seeds separated by blanks."""
    out = io.StringIO()
    lines = csv.writer(out, lineterminator="\n")
    lines.writerow(COLUMNS)
    for row in rows:
        returns = sum(row.returns) / len(row.returns) if row.returns else ""
        seeds = " ".join(map(str, row.seeds))
        lines.writerow(
            [
                *(row.scenario, row.condition, row.method, seeds, row.mean),
                "" if row.std is None else row.std,
                *_bounds(row.interval)[1:],
                *_bounds(row.iqm),
                returns,
                " ".join(map(str, row.success)),
            ]
        )
    return out.getvalue()


def _bounds(estimate: Estimate | None) -> list[float | str]:
    """Value, low, high."""
    return [""] * 3 if estimate is None else [estimate.value, estimate.low, estimate.high]


def as_latex(rows: Sequence[Row]) -> str:
    """A tabular per map, for the package booktabs: methods down, conditions across, in %."""
    out = []
    for name, columns, lines in overview(rows):
        body = [_line(["method", *columns]), r"\midrule", *(_line(cells) for cells in lines)]
        out.append(
            "\n".join(
                [
                    f"% {name}: success in %, mean and sample standard deviation over seeds",
                    rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
                    *(r"\toprule", *body, r"\bottomrule"),
                    r"\end{tabular}",
                ]
            )
        )
    return "\n\n".join(out) + "\n"


def _line(cells: Sequence[str]) -> str:
    return " & ".join(map(_cell, cells)) + r" \\"


def _cell(text: str) -> str:
    """Markdown's bold as LaTeX's; what is special in LaTeX, as it looks."""
    bold = re.fullmatch(r"\*\*(.*)\*\*", text)
    if bold:
        return rf"\textbf{{{_cell(bold[1])}}}"
    escaped = "".join(_SPECIAL.get(c, rf"\{c}" if c in "&%$#_{}" else c) for c in text)
    return escaped.replace("±", r"$\pm$").replace("–", "--").replace("−", "$-$")
