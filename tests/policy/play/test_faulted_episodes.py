"""Episodes in one process under every mode and trigger: acted on, recorded, resumed."""

from __future__ import annotations

import json
import math
from collections import Counter

import numpy as np
import pytest

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.effects import OBSERVED, WITHHELD, EffectRow
from crash_coach_pkg.faults import mode_names
from crash_coach_pkg.plan import (
    CrashPlan,
    Fault,
    Trigger,
    TriggerKind,
    plan_from_json,
    plan_to_json,
)
from crash_coach_pkg.team import TeamSpec
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.play.conditions import Condition, Planned, crash_free, named
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluate
from policy_pkg.play.rollout import Finished, Rollout
from policy_pkg.policy import RecurrentPolicy
from sim_pkg.env import make_env

ACTION_MODES = [mode for mode in mode_names() if mode not in ("bias", "scale")]
OBSERVATION_MODES = ("blind", "stale", "noise")
SEED = 5


def make_policy(scenario: str) -> RecurrentPolicy:
    """Untrained, but what it sees decides what it does."""
    spec = make_env(scenario, 1).spec
    weights = Learner(LearnerConfig(), Sizes.of(spec), seed=1).agent_weights()
    spread = {name: 4 * array for name, array in weights.items()}
    return RecurrentPolicy(spread, spec.n_robots, spec.n_actions)


@pytest.fixture(scope="module")
def policy() -> RecurrentPolicy:
    return make_policy("buttons")


def fixed(mode: str, **settings: object) -> CoachConfig:
    values = {"strategy": "fixed", "victims": ("robot_2",), "crash_mode": mode, **settings}
    return CoachConfig.model_validate(values)


def effects(run: Evaluation) -> list[EffectRow]:
    return [row for row in run.effects if row.kind == "EFFECT"]


@pytest.mark.parametrize("mode", ACTION_MODES)
def test_every_mode_is_the_same_for_every_number_of_arenas(
    policy: RecurrentPolicy, mode: str
) -> None:
    condition = Condition(mode, fixed(mode, start_step=3, duration_steps=9))
    runs = [evaluate(policy, "buttons", condition, 6, 7, k, effects=True) for k in (1, 4)]
    assert runs[0] == runs[1]
    assert all(e.crashed == (1,) for e in runs[0].episodes)
    applied = OBSERVED if mode in OBSERVATION_MODES else None
    for episode in runs[0].episodes:
        mine = [row for row in effects(runs[0]) if row.episode == episode.episode]
        assert [row.step for row in mine] == list(range(3, min(12, episode.steps)))
        assert {(row.robot, row.mode, row.entry) for row in mine} == {("robot_2", mode, 0)}
        assert applied is None or {row.applied for row in mine} == {applied}
    kinds = Counter(row.kind for row in runs[0].effects)
    assert kinds["ACTIVE"] == 6
    assert kinds["CLEARED"] == sum(e.steps > 12 for e in runs[0].episodes)
    assert evaluate(policy, "buttons", crash_free(), 2, 7, effects=True).effects == ()


@pytest.mark.parametrize("mode", ["mute", "random"])
def test_batches_and_robot_by_robot_give_the_same_episodes(
    policy: RecurrentPolicy, mode: str
) -> None:
    """Asking for effects takes every arena through TeamFaults."""
    config = CoachConfig(
        strategy="fixed", crash_rate=0.6, crash_mode=mode, start_step=2, duration_steps=8,
        resample=False,
    )  # fmt: skip
    condition = Condition(mode, config)
    fast = evaluate(policy, "buttons", condition, 30, 7, 8)
    slow = evaluate(policy, "buttons", condition, 30, 7, 8, effects=True)
    assert fast.episodes == slow.episodes
    assert sum(len(e.crashed) for e in fast.episodes) > 20
    withheld = {row.applied == WITHHELD for row in effects(slow)}
    assert withheld == {mode == "mute"}


