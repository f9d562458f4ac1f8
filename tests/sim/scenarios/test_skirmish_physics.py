"""The skirmish's bodies: apart, inside, finite, no energy from nowhere, alike in a mirror."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from skirmish_maps import load_map, random_actions, write_map

from sim_pkg.env import Env, make_env
from sim_pkg.scenario_files import SCENARIOS_DIR
from sim_pkg.scenarios.skirmish.layout import FIRST_ATTACK, NORTH, SOUTH
from sim_pkg.scenarios.skirmish.rules import Skirmish
from sim_pkg.scripted.base import make_scripted
from sim_pkg.world import World


def check_bodies(env: Env, alive: np.ndarray) -> None:
    """After a step: nobody overlaps by more than 5 % of a radius, or with a wall."""
    config = env.config
    radii = np.array([unit.body_radius_m for unit in config.units])  # type: ignore[attr-defined]
    bodies = env.world.bodies
    assert np.isfinite(bodies).all()
    places = bodies[:, :, :2]
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    gaps -= radii[:, None] + radii[None, :]
    gaps[~(alive[:, :, None] & alive[:, None, :])] = np.inf
    gaps[:, np.arange(len(radii)), np.arange(len(radii))] = np.inf
    assert (gaps > -0.05 * np.minimum(radii[:, None], radii[None, :])).all()
    low, high = np.array(config.free_m[:2]), np.array(config.free_m[2:])  # type: ignore[attr-defined]
    slack = (0.95 * radii)[:, None]
    assert ((places >= low + slack) & (places <= high - slack)).all()


def alive_of(env: Env) -> np.ndarray:
    """(B, d)"""
    layout = env.config.layout  # type: ignore[attr-defined]
    parts = layout.split_state(env.state)
    return np.concatenate((parts.robots[:, :, 0], parts.opponents[:, :, 0]), axis=1) > 0


def fuzz(name: str, steps: int, seed: int) -> None:
    """Half the arenas at random, half with everyone driving into a corner for a while."""
    env = make_env(f"skirmish/{name}", 16)
    rng = np.random.default_rng(seed)
    env.reset(np.arange(16), seed, np.arange(16))
    episode = 16
    for step in range(steps // 16):
        actions = random_actions(env, rng)
        drawn = np.full((8, env.spec.n_robots), NORTH + (step // 12) % 4, dtype=np.int32)
        may = np.take_along_axis(env.available[8:], drawn[:, :, None], axis=2)[:, :, 0]
        actions[8:] = np.where(may, drawn, actions[8:])
        before = env.world.bodies[:, :, :2].copy()
        env.step(actions)
        check_bodies(env, alive_of(env))
        ways = np.linalg.norm(env.world.bodies[:, :, :2] - before, axis=-1)
        assert ways.max() <= 0.5 * 2.953 + 0.02, "nobody is faster than its speed"
        ended = np.flatnonzero(~env.running)
        env.reset(ended, seed, episode + np.arange(len(ended)))
        episode += len(ended)


@pytest.mark.parametrize("name", ["3s_vs_5z", "3s5z_vs_3s5z", "8m"])
def test_fuzz(name: str) -> None:
    fuzz(name, 10_000, 3)


@pytest.mark.soak
@pytest.mark.parametrize("name", ["3s_vs_5z", "3s5z_vs_3s5z", "8m", "8s_vs_3s5z"])
@pytest.mark.parametrize("seed", range(4))
def test_fuzz_at_length(name: str, seed: int) -> None:
    fuzz(name, 100_000, seed)


@pytest.mark.parametrize("policy", ["nearest", "focus"])
def test_bodies_in_a_melee(policy: str) -> None:
    env = make_env("skirmish/3s5z_vs_3s5z", 16)
    team = make_scripted(policy, env)
    numbers = np.arange(16)
    env.reset(numbers, 0, numbers)
    team.begin(numbers, 0, numbers)
    actions = np.zeros((16, env.spec.n_robots), dtype=np.int32)
    while env.running.any():
        team.act(env.obs, env.available, actions)
        env.step(actions)
        check_bodies(env, alive_of(env))


def test_energy_does_not_grow_when_nobody_drives() -> None:
    """Discs thrown at each other in the skirmish's world: contacts and walls only take energy."""
    config = load_map("skirmish/3s5z_vs_3s5z")
    spec = Skirmish(config, "thrown", 1).world
    mass = np.array([disc.mass_kg for disc in spec.discs])
    rng = np.random.default_rng(4)
    collisions = 0
    for _ in range(20):
        world = World(spec, 1)
        world.place(0, np.array([placed.start_m for placed in config.placed]))
        world.commands[0] = rng.uniform(-3, 3, (len(mass), 2))
        energy = float((mass * (world.commands[0] ** 2).sum(axis=1)).sum() / 2)
        for _ in range(40):
            world.advance(np.ones(1, dtype=np.bool_))
            after = float((mass * (world.bodies[0, :, 2:] ** 2).sum(axis=1)).sum() / 2)
            assert after <= energy * (1 + 1e-9)
            collisions += after < energy * (1 - 1e-6)
            energy = after
            world.commands[0] = world.bodies[0, :, 2:]
    assert collisions > 100, "nothing ever collided: the test is void"


