"""Environment steps per CPU second of the simulator alone: random available actions, one core; and
its physics beside the same scene on pymunk's classes.

python benchmarks/bench_sim.py
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pymunk
from numba import njit

from sim_pkg.env import Env, make_env
from sim_pkg.world import Float64Array, World, WorldSpec

SECONDS = 1.5
REPEATS = 3
WARM_UP_STEPS = 50
# Scenario, arenas, target. For buttons 20,000 steps/s with 32 arenas including acting are wanted,
# which needs about 40 % of it.
CASES: tuple[tuple[str, int, float | None], ...] = (
    ("buttons", 1, None),
    ("buttons", 32, 20_000 / 0.6),
    ("buttons", 64, None),
    ("skirmish/3s5z_vs_3s5z", 1, 5_000),
    ("skirmish/3s5z_vs_3s5z", 64, 25_000),
    ("skirmish/3s_vs_5z", 1, 5_000),
    ("skirmish/3s_vs_5z", 64, 45_000),
)


PHYSICS = "skirmish/3s_vs_5z"
PHYSICS_ARENAS = 64
TIMED_ADVANCES = 200
FASTEST_MPS = 3.0


class _Play:
    """Random actions; an arena whose episode ends starts its next one at once."""

    def __init__(self, env: Env) -> None:
        self._env = env
        spec = env.spec
        rng = np.random.default_rng(0)
        shape = (256, env.n_arenas, spec.n_robots)
        self._numbers = rng.random(shape, dtype=np.float32)
        self._actions = np.zeros(shape[1:], dtype=np.int32)
        self._next_episode = env.n_arenas
        env.reset(np.arange(env.n_arenas), 0, np.arange(env.n_arenas))

    def steps(self, count: int) -> None:
        env = self._env
        for k in range(count):
            _choose(env.available, self._numbers[k % len(self._numbers)], self._actions)
            env.step(self._actions)
            ended = np.flatnonzero(~env.running)
            if ended.size:
                first = self._next_episode
                self._next_episode += ended.size
                env.reset(ended, 0, np.arange(first, self._next_episode))


@njit(cache=True)
def _choose(available, numbers, actions):  # type: ignore[no-untyped-def]
    """Of each robot's available actions one at random; numbers: (B, n) in 0..1."""
    for b in range(actions.shape[0]):
        for i in range(actions.shape[1]):
            left = int(numbers[b, i] * available[b, i].sum())
            for a in range(available.shape[2]):
                if available[b, i, a]:
                    if left == 0:
                        actions[b, i] = a
                        break
                    left -= 1


def steps_per_s(scenario: str, n_arenas: int) -> float:
    """The best of a few runs: other processes can only slow one down."""
    play = _Play(make_env(scenario, n_arenas))
    play.steps(WARM_UP_STEPS)
    chunk = max(1, 512 // n_arenas)
    best = 0.0
    for _ in range(REPEATS):
        start, done = time.process_time(), 0
        while (spent := time.process_time() - start) < SECONDS / REPEATS:
            play.steps(chunk)
            done += chunk * n_arenas
        best = max(best, done / spent)
    return best


class _Pymunk:
    """Arenas of a world of discs as a user of pymunk builds them."""

    def __init__(self, spec: WorldSpec, starts_m: Float64Array) -> None:
        self._spec = spec
        self._arenas = [self._arena(positions_m) for positions_m in starts_m.tolist()]
        self.bodies = np.zeros((*starts_m.shape[:2], 4))

    def _arena(self, starts_m: list[tuple[float, float]]) -> tuple[pymunk.Space, list[pymunk.Body]]:
        spec, space = self._spec, pymunk.Space()
        space.iterations = spec.iterations
        space.collision_slop, space.collision_bias = spec.slop_m, spec.penetration_left
        for x1, y1, x2, y2 in spec.walls_m:
            space.add(pymunk.Segment(space.static_body, (x1, y1), (x2, y2), spec.wall_radius_m))
        bodies = []
        for disc, position_m in zip(spec.discs, starts_m, strict=True):
            body = pymunk.Body(disc.mass_kg, float("inf"))
            body.position = position_m
            shape = pymunk.Circle(body, disc.radius_m)
            shape.friction = disc.friction
            space.add(body, shape)
            bodies.append(body)
        return space, bodies

    def advance(self, commands: Float64Array) -> None:
        spec = self._spec
        for (space, bodies), velocities, seen in zip(
            self._arenas, commands.tolist(), self.bodies, strict=True
        ):
            for body, velocity in zip(bodies, velocities, strict=True):
                body.velocity = velocity
            for _ in range(spec.substeps):
                space.step(spec.dt_s / spec.substeps)
            seen[:] = [(*body.position, *body.velocity) for body in bodies]


def physics_rates() -> tuple[float, float]:
    """Advances of an arena per CPU second: ours, and pymunk's. Both see the same velocities.

    Raises:
        RuntimeError: the two did not end in the same bits.
    """
    env = make_env(PHYSICS, PHYSICS_ARENAS)
    env.reset(np.arange(PHYSICS_ARENAS), 0, np.arange(PHYSICS_ARENAS))
    starts_m = env.world.bodies[:, :, :2].copy()
    world, reference = World(env.world.spec, PHYSICS_ARENAS), _Pymunk(env.world.spec, starts_m)
    for arena, positions_m in enumerate(starts_m):
        world.place(arena, positions_m)
    rng, running = np.random.default_rng(0), np.ones(PHYSICS_ARENAS, dtype=np.bool_)
    spent = [0.0, 0.0]
    for k in range(WARM_UP_STEPS + TIMED_ADVANCES):
        commands = rng.uniform(-FASTEST_MPS, FASTEST_MPS, world.commands.shape)
        times = [time.process_time()]
        world.commands[:] = commands
        world.advance(running)
        times.append(time.process_time())
        reference.advance(commands)
        times.append(time.process_time())
        if k >= WARM_UP_STEPS:
            spent = [total + t for total, t in zip(spent, np.diff(times).tolist(), strict=True)]
    if not np.array_equal(world.bodies, reference.bodies):
        raise RuntimeError("the physics and pymunk's classes differ")
    return TIMED_ADVANCES * PHYSICS_ARENAS / spent[0], TIMED_ADVANCES * PHYSICS_ARENAS / spent[1]


def rows() -> list[dict[str, Any]]:
    """One row per scenario and batch size: {name, value, unit, reference, ratio, target, ok}; and
    one of the physics.

    No reference: no other implementation of this scenario exists.
    """
    result = []
    for scenario, n_arenas, target in CASES:
        value = steps_per_s(scenario, n_arenas)
        result.append(
            {
                "name": f"sim {scenario.split('/')[-1]} {n_arenas} arena{'s' * (n_arenas > 1)}",
                "value": value,
                "unit": "steps/s",
                "reference": None,
                "ratio": None,
                "target": target,
                "ok": target is None or value >= target,
            }
        )
    ours, pymunks = physics_rates()
    result.append(
        {
            "name": f"physics of {PHYSICS}, {PHYSICS_ARENAS} arenas, and pymunk's classes",
            "value": ours,
            "unit": "advances/s",
            "reference": pymunks,
            "ratio": ours / pymunks,
            "target": None,
            "ok": None,
        }
    )
    return result


if __name__ == "__main__":
    print(json.dumps(rows(), indent=2))
