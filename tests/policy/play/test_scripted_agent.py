"""A scripted team one observation at a time does what it does in one process."""

from __future__ import annotations

import numpy as np
import pytest

from crash_coach_common.contract import UserError
from policy_pkg.agent import ObservationError, Sensed
from policy_pkg.play.scripted_agent import ScriptedAgent
from sim_pkg.env import make_env
from sim_pkg.scripted import make_scripted, scripted_names
from sim_pkg.session import Session

SEED = 5
TEAMS = [
    (scenario, name)
    for scenario in ("buttons", "coverage", "transport", "skirmish/3s_vs_3z")
    for name in scripted_names(make_env(scenario, 1))
]


def sensed(session: Session, robot: int) -> Sensed[None]:
    return Sensed(
        session.episode,
        session.step,
        int(session.last_actions[robot]),
        session.obs[robot].copy(),
        session.available[robot].astype(np.uint8),
        None,
    )


@pytest.mark.parametrize(("scenario", "name"), TEAMS)
def test_each_robot_on_its_own_acts_as_in_the_team(scenario: str, name: str) -> None:
    env = make_env(scenario, 1)
    session, team = Session(env, SEED, 0), make_scripted(name, env)
    agents = [ScriptedAgent[None](name, scenario, [robot], SEED) for robot in env.spec.robots]
    actions = np.zeros((1, env.spec.n_robots), np.int32)
    for _ in range(2):
        session.begin()
        team.begin(np.array([0]), SEED, np.array([session.episode]))
        while session.running:
            team.act(session.obs[None], session.available[None], actions)
            for robot, agent in enumerate(agents):
                (answer,) = agent.receive(0, sensed(session, robot))
                assert agent.receive(0, sensed(session, robot)) == [answer]  # told again
                assert answer.action == actions[0, robot]
            session.advance(actions[0], np.zeros(env.spec.n_robots, np.uint8))


def test_missed_steps_go_by() -> None:
    """What a policy draws is keyed by the step, also in a node that begins in mid-episode."""
    env = make_env("buttons", 1)
    session = Session(env, SEED, 0)
    session.begin()
    early, late = (ScriptedAgent[None]("random", "buttons", (), SEED) for _ in range(2))
    situation = sensed(session, 0)
    seen = [Sensed(0, step, -1, situation.features, situation.available, None) for step in range(9)]
    answers = [early.receive(0, one)[0] for one in seen]
    assert late.receive(0, seen[4]) == [answers[4]]
    assert late.receive(0, seen[8]) == [answers[8]]
    assert late.receive(0, seen[5]) == []


def test_what_is_wrong_is_named() -> None:
    with pytest.raises(UserError, match="robot 'robot_9' is not of buttons: robot_1, robot_2"):
        ScriptedAgent[None]("hold", "buttons", ["robot_9"], 0)
    agent = ScriptedAgent[None]("hold", "buttons", (), 0)
    wrong = Sensed(0, 0, -1, np.zeros(3, np.float32), np.ones(2, np.uint8), None)
    with pytest.raises(ObservationError, match=r"expected .* features"):
        agent.receive(0, wrong)