def test_even_duels_are_even(tmp_path: Path) -> None:
    """Marine against marine, both within reach from the start: neither side is favoured."""
    path = write_map(tmp_path, [("marine", 10, 16)], [("marine", 15.6, 16)])
    n = 512
    env = make_env(path, n)
    env.reset(np.arange(n), 0, np.arange(n))
    won = lost = 0
    while env.running.any():
        attack = env.available[:, :, FIRST_ATTACK]
        result = env.step(np.where(attack, FIRST_ATTACK, env.available[:, :, 1]).astype(np.int32))
        won += int(result.success.sum())
        ended = result.terminated & ~result.success
        opponent_left = env.state[:, 4] > 0
        lost += int((ended & opponent_left).sum())
    assert won + lost > 300
    assert abs(won - lost) < 4 * np.sqrt(won + lost), (won, lost)


def outcome(path: Path, episodes: int, seed: int) -> tuple[float, float]:
    """Mean and standard error of the return of ``nearest``."""
    env = make_env(path, episodes)
    team = make_scripted("nearest", env)
    numbers = np.arange(episodes)
    env.reset(numbers, seed, numbers)
    team.begin(numbers, seed, numbers)
    actions = np.zeros((episodes, env.spec.n_robots), dtype=np.int32)
    sums = np.zeros(episodes)
    while env.running.any():
        team.act(env.obs, env.available, actions)
        sums += env.step(actions).reward
    return float(sums.mean()), float(sums.std() / np.sqrt(episodes))


def test_a_mirrored_map_is_the_same_task_in_expectation(tmp_path: Path) -> None:
    """North and south exchanged, with a formation that is not symmetric by itself."""
    values = yaml.safe_load((SCENARIOS_DIR / "skirmish" / "2s3z.yaml").read_text())
    for k, placed in enumerate(values["robots"]):
        placed["start_m"][1] -= 0.4 * k
    paths = []
    for name, sign in (("plain", 1), ("mirrored", -1)):
        for team in ("robots", "opponents"):
            for placed in values[team]:
                x, y = placed["start_m"]
                placed["start_m"] = [x, y if sign > 0 else 31.0 - y]
        paths.append(tmp_path / f"{name}.yaml")
        paths[-1].write_text(yaml.safe_dump(values))
    assert NORTH + 1 == SOUTH
    plain, error = outcome(paths[0], 256, 0)
    mirrored, other_error = outcome(paths[1], 256, 1)
    assert abs(plain - mirrored) < 4 * np.hypot(error, other_error), (plain, mirrored)
    assert error > 0
