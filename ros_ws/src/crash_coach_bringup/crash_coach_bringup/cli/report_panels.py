"""A figure of the report as a grid of panels, with one legend above them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

COLUMNS = 4
LEGEND_LINE = 0.2  # inches


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


def legend_above(figure: Figure, handles: Sequence[Line2D], names: Sequence[str]) -> None:
    """In as many columns as the longest name allows; the figure grows by the legend's height."""
    columns = max(1, int(figure.get_figwidth() / (1.0 + 0.085 * max(map(len, names)))))
    figure.set_figheight(figure.get_figheight() + LEGEND_LINE * math.ceil(len(names) / columns))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
