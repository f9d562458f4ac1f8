"""Evaluation: equal for every number of arenas, paired, and counted right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_common.strict_yaml import ConfigError
from policy_pkg.checkpoint import CheckpointError, PolicyBundle
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.play.conditions import Condition, at_rate, crash_free, exactly, named, within
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluate, evaluation_seed, record
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.config import TrainConfig
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
    within(named(["robot_1"]), 3, 0),
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


def test_a_recorded_episode_is_the_evaluated_one(policy: RecurrentPolicy) -> None:
    condition = named(["robot_2"])
    evaluated = evaluate(policy, SCENARIO, condition, 3, 7).episodes[2]
    (frames,) = record(policy, SCENARIO, condition, range(2, 3), 7)
    many = record(policy, SCENARIO, condition, range(5), 7, n_arenas=2)
    assert [f.episode for f in many] == list(range(5))
    assert many[2].trajectory_hash == frames.trajectory_hash
    assert frames.trajectory_hash == evaluated.trajectory_hash
    assert (frames.episode, frames.steps) == (2, evaluated.steps)
    assert frames.returns[-1] == evaluated.episode_return
    assert frames.success == evaluated.success
    assert frames.faulted == evaluated.crashed == (1,)
    assert frames.positions_m.shape == (evaluated.steps + 1, 2, 2)
    assert np.ptp(frames.positions_m[:, 0], axis=0).max() > 0.9
    np.testing.assert_allclose(frames.positions_m[:, 1], [[8.5, 2.5]] * (frames.steps + 1))


def test_scripted_teams_are_evaluated_alike() -> None:
    runs = [evaluate(Scripted("random"), SCENARIO, at_rate(0.3), 9, 5, k) for k in (1, 4)]
    assert runs[0] == runs[1]
    assert len({e.trajectory_hash for e in runs[0].episodes}) == 9
    held = evaluate(Scripted("hold"), SCENARIO, crash_free(), 2, 5)
    assert {e.steps for e in held.episodes} == {20}
    with pytest.raises(ConfigError, match=r"unknown scripted policy 'randon'.*did you mean"):
        evaluate(Scripted("randon"), SCENARIO, crash_free(), 1, 0)


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


def test_episodes_that_are_all_one_are_told(policy: RecurrentPolicy) -> None:
    """On buttons nothing is drawn but victims and random commands."""
    alike = {
        condition.name: evaluate(policy, SCENARIO, condition, 6, 5).alike
        for condition in (
            *(crash_free(), named(["robot_1"]), exactly(2), at_rate(0.0), at_rate(1.0)),
            *(named(["robot_2"], "random"), exactly(1), at_rate(1e-9)),
        )
    }
    assert alike == {
        "crash-free": True, "robot_1 mute": True, "2 crashed": True, "rate 0": True, "rate 1": True,
        "robot_2 random": False, "1 crashed": False, "rate 1e-09": False,
    }  # fmt: skip
    run = evaluate(policy, SCENARIO, crash_free(), 6, 5)
    assert len({e.trajectory_hash for e in run.episodes}) == 6  # these know seed and number
    assert run.summary()["success_ci95"] is None
    assert not evaluate(policy, SCENARIO, crash_free(), 1, 5).alike
    assert not evaluate(Scripted("random"), SCENARIO, crash_free(), 6, 5).alike


def test_no_training_has_played_the_episodes_of_an_evaluation(policy: RecurrentPolicy) -> None:
    highest = TrainConfig.model_validate({"scenario": SCENARIO, "seed": 2**62 - 1}).seed
    assert evaluation_seed(0) > highest
    assert evaluation_seed(2**62 - 1) == 2**63 - 1  # as much as a ROS parameter holds
    assert len({evaluation_seed(seed) for seed in range(100)}) == 100
    for seed in (-1, 2**62):
        with pytest.raises(UserError, match=f"seed {seed}: "):
            evaluation_seed(seed)
    drawn = [
        [e.crashed for e in evaluate(policy, SCENARIO, at_rate(0.4), 40, key).episodes]
        for key in (0, evaluation_seed(0))
    ]
    assert drawn[0] != drawn[1]


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
