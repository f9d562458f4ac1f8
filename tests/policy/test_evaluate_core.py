"""Evaluation: equal for every number of arenas, paired, and counted right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crash_coach_pkg.config import CoachConfig
from policy_pkg.checkpoint import CheckpointError, PolicyBundle
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.episode import Sizes
from policy_pkg.train.evaluate import (
    Condition,
    Evaluation,
    at_rate,
    crash_free,
    evaluate,
    exactly,
    named,
)
from policy_pkg.train.learner import Learner
from policy_pkg.train.learner_config import LearnerConfig
from sim_pkg.config import ConfigError
from sim_pkg.contract import EnvSpec, UserError
from sim_pkg.env import make_env

SCENARIO = "buttons"


@pytest.fixture(scope="module")
def spec() -> EnvSpec:
    return make_env(SCENARIO, 1).spec


@pytest.fixture(scope="module")
def policy(spec: EnvSpec) -> RecurrentPolicy:
    """Untrained; its greedy actions still depend on what it sees."""
    weights = Learner(LearnerConfig(), Sizes.of(spec), seed=1).agent_weights()
    spread = {name: 4 * array for name, array in weights.items()}
    return RecurrentPolicy(spread, spec.n_robots, spec.n_actions)


CONDITIONS = [
    crash_free(),
    at_rate(0.4),
    at_rate(0.4, "random"),
    exactly(1, "random"),
    exactly(2),
    named(["robot_2"], "random"),
    Condition("late", CoachConfig(strategy="fixed", victims=("robot_1",), start_step=3)),
]


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda c: c.name)
def test_the_number_of_arenas_changes_no_bit(policy: RecurrentPolicy, condition: Condition) -> None:
    one, many = (evaluate(policy, SCENARIO, condition, 12, 7, n_arenas=k) for k in (1, 32))
    few = evaluate(policy, SCENARIO, condition, 12, 7, n_arenas=5)
    assert one.episodes == many.episodes == few.episodes
    assert one.summary()["trajectory_hash"] == many.summary()["trajectory_hash"]


def test_crashes_show_in_the_trajectories(policy: RecurrentPolicy) -> None:
    conditions = crash_free(), named(["robot_1"]), named(["robot_1"], "random")
    runs = [evaluate(policy, SCENARIO, condition, 6, 7) for condition in conditions]
    assert len({run.summary()["trajectory_hash"] for run in runs}) == 3


def test_who_crashes_is_what_the_condition_says(policy: RecurrentPolicy) -> None:
    def crashed(condition: Condition) -> list[tuple[int, ...]]:
        return [e.crashed for e in evaluate(policy, SCENARIO, condition, 200, 3).episodes]

    assert set(crashed(crash_free())) == {()}
    assert set(crashed(named(["robot_2"]))) == {(1,)}
    assert set(crashed(exactly(1))) == {(0,), (1,)}
    assert set(crashed(exactly(2))) == {(0, 1)}
    drawn = crashed(at_rate(0.5))  # no re-sampling: both may crash at once
    assert set(drawn) == {(), (0,), (1,), (0, 1)}
    assert sum(map(len, drawn)) / 400 == pytest.approx(0.5, abs=0.08)


def test_a_muted_robot_stays_where_it_is(policy: RecurrentPolicy) -> None:
    run = evaluate(policy, SCENARIO, named(["robot_2"]), 2, 7, record_positions=True)
    for episode in run.episodes:
        assert episode.positions_m is not None
        assert episode.positions_m.shape == (episode.steps + 1, 2, 2)
        np.testing.assert_allclose(
            episode.positions_m[:, 1] - episode.positions_m[0, 1], 0, atol=1e-6
        )
    assert evaluate(policy, SCENARIO, crash_free(), 1, 7).episodes[0].positions_m is None


def test_the_same_seed_pairs_methods(policy: RecurrentPolicy, spec: EnvSpec) -> None:
    other = RecurrentPolicy(
        Learner(LearnerConfig(), Sizes.of(spec), seed=2).agent_weights(),
        spec.n_robots,
        spec.n_actions,
    )
    condition = at_rate(0.3)
    mine, theirs = (evaluate(p, SCENARIO, condition, 40, 11) for p in (policy, other))
    assert [e.crashed for e in mine.episodes] == [e.crashed for e in theirs.episodes]
    again = evaluate(policy, SCENARIO, condition, 40, 12)
    assert [e.crashed for e in mine.episodes] != [e.crashed for e in again.episodes]


def test_summary_counts(policy: RecurrentPolicy) -> None:
    run = evaluate(policy, SCENARIO, exactly(1), 10, 5)
    summary = run.summary()
    assert summary["episodes"] == len(run.episodes) == 10
    assert [e.episode for e in run.episodes] == list(range(10))
    assert summary["crashed_fraction"] == 0.5
    returns = [e.episode_return for e in run.episodes]
    assert summary["return_mean"] == pytest.approx(sum(returns) / 10)
    assert summary["return_std"] == pytest.approx(np.std(returns, ddof=1))
    low, high = summary["success_ci95"]
    assert low <= summary["success_rate"] <= high
    assert isinstance(run, Evaluation)


def test_a_policy_of_another_team_is_refused(policy: RecurrentPolicy) -> None:
    bundle = PolicyBundle(policy, "skirmish", ("robot_1",), 4, 2, Path("run"))
    with pytest.raises(CheckpointError) as caught:
        evaluate(bundle, SCENARIO, crash_free(), 1, 0)
    text = str(caught.value)
    assert "run was trained on 'skirmish' and does not fit scenario 'buttons'" in text
    assert "actions: trained with 4, scenario has 5" in text
    assert "robots: trained with ['robot_1']" in text


def test_bad_requests_name_the_value(policy: RecurrentPolicy) -> None:
    with pytest.raises(UserError, match="episodes = 0"):
        evaluate(policy, SCENARIO, crash_free(), 0, 0)
    with pytest.raises(UserError, match="unknown robot 'robot_9'"):
        evaluate(policy, SCENARIO, named(["robot_9"]), 1, 0)
    with pytest.raises(ConfigError, match="unknown scenario 'butons'"):
        evaluate(policy, "butons", crash_free(), 1, 0)
