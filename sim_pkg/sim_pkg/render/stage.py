"""The stage on which stills and videos draw an episode: view, arena, sites, legend, colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.transforms import Affine2D

from sim_pkg.render.frames import Actor, Frames, Side
from sim_pkg.scenarios.base import Scene

INK = "#333333"
GRID = "#dddddd"
PAPER = "#ffffff"
OUTSIDE = "#ececec"
ROUGH = "#f3f0ea"
SITES = ("#f4c95d", "#8ecae6", "#cdb4db", "#b7e4c7")
SITE_DONE = "#c9c9c9"
# Okabe and Ito's palette: told apart with every kind of colour vision.
SIDE_COLOURS = {Side.ROBOTS: "#0072B2", Side.OPPONENTS: "#D55E00", Side.THINGS: "#8c6d46"}
CRASHED = "#9a9a9a"
HIT = "#F0C000"
HEALTH = "#009E73"
SHIELD = "#56B4E9"

DPI = 100
WIDTH_IN = 9.0
HEADER_IN, FOOTER_IN, MARGIN_IN = 0.72, 0.5, 0.12
FONT_PT = 12
MAX_ASPECT = 1.05  # height over width of the view
_LEAST_M = 8.0  # the view is never narrower
_AROUND_M = 1.5  # free space around everything that happens

View = tuple[float, float, float, float]
"""x1, y1, x2, y2 in m of what is shown."""


def view_of(frames: Frames) -> View:
    """The whole arena, or where it is large, the part in which the episode took place."""
    width, height = frames.scene.arena_m
    if frames.scene.cell_m > 0 or max(width, height) <= 2 * _LEAST_M:
        return (0.0, 0.0, width, height)
    seen = frames.positions_m[frames.alive]
    points = np.concatenate([seen, np.array(frames.scene.sites_m).reshape(-1, 2)])
    (x1, y1), (x2, y2) = points.min(axis=0) - _AROUND_M, points.max(axis=0) + _AROUND_M
    # No taller than wide, and wide enough for the header.
    least_width = max(_LEAST_M, (y2 - y1) / MAX_ASPECT)
    left, right = _widened(x1, x2, least_width, width)
    low, high = _widened(y1, y2, 0.35 * (right - left), height)
    return (left, low, right, high)


def _widened(low: float, high: float, least: float, limit: float) -> tuple[float, float]:
    """low..high made at least ``least`` long around its middle, and then cut to 0..limit."""
    short = max(0.0, least - (high - low)) / 2
    low, high = low - short, high + short
    shift = max(0.0, -low) - max(0.0, high - limit)
    return max(0.0, low + shift), min(limit, high + shift)


class Stage:
    """A figure with the arena of ``frames``; x and y of ``ax`` are metres.

    Args:
        caption: who acts, and what happens to whom: a line above the episode's own.
        view: what is shown; None: where the episode took place.
    """

    def __init__(
        self, frames: Frames, legend: Sequence[Any], caption: str = "", view: View | None = None
    ) -> None:
        self.view = view_of(frames) if view is None else view
        x1, y1, x2, y2 = self.view
        inner = WIDTH_IN - 2 * MARGIN_IN
        tall = inner * (y2 - y1) / (x2 - x1)
        height = tall + HEADER_IN + FOOTER_IN
        # Videos need even numbers of pixels.
        pixels = 2 * round(height * DPI / 2)
        self.figure = Figure(figsize=(WIDTH_IN, pixels / DPI), dpi=DPI, facecolor=PAPER)
        self.canvas: Any = FigureCanvasAgg(self.figure)
        self.ax: Any = self.figure.add_axes(
            (MARGIN_IN / WIDTH_IN, FOOTER_IN / height, inner / WIDTH_IN, tall / height)
        )
        self.pixels_per_m = inner * DPI / (x2 - x1)
        upper, lower = (1 - share * HEADER_IN / height for share in (0.3, 0.7))
        style: dict[str, Any] = {"va": "center", "fontsize": FONT_PT, "color": INK}
        side = MARGIN_IN / WIDTH_IN
        self.caption = self.figure.text(side, upper, caption, ha="left", weight="bold", **style)
        self.title = self.figure.text(side, lower, "", ha="left", **style)
        self.clock = self.figure.text(1 - side, lower, outcome(frames), ha="right", **style)
        self._draw_arena(frames)
        self._shrink(self.caption)
        self._shrink(self.title, self.clock)
        self.figure.legend(
            handles=list(legend), loc="lower center", ncols=len(legend), frameon=False,
            fontsize=FONT_PT - 1, bbox_to_anchor=(0.5, 0.0), borderaxespad=0.3,
            handletextpad=0.4, columnspacing=1.2, handlelength=1.4,
        )  # fmt: skip

    def _shrink(self, *texts: Any) -> None:
        """Makes the texts of a line as small as it takes to stand beside each other."""
        free = self.figure.bbox.width - (1 + len(texts)) * MARGIN_IN * DPI
        width = sum(text.get_window_extent(self.canvas.get_renderer()).width for text in texts)
        for text in texts:
            text.set_fontsize(FONT_PT * min(1.0, free / max(1.0, width)))

    def _draw_arena(self, frames: Frames) -> None:
        ax, (x1, y1, x2, y2) = self.ax, self.view
        ax.set_xlim(x1, x2)
        ax.set_ylim(y1, y2)
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_facecolor(OUTSIDE)
        left, low, right, high = frames.walled_m
        floor = Rectangle((left, low), right - left, high - low, facecolor=PAPER, zorder=0)
        wall = Rectangle(
            (left, low),
            right - left,
            high - low,
            fill=False,
            edgecolor=INK,
            linewidth=2.2,
            zorder=3,
        )
        ax.add_patch(floor)
        for x, y, right_m, top_m in frames.scene.rough_m:
            size = (right_m - x, top_m - y)
            ax.add_patch(
                Rectangle((x, y), *size, facecolor=ROUGH, edgecolor=GRID, hatch="....", zorder=0)
            )
        ax.add_patch(wall)
        every = frames.scene.cell_m or grid_step(x2 - x1)
        self.title.set_text(f"{title(frames)}, grid {every:g} m")
        for x in np.arange(math.ceil(x1 / every), x2 / every + 1e-6) * every:
            ax.plot((x, x), (low, high), color=GRID, linewidth=0.7, zorder=1)
        for y in np.arange(math.ceil(y1 / every), y2 / every + 1e-6) * every:
            ax.plot((left, right), (y, y), color=GRID, linewidth=0.7, zorder=1)
        ax.spines[:].set_color(GRID)

    def label_size_pt(self, radius_m: float) -> float:
        """Of a number that fits a disc."""
        return float(np.clip(0.95 * radius_m * self.pixels_per_m * 72 / DPI, 6.0, 13.0))


def grid_step(width_m: float) -> float:
    """1, 2, 5, 10, ... m, so that some ten lines are seen."""
    rough = width_m / 10
    power = 10.0 ** math.floor(math.log10(rough))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= rough - 1e-9)


def title(frames: Frames) -> str:
    return f"{frames.scenario}, episode {frames.episode} of seed {frames.seed}"


def outcome(frames: Frames) -> str:
    done = "success" if frames.success else "no success"
    seconds = frames.steps * frames.dt_s
    return f"{done} after {frames.steps} steps ({seconds:g} s), return {frames.returns[-1]:.2f}"


def letter(actor: Actor, index: int) -> str:
    """What is written in a disc: a robot's number, an opponent's type."""
    return str(index + 1) if actor.side is Side.ROBOTS else actor.kind[:1].upper()


def box_corners(
    actor: Actor, centre_m: npt.NDArray[Any], angle_rad: float
) -> npt.NDArray[np.float64]:
    """(4, 2) corners of an actor that has a size."""
    if actor.size_m is None:
        raise ValueError(f"{actor.name} is a disc")
    w, h = actor.size_m[0] / 2, actor.size_m[1] / 2
    turn = Affine2D().rotate(angle_rad).translate(float(centre_m[0]), float(centre_m[1]))
    corners: npt.NDArray[np.float64] = turn.transform([(-w, -h), (w, -h), (w, h), (-w, h)])
    return corners


def site_colour(scene: Scene, index: int) -> str:
    """On a grid, the sites are told apart, as in the paper's figure."""
    return SITES[index % len(SITES)] if scene.site_radius_m == 0 else SITES[0]


