"""An evaluation block crashes robots as training does then: every trigger, every strategy."""

from __future__ import annotations

from typing import Any

import pytest
from small_run import small

from crash_coach_pkg.coach.strategies import strategy_names
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.session import TEST_ARENAS, TEST_KEY, TrainSession
from sim_pkg.env import make_env

EPISODES = range(400)
TRIGGERS: dict[str, dict[str, Any]] = {
    "none": {},
    "hazard": {"hazard_rate_hz": 0.2},
    "near": {"near_point_m": (2.0, 4.0), "near_radius_m": 3.0},
    "return": {"return_above": -5.0},
}


def session(strategy: str, alpha: float, **trigger: Any) -> TrainSession:
    """A run whose coach is at crash rate ``alpha``, where its strategy has one."""
    settings = {"crash_rate": alpha, "min_alive": 1, "strategy": strategy, **trigger}
    config = small(coach=settings, test_episodes=12)
    env, test_env = (make_env(config.scenario, n) for n in (config.n_envs, TEST_ARENAS))
    made = TrainSession(config, env, test_env)
    state = made.coach.state_dict()
    if "rate" in state["strategy"]:
        made.coach.load_state_dict({**state, "strategy": {"rate": alpha}})
    return made


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("strategy", strategy_names())
def test_a_block_plans_as_training_does(strategy: str, trigger: str, alpha: float) -> None:
    made = session(strategy, alpha, **TRIGGERS[trigger])
    coach = made.coach
    block = coach.keyed(made.config.seed ^ TEST_KEY)
    trained, tested = ([p.plan(e) for e in EPISODES] for p in (coach, block))
    assert {plan.rate for plan in trained} == {plan.rate for plan in tested} == {coach.rate}
    assert {plan.cap for plan in trained} == {plan.cap for plan in tested}
    means = [sum(len(p.faults) for p in plans) / len(EPISODES) for plans in (trained, tested)]
    # The same law with other draws: 400 episodes of at most 2 robots.
    assert means[0] == pytest.approx(means[1], abs=0.15)
    kinds = [{f.trigger for p in plans for f in p.faults} for plans in (trained, tested)]
    assert kinds[0] == kinds[1]
    moving = strategy in ("adaptive", "curriculum")  # which have a rate that is 0 at first
    if moving and alpha == 0:
        assert means == [0, 0]


@pytest.mark.parametrize("trigger", [name for name in TRIGGERS if name != "none"])
def test_a_block_is_what_was_planned_and_adaptive_starts(trigger: str) -> None:
    """It never did with a trigger: at rate 0 the block struck everybody, training nobody."""
    made = session("adaptive", 0.0, **TRIGGERS[trigger])
    assert made.test().crashed.summary()["crashed_fraction"] == 0
    made.coach.record_block(1.0, made.progress)
    assert made.coach.rate == pytest.approx(0.01)


def test_the_blocks_of_a_fixed_rate_are_what_they_always_were() -> None:
    """Figures of published runs depend on these draws."""
    made = session("adaptive", 0.5)
    block = made.test().crashed
    assert [result.crashed for result in block.episodes] == GOLDEN


GOLDEN = [(), (1,), (0,), (1,), (), (0,), (1,), (0,), (1,), (), (), ()]


def test_the_configuration_says_what_counts() -> None:
    config = small(coach={"strategy": "deck", "deck": {"two": 3}, "adaptive": {"rho": 0.5}})
    dumped = config.model_dump(mode="json")["coach"]
    assert dumped["deck"] == {"nobody": 2, "one": 2, "two": 3, "three": 0}
    assert "adaptive" not in dumped
    assert TrainConfig.model_validate({**config.model_dump(), "coach": dumped}) == config
