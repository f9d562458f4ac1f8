"""The physics engine's wrapper: bits, memory and row order."""

from __future__ import annotations

import numpy as np
import pymunk
from pymunk import batch

from sim_pkg.world import SPARE_DOUBLES, DiscSpec, Float64Array, World, WorldSpec, box_walls

WALLS = box_walls(6.0, 6.0, 0.0, 0.5)
SPEC = WorldSpec(
    discs=tuple(DiscSpec(0.3 + 0.05 * i, 1.0 + i, 0.4, group=0) for i in range(5)),
    walls_m=WALLS,
    wall_radius_m=0.5,
    wall_friction=0.6,
    dt_s=0.5,
    substeps=4,
    iterations=10,
    slop_m=0.01,
    penetration_left=0.001,
)
STARTS_M = np.array([[1.0, 1.0], [2.0, 1.2], [3.0, 3.0], [4.2, 3.1], [2.5, 4.6]])


def commands(seed: int, steps: int) -> Float64Array:
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (steps, 5, 2))


def run(world: World, arena: int, velocities: Float64Array) -> Float64Array:
    running = np.zeros(len(world.bodies), dtype=np.bool_)
    running[arena] = True
    world.place(arena, STARTS_M)
    path = []
    for command in velocities:
        world.commands[arena] = command
        world.advance(running)
        path.append(world.bodies[arena].copy())
    return np.array(path)


def reference(velocities: Float64Array) -> Float64Array:
    """The same scene on pymunk's public classes alone."""
    space = pymunk.Space()
    space.iterations, space.collision_slop, space.collision_bias = 10, 0.01, 0.001
    for x1, y1, x2, y2 in WALLS:
        wall = pymunk.Segment(space.static_body, (x1, y1), (x2, y2), 0.5)
        wall.friction = 0.6
        space.add(wall)
    bodies = []
    for disc, position in zip(SPEC.discs, STARTS_M.tolist(), strict=True):
        body = pymunk.Body(disc.mass_kg, float("inf"))
        body.position = position
        shape = pymunk.Circle(body, disc.radius_m)
        shape.friction = disc.friction
        space.add(body, shape)
        bodies.append(body)
    path = []
    for command in velocities.tolist():
        for body, velocity in zip(bodies, command, strict=True):
            body.velocity = velocity
        for _ in range(4):
            space.step(0.125)
        path.append([(*b.position, *b.velocity) for b in bodies])
    return np.array(path)


def test_same_bits_as_pymunks_public_classes() -> None:
    """400 steps of colliding discs: equal in every bit to the documented API."""
    velocities = commands(0, 400)
    ours = run(World(SPEC, 1), 0, velocities)
    np.testing.assert_array_equal(ours, reference(velocities))
    free = STARTS_M[None] + np.cumsum(velocities, axis=0) * 0.5
    assert np.abs(ours[:, :, :2] - free).max() > 1.0, "nothing ever collided: the test is void"


def test_an_episode_does_not_depend_on_the_ones_before() -> None:
    velocities = commands(1, 60)
    world = World(SPEC, 3)
    first = run(world, 1, velocities)
    for seed in (2, 3, 4):
        run(world, 1, commands(seed, 40))
    np.testing.assert_array_equal(run(world, 1, velocities), first)


def test_discs_stay_inside_and_apart() -> None:
    path = run(World(SPEC, 1), 0, commands(5, 500))
    radii = np.array([d.radius_m for d in SPEC.discs])
    assert np.isfinite(path).all()
    # A disc may dent a wall by one substep's way at full speed (2.5 m/s on each axis).
    dent_m = 2.5 * 0.125
    assert (path[:, :, :2] > radii[:, None] - dent_m).all()
    assert (path[:, :, :2] < 6.0 - radii[:, None] + dent_m).all()
    gaps = np.linalg.norm(path[:, :, None, :2] - path[:, None, :, :2], axis=-1)
    gaps -= radii[:, None] + radii[None, :]
    gaps[:, np.arange(5), np.arange(5)] = np.inf
    assert gaps.min() > -2 * dent_m


def test_rows_are_in_order_of_creation_and_the_memory_stays() -> None:
    """pymunk's batch functions are experimental: what this project relies on, pinned."""
    assert pymunk.version == "7.3.1", "read the notes in world.py before changing the version"
    space = pymunk.Space()
    space.add(pymunk.Segment(space.static_body, (0, -5), (9, -5), 0.1))
    for i in range(4):
        body = pymunk.Body(1, 1)
        body.position = (i, 10 * i)
        space.add(body, pymunk.Circle(body, 0.1))
    memory = np.full(5 * 2 + SPARE_DOUBLES, np.nan)
    buffer = batch.Buffer()
    buffer.set_float_buf(memory)
    address = memory.__array_interface__["data"][0]
    for _ in range(3):
        space.step(0.1)  # nothing moves: at rest, no gravity, apart
        buffer.clear()
        batch.get_space_bodies(space, batch.BodyFields.POSITION, buffer)
        written = np.frombuffer(buffer.float_buf())
        assert written.__array_interface__["data"][0] == address
        expected = [(i, 10 * i) for i in range(4)] + [(0, 0)]  # the static body comes last
        np.testing.assert_array_equal(written.reshape(5, 2), expected)


def test_worlds_memory_is_never_replaced() -> None:
    world = World(SPEC, 2)
    address = world.bodies.__array_interface__["data"][0]
    run(world, 1, commands(6, 20))
    assert world.bodies.__array_interface__["data"][0] == address
    assert np.ptp(world.bodies[1, :, 0]) > 0
    np.testing.assert_array_equal(world.bodies[0], 0.0)
