"""Every kind of damage: one clear line that names it, and no episode made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import Made, Sent, Team, change, messages, played, write
from test_bag_round_trip import compare

from policy_pkg.bags.dataset import RecordedEpisode, load_episodes
from policy_pkg.bags.problems import BagError, Problem, Severity

Change = Callable[[list[Sent]], list[Sent]]


def read(*folders: Path) -> tuple[list[RecordedEpisode], list[Problem]]:
    problems: list[Problem] = []
    return list(load_episodes(folders, report=problems.append)), problems


def nth(sent: list[Sent], topic: str, number: int = 0) -> int:
    return [i for i, one in enumerate(sent) if one.topic == topic][number]


def without(topic: str, number: int) -> Change:
    def edit(sent: list[Sent]) -> list[Sent]:
        at = nth(sent, topic, number)
        return sent[:at] + sent[at + 1 :]

    return edit


def altered(topic: str, number: int, msgtype: str, twice: bool = False, **fields: object) -> Change:
    def edit(sent: list[Sent]) -> list[Sent]:
        at = nth(sent, topic, number)
        kept = [sent[at]] if twice else []
        return [*sent[:at], *kept, change(sent[at], msgtype, **fields), *sent[at + 1 :]]

    return edit


NAN = np.array([np.nan], np.float32)
CASES: dict[str, tuple[Change, str, Severity]] = {
    "lost observation": (
        without("/robot_2/observation", 7), "no observation of robot_2's step 7",
        Severity.INCOMPLETE,
    ),
    "lost state": (
        without("/sim/episode", 5), "no EpisodeState of step 5", Severity.INCOMPLETE,
    ),
    "lost effect": (
        without("/coach/events", 0), "no ", Severity.INCOMPLETE,
    ),
    "two observations of one step": (
        altered("/robot_1/observation", 3, "Observation", twice=True, last_action=77),
        "/robot_1/observation, step 3, comes twice with different content", Severity.DAMAGED,
    ),
    "another sim's state": (
        altered("/sim/episode", 4, "EpisodeState", twice=True, seed=99),
        "seeds 3 and 99: two sims", Severity.DAMAGED,
    ),
    "wrong robot count": (
        altered("/sim/episode", 2, "EpisodeState", crashed=np.zeros(3, np.uint8)),
        "wrong robot count: EpisodeState.crashed of step 2 has 3", Severity.DAMAGED,
    ),
    "NaN in the reward": (
        altered("/sim/episode", 2, "EpisodeState", reward=float("nan")), "NaN", Severity.DAMAGED,
    ),
    "changed reward": (
        altered("/sim/episode", 2, "EpisodeState", reward=7.0),
        "do not give its trajectory hash", Severity.DAMAGED,
    ),
    "unavailable action": (
        altered("/sim/episode", 2, "EpisodeState", actions=np.array([99, 0], np.int32)),
        "robot_1 executed action 99 in step 1, which was not available", Severity.DAMAGED,
    ),
    "effect without a fault": (
        altered("/robot_1/command", 0, "Action", fault=2), "robot_1", Severity.INCOMPLETE,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_damage_within_an_episode(tmp_path: Path, team: Team, made: list[Made], name: str) -> None:
    edit, text, severity = CASES[name]
    sent = edit(made[0].sent) + messages(made[1:3])
    folder = write(tmp_path / "bag", team, sent)
    got, problems = read(folder)
    compare(made[1:3], got)
    (problem,) = problems
    assert text in str(problem)
    assert f"{folder}: episode 0: left out: " in str(problem)
    assert problem.severity is severity
    with pytest.raises(BagError, match="episode 0"):
        list(load_episodes([folder], strict=True))


def test_nan_in_an_observation_names_robot_and_step(
    tmp_path: Path, team: Team, made: list[Made]
) -> None:
    features = made[0].episode.obs[6, 1].copy()
    features[0] = np.inf
    edit = altered("/robot_2/observation", 6, "Observation", features=features)
    _, problems = read(write(tmp_path / "bag", team, edit(made[0].sent)))
    assert "NaN or infinity in /robot_2/observation, step 6" in str(problems[0])


def test_contradicting_command_and_event(tmp_path: Path) -> None:
    team = Team(p_fault=1.0)
    (made,) = played(team, 1)
    at = next(i for i, one in enumerate(made.sent) if one.topic.endswith("/command"))
    for fields, text in (
        ({"fault": 8}, "fault code 8 in the command, 2 (random) in the EFFECT"),
        ({"fault": 0}, "an EFFECT of random, but a command without a fault"),
        ({"action": 77}, "a command with action 77, but an EFFECT that applied"),
    ):
        sent = list(made.sent)
        sent[at] = change(sent[at], "Action", **fields)
        got, problems = read(write(tmp_path / str(fields), team, sent))
        assert not got
        assert text in str(problems[0])


def test_a_restarted_sim_with_another_seed(tmp_path: Path, team: Team, made: list[Made]) -> None:
    other = Team(seed=8)
    sent = messages(made[:2]) + messages(played(other, 2))
    got, problems = read(write(tmp_path / "bag", team, sent))
    compare(made[:2], got)
    assert [str(p) for p in problems] == [
        f"{tmp_path / 'bag'}: episode {number} comes twice, seeds 3 and 8: two sims, or a "
        "restarted one, in one bag; the second is left out"
        for number in (0, 1)
    ]


def test_missing_topics(tmp_path: Path, team: Team, made: list[Made]) -> None:
    sent = [one for one in messages(made[:2]) if one.topic != "/sim/episode"]
    got, problems = read(write(tmp_path / "bag", team, sent))
    assert not got
    texts = [str(p) for p in problems]
    assert f"{tmp_path / 'bag'}: missing topic: no message on /sim/episode" in texts
    assert f"{tmp_path / 'bag'}: episode 0: left out: it has no end" in texts


def test_a_topic_of_another_type(tmp_path: Path, team: Team, made: list[Made]) -> None:
    team = Team()
    team.connections = tuple(
        replace(c, msgtype="std_msgs/msg/String") if c.topic == "/sim/episode" else c
        for c in team.connections
    )
    _, problems = read(write(tmp_path / "bag", team, messages(made[:1])))
    assert "topic /sim/episode has type std_msgs/msg/String, not crash_coach_interfaces" in str(
        problems[0]
    )


def test_a_robot_who_is_not_of_the_team(tmp_path: Path, team: Team, made: list[Made]) -> None:
    about = replace(team.about, robots=("robot_1",))
    _, problems = read(write(tmp_path / "bag", team, messages(made[:1]), about=about))
    assert "robot_2 is not one of the team (robot_1)" in str(problems[0])
    assert "episode 0: left out: " in str(problems[-1])


def test_bags_of_different_teams(tmp_path: Path, team: Team, made: list[Made]) -> None:
    other = Team("coverage")
    write(tmp_path / "a", team, messages(made[:1]))
    write(tmp_path / "b", other, messages(played(other, 1)))
    with pytest.raises(BagError, match="its robots are"):
        list(load_episodes([tmp_path]))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nowhere", "there is no such file or folder"),
        ("empty", "no MCAP recording in it"),
        ("old", "an SQLite recording"),
        ("packed", "compressed as a whole"),
    ],
)
def test_no_recording_there(tmp_path: Path, name: str, text: str) -> None:
    for folder in ("empty", "old", "packed"):
        (tmp_path / folder).mkdir()
    (tmp_path / "old" / "x.db3").touch()
    (tmp_path / "packed" / "x.mcap.zstd").touch()
    with pytest.raises(BagError, match=text):
        list(load_episodes([tmp_path / name]))


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_truncated_file(tmp_path: Path, team: Team, made: list[Made], kept: float) -> None:
    folder = write(tmp_path / "bag", team, messages(made))
    path = folder / "bag_0.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    got, problems = read(folder)
    whole = [one for one in made if one.number in {g.number for g in got}]
    compare(whole, got)
    assert str(path) in str(problems[0])
    assert "cut off" in str(problems[0])
