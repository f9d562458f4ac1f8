"""Reference policies of coverage.

``coverage_fixed``: site j belongs to robot j mod n, and nobody else goes there: a still robot's
sites are never done. ``coverage_adaptive``: a robot that is done with its own sites goes to the
nearest site that it has not seen done, and so fills the hole that a still robot leaves.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, EnvSpec, EpisodeArray, FloatArray, IntArray
from sim_pkg.compiled import entry
from sim_pkg.scenarios import drive
from sim_pkg.scenarios.coverage import CoverageConfig
from sim_pkg.scripted.base import Entry
from sim_pkg.scripted.driving import drive_to, read_others

# Shares of watching below this are none.
_DONE = 1e-6
# Robots keep this far apart, beside their radii.
_MARGIN_M = 0.3


class CoveragePolicy:
    """Both policies over ``n_arenas`` arenas; a robot remembers the sites that it saw done."""

    def __init__(
        self, spec: EnvSpec, config: CoverageConfig, n_arenas: int, fills_holes: bool
    ) -> None:
        self._config = config
        self._fills_holes = fills_holes
        self._sites_m = np.array(config.sites)
        self._seen_done = np.zeros((n_arenas, spec.n_robots, len(config.sites)), dtype=np.bool_)

    def begin(self, arenas: npt.NDArray[np.intp], seed: int, episodes: EpisodeArray) -> None:
        self._seen_done[arenas] = False

    def act(self, obs: FloatArray, available: BoolArray, actions: IntArray) -> None:
        config, robot = self._config, self._config.robot
        _act(
            obs, self._seen_done, self._fills_holes, config.arena_m, config.sight_m,
            config.watch_radius_m, 2 * robot.radius_m + _MARGIN_M, drive.DIRECTIONS,
            robot.max_speed_mps, robot.max_force_n / robot.mass_kg, config.dt_s, actions,
        )  # fmt: skip


@entry
def _read_sites(row, arena_m, sites, seen_done):  # type: ignore[no-untyped-def]
    """Places of the sites relative to the robot in m; notes which it sees done."""
    for j in range(len(sites)):
        sites[j, 0] = row[4 * j] * arena_m[0]
        sites[j, 1] = row[4 * j + 1] * arena_m[1]
        if row[4 * j + 2] > 0.0 and row[4 * j + 3] < _DONE:
            seen_done[j] = True


@entry
def _taken(site, others, radius_m):  # type: ignore[no-untyped-def]
    """Whether another robot is seen at ``site``, nearer to it than this one."""
    own = site[0] * site[0] + site[1] * site[1]
    for k in range(len(others)):
        gap = (others[k, 0] - site[0]) ** 2 + (others[k, 1] - site[1]) ** 2
        if gap <= radius_m * radius_m and gap < own:
            return True
    return False


@entry
def _choose(i, n, sites, others, seen_done, fills_holes, radius_m):  # type: ignore[no-untyped-def]
    """The site to go to, -1: none. Its own in order, then the nearest of the others'."""
    best, best_gap = -1, np.inf
    for j in range(len(sites)):
        if seen_done[j]:
            continue
        if j % n == i:
            return j
        gap = sites[j, 0] * sites[j, 0] + sites[j, 1] * sites[j, 1]
        if fills_holes and gap < best_gap and not _taken(sites[j], others, radius_m):
            best, best_gap = j, gap
    return best


@entry
def _act(  # type: ignore[no-untyped-def]
    obs, seen_done, fills_holes, arena_m, sight_m, radius_m, apart_m, directions, speed_mps,
    accel_mps2, dt_s, actions,
):  # fmt: skip
    n, m = seen_done.shape[1], seen_done.shape[2]
    sites, others = np.zeros((m, 2)), np.zeros((n - 1, 2))
    for b in range(len(obs)):
        for i in range(n):
            row = obs[b, i]
            velocity = (row[2] * speed_mps, row[3] * speed_mps)
            _read_sites(row[4:], arena_m, sites, seen_done[b, i])
            read_others(row[4 + 4 * m :], sight_m, others)
            j = _choose(i, n, sites, others, seen_done[b, i], fills_holes, radius_m)
            target = (sites[j, 0], sites[j, 1]) if j >= 0 else (0.0, 0.0)
            actions[b, i] = drive_to(
                target, velocity, others, apart_m, directions, speed_mps, accel_mps2, dt_s
            )


ENTRIES = {
    "coverage_fixed": Entry(CoverageConfig, partial(CoveragePolicy, fills_holes=False)),
    "coverage_adaptive": Entry(CoverageConfig, partial(CoveragePolicy, fills_holes=True)),
}
