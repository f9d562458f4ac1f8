"""The agent's memory: what it answers to duplicates, gaps, new episodes, wrong observations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from policy_team import ALL, OBS, ROBOTS, SPEC, actions, make_agent, sense

from crash_coach_common.contract import UserError
from policy_pkg.act import greedy
from policy_pkg.agent import ObservationError, Sensed
from policy_pkg.checkpoint import PolicyBundle, load_policy
from policy_pkg.untrained import write_untrained


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_0"
    write_untrained(folder, SPEC, seed=1)
    return folder


@pytest.fixture(scope="module")
def bundle(checkpoint: Path) -> PolicyBundle:
    return load_policy(checkpoint)


def test_alone_in_a_team_and_by_the_formula_the_actions_are_the_same(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(5)
    team = make_agent(bundle)
    alone = [make_agent(bundle, (name,)) for name in SPEC.robots]
    seen = set()
    for episode in range(3):
        hidden = bundle.policy.initial_hidden(ROBOTS)
        last = [-1] * ROBOTS
        for step in range(12):
            sensed = [sense(rng, step, episode, last[i]) for i in range(ROBOTS)]
            q, hidden = bundle.policy.forward(
                np.stack([s.features for s in sensed]),
                np.array(last, dtype=np.int32),
                np.arange(ROBOTS, dtype=np.int32),
                hidden,
            )
            available = np.stack([s.available for s in sensed]).astype(bool)
            expected = greedy(q, available).tolist()
            together = [a for i in (2, 0, 1) for a in team.receive(i, sensed[i])]
            assert actions(together) == expected
            assert [a.robot for a in together] == [0, 1, 2]
            least = [min(np.flatnonzero(a), key=q[i].__getitem__) for i, a in enumerate(available)]
            assert [a.worst_action for a in together] == least
            assert [a.stamp for a in together] == [f"{episode}/{step}"] * ROBOTS
            assert [actions(alone[i].receive(0, sensed[i]))[0] for i in range(ROBOTS)] == expected
            last = expected
            seen.update(expected)
    assert len(seen) > 2
    assert team.gaps == 0


def test_a_duplicate_gets_the_old_answer_and_leaves_the_memory_alone(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(6)
    steps = [sense(rng, step) for step in range(30)]
    plain, disturbed = (make_agent(bundle, ("robot_2",)) for _ in range(2))
    for sensed in steps:
        expected = plain.receive(0, sensed)
        assert disturbed.receive(0, sensed) == expected
        assert disturbed.receive(0, sensed) == expected
    assert len({a.action for s in steps for a in make_agent(bundle).receive(0, s)}) == 0


def test_an_older_observation_than_the_last_answered_is_not_answered(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(7)
    steps = [sense(rng, step) for step in range(4)]
    agent = make_agent(bundle, ("robot_1",))
    answered = [agent.receive(0, sensed) for sensed in steps]
    assert agent.receive(0, steps[1]) == []
    assert agent.receive(0, steps[3]) == answered[3]


def test_an_incomplete_step_is_answered_when_the_next_one_comes(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(8)
    first = [sense(rng, 0) for _ in range(ROBOTS)]
    second = [sense(rng, 1, last=0) for _ in range(ROBOTS)]
    agent, whole = make_agent(bundle), make_agent(bundle)
    expected = [a for i in range(ROBOTS) for a in whole.receive(i, first[i])]
    assert agent.receive(0, first[0]) == []
    assert agent.receive(2, first[2]) == []
    assert agent.receive(0, second[0]) == [expected[0], expected[2]]
    assert agent.receive(1, second[1]) == []
    assert len(agent.receive(2, second[2])) == ROBOTS
    assert agent.gaps == 1  # robot_2 was never seen at step 0


def test_a_repeated_observation_of_an_incomplete_step_is_answered_at_once(
    bundle: PolicyBundle,
) -> None:
    rng = np.random.default_rng(9)
    first = [sense(rng, 0) for _ in range(ROBOTS)]
    agent, whole = make_agent(bundle), make_agent(bundle)
    expected = [a for i in range(ROBOTS) for a in whole.receive(i, first[i])]
    assert agent.receive(0, first[0]) == []
    assert agent.receive(0, first[0]) == [expected[0]]
    assert agent.receive(0, first[0]) == [expected[0]]


def test_a_new_episode_forgets_the_old_one(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(10)
    agent = make_agent(bundle, ("robot_3",))
    start = [sense(rng, step) for step in range(3)]
    before = [actions(agent.receive(0, sensed)) for sensed in start]
    again = [Sensed(1, s.step, s.last_action, s.features, s.available, s.stamp) for s in start]
    assert [actions(agent.receive(0, sensed)) for sensed in again] == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": np.zeros(7, np.float32)}, "robot_2: expected 6 features, got 7"),
        ({"available": np.ones(4, np.uint8)}, "robot_2: expected 5 available_actions, got 4"),
        ({"available": np.zeros(5, np.uint8)}, "robot_2: no action is available"),
        ({"last_action": 5}, r"robot_2: last_action 5 is not in \[-1, 4\]"),
        ({"features": np.full(6, np.nan, np.float32)}, "robot_2: the action values are not finite"),
    ],
)
def test_what_the_policy_cannot_use_is_refused(
    bundle: PolicyBundle, change: dict[str, object], message: str
) -> None:
    fields = {
        "episode": 0,
        "step": 0,
        "last_action": -1,
        "features": np.zeros(OBS, np.float32),
        "available": ALL,
        "stamp": "",
    }
    agent = make_agent(bundle, ("robot_2",))
    with pytest.raises(ObservationError, match=message):
        agent.receive(0, Sensed(**{**fields, **change}))  # type: ignore[arg-type]


def test_a_robot_of_another_team_is_refused(bundle: PolicyBundle) -> None:
    with pytest.raises(UserError, match=r"robot_9.*robot_1, robot_2, robot_3"):
        make_agent(bundle, ("robot_9",))
