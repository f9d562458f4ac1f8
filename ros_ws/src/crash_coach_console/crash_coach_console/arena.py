"""What is drawn: an arena that stays, and its states; JSON values for pages, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_pkg.render.frames import Frames

_PLACES = 3  # decimals of metres and radians: a millimetre


def rounded(values: Sequence[float]) -> list[float]:
    """For JSON: short, and finite (what is not becomes 0)."""
    array = np.nan_to_num(np.asarray(values, dtype=np.float64), posinf=0.0, neginf=0.0)
    flat: list[float] = np.round(array.ravel(), _PLACES).tolist()
    return flat


def pairs(values: Sequence[float], width: int = 2) -> list[list[float]]:
    """A flat list in rows of ``width``; an incomplete last row is left out."""
    flat = rounded(values)
    return [flat[i : i + width] for i in range(0, len(flat) - width + 1, width)]


@dataclass(frozen=True)
class Arena:
    """The still part. ``walled_m``, ``rough_m``: x1, y1, x2, y2. Robots are the first actors."""

    scenario: str
    lockstep: bool
    dt_s: float
    action_names: tuple[str, ...]
    arena_m: tuple[float, float]
    walled_m: tuple[float, ...]
    cell_m: float
    site_name: str
    site_radius_m: float
    sites_m: tuple[tuple[float, ...], ...]
    rough_m: tuple[tuple[float, ...], ...]
    actors: tuple[tuple[str, str, str, float, tuple[float, ...]], ...]
    """(name, kind, side, radius_m, (width, height) in m) each."""

    @property
    def robots(self) -> tuple[str, ...]:
        return tuple(name for name, _, side, _, _ in self.actors if side == "robots")

    def value(self) -> dict[str, Any]:
        return {
            "scenario": self.scenario,
            "lockstep": self.lockstep,
            "dt_s": self.dt_s,
            "action_names": list(self.action_names),
            "arena_m": list(self.arena_m),
            "walled_m": list(self.walled_m),
            "cell_m": self.cell_m,
            "site_name": self.site_name,
            "site_radius_m": self.site_radius_m,
            "sites_m": [list(site) for site in self.sites_m],
            "rough_m": [list(rough) for rough in self.rough_m],
            "actors": [
                {"name": name, "kind": kind, "side": side, "radius_m": radius, "size_m": list(size)}
                for name, kind, side, radius, size in self.actors
            ],
        }


@dataclass(frozen=True)
class State:
    """The moving part after ``step`` control steps; per actor, site or robot in Arena's order."""

    episode: int
    step: int
    time_s: float  # of the simulation or the recording
    episode_return: float
    ended: bool
    success: bool
    poses: tuple[float, ...]  # x, y, angle each
    health: tuple[float, ...]
    shield: tuple[float, ...]
    sites_done: tuple[int, ...]
    crashed: tuple[int, ...]
    hits: tuple[int, ...]  # actor that hit, actor that was hit, ...

    def value(self) -> dict[str, Any]:
        return {
            "episode": self.episode,
            "step": self.step,
            "time_s": round(self.time_s, _PLACES),
            "return": round(self.episode_return, _PLACES),
            "ended": self.ended,
            "success": self.success,
            "poses": rounded(self.poses),
            "health": rounded(self.health),
            "shield": rounded(self.shield),
            "done": list(self.sites_done),
            "crashed": list(self.crashed),
            "hits": list(self.hits),
        }


def arena_of(frames: Frames, action_names: tuple[str, ...]) -> Arena:
    """Of a whole episode."""
    scene = frames.scene
    return Arena(
        scenario=frames.scenario,
        lockstep=False,
        dt_s=frames.dt_s,
        action_names=action_names,
        arena_m=scene.arena_m,
        walled_m=frames.walled_m,
        cell_m=scene.cell_m,
        site_name=scene.site_name,
        site_radius_m=scene.site_radius_m,
        sites_m=scene.sites_m,
        rough_m=scene.rough_m,
        actors=tuple(
            (a.name, a.kind, a.side.name.lower(), float(a.radius_m), a.size_m or (0.0, 0.0))
            for a in frames.actors
        ),
    )


def state_of(frames: Frames, step: int) -> State:
    """Of an episode after ``step`` control steps, 0 to ``frames.steps``."""
    poses = np.concatenate([frames.positions_m[step], frames.angles_rad[step][:, None]], axis=1)
    crashed = frames.crashed[step - 1] if step else np.zeros(frames.n_robots, dtype=np.bool_)
    hits: list[int] = []
    if step:
        hit, hitter = np.nonzero(frames.damage[step - 1])
        hits = np.stack([hitter, hit], axis=1).ravel().tolist()
    last = step == frames.steps
    return State(
        episode=frames.episode,
        step=step,
        time_s=step * frames.dt_s,
        episode_return=float(frames.returns[step]),
        ended=last,
        success=last and frames.success,
        poses=tuple(poses.ravel().tolist()),
        health=tuple(frames.health[step].tolist()),
        shield=tuple(frames.shield[step].tolist()),
        sites_done=tuple(frames.sites_done[step].astype(int).tolist()),
        crashed=tuple(crashed.astype(int).tolist()),
        hits=tuple(hits),
    )
