"""Transport: forces that add up, bodies that stay apart, observations, references, bad files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from bad_files import check_refused
from scripted_episodes import play

from sim_pkg.env import Env, make_env
from sim_pkg.scenario_files import SCENARIOS_DIR
from sim_pkg.scenarios.drive import DIRECTIONS
from sim_pkg.scripted import make_scripted

STAY, EAST = 0, 1
DENT_M = 0.05 * 0.3  # 5 % of a robot's radius
GOOD = (SCENARIOS_DIR / "transport.yaml").read_text()


def variant(tmp_path: Path, **changes: object) -> Path:
    path = tmp_path / "variant.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(GOOD) | changes))
    return path


def behind_the_box(tmp_path: Path, pushers: int, grip: float) -> Env:
    """Robots in contact with the box's western face, in front of a long way east."""
    places = {1: [4.0], 2: [3.6, 4.4], 3: [3.35, 4.0, 4.65]}[pushers]
    starts = [[2.9, y] for y in places] + [[1.0, 8.0 + 0.65 * i] for i in range(3 - pushers)]
    floor = {"grip": grip, "grip_rough": grip, "rough": [], "drag_per_s": 1.0}
    path = variant(tmp_path, starts=starts, start_jitter_m=0.0, floor=floor)
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    return env


@pytest.mark.parametrize(("pushers", "grip"), [(1, 0.05), (2, 0.1), (3, 0.1), (3, 0.187)])
def test_forces_add_up(tmp_path: Path, pushers: int, grip: float) -> None:
    """The final speed is (k F - mu M g) / (drag (M + k m)), with no more than the top speed."""
    env = behind_the_box(tmp_path, pushers, grip)
    actions = np.full((1, 3), STAY, dtype=np.int32)
    actions[0, :pushers] = EAST
    expected = (pushers * 50.0 - grip * 60.0 * 9.81) / (1.0 * (60.0 + pushers * 15.0))
    # From rest, the speed nears the final one with a time constant of 1 / drag = 1 s.
    for _ in range(8):
        env.step(actions)
    assert env.world.bodies[0, 3, 2] == pytest.approx(expected, rel=0.04)
    assert 0.2 < expected < 1.0


@pytest.mark.parametrize(("pushers", "grip"), [(1, 0.1), (2, 0.187)])
def test_too_few_do_not_move_it(tmp_path: Path, pushers: int, grip: float) -> None:
    env = behind_the_box(tmp_path, pushers, grip)
    actions = np.full((1, 3), STAY, dtype=np.int32)
    actions[0, :pushers] = EAST
    for _ in range(60):
        env.step(actions)
    np.testing.assert_allclose(env.world.bodies[0, 3, :2], (4.0, 4.0), atol=0.03)


