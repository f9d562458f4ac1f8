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
from policy_pkg.report.finished_runs import KEPT_BESIDE, read_text, todays_config
from policy_pkg.report.training import LAST_BLOCKS
from policy_pkg.train.metrics import crashed_robot
from policy_pkg.train.run_dir import METRICS, RUN, read_run, seedless_name

MAX_RANGE_SEEDS = 4
CONFIDENCE = 0.95
RESAMPLES = 2000
EACH_CRASHED = "success_each_crashed"  # mean over the robots, each crashed alone in its episodes
RANGE, BOOTSTRAP = "min..max", "95 % bootstrap interval of the mean"

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Kind:
    """A kind of run: what its metrics count (``steps``), how long it is (a key of its config), and
    which of its figures are drawn; ``optional``: those that not every run has."""

    name: str
    steps: str
    length: str
    curves: tuple[str, ...]
    optional: frozenset[str] = frozenset()


TRAINING = Kind(
    "training in the simulator",
    "env_steps",
    "total_steps",
    ("success_rate", "success_crash_free", "return_mean", "alpha", EACH_CRASHED),
    frozenset({EACH_CRASHED}),
)
OFFLINE = Kind(
    "training on recordings",
    "gradient_steps",
    "gradient_steps",
    ("success_crash_free", "success_1_crashed", "return_crash_free", "loss"),
    frozenset({"success_1_crashed"}),
)