TRIGGERED = {
    "hazard": fixed("mute", hazard_rate_hz=0.4, duration_steps=2),
    "near": fixed("mute", near_point_m=(10.0, 2.0), near_radius_m=1.0),
    "return": fixed("freeze", return_above=0.9),
}


@pytest.mark.parametrize("name", TRIGGERED)
def test_triggers_strike_alike_for_every_number_of_arenas(name: str) -> None:
    target, condition = Scripted("coverage_adaptive"), Condition(name, TRIGGERED[name])
    runs = [evaluate(target, "coverage", condition, 5, 7, k, effects=True) for k in (1, 3)]
    assert runs[0] == runs[1]
    begun = [row for row in runs[0].effects if row.kind == "ACTIVE"]
    assert begun
    assert {row.robot for row in begun} == {"robot_2"}
    assert any(row.step > 0 for row in begun)
    struck = {row.episode for row in begun}
    assert {e.episode for e in runs[0].episodes if e.crashed} == struck
    if name != "hazard":
        assert len(begun) == len(struck)


def test_adversarial_takes_the_least_valued_action(policy: RecurrentPolicy) -> None:
    """The hidden state and the input of the first step are known: so is what is valued least."""
    env = make_env("buttons", 1)
    env.reset(np.array([0]), 7, np.array([0]))
    none = np.full(2, -1, np.int32)
    q, _ = policy.forward(env.obs[0], none, np.arange(2, dtype=np.int32), policy.initial_hidden(2))
    expected = np.where(env.available[0], q, np.inf).argmin(axis=-1)
    run = evaluate(policy, "buttons", named(["robot_2"], "adversarial"), 1, 7, effects=True)
    assert effects(run)[0].applied == expected[1]
    assert effects(run)[0].intent == np.where(env.available[0], q, -np.inf).argmax(axis=-1)[1]


@pytest.mark.parametrize(
    ("target", "mode", "text"),
    [
        (Scripted("random"), "adversarial", "the command that the policy values least"),
        (Scripted("random"), "bias", "velocities"),
        (None, "scale", "velocities"),
    ],
)
def test_what_a_team_cannot_have_is_refused_at_the_start(
    policy: RecurrentPolicy, target: Scripted | None, mode: str, text: str
) -> None:
    who = named(["robot_1"], mode)
    with pytest.raises(UserError, match=f"condition .*crash mode {mode} needs {text}"):
        evaluate(target or policy, "buttons", who, 1, 0)


class Everyone:
    """A planner that is not a coach: robot ``episode`` mod n, muted at step 1, blind from 3 on."""

    def __init__(self, team: TeamSpec, seed: int) -> None:
        self._n, self._seed = team.n, seed

    def plan(self, episode: int) -> CrashPlan:
        robot = episode % self._n
        faults = Fault(robot, "mute", 1, 1, entry=4), Fault(robot, "blind", 3, 2, entry=9)
        return CrashPlan(episode, 0, self._seed, 0.0, 1, faults)


def test_any_planner_is_a_condition(policy: RecurrentPolicy) -> None:
    run = evaluate(policy, "buttons", Planned("mine", Everyone), 2, 7, effects=True)
    assert run.condition == "mine"
    assert [e.crashed for e in run.episodes] == [(0,), (1,)]
    assert run.effects[:6] == (
        EffectRow(0, 1, "ACTIVE", "robot_1", "mute", 4),
        EffectRow(0, 1, "EFFECT", "robot_1", "mute", 4, run.effects[1].intent, WITHHELD),
        EffectRow(0, 2, "CLEARED", "robot_1", "mute", 4),
        EffectRow(0, 3, "ACTIVE", "robot_1", "blind", 9),
        EffectRow(0, 3, "EFFECT", "robot_1", "blind", 9, -1, OBSERVED),
        EffectRow(0, 4, "EFFECT", "robot_1", "blind", 9, -1, OBSERVED),
    )
    refused = Planned("theirs", lambda team, seed: Coach(fixed("mute", min_alive=9), team, seed))
    with pytest.raises(UserError, match="condition 'theirs': min_alive 9"):
        evaluate(policy, "buttons", refused, 1, 0)


