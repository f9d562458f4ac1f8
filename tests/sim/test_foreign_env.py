"""PettingZoo environments as scenarios: their arrays, their episodes, what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crash_coach_common.contract import UserError
from sim_pkg.env import make_any_env, make_env
from sim_pkg.foreign.config import EnvRules
from sim_pkg.foreign.env import ForeignEnv
from sim_pkg.scenario_source import read_scenario, short_name

CORRIDOR = "pettingzoo:corridor_env:Corridor"


def corridor(n_arenas: int = 1, args: dict[str, Any] | None = None, **rules: Any) -> ForeignEnv:
    told = EnvRules.model_validate({"stay_action": 0, **rules})
    env = make_any_env(read_scenario(CORRIDOR, args or {}, told), n_arenas)
    assert isinstance(env, ForeignEnv)
    return env


def start(env: ForeignEnv, seed: int, *episodes: int) -> None:
    env.reset(np.arange(len(episodes)), seed, np.array(episodes))


def act(env: ForeignEnv, *actions: int) -> Any:
    return env.step(np.array([actions], dtype=np.int32))


def test_what_it_promises() -> None:
    spec = corridor(success_info="all_through").spec
    assert spec.robots == ("slow_1", "quick_2")
    assert spec.roles == ("slow", "quick")
    assert (spec.obs_size, spec.state_size, spec.n_actions) == (3, 3, 3)
    assert spec.stay_actions == (0, 1, 2)
    assert (spec.episode_limit, spec.dt_s, spec.bounds) == (20, 0.25, (-1.0, 20.0))
    assert spec.reports_success
    assert not spec.reports_positions
    assert not corridor().spec.reports_success


def test_rows_are_padded_and_agents_that_left_can_only_stay() -> None:
    env = corridor(success_info="all_through")
    start(env, 3, 0)
    places = env.state[0, :2].copy()
    np.testing.assert_array_equal(env.obs[0], [[places[0], 0, 0], [places[1], 0, 1]])
    np.testing.assert_array_equal(env.available[0, 0], [True, True, False])
    assert env.available[0, 1].tolist() == [True, True, bool(places[1] % 2 == 0)]
    for _ in range(int(6 - places[1])):
        result = act(env, 0, 1)
    assert env.alive(0).tolist() == [True, False]
    assert result.reward[0] == pytest.approx(0.9)
    assert not result.terminated[0]
    result = act(env, 1, 0)  # whoever has left is asked for nothing more
    np.testing.assert_array_equal(env.obs[0, 1], [0, 0, 0])
    assert env.available[0, 1].tolist() == [True, False, False]
    with pytest.raises(ValueError, match="action 1 of quick_2 in arena 0 is not available"):
        act(env, 1, 1)
    while env.running[0]:
        result = act(env, 1, 0)
    assert (result.terminated[0], result.truncated[0], result.success[0]) == (True, False, True)


def test_an_episode_at_its_limit_is_truncated() -> None:
    env = corridor(success_info="all_through")
    start(env, 1, 0)
    for step in range(20):
        result = act(env, 0, 0)
        assert bool(result.truncated[0]) is (step == 19)
    assert not result.terminated[0]
    assert not result.success[0]
    cut = corridor(episode_limit=3, success_return=-1.0)
    start(cut, 1, 0)
    results = [bool(act(cut, 0, 0).truncated[0]) for _ in range(3)]
    assert results == [False, False, True]
    assert cut.spec.episode_limit == 3


def test_success_by_return_and_the_mean_reward() -> None:
    for least, expected in ((-1.91, True), (-1.89, False)):
        env = corridor(success_return=least, team_reward="mean", episode_limit=19)
        start(env, 1, 0)
        for _ in range(19):
            result = act(env, 0, 0)
            assert result.reward[0] == pytest.approx(-0.1)
        assert bool(result.success[0]) is expected


def test_an_episode_follows_from_its_key_whatever_the_batch() -> None:
    alone, four = corridor(), corridor(4)
    start(four, 7, 3, 4, 5, 6)
    starts = four.state.copy()
    for i, episode in enumerate((3, 4, 5, 6)):
        start(alone, 7, episode)
        np.testing.assert_array_equal(alone.state[0], starts[i])
    start(four, 8, 3, 4, 5, 6)
    assert not np.array_equal(four.state, starts)


def test_without_a_state_the_joined_observations_are_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import corridor_env

    monkeypatch.delattr(corridor_env.Corridor, "state")
    env = corridor()
    start(env, 1, 0)
    assert env.spec.state_size == 6
    np.testing.assert_array_equal(env.state[0], env.obs[0].ravel())


@pytest.mark.parametrize(
    ("scenario", "args", "rules", "text"),
    [
        (CORRIDOR, {}, {"stay_action": None}, "stay_action is missing.*0 to 2"),
        (CORRIDOR, {}, {"stay_action": 3}, "stay_action = 3: actions are 0 to 2"),
        (CORRIDOR, {}, {"action_names": ["a", "b"]}, "2 names, but there are 3 actions"),
        (
            CORRIDOR,
            {},
            {"action_names": ["stay", "step", "leap"], "stay_action": "leep"},
            "did you mean 'leap'",
        ),
        (CORRIDOR, {"lenght": 3}, {}, "refuses its arguments .*lenght"),
        ("pettingzoo:corridor_env:Corridorr", {}, {}, "did you mean 'Corridor'"),
        ("pettingzoo:corridor_env:Continuous", {}, {}, "only Discrete ones"),
        ("pettingzoo:no_such_module:make", {}, {}, "No module named 'no_such_module'"),
        ("pettingzoo:corridor", {}, {}, "entry points crash_coach.environments"),
        ("pettingzoo:json:dumps", {"obj": 1}, {}, "gives str: a ParallelEnv"),
        ("buttons", {"n": 1}, {}, "'n' has no meaning there"),
        ("buttons", {}, {"dt_s": 1.0}, "no meaning there"),
    ],
)
def test_what_is_refused(
    scenario: str, args: dict[str, Any], rules: dict[str, Any], text: str
) -> None:
    told = {} if scenario == "buttons" else {"stay_action": 0}
    with pytest.raises(UserError, match=text):
        make_any_env(read_scenario(scenario, args, EnvRules(**{**told, **rules})), 1)


def test_a_success_key_that_never_comes() -> None:
    env = corridor(success_info="won", episode_limit=1)
    start(env, 1, 0)
    with pytest.raises(UserError, match="success_info = 'won': no such key"):
        act(env, 0, 0)


def test_a_scenario_file_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text(
        "kind: pettingzoo\nenvironment: corridor_env:Corridor\nenv_args: {length: 4}\n"
        "action_names: [stay, step, leap]\nstay_action: stay\nsuccess_info: all_through\n"
    )
    env = make_any_env(path, 2)
    assert env.config.env_args == {"length": 4}
    assert env.spec.action_names == ("stay", "step", "leap")
    longer = make_any_env(read_scenario(path, {"length": 9}), 1)
    assert longer.config.env_args == {"length": 9}
    with pytest.raises(UserError, match=r"hall.yaml.* PettingZoo environment.*no ROS graph"):
        make_env(path, 1)
    path.write_text(path.read_text() + "stay: 1\n")
    with pytest.raises(UserError, match=r"hall.yaml:7: unknown key 'stay'"):
        make_any_env(path, 1)


def test_names_of_files() -> None:
    assert short_name("pettingzoo:mpe2.simple_spread_v3:parallel_env") == "simple_spread_v3"
    assert short_name("pettingzoo:warehouse") == "warehouse"
    assert short_name("skirmish/3m") == "3m"
    assert short_name("some/where/hall.yaml") == "hall"
