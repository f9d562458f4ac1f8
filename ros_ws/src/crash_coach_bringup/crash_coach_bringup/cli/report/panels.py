"""A figure of the report as a grid of panels, with one legend above them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

COLUMNS = 4


def panels(count: int, width: float, height: float) -> tuple[Figure, list[Any]]:
    """A figure and its ``count`` axes, ``COLUMNS`` in a line; width and height of one in inches."""
    columns = min(count, COLUMNS)
    lines = math.ceil(count / columns)
    size = (max(5.0, width * columns), height * lines + 0.5)
    figure = Figure(figsize=size, dpi=160, layout="constrained")
    axes = list(figure.subplots(lines, columns, squeeze=False).flat)
    for ax in axes[count:]:
        ax.remove()
    for ax in axes[:count]:
        ax.grid(color="#dddddd", linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes[:count]


def legend_above(figure: Figure, handles: Sequence[Line2D]) -> None:
    """In as few lines as fit; the figure grows by the legend's height."""
    for lines in range(1, len(handles) + 1):
        legend = figure.legend(
            handles=handles,
            loc="outside upper center",
            ncols=math.ceil(len(handles) / lines),
            frameon=False,
            fontsize=8,
        )
        box = legend.get_window_extent()
        if lines == len(handles) or box.width <= figure.bbox.width:
            break
        legend.remove()
    figure.set_figheight(figure.get_figheight() + box.height / figure.dpi)
