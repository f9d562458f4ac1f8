"""The physics engine's wrapper: bits, memory and row order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import psutil
import pymunk
import pytest

from sim_pkg.world import (
    BoxSpec,
    DiscSpec,
    Float64Array,
    World,
    WorldSpec,
    box_walls,
)

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
# The same, with limited drives (but for the last disc), a box, and speed-dependent resistance.
HEAVY = replace(
    SPEC,
    discs=tuple(replace(d, drive_n=30.0 + i) for i, d in enumerate(SPEC.discs[:4]))
    + SPEC.discs[4:],
    boxes=(BoxSpec(1.2, 0.8, 20.0, 0.3, floor_arm_m=0.4),),
    speed_left=0.4,
)
BOX_M = np.array([[3.0, 4.2]])
STARTS_M = np.array([[1.0, 1.0], [2.0, 1.2], [3.0, 3.0], [4.2, 3.1], [2.5, 4.6]])


def commands(seed: int, steps: int) -> Float64Array:
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (steps, 5, 2))


def run(world: World, arena: int, velocities: Float64Array) -> Float64Array:
    """(steps, bodies, 4) of an episode; the floor holds a box with 20 to 60 N in turn."""
    running = np.zeros(len(world.bodies), dtype=np.bool_)
    running[arena] = True
    boxes = world.floor_n.shape[1]
    world.place(arena, np.concatenate((STARTS_M, BOX_M[:boxes])))
    path = []
    for step, command in enumerate(velocities):
        world.commands[arena] = command
        world.floor_n[arena] = floor_n(step)
        world.advance(running)
        path.append(np.concatenate((world.bodies[arena], world.turns[arena]), axis=1))
    return np.array(path)


def floor_n(step: int) -> float:
    return 20.0 + 10.0 * (step % 5)


class Reference:
    """The same scenes on pymunk's public classes alone."""

    def __init__(self, spec: WorldSpec) -> None:
        self.space = space = pymunk.Space()
        space.iterations, space.collision_slop, space.collision_bias = 10, 0.01, 0.001
        space.damping = spec.speed_left
        for x1, y1, x2, y2 in WALLS:
            wall = pymunk.Segment(space.static_body, (x1, y1), (x2, y2), 0.5)
            wall.friction = 0.6
            space.add(wall)
        self.bodies: list[pymunk.Body] = []
        self.floors: list[tuple[pymunk.Constraint, pymunk.Constraint]] = []
        for disc, position in zip(spec.discs, STARTS_M.tolist(), strict=True):
            body = pymunk.Body(disc.mass_kg, float("inf"))
            body.position = position
            shape = pymunk.Circle(body, disc.radius_m)
            shape.filter = pymunk.ShapeFilter(group=disc.group)
            self.add(body, shape, disc.friction)
        for box, position in zip(spec.boxes, BOX_M.tolist(), strict=False):
            size = (box.width_m, box.height_m)
            body = pymunk.Body(box.mass_kg, pymunk.moment_for_box(box.mass_kg, size))
            body.position = position
            self.add(body, pymunk.Poly.create_box(body, size), box.friction)
            slide = pymunk.PivotJoint(space.static_body, body, (0, 0), (0, 0))
            turn = pymunk.GearJoint(space.static_body, body, 0, 1)
            self.floors.append((self.held(slide), self.held(turn)))
        self.commanded = self.bodies[: len(spec.discs)]
        for i, disc in enumerate(spec.discs):
            if disc.drive_n < float("inf"):
                motor = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
                space.add(motor)
                joint = pymunk.PivotJoint(motor, self.bodies[i], (0, 0), (0, 0))
                self.held(joint).max_force = disc.drive_n
                self.commanded[i] = motor

    def add(self, body: pymunk.Body, shape: pymunk.Shape, friction: float) -> None:
        shape.friction = friction
        self.space.add(body, shape)
        self.bodies.append(body)

    def held(self, joint: pymunk.Constraint) -> pymunk.Constraint:
        joint.max_bias = 0
        self.space.add(joint)
        return joint

    def run(self, velocities: Float64Array) -> Float64Array:
        path = []
        for step, command in enumerate(velocities.tolist()):
            for body, velocity in zip(self.commanded, command, strict=True):
                body.velocity = velocity
            for slide, turn in self.floors:
                slide.max_force, turn.max_force = floor_n(step), 0.4 * floor_n(step)
            for _ in range(4):
                self.space.step(0.125)
            path.append(
                [(*b.position, *b.velocity, b.angle, b.angular_velocity) for b in self.bodies]
            )
        return np.array(path)


@pytest.mark.parametrize("groups", [(0, 0, 0, 0, 0), (1, 0, 2, 1, 2)])
def test_same_bits_as_pymunks_public_classes(groups: tuple[int, ...]) -> None:
    """400 steps of colliding discs: equal in every bit to the documented API."""
    spec = replace(
        SPEC, discs=tuple(replace(d, group=g) for d, g in zip(SPEC.discs, groups, strict=True))
    )
    velocities = commands(0, 400)
    ours = run(World(spec, 1), 0, velocities)
    np.testing.assert_array_equal(ours, Reference(spec).run(velocities))
    free = STARTS_M[None] + np.cumsum(velocities, axis=0) * 0.5
    assert np.abs(ours[:, :, :2] - free).max() > 1.0, "nothing ever collided: the test is void"


