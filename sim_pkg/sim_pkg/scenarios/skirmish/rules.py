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
orders.py, brake.py, combat.py and observe.py are compiled.

Chance is in the starts (``jitter_m``) and in a random extra on the cooldown of every attack: the
k-th attack of a unit draws the k-th number of a table. Both depend on (seed, episode) alone.
"""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray, EnvSpec, FloatArray, IntArray
from sim_pkg.scenarios.base import Actor, Buffers, Kind, Scene, Side, episode_rng, robot_names
from sim_pkg.scenarios.skirmish import brake, combat, observe, orders
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
        self._phase_s = config.dt_s / PHASES
        self._phase = 0
        self._habits = (config.behaviour.help_m, config.behaviour.patience_s)
        health, count = tables.standing
        self._full_reward = health + observe.REWARD_KILL * count + observe.REWARD_WIN
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
        tables, fight, layout = self._tables, self._fight, self.layout
        shields = (int(layout.robot_shields), int(layout.opponent_shields))
        observe.observe(
            running, self._n, shields, world.bodies, tables.units, tables.type_bits,
            tables.free_m, self.config.arena_m, fight.clock_s, fight.real, fight.whole, out.obs,
            out.state, out.available,
        )  # fmt: skip

    def command(self, running: BoolArray, actions: IntArray, world: World) -> None:
        tables, fight = self._tables, self._fight
        if self._phase == 0:
            orders.take_orders(running, actions, world.bodies, fight.real, fight.whole)
            self._hits[:] = 0.0
        else:
            self._fight_on(running, world)
        self._phase += 1
        orders.drive(
            running, self._n, self._phase_s, world.bodies, tables.units, tables.reach_m,
            tables.acquire_m, tables.leash_m, self._habits, tables.goal_m, fight.real, fight.whole,
            world.commands,
        )  # fmt: skip
        brake.brake(
            running, self._phase_s, world.bodies, tables.units, tables.free_m, fight.whole,
            world.commands,
        )  # fmt: skip

    def settle(self, running: BoolArray, world: World, out: Buffers) -> None:
        fight = self._fight
        self._fight_on(running, world)
        self._phase = 0
        out.hits[:] = self._hits
        observe.score(
            running, self._n, self.config.episode_limit, self._full_reward, fight.real,
            fight.whole, fight.steps, fight.standing, out.reward, out.terminated, out.success,
        )  # fmt: skip
        self.observe(running, world, out)

    def _fight_on(self, running: BoolArray, world: World) -> None:
        """The ticks of the phase that the physics has just been through."""
        tables, fight = self._tables, self._fight
        deaths = combat.fight(
            running, round(self._phase_s / TICK_S), TICK_S, world.bodies, tables.units,
            tables.hits_s, tables.damage, tables.reach_m, fight.extras_s, fight.clock_s,
            fight.real, fight.whole, self._hits,
        )  # fmt: skip
        if deaths:
            alive = fight.whole[:, :, ALIVE] != 0
            for arena, disc in np.argwhere(self._inside & ~alive & running[:, None]).tolist():
                world.take_out(arena, disc)
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
