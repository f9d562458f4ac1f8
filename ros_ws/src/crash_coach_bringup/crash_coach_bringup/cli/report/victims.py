"""The report's victims: success with each robot alone crashed, who hurts most at the top."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from crash_coach_bringup.cli.figure_style import INK, mark, style
from crash_coach_bringup.cli.report.panels import legend_above, panels
from policy_pkg.report.rows import ALL_MAPS, Row
from policy_pkg.report.victims import Cost

BETWEEN = 0.7  # of a victim's line, shared by the methods


def victims(rows: Sequence[Row], costs: Sequence[Cost], methods: Sequence[str]) -> Figure:
    """A panel per map, a line per victim; bars lead to each method's crash-free success.

    Args:
        rows: those of each victim and the crash-free ones, among others.
        costs: in the victims' order.
        methods: all there are, in the order of their colours.
    """
    maps = list(dict.fromkeys(cost.scenario for cost in costs))
    of_map = {
        name: list(dict.fromkeys(cost.victim for cost in costs if cost.scenario == name))
        for name in maps
    }
    lines = max(map(len, of_map.values()))
    height = 1.0 + lines * max(0.3, 0.13 * len(methods))
    figure, axes = panels(len(maps), width=4.4, height=height)
    for ax, name in zip(axes, maps, strict=True):
        here = [row for row in rows if row.scenario == name != ALL_MAPS]
        _draw_map(ax, here, of_map[name], methods)
        ax.set_title(name, fontsize=11, color=INK)
    handles = [
        Line2D([], [], color=style(i)[0], marker=mark(i), linestyle="", label=name)
        for i, name in enumerate(methods)
    ]
    handles.append(Line2D([], [], color=INK, marker="|", linestyle="", label="crash-free"))
    legend_above(figure, handles)
    text = "success rate with this robot alone crashed; large: mean of the seeds, small: each seed"
    figure.supxlabel(text, fontsize=8, color=INK)
    return figure


def _draw_map(ax: Any, rows: Sequence[Row], victims: Sequence[str], methods: Sequence[str]) -> None:
    free = {row.method: row.mean for row in rows if row.crashed == 0}
    for row in rows:
        if row.victim not in victims:
            continue
        index = methods.index(row.method)
        colour, _ = style(index)
        apart = (index - (len(methods) - 1) / 2) / max(1, len(methods))
        place = victims.index(row.victim) + BETWEEN * apart
        ends = [row.mean, free[row.method]]
        ax.plot(ends, [place] * 2, "-", color=colour, linewidth=1, alpha=0.6)
        ax.plot(ends[1:], [place], "|", color=colour, markersize=8)
        if len(row.seeds) > 1:
            places = [place] * len(row.success)
            ax.plot(row.success, places, mark(index), color=colour, markersize=3, alpha=0.5)
        ax.plot(row.mean, place, mark(index), color=colour, markersize=6, zorder=3)
    ax.set_xlim(-0.03, 1.03)
    ax.set_ylim(len(victims) - 0.5, -0.5)
    ax.set_yticks(range(len(victims)))
    ax.set_yticklabels(victims, fontsize=8)
