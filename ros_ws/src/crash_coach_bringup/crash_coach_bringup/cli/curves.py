"""Learning curves from run directories: reading, grouping over seeds, averaging."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_bringup.cli.output import CliError
from policy_pkg.train.run_dir import METRICS, RUN, read_run, seedless_name

STEPS = "env_steps"
# Keys of metrics.jsonl that are drawn.
CURVES = ("success_rate", "success_crash_free", "return_mean", "alpha")
MAX_RANGE_SEEDS = 4
CONFIDENCE = 0.95
RESAMPLES = 2000
RANGE, BOOTSTRAP = "min..max", "95 % bootstrap interval of the mean"

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """One run directory.

    ``config``: without ``seed``. ``env_steps``: (B,) of its evaluation blocks, rising.
    ``values``: key -> (B,), NaN where the run did not measure it.
    """

    path: Path
    config: Mapping[str, Any]
    seed: int
    env_steps: Floats
    values: Mapping[str, Floats]

    @property
    def total_steps(self) -> int:
        return int(self.config["total_steps"])

    @property
    def last_step(self) -> int:
        return int(self.env_steps[-1])

    @property
    def finished(self) -> bool:
        return self.last_step >= self.total_steps


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but the seed, in the order of their seeds."""

    label: str
    runs: tuple[Run, ...]

    @property
    def band(self) -> str | None:
        """What the band of the group's curves is; None for a single run, which has none."""
        if len(self.runs) == 1:
            return None
        return RANGE if len(self.runs) <= MAX_RANGE_SEEDS else BOOTSTRAP

    @property
    def finished(self) -> bool:
        return all(run.finished for run in self.runs)


@dataclass(frozen=True)
class Curve:
    """Mean over the seeds of a group, (P,) each; ``low``, ``high`` None for a single run."""

    env_steps: Floats
    mean: Floats
    low: Floats | None = None
    high: Floats | None = None


def load_run(path: Path) -> Run:
    """Reads ``run.json`` and ``metrics.jsonl``.

    Raises:
        UserError: there is no run, or what it holds is damaged; names the file and the line.
    """
    config = read_run(path).get("config")
    if not isinstance(config, dict):
        raise CliError(f'{path / RUN}: "config" is missing')
    for key, least in (("seed", 0), ("total_steps", 1)):
        value = config.get(key)
        if not isinstance(value, int) or value < least:
            raise CliError(f"{path / RUN}: config.{key} is {value!r}, not a number from {least} on")
    rows = _read_metrics(path / METRICS)
    return Run(
        path,
        {key: value for key, value in config.items() if key != "seed"},
        config["seed"],
        np.array([row[STEPS] for row in rows]),
        {key: np.array([row[key] for row in rows]) for key in CURVES},
    )


def _read_metrics(path: Path) -> list[dict[str, float]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise CliError(f"{path} is missing: the run has not begun") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CliError(f"{path} cannot be read: {error}") from error
    if not lines:
        raise CliError(f"{path} is empty: the run has not finished its first evaluation block")
    rows: list[dict[str, float]] = []
    for number, line in enumerate(lines, start=1):
        row = _read_line(line, f"{path}:{number}")
        if rows and row[STEPS] <= rows[-1][STEPS]:
            raise CliError(
                f"{path}:{number}: damaged line: {STEPS} {row[STEPS]:.0f} does not exceed "
                f"{rows[-1][STEPS]:.0f} of the line before"
            )
        rows.append(row)
    return rows


def _read_line(line: str, place: str) -> dict[str, float]:
    """The drawn figures of a line; null becomes NaN, except for the steps."""
    try:
        content = json.loads(line)
    except json.JSONDecodeError as error:
        raise CliError(f"{place}: damaged line: {error.msg} at column {error.colno}") from None
    if not isinstance(content, dict):
        raise CliError(f"{place}: damaged line: expected an object with {STEPS} and other figures")
    row = {}
    for key in (STEPS, *CURVES):
        if key not in content:
            raise CliError(f"{place}: damaged line: {key} is missing")
        value = content[key]
        if value is None and key != STEPS:
            row[key] = math.nan
        elif isinstance(value, int | float) and type(value) is not bool and math.isfinite(value):
            row[key] = float(value)
        else:
            raise CliError(f"{place}: damaged line: {key} is {value!r}, not a finite number")
    return row


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Runs of the same config but for the seed become one group; groups in order of appearance.

    Raises:
        CliError: two runs have the same config and seed: together they would pass for two seeds.
    """
    groups: dict[str, list[Run]] = {}
    for run in runs:
        members = groups.setdefault(json.dumps(run.config, sort_keys=True), [])
        for other in members:
            if other.seed == run.seed:
                raise CliError(
                    f"{other.path} and {run.path} have the same config and seed {run.seed}: "
                    "give one of them"
                )
        members.append(run)
    ordered = [tuple(sorted(members, key=lambda run: run.seed)) for members in groups.values()]
    return [Group(label, members) for label, members in zip(_labels(ordered), ordered, strict=True)]


def _labels(groups: Sequence[Sequence[Run]]) -> list[str]:
    """Folder names without -s<seed>; with the folder above, or in full, where two were the same."""

    def name(run: Run) -> str:
        return seedless_name(run.path)

    def above(run: Run) -> str:
        return f"{run.path.resolve().parent.name}/{name(run)}"

    for label in (name, above):
        labels = [", ".join(dict.fromkeys(label(run) for run in group)) for group in groups]
        if len(set(labels)) == len(labels):
            return labels
    return [", ".join(str(run.path) for run in group) for group in groups]


def average(group: Group, key: str) -> Curve | None:
    """The group's curve of ``key``; None where one of its runs did not measure it.

    Where the runs' steps differ, they are interpolated at the steps of the run that ends first,
    as far as all runs reach.

    Raises:
        CliError: the runs share no range of steps.
    """
    series = []
    for run in group.runs:
        there = ~np.isnan(run.values[key])
        if not there.any():
            return None
        series.append((run.env_steps[there], run.values[key][there]))
    begin = max(steps[0] for steps, _ in series)
    grid = min((steps for steps, _ in series), key=lambda steps: float(steps[-1]))
    grid = grid[grid >= begin]
    if not grid.size:
        raise CliError(f"the runs of {group.label} share no range of {STEPS} with {key}")
    rows = np.stack([np.interp(grid, steps, values) for steps, values in series])
    if group.band is None:
        return Curve(grid, rows[0])
    if group.band == RANGE:
        return Curve(grid, rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0))
    return Curve(grid, rows.mean(axis=0), *bootstrap_mean(rows))


def bootstrap_mean(rows: Floats) -> tuple[Floats, Floats]:
    """Percentile bootstrap interval of the mean over seeds (Efron 1979), at every step.

    The same resamples serve all steps; they are drawn with a fixed seed.

    Args:
        rows: (seeds, P).

    Returns:
        Lower and upper bounds, (P,) each.
    """
    seeds = len(rows)
    draws = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds))
    weights = (draws[:, :, None] == np.arange(seeds)).sum(axis=1) / seeds
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(weights @ rows, [tail, 1 - tail], axis=0)
    return low, high
