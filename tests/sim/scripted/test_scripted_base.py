"""What every scripted policy keeps: its interface, its name, its repeatability."""

from __future__ import annotations

import numpy as np
import pytest
from scripted_episodes import play

from crash_coach_common.strict_yaml import ConfigError
from sim_pkg.env import make_env, scenario_names
from sim_pkg.scripted import make_scripted, scripted_names

PLAYED = [(s, p) for s in scenario_names() for p in scripted_names(make_env(s, 1))]


@pytest.mark.parametrize(("scenario", "policy"), PLAYED)
def test_available_actions_in_every_arena(scenario: str, policy: str) -> None:
    """A step of the environment refuses anything else; rows of ended arenas are filled too."""
    env = make_env(scenario, 3)
    team = make_scripted(policy, env)
    arenas = np.array([0, 2])
    env.reset(arenas, 4, np.array([7, 8]))
    team.begin(arenas, 4, np.array([7, 8]))
    actions = np.full((3, env.spec.n_robots), -1, dtype=np.int32)
    for _ in range(10):
        team.act(env.obs, env.available, actions)
        assert actions.min() >= 0
        assert actions.max() < env.spec.n_actions
        env.step(actions)


@pytest.mark.parametrize(
    ("scenario", "policy"),
    [
        ("buttons", "random"),
        ("coverage", "coverage_adaptive"),
        ("coverage", "random"),
        ("transport", "transport_adaptive"),
    ],
)
def test_same_bits_for_1_8_and_64_arenas(scenario: str, policy: str) -> None:
    one = play(scenario, policy, 24, muted=(0,), n_arenas=1).hashes
    assert len(set(one)) == 24
    assert play(scenario, policy, 24, muted=(0,), n_arenas=8).hashes == one
    assert play(scenario, policy, 24, muted=(0,), n_arenas=64).hashes == one


def test_random_is_uniform_over_what_is_available() -> None:
    env = make_env("buttons", 256)
    team = make_scripted("random", env)
    team.begin(np.arange(256), 0, np.arange(256))
    available = np.ones((256, 2, 5), dtype=np.bool_)
    available[:, 0, [0, 3]] = False
    counts = np.zeros((2, 5))
    actions = np.zeros((256, 2), dtype=np.int32)
    for _ in range(20):
        team.act(env.obs, available, actions)
        for i in range(2):
            counts[i] += np.bincount(actions[:, i], minlength=5)
    assert counts[0, [0, 3]].tolist() == [0, 0]
    for row, expected in ((counts[0, [1, 2, 4]], 1 / 3), (counts[1], 1 / 5)):
        deviation = np.sqrt(expected * (1 - expected) / 5120)
        assert np.abs(row / 5120 - expected).max() < 4 * deviation


def test_hold_stays() -> None:
    env = make_env("buttons", 1)
    env.reset(np.arange(1), 0, np.arange(1))
    actions = np.zeros((1, 2), dtype=np.int32)
    make_scripted("hold", env).act(env.obs, env.available, actions)
    assert actions.tolist() == [[4, 4]]


def test_unknown_and_unfit_names() -> None:
    env = make_env("buttons", 1)
    with pytest.raises(ConfigError, match=r"unknown.*'hodl' \(did you mean 'hold'\?\).*random"):
        make_scripted("hodl", env)
    with pytest.raises(ConfigError, match=r"'coverage_fixed' does not play scenario 'buttons'"):
        make_scripted("coverage_fixed", env)
    assert {"coverage_fixed", "hold"} < set(scripted_names(make_env("coverage", 1)))
