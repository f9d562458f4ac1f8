"""One episode as a film: MP4 or GIF. Needs no display.

Positions are known at control steps and drawn on straight lines between them. What does not
change is drawn once; of every picture only the rest is drawn anew.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from PIL import Image

from crash_coach_common.whole_output import whole_output
from sim_pkg.foreign.pictures import Picture, PictureFilm, Pictures
from sim_pkg.render.frames import Frames, Side
from sim_pkg.render.stage import (
    CRASHED,
    HEALTH,
    HIT,
    INK,
    SHIELD,
    SIDE_COLOURS,
    SITE_DONE,
    Stage,
    View,
    box_corners,
    entry,
    letter,
    outcome,
    scene_entries,
    site_colour,
    site_entry,
    sites,
)

MP4_FPS = 25
GIF_FPS = 10  # a GIF counts hundredths of a second
_GIF_COLOURS = 64
GIF_SCALE = 0.6  # of an MP4's width and height
LAST_S = 1.5  # how long the end is shown
_TRAIL_S = 4.0
_SPACE_BYTES = 1 << 20  # with less left a film failed for want of it
_FADED = 0.25


class Film(Protocol):
    """Pictures by their time."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, both even."""
        ...

    def picture(self, at: float) -> Picture:
        """(H, W, 3) at a time in control steps."""
        ...


def write_video(
    frames: Frames | Pictures, path: Path, speed: float = 1.0, caption: str = ""
) -> None:
    """Writes ``path``, a .mp4 (H.264) or .gif by its suffix; it is complete or not there.

    Args:
        caption: as of Stage; pictures of a foreign environment have none.
        speed: simulated seconds per second of the film, above 0.

    Raises:
        ValueError: another suffix, or a speed that is not above 0.
        OSError: the file cannot be written.
    """
    if not speed > 0:
        raise ValueError(f"speed = {speed}: a number above 0 is needed")
    writers = {".mp4": (_write_mp4, MP4_FPS), ".gif": (_write_gif, GIF_FPS)}
    if path.suffix not in writers:
        raise ValueError(f"{path}: a film is a .mp4 or .gif file")
    write, fps = writers[path.suffix]
    film: Film = (
        PictureFilm(frames) if isinstance(frames, Pictures) else EpisodeFilm(frames, caption)
    )
    with whole_output(path) as temporary:
        write(film, _times(frames, fps, speed), temporary)


def _write_mp4(film: Film, times: npt.NDArray[np.float64], path: Path) -> None:
    # One thread and no dates, so that the same episode gives the same file.
    same = ["-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    quality = ["-preset", "veryfast", "-crf", "20", "-movflags", "+faststart"]
    encoder = imageio_ffmpeg.write_frames(
        str(path), film.size, fps=MP4_FPS, codec="libx264", quality=None, macro_block_size=2,
        output_params=[*quality, *same], ffmpeg_log_level="quiet",
    )  # fmt: skip
    encoder.send(None)
    try:
        for at in times:
            encoder.send(film.picture(at))
        encoder.close()
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError):  # with ffmpeg's command line, but without a reason
        written = 0
    if written != len(times):
        full = shutil.disk_usage(path.parent).free < _SPACE_BYTES
        reason = errno.ENOSPC if full else errno.EIO
        raise OSError(reason, os.strerror(reason), str(path))


def _write_gif(film: Film, times: npt.NDArray[np.float64], path: Path) -> None:
    # One palette for all pictures, from the first, the last and those between.
    some = np.linspace(0, len(times) - 1, 5).astype(int)
    sheet = Image.fromarray(np.concatenate([_shrunk(film.picture(times[k])) for k in some]))
    palette = sheet.quantize(_GIF_COLOURS)

    def images() -> Iterator[Image.Image]:
        for at in times:
            image = Image.fromarray(_shrunk(film.picture(at)))
            yield image.quantize(palette=palette, dither=Image.Dither.NONE)

    rest = images()
    next(rest).save(
        path, format="GIF", save_all=True, append_images=rest, duration=1000 // GIF_FPS, loop=0
    )  # fmt: skip


def _shrunk(picture: Picture) -> Picture:
    image = Image.fromarray(picture)
    size = (round(image.width * GIF_SCALE), round(image.height * GIF_SCALE))
    return np.asarray(image.resize(size, Image.Resampling.LANCZOS))


