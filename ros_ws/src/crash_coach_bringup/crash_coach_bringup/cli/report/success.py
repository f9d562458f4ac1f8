"""The report's dots: success of every method and seed, a panel per map, a colour per condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from crash_coach_bringup.cli.figure_style import COLOURS, INK
from crash_coach_bringup.cli.report.panels import legend_above, panels
from policy_pkg.report.finished_runs import Run
from policy_pkg.report.rows import Row
from policy_pkg.train.run_dir import read_run

APART = 0.16  # between the conditions of a method
DATA = "in the recordings"

MapMethod = tuple[str, str]


def in_recordings(runs: Sequence[Run]) -> dict[MapMethod, float]:
    """Success rate of the recorded episodes that runs on recordings learned from."""
    found = {}
    for run in runs:
        data = read_run(run.path).get("data")
        if data is not None:
            found[run.scenario, run.method] = float(data["success_rate"])
    return found


def success(rows: Sequence[Row], recorded: Mapping[MapMethod, float]) -> Figure:
    """Large: a method's mean; small: its seeds; bar: the row's 95 % interval."""
    maps = list(dict.fromkeys(row.scenario for row in rows))
    conditions = list(dict.fromkeys(row.condition for row in rows))
    most = max(len({r.method for r in rows if r.scenario == name}) for name in maps)
    figure, axes = panels(len(maps), width=5.0, height=1.0 + 0.42 * most)
    for ax, name in zip(axes, maps, strict=True):
        _draw_map(ax, [row for row in rows if row.scenario == name], conditions, recorded)
        ax.set_title(name, fontsize=11, color=INK)
    handles = [
        Line2D([], [], color=COLOURS[i % len(COLOURS)], marker="o", linestyle="", label=condition)
        for i, condition in enumerate(conditions)
    ]
    if recorded:
        handles.append(
            Line2D([], [], color=INK, marker="|", markersize=14, linestyle="", label=DATA)
        )
    legend_above(figure, handles)
    text = "success rate; large: mean of the seeds, small: each seed; bar: 95 % interval"
    figure.supxlabel(text, fontsize=8, color=INK)
    return figure


def _draw_map(
    ax: Any, rows: Sequence[Row], conditions: Sequence[str], recorded: Mapping[MapMethod, float]
) -> None:
    methods = list(dict.fromkeys(row.method for row in rows))
    for row in rows:
        index = conditions.index(row.condition)
        colour, middle = COLOURS[index % len(COLOURS)], methods.index(row.method)
        place = middle + (index - (len(conditions) - 1) / 2) * APART
        ax.plot(row.success, [place] * len(row.success), "o", color=colour, markersize=3, alpha=0.5)
        interval = row.interval
        if interval is not None:
            ends = [interval.low, interval.high]
            ax.plot(ends, [place] * 2, "-", color=colour, linewidth=1, alpha=0.7)
        ax.plot(row.mean, place, "o", color=colour, markersize=6.5, zorder=3)
    for middle, method in enumerate(methods):
        if (rate := recorded.get((rows[0].scenario, method))) is not None:
            ax.plot(rate, middle, "|", color=INK, markersize=16, zorder=2)
    ax.set_xlim(-0.03, 1.03)
    ax.set_ylim(len(methods) - 0.5, -0.5)
    ax.set_yticks(range(len(methods)))
    ax.set_yticklabels(methods, fontsize=8)
