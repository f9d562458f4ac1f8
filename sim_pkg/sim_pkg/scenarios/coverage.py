"""Coverage: n robots watch m sites; a still robot leaves a hole that the others can fill.

A site is done when robots have watched it for ``watch_s`` in all. A robot watches a site in a
control step at whose end its centre is within ``watch_radius_m`` of it and slower than
``watch_speed_mps``; several robots at one site watch no faster than one. Robots have mass and a
drive of limited force: they need metres to brake, knock into each other, and can be pushed away.

Actions: stay (brake) or full speed in one of 8 directions.

Observation of a robot, (4 + 4 m + 3 (n - 1),), all in [-1, 1]:
    own x, y from the arena's centre over half its size, own vx, vy over the top speed |
    per site: dx over the arena's width, dy over its height (where the sites are is known), seen
    (0 or 1: within ``sight_m``), the share of its watching that is left (0 where unseen) |
    per other robot: seen (0 or 1), dx, dy over ``sight_m`` (zeros where unseen).
State, (4 n + 3 m + 1,): per robot x, y, vx, vy as above | per site x, y, share left | share of
the episode limit that has passed.

Reward: ``reward_site`` for each site that gets done, ``reward_step`` for every step. The task
ends with success when all sites are done, without at ``episode_limit``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from crash_coach_common.contract import BoolArray, IntArray
from crash_coach_common.strict_yaml import Misplaced
from sim_pkg.compiled import entry
from sim_pkg.scenarios import drive
from sim_pkg.scenarios.base import Buffers, Kind, Scene, episode_rng
from sim_pkg.scenarios.drive import DrivenConfig, Metres, Point, clip
from sim_pkg.world import Float64Array, World

# Watching is counted in floating-point seconds.
_DONE_S = 1e-9


class CoverageConfig(DrivenConfig):
    """coverage.yaml; units are in its comments."""

    kind: Literal["coverage"]
    sites: tuple[Point, ...] = Field(min_length=1, max_length=1000)
    watch_radius_m: Metres
    watch_speed_mps: float = Field(gt=0)
    watch_s: float = Field(gt=0)
    reward_site: float

    @model_validator(mode="after")
    def _check(self) -> CoverageConfig:
        radius_m = self.robot.radius_m
        drive.check_starts(self.starts, self.arena_m, self.start_jitter_m, radius_m)
        for j, site in enumerate(self.sites):
            drive.check_inside(("sites", j), site, self.arena_m, radius_m)
            if site in self.sites[:j]:
                raise Misplaced(("sites", j), f"sites: {list(site)} again; one site per place")
        if self.sight_m <= self.watch_radius_m:
            raise Misplaced(
                ("sight_m",),
                f"sight_m: {self.sight_m} must exceed watch_radius_m, {self.watch_radius_m}: a "
                f"robot sees the site that it watches",
            )
        return self


class Coverage:
    """The scenario over ``n_arenas`` arenas; hooks as in base.Scenario."""

    def __init__(self, config: CoverageConfig, name: str, n_arenas: int) -> None:
        n, m = len(config.starts), len(config.sites)
        self.config = config
        self._starts_m = np.array(config.starts)
        self._sites_m = np.array(config.sites)
        self._arena_m = np.array(config.arena_m)
        self._left_s = np.zeros((n_arenas, m))
        self._steps = np.zeros(n_arenas, dtype=np.int32)
        self.spec = config.spec(
            name, obs_size=4 + 4 * m + 3 * (n - 1), state_size=4 * n + 3 * m + 1
        )
        self.scene = Scene(
            arena_m=config.arena_m,
            cell_m=0.0,
            radii_m=(config.robot.radius_m,) * n,
            sites_m=config.sites,
            site_radius_m=config.watch_radius_m,
        )
        self.world = config.world(wall_friction=config.robot.friction)

    def begin(self, arena: int, seed: int, episode: int) -> Float64Array:
        self._left_s[arena] = self.config.watch_s
        self._steps[arena] = 0
        jitter_m = self.config.start_jitter_m
        rng = episode_rng(seed, episode)
        return self._starts_m + rng.uniform(-jitter_m, jitter_m, self._starts_m.shape)

    def observe(self, running: BoolArray, world: World, out: Buffers) -> None:
        config = self.config
        _observe(
            running, world.bodies, self._sites_m, self._left_s / config.watch_s, self._arena_m,
            config.robot.max_speed_mps, config.sight_m, self._steps / config.episode_limit,
            out.obs, out.state,
        )  # fmt: skip
        out.sites_done[:] = self._left_s <= _DONE_S

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        speed_mps = self.config.robot.max_speed_mps
        drive.steer(running, actions, drive.DIRECTIONS, speed_mps, world.commands)

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        config = self.config
        _score(
            running, world.bodies, self._sites_m, self._left_s, self._steps,
            config.watch_radius_m, config.watch_speed_mps, config.dt_s, config.episode_limit,
            config.reward_site, config.reward_step, out.reward, out.terminated, out.success,
        )  # fmt: skip
        self.observe(running, world, out)


@entry
def _watched(bodies, n, site, radius_m, speed_mps):  # type: ignore[no-untyped-def]
    """Whether one of the n robots is at ``site`` and slow enough."""
    for i in range(n):
        dx, dy = bodies[i, 0] - site[0], bodies[i, 1] - site[1]
        vx, vy = bodies[i, 2], bodies[i, 3]
        near = dx * dx + dy * dy <= radius_m * radius_m
        if near and vx * vx + vy * vy < speed_mps * speed_mps:
            return True
    return False


@entry
def _score(  # type: ignore[no-untyped-def]
    running, bodies, sites, left_s, steps, radius_m, speed_mps, dt_s, limit, reward_site,
    reward_step, reward, terminated, success,
):  # fmt: skip
    for b in range(len(running)):
        if not running[b]:
            continue
        steps[b] += 1
        reward[b] = reward_step
        done = True
        for j in range(len(sites)):
            if left_s[b, j] > 0.0:
                if _watched(bodies[b], bodies.shape[1], sites[j], radius_m, speed_mps):
                    left_s[b, j] -= dt_s
                if left_s[b, j] <= _DONE_S:
                    left_s[b, j] = 0.0
                    reward[b] += reward_site
            done = done and left_s[b, j] == 0.0
        success[b] = done
        terminated[b] = done or steps[b] >= limit


@entry
def _observe(  # type: ignore[no-untyped-def]
    running, bodies, sites, left, arena_m, speed_mps, sight_m, time, obs, state
):
    n, m = bodies.shape[1], len(sites)
    for b in range(len(running)):
        if not running[b]:
            continue
        drive.write_robots(bodies[b], arena_m, speed_mps, state[b, : 4 * n])
        for j in range(m):
            for k in range(2):
                state[b, 4 * n + 3 * j + k] = 2.0 * sites[j, k] / arena_m[k] - 1.0
            state[b, 4 * n + 3 * j + 2] = left[b, j]
        state[b, 4 * n + 3 * m] = time[b]
        for i in range(n):
            row = obs[b, i]
            row[:4] = state[b, 4 * i : 4 * i + 4]
            for j in range(m):
                at = 4 + 4 * j
                dx, dy = sites[j, 0] - bodies[b, i, 0], sites[j, 1] - bodies[b, i, 1]
                seen = dx * dx + dy * dy <= sight_m * sight_m
                row[at] = clip(dx / arena_m[0])
                row[at + 1] = clip(dy / arena_m[1])
                row[at + 2] = 1.0 if seen else 0.0
                row[at + 3] = left[b, j] if seen else 0.0
            drive.write_others(bodies[b], n, i, sight_m, row[4 + 4 * m :])


KIND = Kind(CoverageConfig, Coverage)
