"""The paper's grid-world, driven by physics: robots touch buttons on a grid of cells.

A robot observes its own cell; the state is the cells of the robots, then of the buttons (which
buttons were touched is in neither: the paper's state is locations only). Each step costs
``reward_step``, except that buttons touched for the first time give ``reward_button`` each
instead. The task ends with success when every button is touched, without at ``episode_limit``.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from crash_coach_common.contract import BoolArray, EnvSpec, IntArray
from crash_coach_common.strict_yaml import StrictModel
from sim_pkg.compiled import entry
from sim_pkg.scenarios.base import (
    Buffers,
    EpisodeLimit,
    Kind,
    MassKg,
    PhysicsConfig,
    Scene,
    SpeedMps,
    StepSeconds,
    robot_names,
)
from sim_pkg.world import DiscSpec, Float64Array, World, WorldSpec, box_walls

ACTIONS = ("up", "down", "left", "right", "stay")
# (row, column) change of each action; row 0 is the northernmost.
MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)], dtype=np.int32)
STAY = 4

Cell = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


class RobotConfig(StrictModel):
    radius_m: float = Field(gt=0)
    mass_kg: MassKg
    friction: float = Field(ge=0, le=1)
    max_speed_mps: SpeedMps


class ButtonsConfig(StrictModel):
    """buttons.yaml; units are in its comments."""

    kind: Literal["buttons"]
    rows: int = Field(ge=2, le=1000)
    columns: int = Field(ge=2, le=1000)
    cell_m: float = Field(gt=0)
    dt_s: StepSeconds
    episode_limit: EpisodeLimit
    starts: tuple[Cell, ...] = Field(min_length=1)
    buttons: tuple[Cell, ...] = Field(min_length=1)
    reward_step: float
    reward_button: float
    robot: RobotConfig
    physics: PhysicsConfig

    @model_validator(mode="after")
    def _check(self) -> ButtonsConfig:
        for key, cells in (("starts", self.starts), ("buttons", self.buttons)):
            for row, column in cells:
                if row >= self.rows or column >= self.columns:
                    raise ValueError(
                        f"{key}: cell [{row}, {column}] is outside the grid; "
                        f"rows are 0..{self.rows - 1}, columns 0..{self.columns - 1}"
                    )
        for start in self.starts:
            if start in self.buttons:
                raise ValueError(f"starts: cell {list(start)} is a button; start beside it")
        if len(set(self.buttons)) < len(self.buttons):
            raise ValueError("buttons: two buttons in the same cell")
        if self.robot.radius_m > self.cell_m / 2:
            raise ValueError(
                f"robot.radius_m: {self.robot.radius_m} does not fit a cell; "
                f"at most {self.cell_m / 2}"
            )
        needed = self.cell_m / self.dt_s
        if self.robot.max_speed_mps < 1.01 * needed:
            raise ValueError(
                f"robot.max_speed_mps: {self.robot.max_speed_mps} is too slow for a cell per "
                f"step; at least {1.01 * needed:g} (1 % above cell_m / dt_s, to correct drift)"
            )
        return self


class Buttons:
    """The scenario over ``n_arenas`` arenas; hooks as in base.Scenario."""

    def __init__(self, config: ButtonsConfig, name: str, n_arenas: int) -> None:
        n, cell_m = len(config.starts), config.cell_m
        self.config = config
        self._starts = np.array(config.starts, dtype=np.int32)
        self._buttons = np.array(config.buttons, dtype=np.int32)
        self._starts_m = self._centres(self._starts)
        self._cells = np.zeros((n_arenas, n, 2), dtype=np.int32)
        self._touched = np.zeros((n_arenas, len(config.buttons)), dtype=np.bool_)
        self._steps = np.zeros(n_arenas, dtype=np.int32)
        self._rewards = (config.reward_step, config.reward_button)
        self.spec = EnvSpec(
            scenario=name,
            robots=robot_names(n),
            roles=("robot",) * n,
            action_names=ACTIONS,
            stay_actions=(STAY,),
            obs_size=2,
            state_size=2 * (n + len(config.buttons)),
            episode_limit=config.episode_limit,
            dt_s=config.dt_s,
            bounds=(0.0, 1.0),
        )
        self.scene = Scene(
            arena_m=(config.columns * cell_m, config.rows * cell_m),
            cell_m=cell_m,
            radii_m=(config.robot.radius_m,) * n,
            sites_m=tuple((x, y) for x, y in self._centres(self._buttons).tolist()),
            site_name="button",
        )
        self.world = self._world(config, self.scene.arena_m)

    def begin(self, arena: int, seed: int, episode: int) -> Float64Array:
        """Every episode starts alike: the seed changes nothing here."""
        self._cells[arena] = self._starts
        self._touched[arena] = False
        self._steps[arena] = 0
        return self._starts_m

    def observe(self, running: BoolArray, world: World, out: Buffers) -> None:
        _observe(running, self._cells, self._buttons, self._scale(), out.obs, out.state)
        out.sites_done[:] = self._touched

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        config = self.config
        _command(
            running, actions, MOVES, self._cells, config.rows, config.cell_m, config.dt_s,
            config.robot.max_speed_mps, world.bodies, world.commands,
        )  # fmt: skip

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        config = self.config
        _read_cells(running, world.bodies, config.rows, config.columns, config.cell_m, self._cells)
        _score(
            running, self._cells, self._buttons, self._touched, self._steps,
            config.episode_limit, self._rewards, out.reward, out.terminated, out.success,
        )  # fmt: skip
        self.observe(running, world, out)

    def _scale(self) -> tuple[float, float]:
        return (float(self.config.rows - 1), float(self.config.columns - 1))

    def _centres(self, cells: IntArray) -> Float64Array:
        """(k, 2) (row, column) -> (k, 2) x, y in m of the cells' centres."""
        row, column = cells[:, 0].astype(np.float64), cells[:, 1].astype(np.float64)
        x = (column + 0.5) * self.config.cell_m
        y = (self.config.rows - row - 0.5) * self.config.cell_m
        return np.stack((x, y), axis=1)

    @staticmethod
    def _world(config: ButtonsConfig, arena_m: tuple[float, float]) -> WorldSpec:
        robot = config.robot
        # The walls' inner faces touch a robot at the centre of a border cell, so a robot that
        # pushes against a wall is held there.
        inset_m = config.cell_m / 2 - robot.radius_m
        thickness_m = config.cell_m
        return WorldSpec(
            # One group: robots may share a cell, so they pass through each other.
            discs=(DiscSpec(robot.radius_m, robot.mass_kg, robot.friction, group=1),)
            * len(config.starts),
            walls_m=box_walls(*arena_m, inset_m, thickness_m),
            wall_radius_m=thickness_m,
            wall_friction=robot.friction,
            dt_s=config.dt_s,
            substeps=config.physics.substeps,
            iterations=config.physics.iterations,
            # A dent in a wall is gone after one substep: the robot is back at its centre.
            slop_m=0.0,
            penetration_left=0.0,
        )


