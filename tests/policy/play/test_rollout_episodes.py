"""Rollouts: whole episodes, in order, holding exactly what happened; and picked up again."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.team import TeamSpec
from policy_pkg.checkpoint import CheckpointError
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.play.rollout import Finished, Rollout
from policy_pkg.policy import RecurrentPolicy
from sim_pkg.env import make_env
from sim_pkg.scenario_files import find_scenario

SEED = 5
RANDOM = CoachConfig(strategy="fixed", crash_rate=0.5, crash_mode="random", duration_steps=6)
MUTE = CoachConfig(strategy="fixed", crash_rate=0.5, start_step=2, resample=False)


def make_rollout(arenas: int, crash: CoachConfig = RANDOM, scenario: str = "buttons") -> Rollout:
    env = make_env(scenario, arenas)
    spec = env.spec
    weights = Learner(LearnerConfig(), Sizes.of(spec), seed=1).agent_weights()
    policy = RecurrentPolicy(weights, spec.n_robots, spec.n_actions)
    coach = Coach(crash, TeamSpec.of(spec), SEED)
    return Rollout(env, policy, coach.plan, SEED, np.random.default_rng(2))


CODES = {"mute": 1, "random": 2}


def codes_at(plan: CrashPlan, step: int, n_robots: int) -> npt.NDArray[np.uint8]:
    """(n,) what a plan without triggers says of one step."""
    codes = np.zeros(n_robots, dtype=np.uint8)
    for fault in plan.faults:
        end = fault.start_step + fault.duration_steps if fault.duration_steps else math.inf
        if fault.start_step <= step < end:
            codes[fault.robot] = CODES[fault.mode]
    return codes


def copied(finished: Finished) -> Finished:
    arrays = {k: v.copy() for k, v in vars(finished.episode).items() if k != "terminated"}
    return replace(finished, episode=replace(finished.episode, **arrays))


def episodes(rollout: Rollout, steps: int, epsilon: float = 0.6) -> Iterator[Finished]:
    for _ in range(steps):
        for finished in rollout.step(epsilon):
            yield copied(finished)


@pytest.mark.parametrize("crash", [RANDOM, MUTE], ids=["random", "mute"])
def test_episodes_hold_what_the_environment_did(crash: CoachConfig) -> None:
    """Every episode is played again on its own, from its executed actions."""
    found = list(episodes(make_rollout(6, crash), 70))
    assert len(found) >= 18
    env = make_env("buttons", 1)
    sizes, stay = Sizes.of(env.spec), env.spec.stay_actions[0]
    faulted = 0
    for finished in found:
        episode = finished.episode
        episode.check(sizes)
        env.reset(np.array([0]), SEED, np.array([finished.plan.episode]))
        for t in range(episode.length):
            np.testing.assert_array_equal(episode.obs[t], env.obs[0])
            np.testing.assert_array_equal(episode.state[t], env.state[0])
            np.testing.assert_array_equal(episode.available[t], env.available[0])
            modes = codes_at(finished.plan, t, sizes.n_robots)
            np.testing.assert_array_equal(episode.faults[t], modes)
            assert (episode.actions[t][modes == CODES["mute"]] == stay).all()
            faulted += int((modes != 0).sum())
            result = env.step(episode.actions[t : t + 1])
            assert episode.reward[t] == np.float32(result.reward[0])
            assert bool(result.terminated[0]) == (t == episode.length - 1)
        np.testing.assert_array_equal(episode.obs[-1], env.obs[0])
        np.testing.assert_array_equal(episode.state[-1], env.state[0])
        assert episode.terminated is True
        assert finished.success == bool(result.success[0])
    assert faulted > 50


def test_every_episode_is_played_once_and_numbered_in_starting_order() -> None:
    numbers = [finished.plan.episode for finished in episodes(make_rollout(5), 120)]
    assert len(set(numbers)) == len(numbers)
    missing = set(range(max(numbers))) - set(numbers)
    assert len(missing) < 5  # those are still under way


def test_random_crash_actions_do_not_depend_on_the_number_of_arenas() -> None:
    """With epsilon 0 nothing but (seed, episode) decides an episode."""
    one = {f.plan.episode: f for f in episodes(make_rollout(1), 200, epsilon=0.0)}
    many = {f.plan.episode: f for f in episodes(make_rollout(7), 40, epsilon=0.0)}
    common = sorted(set(one) & set(many))
    assert len(common) >= 8
    for episode in common:
        for name, array in vars(one[episode].episode).items():
            np.testing.assert_array_equal(array, getattr(many[episode].episode, name))


@pytest.mark.parametrize("steps", [0, 1, 20, 37, 53])
def test_a_restored_rollout_continues_bit_for_bit(steps: int) -> None:
    first = make_rollout(6)
    before = len(list(episodes(first, steps)))
    arrays, values = first.state_dict()
    arrays = {name: array.copy() for name, array in arrays.items()}
    second = make_rollout(6)
    second.load_state_dict(arrays, json.loads(json.dumps(values)))
    expected, got = list(episodes(first, 60)), list(episodes(second, 60))
    assert len(expected) == len(got) > 10
    assert before >= 6 or steps < 20
    for one, other in zip(expected, got, strict=True):
        assert (one.plan, one.success) == (other.plan, other.success)
        for name, array in vars(one.episode).items():
            np.testing.assert_array_equal(array, getattr(other.episode, name))


def test_a_changed_environment_is_noticed_when_restoring(tmp_path: Path) -> None:
    first = make_rollout(3)
    list(episodes(first, 7))
    arrays, values = first.state_dict()
    changed = tmp_path / "buttons.yaml"
    text = find_scenario("buttons").read_text()
    changed.write_text(text.replace("- [2, 1]", "- [2, 2]"))
    second = make_rollout(3, scenario=str(changed))
    with pytest.raises(CheckpointError, match="does not repeat the episodes under way"):
        second.load_state_dict(arrays, values)


def test_a_checkpoint_without_intended_actions_is_refused() -> None:
    first = make_rollout(3)
    list(episodes(first, 7))
    arrays, values = first.state_dict()
    old = {name: array for name, array in arrays.items() if name not in ("intents", "worst")}
    with pytest.raises(CheckpointError, match="written by an earlier version"):
        make_rollout(3).load_state_dict(old, values)