def sites(scene: Scene, done: Sequence[bool] = ()) -> list[Patch]:
    """A patch per site: cells of a grid, or discs; ``done``: of each, if any may be."""
    cell, radius = scene.cell_m or 1.0, scene.site_radius_m
    out: list[Patch] = []
    for i, (x, y) in enumerate(scene.sites_m):
        colour = SITE_DONE if i < len(done) and done[i] else site_colour(scene, i)
        style: dict[str, Any] = {"facecolor": colour, "zorder": 2}
        if radius > 0:
            out.append(Circle((x, y), radius, **style))
        else:
            out.append(Rectangle((x - cell / 2, y - cell / 2), cell, cell, **style))
    return out


def site_entry(scene: Scene, done: bool = False) -> Line2D:
    """The legend's entry for a site."""
    name = f"{scene.site_name}, done" if done else scene.site_name
    marker = "o" if scene.site_radius_m > 0 else "s"
    return entry(name, marker=marker, color=SITE_DONE if done else SITES[0])


def scene_entries(frames: Frames) -> list[Any]:
    """The legend's entries for what a scenario has but robots."""
    out: list[Any] = []
    if frames.indexes(Side.THINGS):
        out.append(entry("box", marker="s", color=SIDE_COLOURS[Side.THINGS]))
    if frames.scene.rough_m:
        out.append(Patch(facecolor=ROUGH, edgecolor=CRASHED, hatch="....", label="rough floor"))
    if frames.scene.sites_m:
        out.append(site_entry(frames.scene))
    return out


def entry(label: str, **style: Any) -> Line2D:
    """A legend's entry; without a style, a disc."""
    disc = {"linestyle": "none", "marker": "o", "markersize": 10, "markeredgewidth": 1.4}
    return Line2D([], [], **{**disc, **style}, label=label)