@entry
def _command(running, actions, moves, cells, rows, cell_m, dt_s, max_speed_mps, bodies, commands):  # type: ignore[no-untyped-def]
    """Velocity that takes each robot from where it is to the centre of the cell it was told.

    Starting from the true position, not from the cell's centre, errors cannot add up.
    """
    for b in range(actions.shape[0]):
        if not running[b]:
            continue
        for i in range(actions.shape[1]):
            move = moves[actions[b, i]]
            x = (cells[b, i, 1] + move[1] + 0.5) * cell_m
            y = (rows - (cells[b, i, 0] + move[0]) - 0.5) * cell_m
            vx = (x - bodies[b, i, 0]) / dt_s
            vy = (y - bodies[b, i, 1]) / dt_s
            speed = np.sqrt(vx * vx + vy * vy)
            if speed > max_speed_mps:
                vx *= max_speed_mps / speed
                vy *= max_speed_mps / speed
            commands[b, i, 0] = vx
            commands[b, i, 1] = vy


@entry
def _read_cells(running, bodies, rows, columns, cell_m, cells):  # type: ignore[no-untyped-def]
    """The cell in which each robot's centre lies, from the physics."""
    for b in range(cells.shape[0]):
        if not running[b]:
            continue
        for i in range(cells.shape[1]):
            column = int(np.floor(bodies[b, i, 0] / cell_m))
            row = rows - 1 - int(np.floor(bodies[b, i, 1] / cell_m))
            cells[b, i, 0] = min(max(row, 0), rows - 1)
            cells[b, i, 1] = min(max(column, 0), columns - 1)


@entry
def _score(running, cells, buttons, touched, steps, limit, rewards, reward, terminated, success):  # type: ignore[no-untyped-def]
    for b in range(cells.shape[0]):
        if not running[b]:
            continue
        steps[b] += 1
        new = 0
        done = True
        for m in range(buttons.shape[0]):
            for i in range(cells.shape[1]):
                here = cells[b, i, 0] == buttons[m, 0] and cells[b, i, 1] == buttons[m, 1]
                if here and not touched[b, m]:
                    touched[b, m] = True
                    new += 1
            done = done and touched[b, m]
        reward[b] = new * rewards[1] if new > 0 else rewards[0]
        success[b] = done
        terminated[b] = done or steps[b] >= limit


@entry
def _observe(running, cells, buttons, scale, obs, state):  # type: ignore[no-untyped-def]
    n, m = cells.shape[1], buttons.shape[0]
    for b in range(cells.shape[0]):
        if not running[b]:
            continue
        for i in range(n):
            for k in range(2):
                obs[b, i, k] = cells[b, i, k] / scale[k]
                state[b, 2 * i + k] = obs[b, i, k]
        for j in range(m):
            for k in range(2):
                state[b, 2 * (n + j) + k] = buttons[j, k] / scale[k]


KIND = Kind(ButtonsConfig, Buttons)
