"""The fixed data set, what it refuses, and weighting it by crash condition."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from offline_recordings import SIZES, Recording, random_recordings, recording, with_crashes
from reference_learner import random_episode

from policy_pkg.episode import Episode
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.statistics import binomial_weights
from policy_pkg.train.offline.crash_weights import crash_weights
from policy_pkg.train.offline.data import DataError, FixedData, load_data
from sim_pkg.env import make_env

SMALL: dict[str, Any] = {"hidden": 8, "mixing_hidden": 4, "hypernet_hidden": 6}


def load(recordings: list[Recording], limit_mib: int = 10) -> FixedData:
    return load_data(recordings, None, limit_mib)


def test_everything_arrives_whatever_the_order() -> None:
    recordings = [*random_recordings(9, seed=1), *random_recordings(4, seed=2)]
    data = load(recordings)
    assert (len(data), data.duplicates) == (13, 0)
    longest = max(one.episode.length for one in recordings)
    assert data.sizes == replace(SIZES, episode_limit=longest, stay_actions=(0,))
    assert data.success_rate == pytest.approx((5 + 2) / 13)
    assert data.crashed.tolist() == [one.episode.faults.any(0).sum() for one in recordings]
    batch = data.episodes.gather(np.arange(13))
    for i, slot in enumerate(batch.slots):
        expected = recordings[slot].episode
        np.testing.assert_array_equal(batch.reward[batch.episode == i], expected.reward)

    shuffled = [recordings[i] for i in np.random.default_rng(0).permutation(13)]
    again = load(shuffled)
    assert again.sha256 == data.sha256
    assert again.crashed.tolist() == data.crashed.tolist()
    mine, theirs = data.episodes.state_dict(), again.episodes.state_dict()
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)
    assert load(recordings[:-1]).sha256 != data.sha256


def test_an_episode_given_twice_is_counted() -> None:
    recordings = random_recordings(3)
    assert load([*recordings, recordings[1]]).duplicates == 1


@pytest.mark.parametrize("scenario", [None, "buttons"])
def test_no_episode_is_an_error(scenario: str | None) -> None:
    spec = make_env(scenario, 1).spec if scenario else None
    with pytest.raises(DataError, match="no complete episode"):
        load_data([], spec, 10)


def test_more_than_the_bound_names_it_and_the_key() -> None:
    sizes = replace(SIZES, obs_size=3000)
    recordings = random_recordings(40, sizes=sizes)
    with pytest.raises(
        DataError,
        match=r"\d+ episodes of up to 7 steps take 1\.\d MiB, more than memory_limit_mib 1",
    ):
        load(recordings, limit_mib=1)
    data = load(recordings, limit_mib=12)
    assert data.episodes.nbytes <= data.episodes.nbytes_bound <= 12 * 2**20


def changed(one: Recording, **arrays: Any) -> Recording:
    return replace(one, episode=replace(one.episode, **arrays))


def _unavailable(one: Recording) -> Recording:
    available = one.episode.available.copy()
    available[0, 1, one.episode.actions[0, 1]] = False
    return changed(one, available=available)


def _unwanted(one: Recording) -> Recording:
    faults = one.episode.faults.copy()
    faults[0, 2] = 0
    intents = one.episode.actions.copy()
    intents[0, 2] = (intents[0, 2] + 1) % 4
    return replace(changed(one, faults=faults), intents=intents)


def _not_finite(one: Recording) -> Recording:
    obs = one.episode.obs.copy()
    obs[1, 0, 2] = np.nan
    return changed(one, obs=obs)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (_unavailable, r"episode 2 of seed 0, step 0, robot_2: executed action \d, which was not"),
        (_unwanted, r"step 0, robot_3: wanted action \d and executed \d without a fault"),
        (_not_finite, r"episode 2 of seed 0: obs is not finite at step 1"),
        (
            lambda one: replace(one, robots=one.robots[:2]),
            r"has 2 robots \(robot_1, robot_2\), the first episode has 3",
        ),
        (
            lambda one: changed(one, state=one.episode.state[:, :4]),
            r"does not fit the first episode: episode\.state is float32 \(\d, 4\); must be",
        ),
        (lambda one: replace(one, intents=one.intents[:, :1]), r"intents have the shape \(\d, 1\)"),
    ],
)
def test_what_cannot_be_learned_from_is_named(spoil: Any, expected: str) -> None:
    recordings = random_recordings(4)
    recordings[2] = spoil(recordings[2])
    with pytest.raises(DataError, match=expected):
        load(recordings)


def test_intents_that_were_not_recorded_are_no_contradiction() -> None:
    recordings = [replace(r, intents=np.full_like(r.intents, -1)) for r in random_recordings(3)]
    assert len(load(recordings)) == 3


def test_another_scenarios_recordings_are_refused() -> None:
    with pytest.raises(DataError, match=r"has 3 robots .*, scenario 'buttons' has 2"):
        load_data(random_recordings(2), make_env("buttons", 1).spec, 10)


def test_weights_make_the_recorded_conditions_binomial() -> None:
    crashed = np.repeat([0, 1, 2, 3], [50, 5, 40, 5])
    found = crash_weights(crashed, 3, 0.2)
    target = binomial_weights(3, 0.2)
    assert found.weights.mean() == pytest.approx(1)
    for k in range(4):
        assert found.weights[crashed == k].sum() / 100 == pytest.approx(target[k])
    assert found.unrecorded == ()
    assert found.effective_episodes < 100


def test_conditions_that_were_never_recorded_are_named() -> None:
    crashed = np.repeat([0, 2], [30, 10])
    found = crash_weights(crashed, 3, 0.5)
    assert [(c.crashed, c.target, c.weight) for c in found.unrecorded] == [
        (1, pytest.approx(0.375), None),
        (3, pytest.approx(0.125), None),
    ]
    # Among the recorded ones 0 and 2 keep their proportion of 1 to 3.
    assert found.weights[crashed == 0].sum() / 40 == pytest.approx(0.25)
    assert found.weights[crashed == 2].sum() / 40 == pytest.approx(0.75)
    with pytest.raises(DataError, match=r"episodes with 1, 3 of 3 robots crashed were recorded"):
        crash_weights(np.array([1, 3]), 3, 0.0)


def _of_condition(rng: np.random.Generator, crashed: int, number: int) -> Recording:
    """Of full length, so that the mean over steps is the mean over episodes."""
    episode = random_episode(SIZES, rng, 7, terminated=True)
    return recording(with_crashes(episode, list(range(crashed))), number)


def test_the_weighted_loss_is_the_expectation_under_the_wanted_law() -> None:
    rng = np.random.default_rng(0)
    counts = {0: 5, 1: 3, 2: 9, 3: 2}
    by_condition = {
        k: [_of_condition(rng, k, 10 * k + i) for i in range(count)] for k, count in counts.items()
    }
    data = load([one for group in by_condition.values() for one in group])
    learner = Learner(LearnerConfig(**SMALL), data.sizes, seed=0, dtype=np.float64)

    def mean_loss(data: FixedData, weights: Any = None) -> tuple[float, dict[str, Any]]:
        batch = data.episodes.gather(np.arange(len(data)))
        chosen = None if weights is None else weights[batch.slots]
        return learner.loss_and_gradients(batch, chosen)

    law = binomial_weights(3, 0.3)
    losses = {k: mean_loss(load(group)) for k, group in by_condition.items()}
    weights = crash_weights(data.crashed, 3, 0.3).weights
    value, gradients = mean_loss(data, weights)
    assert value == pytest.approx(sum(law[k] * losses[k][0] for k in law_range(law)), rel=1e-9)
    for name, gradient in gradients.items():
        expected = sum(law[k] * losses[k][1][name] for k in law_range(law))
        np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=1e-12, err_msg=name)
    assert value != pytest.approx(mean_loss(data)[0], rel=1e-3)


def law_range(law: list[float]) -> range:
    return range(len(law))


def test_an_episode_knows_how_many_robots_crashed_in_it() -> None:
    rng = np.random.default_rng(0)
    episode: Episode = random_episode(SIZES, rng, 5, terminated=False)
    data = load(
        [recording(with_crashes(episode, robots), i) for i, robots in enumerate([[], [1], [0, 2]])]
    )
    assert data.crashed.tolist() == [0, 1, 2]
