"""SMAC's combat as a decision problem on discs: a team against scripted opponents.

A control step of ``dt_s`` has two phases. In each, every unit is commanded a velocity, the physics
advances, and the fight goes on for the phase's ticks of 1/16 s (combat.py), with each
unit on the straight line between its places before and after. So a chaser corrects its course
every 0.25 s and a shot's moment is exact to a tick, whatever the physics' substeps are. Two phases
are a compromise: with one, zealots lag behind whom they chase (the scripted `kite` needs about 130
steps on 3s_vs_5z instead of 145 with two and 170 with four); four cost 1.4 times as much as two.

Reward of a step: (the health and shield that the opponents lost, less what they regained, + 10
per kill, + 200 for the win) x 20 / (their health and shield at the start + 10 each + 200), so a
win sums to 20. The task ends with success when every opponent is dead and a robot lives; without
when no robot lives, also where the last of both teams die at once, or at ``episode_limit``.

The files: layout.py says where everything is in observations, state and actions;
config.py what a map and a unit type may say; tables.py holds both as arrays;
orders.py, brake.py, combat.py and observe.py are compiled, and phases.py, which joins them.

Chance is in the starts (``jitter_m``) and in a random extra on the cooldown of every attack: the
k-th attack of a unit draws the k-th number of a table. Both depend on (seed, episode) alone.
"""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray, EnvSpec, FloatArray, IntArray
from sim_pkg.scenarios.base import Actor, Buffers, Kind, Scene, Side, episode_rng, robot_names
from sim_pkg.scenarios.skirmish import observe, phases
from sim_pkg.scenarios.skirmish.config import PHASES, TICK_S, SkirmishConfig
from sim_pkg.scenarios.skirmish.layout import (
    NO_OP,
    STATE_HEALTH,
    STATE_OPPONENT_HEALTH,
    STATE_OPPONENT_SHIELD,
    STATE_SHIELD,
    STOP,
)
from sim_pkg.scenarios.skirmish.tables import ALIVE, Fight, Tables
from sim_pkg.world import DiscSpec, Float64Array, World, WorldSpec

WALL_RADIUS_M = 1.0
SLOP_M = 0.002  # an overlap that the contact solver leaves alone; less makes contacts flicker
PENETRATION_LEFT = 1e-6  # after a second: what a contact could not prevent is soon undone


