"""Coverage: what counts as watching, physics, observations, references, bad files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from bad_files import check_refused
from scripted_episodes import play

from sim_pkg.env import Env, make_env
from sim_pkg.scenario_files import SCENARIOS_DIR
from sim_pkg.scripted import make_scripted

STAY, EAST = 0, 1
GOOD = (SCENARIOS_DIR / "coverage.yaml").read_text()
SITES = np.array([(2, 2), (10, 2), (2, 10), (10, 10), (6, 1.5), (6, 10.5)])
DENT_M = 0.05 * 0.35  # 5 % of a robot's radius


def lone_robot(tmp_path: Path, start: tuple[float, float]) -> Env:
    """One robot at ``start``, one site at (6, 6); watched for 2 s within 0.6 m."""
    values = yaml.safe_load(GOOD)
    values |= {"starts": [list(start)], "start_jitter_m": 0.0, "sites": [[6.0, 6.0]]}
    path = tmp_path / "lone.yaml"
    path.write_text(yaml.safe_dump(values))
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    return env


def left(env: Env) -> float:
    """Share of the watching that is left, from the state."""
    return float(env.state[0, 4 + 2])


@pytest.mark.parametrize(("x", "watches"), [(5.41, True), (5.39, False)])
def test_watching_needs_to_be_near(tmp_path: Path, x: float, watches: bool) -> None:
    env = lone_robot(tmp_path, (x, 6.0))
    shares = []
    for _ in range(4):
        r = env.step(np.array([[STAY]], dtype=np.int32))
        shares.append(left(env))
    assert shares == ([0.75, 0.5, 0.25, 0.0] if watches else [1.0] * 4)
    assert bool(r.success[0]) == bool(r.terminated[0]) == bool(env.sites_done[0, 0]) == watches
    assert r.reward[0] == pytest.approx(2.0 - 0.05 if watches else -0.05)


def test_watching_needs_to_be_slow(tmp_path: Path) -> None:
    """Right across the site at full speed: in it for more than a step, and nothing counts."""
    env = lone_robot(tmp_path, (3.0, 6.0))
    inside = 0
    for _ in range(10):
        env.step(np.array([[EAST]], dtype=np.int32))
        x, _, speed, _ = env.world.bodies[0, 0]
        inside += abs(x - 6.0) < 0.6
        assert speed > 0.3
    assert inside >= 2
    assert left(env) == 1.0


def test_braking_takes_the_way_that_the_drive_needs(tmp_path: Path) -> None:
    """From 1 m/s with 20 N / 20 kg: v**2 / (2 a) = 0.5 m."""
    env = lone_robot(tmp_path, (2.0, 6.0))
    for _ in range(4):
        env.step(np.array([[EAST]], dtype=np.int32))
    x, _, speed, _ = env.world.bodies[0, 0]
    assert speed == pytest.approx(1.0, abs=1e-6)
    for _ in range(4):
        env.step(np.array([[STAY]], dtype=np.int32))
    assert env.world.bodies[0, 0, 2] == pytest.approx(0.0, abs=1e-9)
    assert env.world.bodies[0, 0, 0] - x == pytest.approx(0.5, abs=0.02)


def test_ten_thousand_rough_steps() -> None:
    """References with every third action at random, and long random rides."""
    arenas, rng = 64, np.random.default_rng(4)
    env = make_env("coverage", arenas)
    team = make_scripted("coverage_adaptive", env)
    env.reset(np.arange(arenas), 5, np.arange(arenas))
    team.begin(np.arange(arenas), 5, np.arange(arenas))
    actions, ride = np.zeros((2, arenas, 4), dtype=np.int32)
    wanderers = np.arange(arenas) % 2 == 0
    pairs = np.array([(i, j) for i in range(4) for j in range(i)])
    touched, next_episode = 0, arenas
    for _ in range(160):
        team.act(env.obs, env.available, actions)
        wild = rng.integers(0, 9, (arenas, 4)).astype(np.int32)
        ride = np.where(rng.random((arenas, 4)) < 0.1, wild, ride).astype(np.int32)
        mixed = np.where(rng.random((arenas, 4)) < 0.33, wild, actions)
        env.step(np.where(wanderers[:, None], ride, mixed).astype(np.int32))
        places = env.world.bodies[:, :, :2]
        assert np.isfinite(env.world.bodies).all()
        assert places.min() > 0.35 - DENT_M
        assert places.max() < 12.0 - 0.35 + DENT_M
        apart = np.linalg.norm(places[:, pairs[:, 0]] - places[:, pairs[:, 1]], axis=-1)
        assert apart.min() > 0.7 - DENT_M
        touched += int((apart < 0.7).sum())
        assert np.linalg.norm(env.world.bodies[:, :, 2:], axis=-1).max() < 1.2
        assert np.abs(env.obs).max() <= 1.0
        assert np.abs(env.state).max() <= 1.0
        ended = np.flatnonzero(~env.running)
        env.reset(ended, 5, next_episode + np.arange(len(ended)))
        team.begin(ended, 5, next_episode + np.arange(len(ended)))
        next_episode += len(ended)
    assert touched > 100, "robots hardly met: the test is void"


def test_what_is_observed() -> None:
    env = make_env("coverage", 2)
    env.reset(np.arange(2), 9, np.arange(2))
    team = make_scripted("coverage_fixed", env)
    team.begin(np.arange(2), 9, np.arange(2))
    actions = np.zeros((2, 4), dtype=np.int32)
    for _ in range(15):
        team.act(env.obs, env.available, actions)
        env.step(actions)
    unseen = 0
    for b in range(2):
        bodies = env.world.bodies[b]
        shares = env.state[b, 16:34].reshape(6, 3)[:, 2]
        assert 0 < shares.sum() < 6, "nothing was watched: the test is void"
        np.testing.assert_array_equal(env.sites_done[b], shares == 0)
        for i in range(4):
            me = bodies[i, :2]
            expected = [*(me / 6 - 1), *bodies[i, 2:]]
            for site, share in zip(SITES, shares, strict=True):
                seen = np.hypot(*(site - me)) <= 4.0
                expected += [*((site - me) / 12), seen, share if seen else 0]
            for j in (j for j in range(4) if j != i):
                gap = (bodies[j, :2] - me) / 4.0
                seen = np.hypot(*gap) <= 1
                unseen += not seen
                expected += [1.0, *gap] if seen else [0.0, 0.0, 0.0]
            np.testing.assert_allclose(env.obs[b, i], expected, atol=1e-6)
        flat = [v for body in bodies for v in (*(body[:2] / 6 - 1), *body[2:])]
        np.testing.assert_allclose(env.state[b, :16], flat, atol=1e-6)
        np.testing.assert_allclose(env.state[b, 16:34].reshape(6, 3)[:, :2], SITES / 6 - 1)
        assert env.state[b, 34] == np.float32(15 / 80)
    assert unseen > 0


def test_rewards_add_up() -> None:
    result = play("coverage", "coverage_fixed", 8, muted=(3,))
    # Robot 4's one site is left: five sites, and the whole time.
    np.testing.assert_allclose(result.returns, 5 * 2.0 - 80 * 0.05)
    whole = play("coverage", "coverage_fixed", 8)
    np.testing.assert_allclose(whole.returns, 6 * 2.0 - whole.steps * 0.05)


def test_references() -> None:
    """One robot less: fixed sites are never done; the others fill the hole, and take longer."""
    whole = play("coverage", "coverage_adaptive", 64)
    assert whole.success.mean() >= 0.95
    assert play("coverage", "coverage_fixed", 64).success.mean() >= 0.95
    for robot in range(4):
        fixed = play("coverage", "coverage_fixed", 16, muted=(robot,), n_arenas=16)
        assert not fixed.success.any()
        less = play("coverage", "coverage_adaptive", 32, muted=(robot,), n_arenas=32)
        assert less.success.mean() >= 0.9
        assert less.steps.mean() > 1.2 * whole.steps.mean()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  - [6.8, 5.2]", "  - [6.7, 5.2]", r":9: starts: .*may overlap.*at least 1.55 m apart"),
        ("  - [5.2, 5.2]", "  - [0.6, 5.2]", r":8: starts.0: \[0.6, 5.2\] is too near to a wall"),
        ("  - [10.0, 2.0]", "  - [10.0, 12.0]", r":15: sites.1: .*is too near to a wall"),
        ("  - [10.0, 2.0]", "  - [2.0, 2.0]", r":15: sites: \[2.0, 2.0\] again"),
        ("sight_m: 4.0", "sight_m: 0.5", r":23: sight_m: 0.5 must exceed watch_radius_m, 0.6"),
        ("watch_s: 2.0", "watch_s: 0.0", r"watch_s = 0.0: .*greater than 0"),
        ("mass_kg: 20.0", "mass_kg: 1e300", r"robot.mass_kg = 1e\+300: .*equal to 1000000"),
        ("_limit: 80", "_limit: 1" + 20 * "0", r":6: episode_limit = 10+: .*equal to 100000"),
        ("[12.0, 12.0]", "[12.0]", r":4: key .arena_m.1. is missing"),
        ("watch_s: 2.0", "wach_s: 2.0", r"unknown key 'wach_s' \(did you mean 'watch_s'\?\)"),
    ],
)
def test_bad_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    check_refused(tmp_path, GOOD, old, new, message)
