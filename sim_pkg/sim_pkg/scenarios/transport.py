"""Transport: n robots push a heavy box to a goal.

The box slides with dry friction: below a force it does not move at all, and what the robots push
with beyond that makes it faster (everything also meets a resistance that grows with speed). The
floor has a smooth and, in rectangles, a rough part; which friction acts is decided by the floor
under the box's centre. In ``transport.yaml`` one robot cannot move the box, two can on smooth
floor, and only three together can push it over the rough strip in the way: with one robot less
the team is slower and has to go around.

Robots have mass and a drive of limited force, knock into each other and into the box, and can
push but not pull: a box pushed into a corner stays there.

Actions: stay (brake) or full speed in one of 8 directions.

Observation of a robot, (12 + 3 (n - 1),), all in [-1, 1]:
    own x, y from the arena's centre over half its size, own vx, vy over the top speed |
    box: dx over the arena's width, dy over its height, cos and sin of its angle, vx, vy over
    the robots' top speed | goal: dx, dy as the box's |
    per other robot: seen (0 or 1), dx, dy over ``sight_m`` (zeros where unseen).
State, (4 n + 7,): per robot x, y, vx, vy as above | box x, y, vx, vy likewise, cos and sin of its
angle | share of the episode limit that has passed.

Reward: ``reward_metre`` for each metre that the box's centre comes nearer to the goal (negative
when it moves away: the sum depends on start and end alone), ``reward_goal`` when it is there,
``reward_step`` for every step. The task ends with success when the box's centre is within
``goal_radius_m`` of the goal, without at ``episode_limit``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from crash_coach_common.contract import BoolArray, IntArray
from crash_coach_common.strict_yaml import Misplaced, StrictModel
from sim_pkg.compiled import entry
from sim_pkg.scenarios import drive
from sim_pkg.scenarios.base import Buffers, Kind, MassKg, Scene, episode_rng
from sim_pkg.scenarios.drive import DrivenConfig, Metres, Point, clip
from sim_pkg.world import BoxSpec, Float64Array, World

GRAVITY_MPS2 = 9.81


class BoxConfig(StrictModel):
    width_m: Metres
    height_m: Metres
    mass_kg: MassKg
    friction: float = Field(ge=0, le=1)
    start: Point

    def spec(self) -> BoxSpec:
        """With the torque of a floor that carries the box evenly."""
        w, h = self.width_m, self.height_m
        # The mean distance of a rectangle's points from its centre, by integration.
        arm_m = np.hypot(w, h) + w * w / (2 * h) * np.arcsinh(h / w)
        arm_m = float(arm_m + h * h / (2 * w) * np.arcsinh(w / h)) / 6
        return BoxSpec(w, h, self.mass_kg, self.friction, arm_m)


class FloorConfig(StrictModel):
    grip: float = Field(ge=0, le=10)
    grip_rough: float = Field(ge=0, le=10)
    rough: tuple[tuple[float, float, float, float], ...]
    drag_per_s: float = Field(ge=0)

    @model_validator(mode="after")
    def _check(self) -> FloorConfig:
        for i, (x1, y1, x2, y2) in enumerate(self.rough):
            if x1 >= x2 or y1 >= y2:
                raise Misplaced(
                    ("rough", i),
                    f"rough: {[x1, y1, x2, y2]} is empty; expected [x1, y1, x2, y2] with "
                    f"x1 < x2 and y1 < y2",
                )
        return self


class TransportConfig(DrivenConfig):
    """transport.yaml; units are in its comments."""

    kind: Literal["transport"]
    goal: Point
    goal_radius_m: Metres
    reward_metre: float
    reward_goal: float
    box: BoxConfig
    floor: FloorConfig

    @model_validator(mode="after")
    def _check(self) -> TransportConfig:
        box, radius_m, jitter_m = self.box, self.robot.radius_m, self.start_jitter_m
        drive.check_starts(self.starts, self.arena_m, jitter_m, radius_m)
        half_m = max(box.width_m, box.height_m) / 2
        drive.check_inside(("box", "start"), box.start, self.arena_m, half_m + jitter_m)
        drive.check_inside(("goal",), self.goal, self.arena_m, half_m)
        reach = (box.width_m / 2 + radius_m, box.height_m / 2 + radius_m)
        for i, start in enumerate(self.starts):
            gaps = [abs(a - b) - 2 * jitter_m for a, b in zip(start, box.start, strict=True)]
            if gaps[0] < reach[0] and gaps[1] < reach[1]:
                raise Misplaced(
                    ("starts", i),
                    f"starts: {list(start)} may overlap the box at {list(box.start)}; with "
                    f"start_jitter_m {jitter_m:g} it must be {reach[0] + 2 * jitter_m:.3g} m "
                    f"away along x or {reach[1] + 2 * jitter_m:.3g} m along y",
                )
        if np.hypot(*np.subtract(self.goal, box.start)) < self.goal_radius_m + 2 * jitter_m:
            raise Misplaced(("goal",), f"goal: {list(self.goal)} is where the box starts")
        return self


class Transport:
    """The scenario over ``n_arenas`` arenas; hooks as in base.Scenario."""

    def __init__(self, config: TransportConfig, name: str, n_arenas: int) -> None:
        n = len(config.starts)
        self.config = config
        self._places_m = np.array((*config.starts, config.box.start))
        self._arena_m = np.array(config.arena_m)
        self._goal_m = np.array(config.goal)
        self._rough_m = np.array(config.floor.rough).reshape(-1, 4)
        self._gap_m = np.zeros(n_arenas)
        self._steps = np.zeros(n_arenas, dtype=np.int32)
        self.spec = config.spec(name, obs_size=12 + 3 * (n - 1), state_size=4 * n + 7)
        self.scene = Scene(
            arena_m=config.arena_m,
            cell_m=0.0,
            radii_m=(config.robot.radius_m,) * n,
            sites_m=(config.goal,),
            site_name="goal",
            site_radius_m=config.goal_radius_m,
            boxes_m=((config.box.width_m, config.box.height_m),),
            rough_m=config.floor.rough,
        )
        self.world = config.world(
            wall_friction=config.box.friction,
            boxes=(config.box.spec(),),
            speed_left=float(np.exp(-config.floor.drag_per_s)),
        )

    def begin(self, arena: int, seed: int, episode: int) -> Float64Array:
        self._steps[arena] = 0
        jitter_m = self.config.start_jitter_m
        rng = episode_rng(seed, episode)
        places_m = self._places_m + rng.uniform(-jitter_m, jitter_m, self._places_m.shape)
        self._gap_m[arena] = np.sqrt(((places_m[-1] - self._goal_m) ** 2).sum())
        return places_m

    def observe(self, running: BoolArray, world: World, out: Buffers) -> None:
        config = self.config
        _observe(
            running, world.bodies, world.turns, self._goal_m, self._arena_m,
            config.robot.max_speed_mps, config.sight_m, self._steps / config.episode_limit,
            out.obs, out.state,
        )  # fmt: skip
        out.sites_done[:, 0] = self._gap_m <= config.goal_radius_m

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        floor, weight_n = self.config.floor, self.config.box.mass_kg * GRAVITY_MPS2
        speed_mps = self.config.robot.max_speed_mps
        drive.steer(running, actions, drive.DIRECTIONS, speed_mps, world.commands)
        _hold(
            world.bodies, actions.shape[1], self._rough_m, floor.grip * weight_n,
            floor.grip_rough * weight_n, world.floor_n,
        )  # fmt: skip

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        config = self.config
        _score(
            running, world.bodies, self._goal_m, self._gap_m, self._steps, config.goal_radius_m,
            config.episode_limit, config.reward_metre, config.reward_goal, config.reward_step,
            out.reward, out.terminated, out.success,
        )  # fmt: skip
        self.observe(running, world, out)


@entry
def _hold(bodies, n, rough, smooth_n, rough_n, floor_n):  # type: ignore[no-untyped-def]
    """The floor's friction force on each box, by where its centre is."""
    for b in range(floor_n.shape[0]):
        for k in range(floor_n.shape[1]):
            x, y = bodies[b, n + k, 0], bodies[b, n + k, 1]
            floor_n[b, k] = smooth_n
            for r in range(len(rough)):
                if rough[r, 0] <= x <= rough[r, 2] and rough[r, 1] <= y <= rough[r, 3]:
                    floor_n[b, k] = rough_n


