"""Weights that change between episodes, and exploration that no order of arrival can change."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import save

from crash_coach_common.contract import UserError
from policy_pkg.act import Exploration, greedy
from policy_pkg.agent import Sensed
from policy_pkg.live_weights import LiveAgent, Weights
from policy_pkg.policy import weight_shapes

TEAM = ("robot_1", "robot_2", "robot_3")
OBS, ACTIONS, HIDDEN = 4, 5, 8


def agent_bytes(seed: int, hidden: int = HIDDEN) -> bytes:
    rng = np.random.default_rng(seed)
    shapes = weight_shapes(OBS + ACTIONS + len(TEAM), hidden, ACTIONS)
    return save({k: rng.standard_normal(shape).astype(np.float32) for k, shape in shapes.items()})


def weights(
    version: int, from_episode: int, epsilon: float = 0.0, team: tuple[str, ...] = TEAM
) -> Weights:
    agent = agent_bytes(version)
    return Weights.read(version, from_episode, epsilon, 7, team, OBS, ACTIONS, agent)


def sense(episode: int, step: int, robot: int) -> Sensed[int]:
    rng = np.random.default_rng([episode, step, robot])
    available = np.ones(ACTIONS, np.uint8)
    available[rng.integers(ACTIONS)] = 0
    features = rng.standard_normal(OBS).astype(np.float32)
    return Sensed(episode, step, -1 if step == 0 else 0, features, available, robot)


def episode_actions(live: LiveAgent[int], episode: int, steps: int = 6) -> list[int]:
    """Of all robots that ``live`` acts for, step by step."""
    live.begin(episode)
    out: list[int] = []
    for step in range(steps):
        for index, name in enumerate(live.agent.robots):
            sensed = sense(episode, step, TEAM.index(name))
            out += [answer.action for answer in live.agent.receive(index, sensed)]
    return out


def test_weights_count_from_their_episode_on_and_not_within_one() -> None:
    alone = {
        version: episode_actions(LiveAgent(weights(version, 0), ()), 4) for version in (1, 2, 3)
    }
    assert alone[1] != alone[2] != alone[3]
    live: LiveAgent[int] = LiveAgent(weights(1, 0), ())
    live.offer(weights(2, 4))
    live.offer(weights(3, 5))
    assert episode_actions(live, 3) == episode_actions(LiveAgent(weights(1, 0), ()), 3)
    assert episode_actions(live, 4) == alone[2]
    assert episode_actions(live, 5) == episode_actions(LiveAgent(weights(3, 0), ()), 5)


def test_the_newest_of_several_counts_by_arrival_not_by_number() -> None:
    live: LiveAgent[int] = LiveAgent(weights(9, 0), ())
    live.offer(weights(8, 0))
    live.offer(weights(2, 1))  # of a trainer that was restarted
    assert episode_actions(live, 1) == episode_actions(LiveAgent(weights(2, 0), ()), 1)


def test_a_robot_on_its_own_explores_as_it_does_in_the_team() -> None:
    team = np.array(episode_actions(LiveAgent(weights(1, 0, 0.5), ()), 6)).reshape(-1, len(TEAM))
    greedy_team = np.array(episode_actions(LiveAgent(weights(1, 0), ()), 6)).reshape(team.shape)
    assert (team != greedy_team).any()
    for index, name in enumerate(TEAM):
        alone = episode_actions(LiveAgent(weights(1, 0, 0.5), (name,)), 6)
        assert alone == team[:, index].tolist()


def test_exploration_draws_available_actions_evenly_and_as_often_as_told() -> None:
    exploration = Exploration(0.3, seed=5, team=4)
    available = np.array([[1, 1, 0, 1], [0, 1, 1, 1], [1, 0, 1, 1], [1, 1, 1, 1]], bool)
    q = np.tile(np.array([9, 8, 7, -1], np.float32), (4, 1))
    best = greedy(q, available)
    robots = np.arange(4, dtype=np.int32)
    chosen = np.array(
        [exploration.choose(best, available, robots, 2, step) for step in range(4000)]
    )
    for robot in range(4):
        assert available[robot][chosen[:, robot]].all()
        counts = np.bincount(chosen[:, robot], minlength=4) / len(chosen)
        choices = available[robot].sum()
        expected = np.where(available[robot], 0.3 / choices, 0.0)
        expected[best[robot]] += 0.7
        assert np.abs(counts - expected).max() < 0.03  # about four standard deviations
    assert np.array_equal(Exploration(0.0, 5, 4).choose(best, available, robots, 2, 0), best)
    some = exploration.choose(best[[3, 1]], available[[3, 1]], robots[[3, 1]], 2, 17)
    assert some.tolist() == chosen[17, [3, 1]].tolist()


def test_the_draws_differ_by_seed_episode_and_step() -> None:
    best, available = np.zeros(64, np.int32), np.ones((64, 4), bool)
    robots = np.arange(64, dtype=np.int32)
    seen = {
        Exploration(1.0, seed, 64).choose(best, available, robots, episode, step).tobytes()
        for seed in (0, 1)
        for episode in (0, 1)
        for step in (0, 1)
    }
    assert len(seen) == 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epsilon": 1.5}, r"weights 3: epsilon 1.5 is not in \[0, 1\]"),
        ({"agent": b"nothing"}, "weights 3 of 7 bytes: "),
        ({"agent": agent_bytes(1)[:-9]}, "weights 3 of "),
        ({"obs_size": 3}, "are for 4 observation features, not 3"),
        ({"n_actions": 6}, "weights 3 of "),
        ({"robots": ()}, "weights 3 name no robots"),
    ],
)
def test_damaged_weights_are_refused(change: dict[str, object], message: str) -> None:
    fields = {"version": 3, "from_episode": 0, "epsilon": 0.1, "seed": 1, "robots": TEAM}
    fields |= {"obs_size": OBS, "n_actions": ACTIONS, "agent": agent_bytes(1), **change}
    with pytest.raises(UserError, match=message):
        Weights.read(**fields)  # type: ignore[arg-type]


def test_weights_of_another_team_or_size_are_refused_and_leave_the_old_ones() -> None:
    live: LiveAgent[int] = LiveAgent(weights(1, 0), ())
    before = episode_actions(live, 1)
    with pytest.raises(UserError, match="weights 2 have robots"):
        live.offer(weights(2, 0, team=("robot_1", "robot_2", "robot_4")))
    larger = Weights.read(2, 0, 0.0, 7, TEAM, OBS, ACTIONS, agent_bytes(2, hidden=9))
    with pytest.raises(UserError, match="weights 2 have shapes"):
        live.offer(larger)
    assert episode_actions(live, 1) == before
    with pytest.raises(UserError, match="'robot_9' is not of this checkpoint's team"):
        LiveAgent(weights(1, 0), ("robot_9",))