def corners(env: Env) -> np.ndarray:
    """(B, 4, 2) of the box."""
    half = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * 0.8
    angle = env.world.turns[:, 3, 0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return env.world.bodies[:, 3, None, :2] + np.einsum("xyb,cy->bcx", turn, half)


def overlap_with_box(env: Env) -> np.ndarray:
    """(B, 3) how deep each robot is in the box, m."""
    angle = env.world.turns[:, 3, 0][:, None]
    rel = env.world.bodies[:, :3, :2] - env.world.bodies[:, 3:, :2]
    x = np.cos(angle) * rel[..., 0] + np.sin(angle) * rel[..., 1]
    y = np.cos(angle) * rel[..., 1] - np.sin(angle) * rel[..., 0]
    outside = np.stack((np.abs(x) - 0.8, np.abs(y) - 0.8))
    gap = np.linalg.norm(np.maximum(outside, 0), axis=0) + np.minimum(outside.max(axis=0), 0)
    depth: np.ndarray = 0.3 - gap
    return depth


@pytest.mark.parametrize("arenas", [16, pytest.param(64, marks=pytest.mark.soak)])
def test_thousands_of_rough_steps(arenas: int) -> None:
    """The reference with every third action at random, and long random rides: nothing overlaps,
    tunnels, leaves the arena or its bounds, and nothing is faster than a drive makes it."""
    rng = np.random.default_rng(3)
    env = make_env("transport", arenas)
    team = make_scripted("transport_direct", env)
    env.reset(np.arange(arenas), 5, np.arange(arenas))
    team.begin(np.arange(arenas), 5, np.arange(arenas))
    actions, ride = np.zeros((2, arenas, 3), dtype=np.int32)
    wanderers = np.arange(arenas) % 2 == 0
    moved, next_episode = 0.0, arenas
    for step in range(160):
        team.act(env.obs, env.available, actions)
        wild = rng.integers(0, 9, (arenas, 3)).astype(np.int32)
        ride = np.where(rng.random((arenas, 3)) < 0.1, wild, ride).astype(np.int32)
        mixed = np.where(rng.random((arenas, 3)) < 0.33, wild, actions)
        env.step(np.where(wanderers[:, None], ride, mixed).astype(np.int32))
        bodies = env.world.bodies
        assert np.isfinite(bodies).all()
        assert np.isfinite(env.world.turns).all()
        robots = bodies[:, :3, :2]
        assert robots.min() > 0.3 - DENT_M, step
        assert (robots < np.array([14.0, 10.0]) - 0.3 + DENT_M).all()
        assert corners(env).min() > -DENT_M
        assert (corners(env) < np.array([14.0, 10.0]) + DENT_M).all()
        assert overlap_with_box(env).max() < DENT_M
        apart = np.linalg.norm(robots[:, [0, 0, 1]] - robots[:, [1, 2, 2]], axis=-1)
        assert apart.min() > 0.6 - DENT_M
        assert np.linalg.norm(bodies[:, :, 2:], axis=-1).max() < 1.2 * 0.9
        assert np.abs(env.obs).max() <= 1.0
        assert np.abs(env.state).max() <= 1.0
        moved = max(moved, float(np.abs(bodies[:, 3, :2] - 4.0).max()))
        ended = np.flatnonzero(~env.running)
        env.reset(ended, 5, next_episode + np.arange(len(ended)))
        team.begin(ended, 5, next_episode + np.arange(len(ended)))
        next_episode += len(ended)
    assert moved > 6.0, "the box was hardly moved: the test is void"


def test_rewards_add_up() -> None:
    """Metres gained, the goal, and the steps: written down from positions alone."""
    env = make_env("transport", 8)
    team = make_scripted("transport_adaptive", env)
    env.reset(np.arange(8), 2, np.arange(8))
    team.begin(np.arange(8), 2, np.arange(8))
    goal = np.array([11.5, 4.0])
    gaps = [np.linalg.norm(env.world.bodies[:, 3, :2] - goal, axis=-1)]
    actions = np.zeros((8, 3), dtype=np.int32)
    total, steps = np.zeros(8), np.zeros(8)
    while env.running.any():
        running = env.running.copy()
        team.act(env.obs, env.available, actions)
        r = env.step(actions)
        gaps.append(np.linalg.norm(env.world.bodies[:, 3, :2] - goal, axis=-1))
        np.testing.assert_array_equal(r.success[running], gaps[-1][running] <= 0.5)
        np.testing.assert_array_equal(env.sites_done[:, 0], gaps[-1] <= 0.5)
        total += r.reward
        steps += running
    np.testing.assert_allclose(total, gaps[0] - gaps[-1] + 10.0 - 0.05 * steps, atol=1e-9)


def test_what_is_observed() -> None:
    env = make_env("transport", 2)
    env.reset(np.arange(2), 9, np.arange(2))
    rng = np.random.default_rng(0)
    for _ in range(12):
        env.step(rng.integers(0, 9, (2, 3)).astype(np.int32))
    size, goal = np.array([14.0, 10.0]), np.array([11.5, 4.0])
    for b in range(2):
        bodies, angle = env.world.bodies[b], env.world.turns[b, 3, 0]
        box = bodies[3]
        for i in range(3):
            me = bodies[i]
            expected = [*(2 * me[:2] / size - 1), *(me[2:] / 0.9), *((box[:2] - me[:2]) / size)]
            expected += [np.cos(angle), np.sin(angle), *(box[2:] / 0.9), *((goal - me[:2]) / size)]
            for j in (j for j in range(3) if j != i):
                gap = (bodies[j, :2] - me[:2]) / 6.0
                expected += [1.0, *gap] if np.hypot(*gap) <= 1 else [0.0, 0.0, 0.0]
            np.testing.assert_allclose(env.obs[b, i], expected, atol=1e-6)
        flat = [v for body in bodies for v in (*(2 * body[:2] / size - 1), *(body[2:] / 0.9))]
        expected = [*flat, np.cos(angle), np.sin(angle), 12 / 120]
        np.testing.assert_allclose(env.state[b], expected, atol=1e-6)


def test_starts_differ_between_episodes() -> None:
    env = make_env("transport", 64)
    env.reset(np.arange(64), 0, np.arange(64))
    starts = env.world.bodies[:, :, :2]
    nominal = np.array([[1.0, 2.0], [1.0, 4.0], [1.0, 6.0], [4.0, 4.0]])
    assert np.abs(starts - nominal).max() <= 0.3
    assert starts.std(axis=0) == pytest.approx(0.6 / np.sqrt(12), rel=0.25)


def test_references() -> None:
    """All three go straight; two need far longer and another way, and fail on the direct one."""
    whole = play("transport", "transport_adaptive", 64)
    assert whole.success.mean() >= 0.95
    assert play("transport", "transport_direct", 64).steps.tolist() == whole.steps.tolist()
    for robot in range(3):
        less = play("transport", "transport_adaptive", 32, muted=(robot,), n_arenas=32)
        assert less.success.mean() >= 0.85
        assert less.steps.mean() > 2 * whole.steps.mean()
    for muted, policy in (((1,), "transport_direct"), ((0, 1), "transport_adaptive")):
        assert not play("transport", policy, 16, muted, n_arenas=16).success.any()


def test_four_robots_are_data() -> None:
    assert play("transport_4", "transport_adaptive", 16, n_arenas=16).success.mean() >= 0.95
    less = play("transport_4", "transport_adaptive", 16, muted=(1,), n_arenas=16)
    assert less.success.mean() >= 0.8


def test_directions_are_unit_vectors_in_the_order_of_the_names() -> None:
    env = make_env("transport", 9)
    env.reset(np.arange(9), 0, np.zeros(9, dtype=np.int64))
    before = env.world.bodies[:, 1, :2].copy()
    actions = np.zeros((9, 3), dtype=np.int32)
    actions[:, 1] = np.arange(9)
    env.step(actions)
    moved = env.world.bodies[:, 1, :2] - before
    np.testing.assert_allclose(
        moved[1:] / np.linalg.norm(moved[1:], axis=1)[:, None], DIRECTIONS[1:], atol=1e-9
    )
    assert not moved[0].any()
    names = env.spec.action_names
    assert (names[0], names[1], names[3], names[6]) == ("stay", "east", "north", "south_west")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  - [1.0, 4.0]", "  - [1.0, 2.5]", r":10: starts: .*may overlap.*at least 1.45 m apart"),
        ("  - [1.0, 4.0]", "  - [0.5, 4.0]", r":10: starts.1: \[0.5, 4.0\] is too near to a wall"),
        ("  - [1.0, 4.0]", "  - [3.0, 4.0]", r":10: starts: .*may overlap the box.*1.7 m away"),
        (
            "  start: [4.0, 4.0]",
            "  start: [0.9, 4.0]",
            r":\d+: box.start: \[0.9, 4.0\] is too near",
        ),
        ("goal: [11.5, 4.0]", "goal: [13.9, 4.0]", r":13: goal: \[13.9, 4.0\] is too near"),
        ("goal: [11.5, 4.0]", "goal: [4.1, 4.0]", r":13: goal: .*is where the box starts"),
        ("[6.5, 0.0, 8.0, 5.0]", "[8.0, 0.0, 6.5, 5.0]", r":\d+: rough: .*is empty.*x1 < x2"),
        ("max_force_n: 50.0", "max_force_n: 0.0", r"robot.max_force_n = 0.0: .*greater than 0"),
        ("grip: 0.1 ", "gripp: 0.1 ", r"'floor.gripp' \(did you mean 'grip'\?\)"),
        ("substeps: 60", "substeps: 1", r"physics.substeps = 1: .*greater than or equal to 4"),
    ],
)
def test_bad_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    check_refused(tmp_path, GOOD, old, new, message)