def _times(frames: Frames | Pictures, fps: int, speed: float) -> npt.NDArray[np.float64]:
    """The time of each picture, in control steps."""
    per_picture = speed / (fps * frames.dt_s)
    count = int(np.ceil(frames.steps / per_picture)) + round(LAST_S * fps) + 1
    times: npt.NDArray[np.float64] = np.minimum(np.arange(count) * per_picture, frames.steps)
    return times


class EpisodeFilm:
    """The stage and the artists that move on it.

    caption, view: as of Stage; with a view the episode is under way, and the legend has what may
    yet happen.
    """

    def __init__(self, frames: Frames, caption: str = "", view: View | None = None) -> None:
        self._frames = frames
        self._stage = stage = Stage(frames, _legend(frames, view is not None), caption, view)
        self._discs = [i for i, actor in enumerate(frames.actors) if actor.size_m is None]
        self._boxes = [i for i, actor in enumerate(frames.actors) if actor.size_m is not None]
        self._radii = np.array([frames.actors[i].radius_m for i in self._discs])
        self._vital = bool(frames.indexes(Side.OPPONENTS))
        ax = stage.ax
        self._sites = sites(frames.scene)
        for patch in self._sites:
            ax.add_patch(patch)
        self._trails: Any = ax.add_collection(LineCollection([], linewidths=1.6, zorder=4))
        self._shots: Any = ax.add_collection(LineCollection([], linewidths=1.6, zorder=6.5))
        self._crates: Any = ax.add_collection(PolyCollection([], edgecolors=INK, zorder=5))
        self._flashes = self._circles(1.35, facecolors=HIT, zorder=6)
        self._bodies = self._circles(1.0, linewidths=1.4, zorder=7)
        self._arcs: Any = ax.add_collection(LineCollection([], linewidths=2.6, zorder=8))
        (self._dead,) = ax.plot(
            [], [], linestyle="none", marker="x", markersize=9, markeredgewidth=2.4,
            color=INK, zorder=6,
        )  # fmt: skip
        self._labels = [
            ax.text(
                0, 0, letter(frames.actors[i], i), ha="center", va="center_baseline",
                color="white", fontsize=stage.label_size_pt(radius), zorder=9,
            )
            for i, radius in zip(self._discs, self._radii, strict=True)
        ]  # fmt: skip
        self._moving = [
            *self._sites, self._trails, self._crates, self._dead, self._flashes, self._shots,
            self._bodies, self._arcs, *self._labels, stage.clock,
        ]  # fmt: skip
        for artist in self._moving:
            artist.set_animated(True)
        stage.canvas.draw()
        self._empty = stage.canvas.copy_from_bbox(stage.figure.bbox)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, both even."""
        width, height = self._stage.canvas.get_width_height()
        return int(width), int(height)

    def picture(self, at: float) -> Picture:
        """(H, W, 3) at a time in control steps."""
        frames, shown = self._frames, int(at)
        clock = f"step {shown}, {at * frames.dt_s:.1f} s, return {frames.returns[shown]:.2f}"
        return self._drawn(at, clock if shown < frames.steps else outcome(frames))

    def latest(self, frames: Frames, clock: str) -> Picture:
        """(H, W, 3) the end of ``frames``, of the episode that this is a film of."""
        self._frames = frames
        return self._drawn(float(frames.steps), clock)

    def _drawn(self, at: float, clock: str) -> Picture:
        canvas = self._stage.canvas
        self._arrange(at)
        self._stage.clock.set_text(clock)
        canvas.restore_region(self._empty)
        for artist in self._moving:
            self._stage.figure.draw_artist(artist)
        return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])

    def _circles(self, scale: float, **style: Any) -> Any:
        sizes = 2 * scale * self._radii
        circles = EllipseCollection(
            sizes, sizes, np.zeros_like(sizes), units="xy", offsets=np.zeros((len(sizes), 2)),
            offset_transform=self._stage.ax.transData, **style,
        )  # fmt: skip
        return self._stage.ax.add_collection(circles)

    def _arrange(self, at: float) -> None:
        frames = self._frames
        shown = int(at)  # the last step that is over
        step = min(shown, frames.steps - 1)
        part = at - step
        now = (1 - part) * frames.positions_m[step] + part * frames.positions_m[step + 1]
        self._arrange_discs(shown, now)
        self._trail(step, now)
        corners = []
        for i in self._boxes:
            angle = frames.angles_rad[step, i] * (1 - part) + frames.angles_rad[step + 1, i] * part
            corners.append(box_corners(frames.actors[i], now[i], float(angle)))
        self._crates.set_verts(corners)
        self._crates.set_facecolor(SIDE_COLOURS[Side.THINGS])
        for i, patch in enumerate(self._sites):
            done = frames.sites_done[shown, i]
            patch.set_facecolor(SITE_DONE if done else site_colour(frames.scene, i))

    def _arrange_discs(self, shown: int, now: npt.NDArray[Any]) -> None:
        frames, discs = self._frames, self._discs
        alive = frames.alive[shown, discs]
        places = now[discs]
        self._bodies.set_offsets(_where(alive, places))
        # A hit flashes during the step in which it falls; faults show in their step too.
        step = min(shown, frames.steps - 1)
        hit = frames.hits[step, discs] & alive & (shown == step)
        self._flashes.set_offsets(_where(hit, places))
        pairs = np.argwhere((frames.damage[step] > 0) & (shown == step))
        self._shots.set_segments([now[pair] for pair in pairs])
        self._shots.set_color([SIDE_COLOURS[frames.actors[i].side] for i, _ in pairs])
        colours, edges = [], []
        styles: list[Any] = []
        for i in discs:
            crashed = i < frames.n_robots and bool(frames.crashed[step, i])
            colours.append(CRASHED if crashed else SIDE_COLOURS[frames.actors[i].side])
            edges.append(INK if crashed else "white")
            styles.append((0, (1.0, 1.0)) if crashed else "-")
        self._bodies.set_facecolor(colours)
        self._bodies.set_edgecolor(edges)
        self._bodies.set_linestyle(styles)
        dead = ~frames.alive[shown]
        self._dead.set_data(frames.positions_m[shown, dead, 0], frames.positions_m[shown, dead, 1])
        for label, place, there in zip(self._labels, places, alive, strict=True):
            label.set_position(place)
            label.set_visible(bool(there))
        if self._vital:
            self._arrange_arcs(shown, places, alive)

    def _arrange_arcs(self, shown: int, places: npt.NDArray[Any], alive: Any) -> None:
        """Health as an inner arc around each disc, its shield as an outer one."""
        arcs, colours = [], []
        for k, i in enumerate(self._discs):
            if not alive[k]:
                continue
            for share, scale, colour in (
                (self._frames.health[shown, i], 1.18, HEALTH),
                (self._frames.shield[shown, i], 1.42, SHIELD),
            ):
                angle = np.pi / 2 - np.linspace(0, 2 * np.pi * min(1.0, float(share)), 25)
                ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                arcs.append(places[k] + scale * self._radii[k] * ring)
                colours.append(colour)
        self._arcs.set_segments(arcs)
        self._arcs.set_color(colours)

    def _trail(self, step: int, now: npt.NDArray[Any]) -> None:
        frames = self._frames
        since = max(0, step - round(_TRAIL_S / frames.dt_s))
        lines, colours = [], []
        for i in range(len(frames.actors)):
            if frames.alive[step, i]:
                lines.append(np.vstack([frames.positions_m[since : step + 1, i], now[i]]))
                colours.append(SIDE_COLOURS[frames.actors[i].side])
        self._trails.set_segments(lines)
        self._trails.set_color(colours)
        self._trails.set_alpha(_FADED)


def _where(shown: npt.NDArray[np.bool_], places: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(k, 2) places; nowhere, so that nothing is drawn, where ``shown`` is False."""
    return np.where(shown[:, None], places, np.nan)


def _legend(frames: Frames, under_way: bool) -> list[Any]:
    edge = {"markeredgecolor": INK}
    out = [entry("robot", color=SIDE_COLOURS[Side.ROBOTS])]
    if under_way or frames.crashed.any():
        out.append(entry("crashed robot", markerfacecolor=CRASHED, **edge))
    if frames.indexes(Side.OPPONENTS):
        line = {"linestyle": "-", "marker": "", "linewidth": 3}
        out.append(entry("opponent", color=SIDE_COLOURS[Side.OPPONENTS]))
        out.append(entry("health", color=HEALTH, **line))
        if frames.shield.any():
            out.append(entry("shield", color=SHIELD, **line))
    if frames.hits.any():
        out.append(entry("being hit", color=HIT))
    if not frames.alive[-1].all() or (under_way and frames.indexes(Side.OPPONENTS)):
        out.append(entry("dead", marker="x", color=INK, markeredgewidth=2.4))
    out += scene_entries(frames)
    if frames.scene.sites_m:
        out.append(site_entry(frames.scene, done=True))
    return out