class Skirmish:
    """The scenario over ``n_arenas`` arenas; hooks as in base.Scenario."""

    def __init__(self, config: SkirmishConfig, name: str, n_arenas: int) -> None:
        self.config = config
        self.layout = layout = config.layout
        self._n = len(config.robots)
        self._tables = tables = Tables.of(config)
        self._fight = Fight.allocate(tables, n_arenas)
        d = len(config.placed)
        self._hits = np.zeros((n_arenas, d, d), dtype=np.float32)
        # Whose disc still collides.
        self._inside = np.zeros((n_arenas, d), dtype=np.bool_)
        self._phase = 0
        self._gather_arguments()
        self.spec = EnvSpec(
            scenario=name,
            robots=robot_names(self._n),
            roles=tuple(placed.unit for placed in config.robots),
            action_names=layout.action_names,
            stay_actions=(STOP, NO_OP),
            dead_actions=(NO_OP,),
            obs_size=layout.obs_size,
            state_size=layout.state_size,
            episode_limit=config.episode_limit,
            dt_s=config.dt_s,
            bounds=(-1.0, 1.0),
        )
        self.scene = Scene(
            arena_m=config.arena_m,
            cell_m=0.0,
            radii_m=tuple(unit.radius_m for unit in config.units[: self._n]),
            sites_m=(),
            walled_m=config.free_m,
            actors=_actors(config, self.spec.robots),
            vitals=self._vitals,
        )
        self.world = _world(config)

    def _gather_arguments(self) -> None:
        """For phases.py, by what needs them: every call, fighting, moving, scoring and seeing."""
        config, tables, fight = self.config, self._tables, self._fight
        phase_s = config.dt_s / PHASES
        habits = (config.behaviour.help_m, config.behaviour.patience_s)
        self._units = (tables.units, tables.reach_m, fight.real, fight.whole, self._hits)
        self._fighting = (
            round(phase_s / TICK_S), TICK_S, tables.hits_s, tables.damage, fight.extras_s,
            fight.clock_s,
        )  # fmt: skip
        self._moving = (
            phase_s, tables.acquire_m, tables.leash_m, habits, tables.goal_m, tables.free_m,
        )  # fmt: skip
        health, count = tables.standing
        full_reward = health + observe.REWARD_KILL * count + observe.REWARD_WIN
        self._scoring = (config.episode_limit, full_reward, fight.steps, fight.standing)
        shields = (int(self.layout.robot_shields), int(self.layout.opponent_shields))
        self._seeing = (shields, tables.type_bits, tables.free_m, config.arena_m)

    def _vitals(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        layout = self.layout
        parts = layout.split_state(state)
        robots, opponents = parts.robots, parts.opponents
        health = (robots[:, STATE_HEALTH], opponents[:, STATE_OPPONENT_HEALTH])
        shield = (
            robots[:, STATE_SHIELD] if layout.robot_shields else np.zeros(layout.n_robots),
            opponents[:, STATE_OPPONENT_SHIELD]
            if layout.opponent_shields
            else np.zeros(layout.n_opponents),
        )
        return np.concatenate(health), np.concatenate(shield).astype(np.float32)

    def begin(self, arena: int, seed: int, episode: int) -> Float64Array:
        """All whole and at their starts."""
        self._inside[arena] = True
        return self._fight.begin(self._tables, arena, episode_rng(seed, episode))

    def observe(self, running: BoolArray, world: World, out: Buffers) -> None:
        fight = self._fight
        observe.observe(
            running, self._n, world.bodies, self._tables.units, fight.real, fight.whole,
            fight.clock_s, *self._seeing, out.obs, out.state, out.available,
        )  # fmt: skip

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        if phases.move(
            self._phase == 0, running, actions, self._n, world.bodies, *self._units,
            *self._fighting, *self._moving, world.commands,
        ):  # fmt: skip
            self._take_out_the_dead(running, world)
        self._phase += 1

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        self._phase = 0
        if phases.end(
            running, self._n, world.bodies, *self._units, *self._fighting, *self._scoring,
            out.reward, out.terminated, out.success, *self._seeing, out.obs, out.state,
            out.available,
        ):  # fmt: skip
            self._take_out_the_dead(running, world)
        out.hits[:] = self._hits

    def _take_out_the_dead(self, running: BoolArray, world: World) -> None:
        alive = self._fight.whole[:, :, ALIVE] != 0
        world.take_out(self._inside & ~alive & running[:, None])
        self._inside &= alive


def _actors(config: SkirmishConfig, robots: tuple[str, ...]) -> tuple[Actor, ...]:
    names = (*robots, *(f"opponent_{j + 1}" for j in range(len(config.opponents))))
    return tuple(
        Actor(name, placed.unit, Side(int(i >= len(robots))), unit.radius_m)
        for i, (name, placed, unit) in enumerate(
            zip(names, config.placed, config.units, strict=True)
        )
    )


def _world(config: SkirmishConfig) -> WorldSpec:
    west, south, east, north = config.free_m
    left, right = west - WALL_RADIUS_M, east + WALL_RADIUS_M
    low, top = south - WALL_RADIUS_M, north + WALL_RADIUS_M
    return WorldSpec(
        discs=tuple(DiscSpec(u.body_radius_m, u.mass_kg, u.friction) for u in config.units),
        walls_m=(
            (left, low, right, low),
            (right, low, right, top),
            (right, top, left, top),
            (left, top, left, low),
        ),
        wall_radius_m=WALL_RADIUS_M,
        wall_friction=0.0,
        dt_s=config.dt_s / PHASES,
        substeps=config.physics.substeps // PHASES,
        iterations=config.physics.iterations,
        slop_m=SLOP_M,
        penetration_left=PENETRATION_LEFT,
    )


KIND = Kind(SkirmishConfig, Skirmish)
