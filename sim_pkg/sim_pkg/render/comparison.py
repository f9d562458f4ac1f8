"""A picture that compares teams, like the paper's grid-world figure. Needs no display."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerPatch
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from crash_coach_common.contract import FloatArray
from crash_coach_common.whole_output import whole_output
from sim_pkg.render.frames import Frames
from sim_pkg.render.stage import INK, SITES, sites

PANEL_INCHES = 4.2
ROBOT_RADIUS = 0.36  # of a cell
_SPREAD = 0.18  # of a cell: how far the tracks of two teams lie apart
_GRID = "#cccccc"
_DOTTED = (0, (1.0, 1.2))


@dataclass(frozen=True)
class Track:
    """One episode of one team."""

    label: str
    colour: str
    frames: Frames


@dataclass(frozen=True)
class Panel:
    """One drawing: episodes of the same scenario."""

    title: str
    tracks: Sequence[Track]


def draw_trajectories(panels: Sequence[Panel], path: Path) -> None:
    """Writes the panels side by side as a PNG; the file is complete or not there.

    Raises:
        ValueError: no panel, a panel without tracks, or tracks of different scenarios.
        OSError: the file cannot be written.
    """
    if not panels:
        raise ValueError("there is nothing to draw: no panel was given")
    for panel in panels:
        scenarios = sorted({track.frames.scenario for track in panel.tracks})
        if len(scenarios) != 1:
            raise ValueError(f"panel {panel.title!r} needs tracks of one scenario, not {scenarios}")
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
    FigureCanvasAgg(figure)
    with whole_output(path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_panel(ax: Any, panel: Panel) -> None:
    frames = panel.tracks[0].frames
    scene = frames.scene
    width, height = scene.arena_m
    cell = scene.cell_m or 1.0
    ax.set_title(panel.title, fontsize=11, color=INK)
    ax.set_xlim(-0.03 * width, 1.03 * width)
    ax.set_ylim(-0.03 * height, 1.03 * height)
    ax.set_aspect("equal")
    ax.axis("off")
    for patch in sites(scene):
        ax.add_patch(patch)
    if scene.cell_m > 0:
        for x in np.arange(0.0, width + cell / 2, cell):
            ax.plot((x, x), (0, height), color=_GRID, linewidth=0.6, zorder=3)
        for y in np.arange(0.0, height + cell / 2, cell):
            ax.plot((0, width), (y, y), color=_GRID, linewidth=0.6, zorder=3)
    outline = Rectangle((0, 0), width, height, fill=False, edgecolor=INK, linewidth=1.4, zorder=3)
    ax.add_patch(outline)
    for k, track in enumerate(panel.tracks):
        shift = (k - (len(panel.tracks) - 1) / 2) * _SPREAD * cell
        for robot in range(track.frames.n_robots):
            draw_path(ax, track.frames.positions_m[:, robot] + shift, track.colour, cell)
    _draw_robots(ax, panel, ROBOT_RADIUS * cell)


def draw_path(ax: Any, path_m: FloatArray, colour: str, cell_m: float) -> None:
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


def _draw_robots(ax: Any, panel: Panel, radius_m: float) -> None:
    """Circles at the starts; dotted where a track of this panel has the robot crashed."""
    crashed = {robot for track in panel.tracks for robot in track.frames.faulted}
    frames = panel.tracks[0].frames
    for robot in range(frames.n_robots):
        x, y = frames.positions_m[0, robot]
        ax.add_patch(_ring((x, y), radius_m, robot in crashed))
        ax.annotate(
            str(robot + 1), (x, y), xytext=(0, 0), textcoords="offset points", ha="center",
            va="center", fontsize=8, color=INK, zorder=8,
        )  # fmt: skip


def _legend(panels: Sequence[Panel]) -> list[Any]:
    """One line per team, and what circles and coloured cells mean."""
    handles: list[Any] = []
    labels: set[str] = set()
    tracks = [track for panel in panels for track in panel.tracks]
    for track in tracks:
        if track.label not in labels:
            labels.add(track.label)
            handles.append(Line2D([], [], color=track.colour, linewidth=2, label=track.label))
    handles.append(_ring((0, 0), 1.0, crashed=False, label="robot"))
    if any(track.frames.faulted for track in tracks):
        handles.append(_ring((0, 0), 1.0, crashed=True, label="crashed robot"))
    if any(track.frames.scene.sites_m for track in tracks):
        name = tracks[0].frames.scene.site_name
        handles.append(Rectangle((0, 0), 1, 1, facecolor=SITES[0], label=name))
    return handles


def _ring(centre: tuple[float, float], radius: float, crashed: bool, label: str = "") -> Circle:
    """A robot's outline."""
    style = _DOTTED if crashed else "-"
    return Circle(
        centre, radius, facecolor="white", edgecolor=INK, linewidth=1.8, linestyle=style,
        zorder=7, label=label,
    )  # fmt: skip


def _round_key(
    legend: Any, orig_handle: Circle, xdescent: float, ydescent: float, width: float,
    height: float, fontsize: float,
) -> Circle:  # fmt: skip
    """A circle for the legend, where patches are rectangles by default."""
    return Circle(((width - xdescent) / 2, (height - ydescent) / 2), 0.75 * height)
