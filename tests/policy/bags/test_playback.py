"""A recorded episode played again is the recorded one, bit for bit, or is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import Made, Team, change, messages, played, write

from crash_coach_common.contract import UserError
from policy_pkg.bags.dataset import load_episodes
from policy_pkg.bags.playback import play_back, read_episode
from policy_pkg.bags.problems import BagError
from sim_pkg.scenario_files import find_scenario


@pytest.fixture(scope="module")
def made() -> list[Made]:
    team = Team()
    return [team.play(), team.play(cut_at=7), team.play()]


@pytest.fixture(scope="module")
def bag(made: list[Made], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("playback") / "bag", Team(), messages(made))


@pytest.mark.parametrize("number", [0, 1, 2])
def test_it_is_the_recorded_episode(bag: Path, made: list[Made], number: int) -> None:
    """Also one that was cut short, as by /sim/reset."""
    recorded, about = read_episode(bag, number)
    assert about is not None
    frames = play_back(recorded, about.scenario)
    episode = made[number].episode
    assert (frames.seed, frames.episode, frames.steps) == (3, number, episode.length)
    assert frames.trajectory_hash == recorded.trajectory_hash
    assert frames.returns[-1] == pytest.approx(float(episode.reward.sum()))
    np.testing.assert_array_equal(frames.crashed, episode.faults != 0)
    assert frames.crashed.any()
    assert frames.success is made[number].success


@pytest.mark.parametrize("scenario", ["skirmish/3m", "transport"])
def test_bodies_are_where_they_were(scenario: str, tmp_path: Path) -> None:
    """Against the simulator's own words, which the recording has no field for."""
    team = Team(scenario, relay=True)
    one = team.play()
    recorded, _ = read_episode(write(tmp_path / "bag", team, one.sent), None)
    frames = play_back(recorded, scenario)
    places = team.env.world.bodies[0, :, :2].astype(np.float32)
    np.testing.assert_array_equal(frames.positions_m[-1], places)


@pytest.mark.parametrize(
    ("here", "there", "step"),
    [("reward_step: -1.0", "reward_step: -0.5", 20), ("[7, 8]", "[8, 8]", 0)],
)
def test_another_version_of_the_scenario_is_refused(
    bag: Path, tmp_path: Path, here: str, there: str, step: int
) -> None:
    text = find_scenario("buttons").read_text()
    assert text.count(here) == 1
    mine = tmp_path / "mine.yaml"
    mine.write_text(text.replace(here, there))
    recorded, _ = read_episode(bag, 0)
    assert recorded.episode.length == 20
    with pytest.raises(UserError, match=f"episode 0 cannot be played again: by step {step} "):
        play_back(recorded, mine)


def test_actions_that_were_not_those_are_refused(bag: Path) -> None:
    recorded, _ = read_episode(bag, 0)
    episode = recorded.episode
    other = replace(recorded, trajectory_hash="0" * 64)
    with pytest.raises(UserError, match=f"by step {episode.length} "):
        play_back(other, "buttons")
    state = episode.state.copy()
    state[4, 0] += np.float32(1e-6)
    with pytest.raises(UserError, match="by step 4 "):
        play_back(replace(recorded, episode=replace(episode, state=state)), "buttons")


def test_another_team_is_refused(bag: Path) -> None:
    recorded, _ = read_episode(bag, 0)
    with pytest.raises(UserError, match=r"other robots \(robot_1, robot_2\) than scenario 'tran"):
        play_back(recorded, "transport")
    with pytest.raises(UserError, match="other robots"):
        play_back(recorded, "buttons_8")


def test_the_error_lists_what_there_is(bag: Path) -> None:
    with pytest.raises(BagError, match=r"no complete episode 7; complete: 0\.\.2$"):
        read_episode(bag, 7)
    with pytest.raises(BagError, match="no such file"):
        read_episode(bag / "nowhere", 0)


def test_the_error_says_what_is_missing(tmp_path: Path) -> None:
    team = Team()
    sent = messages(played(team, 4))
    states = [i for i, one in enumerate(sent) if one.topic == "/sim/episode"]
    del sent[states[25]]  # in the second of four episodes of 21 states
    bag = write(tmp_path / "a", team, sent)
    with pytest.raises(BagError, match=r"no complete episode 1 \(left out: no EpisodeState of"):
        read_episode(bag, 1)
    with pytest.raises(BagError, match=r"complete: 0, 2\.\.3$"):
        read_episode(bag, 1)
    assert read_episode(bag, None)[0].number == 0
    write(tmp_path / "b", team, sent[:9])
    with pytest.raises(BagError, match=r"no complete episode \(.*no end.*\); complete: none"):
        read_episode(tmp_path / "b", None)
    with pytest.raises(BagError, match="name one of its 2 recordings"):
        read_episode(tmp_path, 0)


def test_a_seed_beyond_a_signed_number(tmp_path: Path) -> None:
    """As far as a recording can say one."""
    team = Team(seed=2**64 - 1)
    bag = write(tmp_path / "bag", team, team.play().sent)
    (recorded,) = load_episodes([bag])
    assert play_back(recorded, "buttons").seed == 2**64 - 1


def test_a_forged_seed_is_refused(tmp_path: Path) -> None:
    """A recording whose hash is right, of a world that does not exist: left out when read."""
    team = Team()
    sent = [
        change(one, "EpisodeState", seed=4) if one.topic == "/sim/episode" else one
        for one in team.play().sent
    ]
    with pytest.raises(BagError, match="do not give its trajectory hash"):
        read_episode(write(tmp_path / "bag", team, sent), 0)