def test_same_bits_with_limited_drives_and_a_box() -> None:
    velocities = commands(7, 400)
    ours = run(World(HEAVY, 1), 0, velocities)
    np.testing.assert_array_equal(ours, Reference(HEAVY).run(velocities))
    box = ours[:, 5]
    assert np.ptp(box[:, :2], axis=0).max() > 0.5, "the box never moved: the test is void"
    assert np.ptp(box[:, 4]) > 0.1, "the box never turned: the test is void"


def test_the_floor_holds_what_is_pushed_with_less_force_than_its_own() -> None:
    """One disc of 30 N against 31 N and 29 N of friction."""
    spec = replace(HEAVY, discs=HEAVY.discs[:1], speed_left=1.0)
    for friction_n, moves in ((31.0, False), (29.0, True)):
        world = World(spec, 1)
        world.place(0, np.array([[1.0, 3.0], [2.0, 3.0]]))
        world.commands[0] = (2.0, 0.0)
        world.floor_n[0] = friction_n
        for _ in range(40):
            world.advance(np.ones(1, dtype=np.bool_))
        assert (world.bodies[0, 1, 0] > 2.3) == moves


@pytest.mark.parametrize("spec", [SPEC, HEAVY])
def test_an_episode_does_not_depend_on_the_ones_before(spec: WorldSpec) -> None:
    velocities = commands(1, 60)
    world = World(spec, 3)
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


def test_pymunk_is_the_version_whose_private_binding_is_called() -> None:
    assert pymunk.version == "7.3.1", "read the notes in chipmunk.py before changing the version"


def test_worlds_memory_is_never_replaced() -> None:
    world = World(SPEC, 2)
    address = world.bodies.__array_interface__["data"][0]
    run(world, 1, commands(6, 20))
    assert world.bodies.__array_interface__["data"][0] == address
    assert np.ptp(world.bodies[1, :, 0]) > 0
    np.testing.assert_array_equal(world.bodies[0], 0.0)


@pytest.mark.parametrize("spec", [SPEC, HEAVY])
def test_spaces_are_freed_with_their_episode_and_with_their_world(spec: WorldSpec) -> None:
    """Each takes some 100 KB: 2,000 that stayed would be 200 MB."""
    starts_m = np.concatenate((STARTS_M, BOX_M[: len(spec.boxes)]))

    def play(worlds: int, episodes: int) -> None:
        for _ in range(worlds):
            world = World(spec, 2)
            for _ in range(episodes):
                world.place(1, starts_m)
                world.advance(np.array([False, True]))

    play(10, 10)
    before = psutil.Process().memory_info().rss
    play(2, 1000)
    play(1000, 2)
    assert psutil.Process().memory_info().rss - before < 50e6


def test_an_arena_without_a_space_cannot_advance() -> None:
    world = World(SPEC, 2)
    world.place(0, STARTS_M)
    with pytest.raises(ValueError, match="nothing has been placed"):
        world.advance(np.ones(2, dtype=np.bool_))


def test_a_disc_that_is_taken_out_collides_with_nothing_and_keeps_its_row() -> None:
    velocities = np.zeros((8, 5, 2))
    velocities[:, 0, 0] = 1.0  # the first runs into the second
    world = World(SPEC, 1)
    blocked = run(world, 0, velocities)
    assert np.abs(blocked[-1, 1, :2] - STARTS_M[1]).max() > 0.1
    world.place(0, STARTS_M)
    world.take_out(np.arange(5)[None] == 1)
    running = np.ones(1, dtype=np.bool_)
    for velocity in velocities:
        world.commands[0] = velocity
        world.advance(running)
    np.testing.assert_allclose(world.bodies[0, 0, :2], STARTS_M[0] + (4.0, 0.0), atol=1e-9)
    np.testing.assert_array_equal(world.bodies[0, 1:, :2], STARTS_M[1:])
    # The next episode has it again.
    np.testing.assert_array_equal(run(world, 0, velocities), blocked)


def test_energy_fades_when_nothing_drives() -> None:
    """Knocks, dry friction and braking drives: the kinetic energy never grows."""
    spec = replace(HEAVY, discs=tuple(replace(d, drive_n=2.0) for d in HEAVY.discs[:4]))
    world = World(spec, 1)
    world.place(0, np.concatenate((STARTS_M[:4], BOX_M)))
    masses = np.array([d.mass_kg for d in spec.discs] + [20.0])
    inertia = 20.0 * (1.2**2 + 0.8**2) / 12
    fades = 0
    for velocities in commands(8, 60)[:, :4]:
        world.commands[0], world.floor_n[0] = velocities, 1.0
        for _ in range(6):
            world.advance(np.ones(1, dtype=np.bool_))
        world.commands[0] = 0.0
        energy = np.inf
        for _ in range(4):
            world.advance(np.ones(1, dtype=np.bool_))
            speeds = (world.bodies[0, :, 2:] ** 2).sum(axis=1)
            now = float((masses * speeds).sum() + inertia * world.turns[0, 4, 1] ** 2) / 2
            assert now <= energy + 1e-12  # rounding, at rest
            fades += now + 1e-6 < energy < np.inf
            energy = now
    assert fades > 30, "everything was at rest: the test is void"
