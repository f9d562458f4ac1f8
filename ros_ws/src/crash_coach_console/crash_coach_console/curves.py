"""A training run's figures as they grow, read from its metrics."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crash_coach_common.natural import natural
from policy_pkg.checkpoint import split_best
from policy_pkg.report.finished_runs import read_text
from policy_pkg.train.metrics import UNDER_CRASH
from policy_pkg.train.run_dir import METRICS

LOOK_S = 1.0
MOST_POINTS = 400
_STEPS = ("env_steps", "gradient_steps")  # of a training; of learning from recordings
_RATES = ("success_rate", "success_crash_free", "success_worst", "alpha")


class Curves:
    """Of the run in ``folder``; nothing where it is none. ``clock_s``: a steady clock."""

    def __init__(self, folder: Path, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._path = split_best(folder)[0] / METRICS
        self._clock_s = clock_s
        self._due_s = -math.inf
        self._seen = 0

    def pages(self) -> dict[str, dict[str, Any]]:
        """{"curves": {"steps": [...], "series": {name: [...]}}} where the file has grown."""
        now_s = self._clock_s()
        if now_s < self._due_s:
            return {}
        self._due_s = now_s + LOOK_S
        rows = read_rows(self._path)
        if len(rows) == self._seen:
            return {}
        self._seen = len(rows)
        return {"curves": curves_of(rows)}


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Its complete lines; the last one may still be being written.

    Raises:
        RunError: a damaged file.
    """
    found = read_text(path)
    rows = []
    for line in found[1].splitlines(keepends=True) if found else []:
        if line.endswith("\n"):
            try:
                rows.append(json.loads(line))
            except json.JSONDecodeError:
                continue  # the reports name damaged lines; a look at what grows goes on
    return [row for row in rows if isinstance(row, dict)]


def curves_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """JSON values: the blocks' steps and, thinned to MOST_POINTS, what lies between 0 and 1."""
    key = next((name for name in _STEPS if rows and name in rows[0]), _STEPS[0])
    rows = [row for row in rows if isinstance(row.get(key), int | float)]
    every = max(1, math.ceil(len(rows) / MOST_POINTS))
    kept = rows[::-1][::every][::-1]
    by_victim = {n for row in kept for n in row if UNDER_CRASH.fullmatch(n)}
    names = (*_RATES, *sorted(by_victim, key=natural))
    series = {name: [_number(row.get(name)) for row in kept] for name in names}
    return {
        "unit": key,
        "steps": [row[key] for row in kept],
        "series": {n: v for n, v in series.items() if any(x is not None for x in v)},
    }


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return round(float(value), 4)
