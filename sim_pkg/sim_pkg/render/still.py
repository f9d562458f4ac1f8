"""One episode as a picture: ways, hits, who crashed and who died. Needs no display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle, Polygon

from crash_coach_common.contract import FloatArray
from crash_coach_common.whole_output import whole_output
from sim_pkg.render.frames import Actor, Frames, Side
from sim_pkg.render.stage import (
    CRASHED,
    INK,
    SIDE_COLOURS,
    Stage,
    box_corners,
    entry,
    letter,
    scene_entries,
    site_entry,
    sites,
)

STILL_DPI = 160
# Ways of up to twelve robots are told apart by colour, of more by their numbers.
WAYS = (
    *("#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#000000", "#8c6d46"),
    *("#7a5fb0", "#999933", "#882255", "#117733", "#44aa99", "#666666"),
)
CROWD = 10  # actors from which opponents' ways are only hinted at


def draw_still(frames: Frames, path: Path, caption: str = "") -> None:
    """Writes a PNG of the whole episode; the file is complete or not there.

    ``caption``: as of Stage.

    Raises:
        OSError: the file cannot be written.
    """
    stage = Stage(frames, _legend(frames), caption)
    for patch in sites(frames.scene, frames.sites_done[-1].tolist()):
        stage.ax.add_patch(patch)
    for index in reversed(range(len(frames.actors))):
        _draw_way(stage, frames, index)
    with whole_output(path) as temporary:
        stage.figure.savefig(temporary, format="png", dpi=STILL_DPI)


def _colour(frames: Frames, index: int) -> str:
    actor = frames.actors[index]
    return WAYS[index % len(WAYS)] if actor.side is Side.ROBOTS else SIDE_COLOURS[actor.side]


def _draw_way(stage: Stage, frames: Frames, index: int) -> None:
    """The way of one actor: pale at first; its start hollow, its end full or a cross."""
    actor, colour, ax = frames.actors[index], _colour(frames, index), stage.ax
    alive = frames.alive[:, index]
    steps = int(alive.sum())  # the dead stay dead
    way = frames.positions_m[:steps, index]
    main = actor.side is Side.ROBOTS
    hinted = not main and len(frames.actors) >= CROWD
    pieces = list(np.stack([way[:-1], way[1:]], axis=1))
    faint, clear = (0.12, 0.35) if hinted else (0.35, 1.0)
    ax.add_collection(
        LineCollection(
            pieces, colors=colour, linewidths=1.8 if main else 1.0,
            alpha=np.linspace(faint, clear, max(1, len(pieces)))[: len(pieces)],
            zorder=6 if main else 5, capstyle="round",
        )
    )  # fmt: skip
    hit = way[1:][frames.hits[: steps - 1, index] & (not hinted)]
    ax.plot(
        hit[:, 0], hit[:, 1], linestyle="none", marker="o", markersize=3.4 if main else 2.6,
        markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.0, zorder=7,
    )  # fmt: skip
    if actor.size_m is not None:
        _draw_box(ax, actor, frames, index)
        return
    _draw_ends(stage, frames, index, way)


def _draw_box(ax: Any, actor: Actor, frames: Frames, index: int) -> None:
    colour = SIDE_COLOURS[actor.side]
    for k, alpha in ((0, 0.25), (frames.steps, 0.8)):
        angle = float(frames.angles_rad[k, index])
        corners = box_corners(actor, frames.positions_m[k, index], angle)
        ax.add_patch(Polygon(corners, facecolor=colour, edgecolor=INK, alpha=alpha, zorder=4))


def _draw_ends(stage: Stage, frames: Frames, index: int, way: FloatArray) -> None:
    actor, colour, ax = frames.actors[index], _colour(frames, index), stage.ax
    crashed = index in frames.faulted
    main = actor.side is Side.ROBOTS
    ax.add_patch(
        Circle(
            tuple(way[0]), actor.radius_m, facecolor=CRASHED if crashed else "white",
            edgecolor=INK if crashed else colour, linewidth=1.8 if main else 1.0,
            linestyle=(0, (1.0, 1.2)) if crashed else "-", zorder=8,
        )
    )  # fmt: skip
    size = stage.label_size_pt(actor.radius_m)
    ax.text(
        way[0, 0], way[0, 1], letter(actor, index), ha="center", va="center_baseline",
        fontsize=size, color=INK, zorder=9,
    )  # fmt: skip
    if len(way) <= frames.steps:
        # Beside the number of a robot that died where it started.
        at = np.array(way[-1])
        if np.linalg.norm(at - way[0]) < actor.radius_m:
            at += actor.radius_m
        ax.plot(*at, marker="x", markersize=8, markeredgewidth=2.4, color=colour, zorder=10)
        if main:
            ax.annotate(
                letter(actor, index), tuple(at), (6, 4), textcoords="offset points",
                fontsize=size, color=colour, weight="bold", zorder=10,
            )  # fmt: skip
    elif np.linalg.norm(way[-1] - way[0]) > 0.2 * actor.radius_m:
        ax.add_patch(Circle(tuple(way[-1]), actor.radius_m, facecolor=colour, zorder=8))
        label = ax.text(
            way[-1, 0], way[-1, 1], letter(actor, index), ha="center", va="center_baseline",
            fontsize=size, color="white", zorder=9,
        )  # fmt: skip
        label.set_path_effects([effects.withStroke(linewidth=0.6, foreground="white")])


def _legend(frames: Frames) -> list[Any]:
    blue, red = SIDE_COLOURS[Side.ROBOTS], SIDE_COLOURS[Side.OPPONENTS]
    out = [
        entry("robot, start", markerfacecolor="white", markeredgecolor=blue, markeredgewidth=1.8),
        entry("end", color=blue),
    ]
    if frames.faulted:
        ring = {"markerfacecolor": CRASHED, "markeredgecolor": INK, "markeredgewidth": 1.4}
        out.append(entry("crashed robot", **ring))
    if frames.indexes(Side.OPPONENTS):
        ring = {"markerfacecolor": "white", "markeredgecolor": red}
        out.append(entry("opponent", **ring))
    if frames.hits.any():
        ring = {"markersize": 5, "markerfacecolor": "white", "markeredgecolor": INK}
        out.append(entry("was hit", **ring))
    if not frames.alive[-1].all():
        out.append(entry("died", marker="x", markersize=8, markeredgewidth=2.4, color=INK))
    out += scene_entries(frames)
    if frames.sites_done[-1].any():
        out.append(site_entry(frames.scene, done=True))
    return out