@entry
def _score(  # type: ignore[no-untyped-def]
    running, bodies, goal, gap_m, steps, radius_m, limit, reward_metre, reward_goal, reward_step,
    reward, terminated, success,
):  # fmt: skip
    for b in range(len(running)):
        if not running[b]:
            continue
        steps[b] += 1
        dx, dy = bodies[b, -1, 0] - goal[0], bodies[b, -1, 1] - goal[1]
        gap = np.sqrt(dx * dx + dy * dy)
        there = gap <= radius_m
        reward[b] = reward_step + reward_metre * (gap_m[b] - gap)
        if there:
            reward[b] += reward_goal
        gap_m[b] = gap
        success[b] = there
        terminated[b] = there or steps[b] >= limit


@entry
def _observe(  # type: ignore[no-untyped-def]
    running, bodies, turns, goal, arena_m, speed_mps, sight_m, time, obs, state
):
    n = bodies.shape[1] - 1
    for b in range(len(running)):
        if not running[b]:
            continue
        whole, box = state[b], bodies[b, n]
        # Robots and box alike: x, y, vx, vy.
        drive.write_robots(bodies[b], arena_m, speed_mps, whole[: 4 * n + 4])
        whole[4 * n + 4] = np.cos(turns[b, n, 0])
        whole[4 * n + 5] = np.sin(turns[b, n, 0])
        whole[4 * n + 6] = time[b]
        for i in range(n):
            row = obs[b, i]
            row[:4] = whole[4 * i : 4 * i + 4]
            for k in range(2):
                row[4 + k] = clip((box[k] - bodies[b, i, k]) / arena_m[k])
                row[10 + k] = clip((goal[k] - bodies[b, i, k]) / arena_m[k])
            row[6:8] = whole[4 * n + 4 : 4 * n + 6]
            row[8:10] = whole[4 * n + 2 : 4 * n + 4]
            drive.write_others(bodies[b], n, i, sight_m, row[12:])


KIND = Kind(TransportConfig, Transport)
