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
from matplotlib.legend_handler import HandlerPatch
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

PANEL_INCHES = 4.2
ROBOT_RADIUS = 0.36  # of a cell
_SPREAD = 0.18  # of a cell: how far the tracks of two methods lie apart
_BUTTON_COLOURS = ("#f4c95d", "#8ecae6", "#cdb4db", "#b7e4c7")
_INK = "#333333"
_DOTTED = (0, (1.0, 1.2))


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

    ``grid``: draw the lines between cells. ``cell_m``: side of a cell, and of a drawn site.
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
    figure.legend(
        handles=handles, loc="lower center", ncols=len(handles), frameon=False,
        handler_map={Circle: HandlerPatch(patch_func=_round_key)},
    )  # fmt: skip
    figure.subplots_adjust(left=0.02, right=0.98, top=0.92, bottom=0.11, wspace=0.05)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        FigureCanvasAgg(figure)
        figure.savefig(temporary, format="png")
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
    ax.plot(path_m[:, 0], path_m[:, 1], color=colour, linewidth=1.6, zorder=5)
    ax.plot(*path_m[-1], marker="o", markersize=4.5, color=colour, zorder=6)
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 0, "mutation_scale": 12}
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
        ax.add_patch(_ring((start[0], start[1]), radius, robot in crashed))
        ax.annotate(
            str(robot + 1), start, xytext=(0, 0), textcoords="offset points", ha="center",
            va="center", fontsize=8, color=_INK, zorder=8,
        )  # fmt: skip


def _legend(panels: Sequence[TrajectoryPanel]) -> list[Any]:
    """One line per method, and what circles and coloured cells mean."""
    handles: list[Any] = []
    labels: set[str] = set()
    for track in (t for panel in panels for t in panel.tracks):
        if track.label not in labels:
            labels.add(track.label)
            handles.append(Line2D([], [], color=track.colour, linewidth=2, label=track.label))
    handles.append(_ring((0, 0), 1.0, crashed=False, label="robot"))
    if any(track.crashed for panel in panels for track in panel.tracks):
        handles.append(_ring((0, 0), 1.0, crashed=True, label="crashed robot"))
    handles.append(Rectangle((0, 0), 1, 1, facecolor=_BUTTON_COLOURS[0], label="button"))
    return handles


def _ring(centre: tuple[float, float], radius: float, crashed: bool, label: str = "") -> Circle:
    """A robot's outline."""
    style = _DOTTED if crashed else "-"
    return Circle(
        centre, radius, facecolor="white", edgecolor=_INK, linewidth=1.8, linestyle=style,
        zorder=7, label=label,
    )  # fmt: skip


def _round_key(
    legend: Any, orig_handle: Circle, xdescent: float, ydescent: float, width: float,
    height: float, fontsize: float,
) -> Circle:  # fmt: skip
    """A circle for the legend, where patches are rectangles by default."""
    return Circle(((width - xdescent) / 2, (height - ydescent) / 2), 0.75 * height)
