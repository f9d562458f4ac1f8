"""What transport and coverage share: robots that are driven with limited force, in 9 actions."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from crash_coach_common.contract import EnvSpec
from crash_coach_common.strict_yaml import Misplaced, StrictModel
from sim_pkg.compiled import entry
from sim_pkg.scenarios.base import (
    EpisodeLimit,
    MassKg,
    PhysicsConfig,
    SpeedMps,
    StepSeconds,
    robot_names,
)
from sim_pkg.world import BoxSpec, DiscSpec, WorldSpec, box_walls

ACTIONS = (
    "stay", "east", "north_east", "north", "north_west", "west", "south_west", "south",
    "south_east",
)  # fmt: skip
STAY = 0
_D = np.sqrt(0.5)
# Unit vector (x, y) of each action.
DIRECTIONS = np.array(
    [(0, 0), (1, 0), (_D, _D), (0, 1), (-_D, _D), (-1, 0), (-_D, -_D), (0, -1), (_D, -_D)]
)
WALL_RADIUS_M = 0.5
# Robots and boxes overlap by at most this when at rest against each other.
SLOP_M = 0.005
# Share of an overlap that is left after a second.
PENETRATION_LEFT = 1e-20

Metres = Annotated[float, Field(gt=0, le=1000)]
Point = tuple[Annotated[float, Field(ge=0, le=1000)], Annotated[float, Field(ge=0, le=1000)]]


class RobotConfig(StrictModel):
    radius_m: Metres
    mass_kg: MassKg
    friction: float = Field(ge=0, le=1)
    max_speed_mps: SpeedMps
    max_force_n: float = Field(gt=0, le=1e9)

    def disc(self) -> DiscSpec:
        return DiscSpec(self.radius_m, self.mass_kg, self.friction, drive_n=self.max_force_n)


class DrivenConfig(StrictModel):
    """The keys that both kinds have."""

    arena_m: Point
    dt_s: StepSeconds
    episode_limit: EpisodeLimit
    starts: tuple[Point, ...] = Field(min_length=1, max_length=64)
    start_jitter_m: float = Field(ge=0)
    sight_m: Metres
    reward_step: float
    robot: RobotConfig
    physics: PhysicsConfig

    def world(
        self, wall_friction: float, boxes: tuple[BoxSpec, ...] = (), speed_left: float = 1.0
    ) -> WorldSpec:
        """The robots, ``boxes`` and four walls whose inner faces are the arena's edges."""
        return WorldSpec(
            discs=(self.robot.disc(),) * len(self.starts),
            boxes=boxes,
            walls_m=box_walls(*self.arena_m, 0.0, WALL_RADIUS_M),
            wall_radius_m=WALL_RADIUS_M,
            wall_friction=wall_friction,
            dt_s=self.dt_s,
            substeps=self.physics.substeps,
            iterations=self.physics.iterations,
            slop_m=SLOP_M,
            penetration_left=PENETRATION_LEFT,
            speed_left=speed_left,
        )

    def spec(self, name: str, obs_size: int, state_size: int) -> EnvSpec:
        return EnvSpec(
            scenario=name,
            robots=robot_names(len(self.starts)),
            roles=("robot",) * len(self.starts),
            action_names=ACTIONS,
            stay_actions=(STAY,),
            obs_size=obs_size,
            state_size=state_size,
            episode_limit=self.episode_limit,
            dt_s=self.dt_s,
            bounds=(-1.0, 1.0),
        )


def check_starts(
    starts: tuple[Point, ...], arena_m: Point, jitter_m: float, radius_m: float
) -> None:
    """Refuses robots that could start in a wall or in each other.

    Raises:
        Misplaced: naming the start and what is right.
    """
    apart_m = 2 * (radius_m + float(np.sqrt(2.0)) * jitter_m)
    for i, first in enumerate(starts):
        check_inside(("starts", i), first, arena_m, radius_m + jitter_m)
        for second in starts[:i]:
            if np.hypot(first[0] - second[0], first[1] - second[1]) < apart_m:
                raise Misplaced(
                    ("starts", i),
                    f"starts: {list(second)} and {list(first)} may overlap; with this radius_m and "
                    f"start_jitter_m, starts must be at least {apart_m:.3g} m apart",
                )


def check_inside(
    location: tuple[int | str, ...], point: Point, arena_m: Point, margin_m: float
) -> None:
    """Refuses a point that is nearer to a wall than ``margin_m``.

    Raises:
        Misplaced: naming the point and what is right.
    """
    if any(not margin_m <= x <= size - margin_m for x, size in zip(point, arena_m, strict=True)):
        name = ".".join(str(part) for part in location)
        raise Misplaced(
            location,
            f"{name}: {list(point)} is too near to a wall; at least {margin_m:g} m from the "
            f"edges of the {arena_m[0]:g} x {arena_m[1]:g} m arena",
        )


@entry
def steer(running, actions, directions, speed_mps, commands):  # type: ignore[no-untyped-def]
    """Actions (B, n) as commanded velocities: full speed in the action's direction, or none."""
    for b in range(actions.shape[0]):
        if running[b]:
            for i in range(actions.shape[1]):
                for k in range(2):
                    commands[b, i, k] = speed_mps * directions[actions[b, i], k]


@entry
def clip(value):  # type: ignore[no-untyped-def]
    """To [-1, 1]: an overlap of a millimetre, or a knock, must not leave the declared bounds."""
    return min(max(value, -1.0), 1.0)


@entry
def write_robots(bodies, arena_m, speed_mps, out):  # type: ignore[no-untyped-def]
    """x, y in [-1, 1] over the arena and vx, vy over the top speed, of each robot, into ``out``."""
    for i in range(out.shape[0] // 4):
        for k in range(2):
            out[4 * i + k] = clip(2.0 * bodies[i, k] / arena_m[k] - 1.0)
            out[4 * i + 2 + k] = clip(bodies[i, 2 + k] / speed_mps)


@entry
def write_others(bodies, n, i, sight_m, out):  # type: ignore[no-untyped-def]
    """Per other robot, in index order: seen, dx, dy over ``sight_m``; zeros where unseen."""
    at = 0
    for j in range(n):
        if j == i:
            continue
        dx = (bodies[j, 0] - bodies[i, 0]) / sight_m
        dy = (bodies[j, 1] - bodies[i, 1]) / sight_m
        seen = dx * dx + dy * dy <= 1.0
        out[at] = 1.0 if seen else 0.0
        out[at + 1] = dx if seen else 0.0
        out[at + 2] = dy if seen else 0.0
        at += 3