def rollout(crash: CoachConfig, scenario: str, arenas: int = 5) -> Rollout:
    env = make_env(scenario, arenas)
    coach = Coach(crash, TeamSpec.of(env.spec), SEED)
    policy = make_policy(scenario)
    return Rollout(env, policy, coach.plan, SEED, np.random.default_rng(2))


def arrays(finished: Finished) -> dict[str, np.ndarray]:
    return {k: np.array(v) for k, v in vars(finished.episode).items()}


STATEFUL = {
    "delay": fixed("delay", hazard_rate_hz=0.3, duration_steps=7, crash_parameters={"steps": 2}),
    "drop": fixed("drop", crash_parameters={"to_bad": 0.3, "to_good": 0.4}, start_step=2),
    "stale": fixed("stale", hazard_rate_hz=0.3, duration_steps=4),
    "freeze": fixed("freeze", return_above=-100.0, start_step=3),
    "adversarial": fixed("adversarial", near_point_m=(8.5, 5.0), near_radius_m=2.0),
}


@pytest.mark.parametrize("name", STATEFUL)
@pytest.mark.parametrize("steps", [9, 31])
def test_a_restored_rollout_continues_its_faults_bit_for_bit(name: str, steps: int) -> None:
    first = rollout(STATEFUL[name], "buttons")
    for _ in range(steps):
        first.step(0.5)
    state, values = first.state_dict()
    state = {key: array.copy() for key, array in state.items()}
    second = rollout(STATEFUL[name], "buttons")
    second.load_state_dict(state, json.loads(json.dumps(values)))
    faulted = 0
    for _ in range(45):
        expected, got = first.step(0.5), second.step(0.5)
        assert [f.plan for f in expected] == [f.plan for f in got]
        for one, other in zip(expected, got, strict=True):
            theirs = arrays(other)
            for key, array in arrays(one).items():
                np.testing.assert_array_equal(array, theirs[key], err_msg=key)
            faulted += int((one.episode.faults != 0).sum())
    assert faulted > 10


def test_replay_holds_what_the_team_saw() -> None:
    crash = fixed("blind", start_step=4, duration_steps=3)
    run = rollout(crash, "buttons")
    found = [arrays(f) for _ in range(40) for f in run.step(1.0)]
    assert len(found) >= 5
    for episode in found:
        blind = np.zeros(len(episode["obs"]), dtype=bool)
        blind[4:7] = True
        assert not episode["obs"][blind, 1].any()
        assert (episode["obs"][~blind, 1] != 0).any(axis=-1).all()
        np.testing.assert_array_equal(episode["faults"][:, 1], 20 * blind[:-1])
        assert not episode["faults"][:, 0].any()
        # What robot 2 sees is its own cell, which the state has too.
        np.testing.assert_array_equal(episode["obs"][~blind, 1], episode["state"][~blind, 2:4])


def test_the_end_of_an_episode_is_seen_through_the_fault_too() -> None:
    run = rollout(fixed("blind"), "buttons")
    found = [arrays(f) for _ in range(25) for f in run.step(1.0)]
    assert found
    assert not any(episode["obs"][:, 1].any() for episode in found)


def test_plans_survive_json() -> None:
    plan = CrashPlan(
        3, 1, 2**63 - 1, 0.1 + 0.2, 2,
        (
            Fault(0, "mute"),
            Fault(1, "drop", 4, 2, (("probability", 1 / 3), ("to_bad", math.pi / 10)), entry=3),
            Fault(2, "delay", trigger=Trigger(TriggerKind.NEAR, (0.1, -2.0, 1e-9))),
        ),
    )  # fmt: skip
    assert plan_from_json(json.loads(json.dumps(plan_to_json(plan)))) == plan