@dataclass(frozen=True)
class Run:
    """One run directory.

    ``config``: without ``seed``. ``steps``: (B,) of its evaluation blocks, rising.
    ``values``: key -> (B,), NaN where the run did not measure it.
    ``data``: SHA-256 of the recordings of a run on such; else "".
    """

    path: Path
    kind: Kind
    config: Mapping[str, Any]
    data: str
    seed: int
    steps: Floats
    values: Mapping[str, Floats]

    @property
    def total_steps(self) -> int:
        return int(self.config[self.kind.length])

    @property
    def last_step(self) -> int:
        return int(self.steps[-1])

    @property
    def finished(self) -> bool:
        return self.last_step >= self.total_steps


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but the seed (the recordings, too, are the same), by seed."""

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

    steps: Floats
    mean: Floats
    low: Floats | None = None
    high: Floats | None = None


def load_run(path: Path) -> Run:
    """Reads ``run.json`` and ``metrics.jsonl``, or the compressed one of a collected run.

    Raises:
        UserError: there is no run, or what it holds is damaged; names the file and the line.
    """
    described = read_run(path)
    config, data = described.get("config"), described.get("data")
    if not isinstance(config, dict):
        raise CliError(f'{path / RUN}: "config" is missing')
    kind = TRAINING if data is None else OFFLINE
    if data is not None and not (isinstance(data, dict) and isinstance(data.get("sha256"), str)):
        raise CliError(f'{path / RUN}: "data" does not name its recordings')
    for key, least in (("seed", 0), (kind.length, 1)):
        value = config.get(key)
        if not isinstance(value, int) or value < least:
            raise CliError(f"{path / RUN}: config.{key} is {value!r}, not a number from {least} on")
    rows = _read_metrics(path / METRICS, kind)
    keys = [*kind.curves, *filter(crashed_robot, rows[-1])]
    return Run(
        path,
        kind,
        {
            key: value
            for key, value in todays_config(path, config).items()
            if key not in {"seed", *KEPT_BESIDE}
        },
        "" if data is None else data["sha256"],
        config["seed"],
        np.array([row[kind.steps] for row in rows]),
        {key: np.array([row.get(key, math.nan) for row in rows]) for key in keys},
    )


def _read_metrics(path: Path, kind: Kind) -> list[dict[str, float]]:
    found = read_text(path)
    if found is None:
        raise CliError(f"{path} is missing: the run has not begun")
    path, text = found
    lines = text.splitlines()
    if not lines:
        raise CliError(f"{path} is empty: the run has not finished its first evaluation block")
    rows: list[dict[str, float]] = []
    for number, line in enumerate(lines, start=1):
        row = _read_line(line, f"{path}:{number}", kind)
        if rows and row[kind.steps] <= rows[-1][kind.steps]:
            raise CliError(
                f"{path}:{number}: damaged line: {kind.steps} {row[kind.steps]:.0f} does not "
                f"exceed {rows[-1][kind.steps]:.0f} of the line before"
            )
        rows.append(row)
    return rows


def _read_line(line: str, place: str, kind: Kind) -> dict[str, float]:
    """The drawn figures of a line, and those of each robot crashed alone; null becomes NaN, except
    for the steps."""
    try:
        content = json.loads(line)
    except json.JSONDecodeError as error:
        raise CliError(f"{place}: damaged line: {error.msg} at column {error.colno}") from None
    if not isinstance(content, dict):
        raise CliError(
            f"{place}: damaged line: expected an object with {kind.steps} and other figures"
        )
    row = _each_robot_crashed(content)
    content[EACH_CRASHED] = sum(row.values()) / len(row) if row else None
    for key in (kind.steps, *kind.curves):
        if key not in content and key not in kind.optional:
            raise CliError(f"{place}: damaged line: {key} is missing")
        value = content.get(key)
        if value is None and key != kind.steps:
            row[key] = math.nan
        elif isinstance(value, int | float) and type(value) is not bool and math.isfinite(value):
            row[key] = float(value)
        else:
            raise CliError(f"{place}: damaged line: {key} is {value!r}, not a finite number")
    return row


def _each_robot_crashed(content: Mapping[str, Any]) -> dict[str, float]:
    """Empty where the run's blocks do not crash each robot alone."""
    return {
        key: float(value)
        for key, value in content.items()
        if crashed_robot(key) and isinstance(value, int | float)
    }


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Runs of the same config but for the seed and what is kept beside, and of the same recordings
    where they have any, become one group; groups in order of appearance.

    Raises:
        CliError: two runs have the same config and seed: together they would pass for two seeds;
            or there are runs of two kinds.
    """
    groups: dict[str, list[Run]] = {}
    for run in runs:
        if run.kind != runs[0].kind:
            raise CliError(
                f"{runs[0].path} is {runs[0].kind.name}, {run.path} is {run.kind.name}: "
                "they count other steps; draw them in two figures"
            )
        members = groups.setdefault(json.dumps([run.config, run.data], sort_keys=True), [])
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
        series.append((run.steps[there], run.values[key][there]))
    begin = max(steps[0] for steps, _ in series)
    grid = min((steps for steps, _ in series), key=lambda steps: float(steps[-1]))
    grid = grid[grid >= begin]
    if not grid.size:
        raise CliError(f"the runs of {group.label} share no range of steps with {key}")
    rows = np.stack([np.interp(grid, steps, values) for steps, values in series])
    if group.band is None:
        return Curve(grid, rows[0])
    if group.band == RANGE:
        return Curve(grid, rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0))
    return Curve(grid, rows.mean(axis=0), *bootstrap_mean(rows))


def last_blocks(group: Group, key: str) -> list[float] | None:
    """Of each run the mean over its last LAST_BLOCKS blocks; None where one has fewer with it."""
    rates = [_last_blocks(run, key) for run in group.runs]
    return None if None in rates else [rate for rate in rates if rate is not None]


def _last_blocks(run: Run, key: str) -> float | None:
    measured = run.values[key][~np.isnan(run.values[key])]
    return None if len(measured) < LAST_BLOCKS else float(np.mean(measured[-LAST_BLOCKS:]))


def worst_victim(group: Group) -> list[float] | None:
    """As ``last_blocks``, of the robot whose crash alone costs each run most; None where runs do
    not crash each robot alone."""
    worst = []
    for run in group.runs:
        robots = [key for key in run.values if crashed_robot(key) and key != EACH_CRASHED]
        rates = [rate for key in robots if (rate := _last_blocks(run, key)) is not None]
        if not rates:
            return None
        worst.append(min(rates))
    return worst


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
