"""Pictures of trajectories, like the paper's grid-world figure. Needs no display."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

PANEL_INCHES = 4.2
ROBOT_RADIUS = 0.36  # of a cell
_SPREAD = 0.13  # of a cell: how far the tracks of two methods lie apart
_BUTTON_COLOURS = ("#f4c95d", "#8ecae6", "#cdb4db", "#b7e4c7")
_INK = "#333333"


@dataclass(frozen=True)
class Track:
    """One episode of one method.

    ``positions_m``: (T+1, n, 2) x, y of each robot, from the start on. ``crashed``: indexes of
    the robots that did not follow their policy.
    """

    label: str
    colour: str
    positions_m: npt.NDArray[np.floating[Any]]
    crashed: tuple[int, ...] = ()


@dataclass(frozen=True)
class TrajectoryPanel:
    """One drawing: an arena of ``arena_size_m`` (width, height) with sites and tracks.

    ``grid``: draw cells of 1/10 of the width (the grid-world), with the sites as full cells.
    ``cell_m`` overrides the side of a cell.
    """

    title: str
    arena_size_m: tuple[float, float]
    sites_m: Sequence[tuple[float, float]]
    tracks: Sequence[Track]
    grid: bool = True
    cell_m: float = 1.0


def draw_trajectories(panels: Sequence[TrajectoryPanel], path: Path) -> None:
    """Writes the panels side by side as a PNG; the file is complete or not there.

    Raises:
        ValueError: no panel, or positions of another shape than (T+1, n, 2).
        OSError: the file cannot be written.
    """
    if not panels:
        raise ValueError("there is nothing to draw: no panel was given")
    for panel in panels:
        for track in panel.tracks:
            if track.positions_m.ndim != 3 or track.positions_m.shape[2] != 2:
                raise ValueError(
                    f"track {track.label!r} of panel {panel.title!r} has positions of shape "
                    f"{track.positions_m.shape}; expected (T+1, n, 2)"
                )
    figure = Figure(figsize=(PANEL_INCHES * len(panels), PANEL_INCHES + 0.75), dpi=160)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, panel in zip(axes, panels, strict=True):
        _draw_panel(ax, panel)
    handles = _legend(panels)
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False)
    figure.subplots_adjust(left=0.02, right=0.98, top=0.92, bottom=0.11, wspace=0.05)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        FigureCanvasAgg(figure).print_png(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _draw_panel(ax: Any, panel: TrajectoryPanel) -> None:
    width, height = panel.arena_size_m
    cell = panel.cell_m
    ax.set_title(panel.title, fontsize=11, color=_INK)
    ax.set_xlim(-0.03 * width, 1.03 * width)
    ax.set_ylim(-0.03 * height, 1.03 * height)
    ax.set_aspect("equal")
    ax.axis("off")
    for i, (x, y) in enumerate(panel.sites_m):
        colour = _BUTTON_COLOURS[i % len(_BUTTON_COLOURS)]
        corner = (x - cell / 2, y - cell / 2)
        ax.add_patch(Rectangle(corner, cell, cell, facecolor=colour, edgecolor="none", zorder=1))
    if panel.grid:
        for x in np.arange(0.0, width + cell / 2, cell):
            ax.plot((x, x), (0, height), color="#cccccc", linewidth=0.6, zorder=2)
        for y in np.arange(0.0, height + cell / 2, cell):
            ax.plot((0, width), (y, y), color="#cccccc", linewidth=0.6, zorder=2)
    outline = Rectangle((0, 0), width, height, fill=False, edgecolor=_INK, linewidth=1.4, zorder=3)
    ax.add_patch(outline)
    for k, track in enumerate(panel.tracks):
        shift = (k - (len(panel.tracks) - 1) / 2) * _SPREAD * cell
        for robot in range(track.positions_m.shape[1]):
            _draw_path(ax, track.positions_m[:, robot] + shift, track.colour, cell)
    _draw_robots(ax, panel)


def _draw_path(ax: Any, path_m: npt.NDArray[np.floating[Any]], colour: str, cell_m: float) -> None:
    """The way of one robot: an arrow in the middle of every move, a dot where it ends."""
    moves = np.diff(path_m, axis=0)
    moving = np.linalg.norm(moves, axis=1) > 0.05 * cell_m
    if not moving.any():
        return
    ax.plot(path_m[:, 0], path_m[:, 1], color=colour, linewidth=1.6, zorder=5, alpha=0.9)
    ax.plot(*path_m[-1], marker="o", markersize=4.5, color=colour, zorder=6)
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 0, "mutation_scale": 11}
    for start, move in zip(path_m[:-1][moving], moves[moving], strict=True):
        ax.annotate(
            "", xy=start + 0.68 * move, xytext=start + 0.3 * move, arrowprops=style, zorder=6
        )


def _draw_robots(ax: Any, panel: TrajectoryPanel) -> None:
    """Circles at the starts; dotted where a track of this panel says crashed."""
    if not panel.tracks:
        return
    crashed = {robot for track in panel.tracks for robot in track.crashed}
    radius = ROBOT_RADIUS * panel.cell_m
    for robot, start in enumerate(panel.tracks[0].positions_m[0]):
        style = (0, (1, 1.2)) if robot in crashed else "-"
        ax.add_patch(
            Circle(
                tuple(start), radius, facecolor="white", edgecolor=_INK, linewidth=1.8,
                linestyle=style, zorder=4,
            )
        )  # fmt: skip
        ax.annotate(
            str(robot + 1), start, xytext=(0, 0), textcoords="offset points", ha="center",
            va="center", fontsize=8, color=_INK, zorder=7,
        )  # fmt: skip


def _legend(panels: Sequence[TrajectoryPanel]) -> list[Any]:
    handles: list[Any] = []
    labels: set[str] = set()
    for track in (t for panel in panels for t in panel.tracks):
        if track.label not in labels:
            labels.add(track.label)
            handles.append(Line2D([], [], color=track.colour, linewidth=2, label=track.label))
    ring = {"marker": "o", "markersize": 9, "linestyle": "none", "markerfacecolor": "white"}
    handles.append(Line2D([], [], markeredgecolor=_INK, label="robot", **ring))
    if any(track.crashed for panel in panels for track in panel.tracks):
        handles.append(_crashed_handle())
    handles.append(
        Line2D([], [], marker="s", markersize=9, linestyle="none", color=_BUTTON_COLOURS[0],
               label="button")
    )  # fmt: skip
    return handles


def _crashed_handle() -> Any:
    """A dotted circle; markers cannot be dotted, so a ring of dots."""
    return Line2D([], [], marker=r"$\u25cc$", markersize=11, linestyle="none", color=_INK,
                  label="crashed robot")  # fmt: skip
