"""The report's learning curves: success without crashes, a panel per map, a colour per method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from crash_coach_bringup.cli.figure_style import INK, STEPS, style
from crash_coach_bringup.cli.report.panels import legend_above, panels
from policy_pkg.report.finished_runs import Run, read_lines
from policy_pkg.train.run_dir import METRICS

SUCCESS = "success_crash_free"
BLOCKS = 10  # of the running mean

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """A run's greedy evaluation blocks without crashes: (B,) steps and success rates."""

    run: Run
    axis: str
    steps: Floats
    success: Floats


def read_curve(run: Run) -> Curve | None:
    """None for a run that kept no such blocks, or fewer than two.

    Raises:
        RunError: damaged metrics.
    """
    lines = [line for line in read_lines(run.path / METRICS) if line.get(SUCCESS) is not None]
    # Runs from recordings have no environment steps.
    axis = next((key for key in STEPS if all(key in line for line in lines)), None)
    if axis is None or len(lines) < 2:
        return None
    steps = np.array([line[axis] for line in lines], dtype=np.float64)
    return Curve(run, axis, steps, np.array([line[SUCCESS] for line in lines], dtype=np.float64))


def running_mean(values: Floats, blocks: int = BLOCKS) -> Floats:
    """(B,) mean of each value and up to ``blocks - 1`` before it."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - blocks)
    means: Floats = (sums[ends] - sums[starts]) / (ends - starts)
    return means


def mean_curve(curves: Sequence[Curve]) -> tuple[Floats, Floats]:
    """Mean over runs, at the steps of the one that ends first, as far as all reach."""
    grid = min((curve.steps for curve in curves), key=lambda steps: float(steps[-1]))
    rows = [np.interp(grid, curve.steps, running_mean(curve.success)) for curve in curves]
    return grid, np.mean(rows, axis=0)


def learning_curves(runs: Sequence[Run], methods: Sequence[str]) -> Figure | None:
    """Thin lines are seeds, a thick one is their mean; None where no run kept its blocks.

    Args:
        methods: all there are, in the order of their colours.
    """
    curves = [curve for run in runs if (curve := read_curve(run)) is not None]
    if not curves:
        return None
    maps = list(dict.fromkeys(curve.run.scenario for curve in curves))
    figure, axes = panels(len(maps), width=3.6, height=3.0)
    for ax, name in zip(axes, maps, strict=True):
        mine = [curve for curve in curves if curve.run.scenario == name]
        for index, method in enumerate(methods):
            _draw_method(ax, [curve for curve in mine if curve.run.method == method], index)
        ax.set_title(name, fontsize=11, color=INK)
        ax.set_ylim(-0.03, 1.03)
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.set_xlabel(" or ".join(dict.fromkeys(STEPS[curve.axis] for curve in mine)), color=INK)
        ax.set_ylabel("success rate without crashes", color=INK)
    handles = [
        Line2D([], [], color=style(i)[0], linestyle=style(i)[1], label=name)
        for i, name in enumerate(methods)
    ]
    legend_above(figure, handles)
    text = f"running mean of {BLOCKS} evaluation blocks; thin: seeds, thick: their mean"
    figure.supxlabel(f"{text}, as far as all reach", fontsize=8, color=INK)
    return figure


def _draw_method(ax: Any, curves: Sequence[Curve], index: int) -> None:
    colour, dash = style(index)
    for curve in curves:
        width, alpha = (1.6, 1.0) if len(curves) == 1 else (0.8, 0.45)
        smooth = running_mean(curve.success)
        ax.plot(curve.steps, smooth, dash, color=colour, linewidth=width, alpha=alpha)
    if len(curves) > 1:
        ax.plot(*mean_curve(curves), dash, color=colour, linewidth=1.8, zorder=3)
