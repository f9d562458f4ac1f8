"""Runs and recordings on the page, without ROS or a browser: the episodes are the real ones."""

from __future__ import annotations

import asyncio
import gzip
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_maker import Made, Team, messages, write

from crash_coach_common.contract import UserError
from crash_coach_console.board import Cursor
from crash_coach_console.curves import MOST_POINTS, Curves, curves_of, read_rows
from crash_coach_console.episode_source import EpisodeSource
from crash_coach_console.playback import Playback
from crash_coach_console.player import CHUNK, Player
from crash_coach_console.recording import Recording
from crash_coach_console.requests import Inject, Request, parse_request
from policy_pkg.play.conditions import crash_free, named
from policy_pkg.play.evaluate import Scripted, evaluate, evaluation_seed
from policy_pkg.play.target import load_target

WAIT_S = 60.0
SCENARIO, KITE = "skirmish/3s_vs_5z", "scripted:kite"
KEY = evaluation_seed(4)


def inject(*victims: str, mode: str = "mute", **fields: Any) -> Inject:
    return Inject(type="inject", id=0, source=0, victims=victims, mode=mode, **fields)


@pytest.fixture(scope="module")
def player() -> Player:
    return Player(load_target(KITE, SCENARIO), seed=4)


def test_a_run_plays_the_episodes_that_evaluate_plays(player: Player) -> None:
    film = player.choose(2)
    result = evaluate(Scripted("kite"), SCENARIO, crash_free(), range(2, 3), KEY).episodes[0]
    assert film.frames.trajectory_hash == result.trajectory_hash
    assert (film.played.success, film.played.steps) == (result.success, result.steps)
    assert film.stretches == []


def test_the_same_episode_goes_otherwise_from_the_crash_on(player: Player) -> None:
    before = player.choose(2)
    crashed, said = player.crash(before, inject("robot_2"), 10)
    assert said == "robot_2: mute from the next step on (from step 10 of this episode)"
    assert crashed.begin == 10
    np.testing.assert_array_equal(crashed.frames.positions_m[:11], before.frames.positions_m[:11])
    assert crashed.stretches == [
        {"robot": "robot_2", "mode": "mute", "from": 10, "to": crashed.frames.steps}
    ]
    states = [robot["state"] for robot in crashed.team(11)["robots"]]
    assert states == ["ok", "faulted", "ok"]
    last = crashed.team(11)["robots"][1]["steps"][-1]
    assert last[:2] == [2, 10]
    assert last[2] == crashed.frames.intents[10, 1]
    assert last[3:] == [-1, "mute"]
    after = player.after(crashed)
    result = evaluate(Scripted("kite"), SCENARIO, named(["robot_2"]), range(3, 4), KEY).episodes[0]
    assert after.frames.trajectory_hash == result.trajectory_hash
    both, _ = player.crash(after, inject("robot_1"), after.frames.steps)
    assert both.begin == 0
    assert {s["robot"] for s in both.stretches} == {"robot_1", "robot_2"}
    cleared, said = player.clear(both, ("robot_1",))
    assert said.startswith("still crashed: robot_2")
    assert {s["robot"] for s in cleared.stretches} == {"robot_2"}
    cleared, said = player.clear(cleared, ())
    assert cleared.stretches == []


def test_parameters_and_duration_of_a_crash(player: Player) -> None:
    film = player.choose(0)
    asked = inject("robot_3", mode="delay", parameters={"steps": 3.0}, duration_steps=5)
    crashed, _ = player.crash(film, asked, 4)
    assert crashed.stretches == [{"robot": "robot_3", "mode": "delay", "from": 4, "to": 9}]
    with pytest.raises(UserError, match="crash mode delay: no parameter 'stps'"):
        player.crash(film, inject("robot_3", mode="delay", parameters={"stps": 3.0}), 4)
    with pytest.raises(UserError, match="values least"):
        player.crash(film, inject("robot_3", mode="adversarial"), 4)  # a script values nothing
    player.clear(film, ())


def test_costs_are_those_of_evaluate() -> None:
    player = Player(load_target(KITE, SCENARIO), seed=4)
    player.crash(player.first(), inject("robot_1"), 0)
    found = []
    until_s = time.monotonic() + WAIT_S
    while len(found) < 2 * CHUNK:
        assert time.monotonic() < until_s
        found += player.more()
        time.sleep(0.01)
    for crash, condition in (((), crash_free()), (("robot_1",), named(["robot_1"]))):
        wanted = evaluate(Scripted("kite"), SCENARIO, condition, range(CHUNK), KEY).episodes
        shown = [played for played in found if played.crashed == crash][:CHUNK]
        assert [(p.episode, p.success, p.episode_return) for p in shown] == [
            (r.episode, r.success, r.episode_return) for r in wanted
        ]


def test_a_playback_plays_at_its_pace_and_stops_at_the_end() -> None:
    playback = Playback()
    playback.load(10, 0.5)
    playback.advance(1.2)
    assert playback.frame == 2
    playback.speed = 4.0
    playback.advance(0.5)
    assert playback.frame == 6
    playback.advance(100.0)
    assert (playback.frame, playback.playing) == (10, False)
    playback.play(True)
    assert (playback.frame, playback.playing) == (0, True)
    playback.step(-1)
    assert (playback.frame, playback.playing) == (0, False)
    playback.seek(99)
    assert playback.frame == 10


@pytest.fixture(scope="module")
def made() -> list[Made]:
    team = Team()
    return [team.play(), team.play(cut_at=7), team.play()]


@pytest.fixture(scope="module")
def source(made: list[Made], tmp_path_factory: pytest.TempPathFactory) -> Iterator[EpisodeSource]:
    bag = write(tmp_path_factory.mktemp("console") / "bag", Team(), messages(made))
    source = EpisodeSource(0, Recording(bag))
    source.start()
    yield source
    source.close()


def shown(source: EpisodeSource, topic: str) -> dict[str, Any]:
    """The newest value of a topic."""
    values = [json.loads(text) for text in source.board.since(Cursor())]
    (value,) = (v for v in values if v["type"] == topic)
    return value  # type: ignore[no-any-return]


def act(source: EpisodeSource, kind: str, **fields: Any) -> str:
    request: Request = parse_request(json.dumps({"type": kind, "id": 0, "source": 0, **fields}))
    return asyncio.run(source.act(request))


def test_a_recording_plays_what_was_recorded(source: EpisodeSource, made: list[Made]) -> None:
    act(source, "pause", on=True)
    act(source, "choose", episode=2)
    act(source, "seek", frame=3)
    time.sleep(0.1)
    timeline, state = shown(source, "timeline"), shown(source, "state")
    episode = made[2].episode
    assert (timeline["episode"], timeline["last"]) == (2, episode.length)
    assert (state["episode"], state["step"]) == (2, timeline["frame"])
    rows = shown(source, "team")["robots"]
    wanted = made[2].intents[: timeline["frame"], 0]
    assert [step[2] for step in rows[0]["steps"]] == wanted.tolist()
    faulted = {(s["robot"], k) for s in timeline["stretches"] for k in range(s["from"], s["to"])}
    names = ("robot_1", "robot_2")
    assert faulted == {(names[i], int(k)) for k, i in np.argwhere(episode.faults != 0)}
    with pytest.raises(UserError, match="a recording shows what was"):
        act(source, "inject", victims=["robot_1"], mode="mute")
    with pytest.raises(UserError, match="no complete episode 9"):
        act(source, "choose", episode=9)
    act(source, "reset")  # the next, and behind the last the first one
    assert shown(source, "timeline")["episode"] == 0


def test_what_crashes_cost_in_a_recording(source: EpisodeSource, made: list[Made]) -> None:
    until_s = time.monotonic() + WAIT_S
    while len(shown(source, "timeline")["episodes"]) < len(made):
        assert time.monotonic() < until_s
        time.sleep(0.05)
    rows = [row for row in shown(source, "costs")["rows"] if row["crashed"] is not None]
    assert sum(row["episodes"] for row in rows) == len(made)
    total = sum(float(m.episode.reward.sum()) for m in made)
    assert sum(row["episodes"] * row["return"][0] for row in rows) == pytest.approx(total)
    assert [e["episode"] for e in shown(source, "timeline")["episodes"]] == [0, 1, 2]


def test_curves_grow_with_the_run_and_skip_a_half_written_line(tmp_path: Path) -> None:
    now = [0.0]
    curves = Curves(tmp_path, lambda: now[0])
    assert curves.pages() == {}
    path = tmp_path / "metrics.jsonl"
    rows = [
        {"env_steps": 10 * k, "success_rate": k / 10, "alpha": None, "success_robot_1_crashed": 0.5}
        for k in range(3)
    ]
    lines = [json.dumps(row) + "\n" for row in rows]
    path.write_text("".join(lines[:2]) + lines[2][:9])
    now[0] = 2.0
    assert curves.pages()["curves"] == {
        "unit": "env_steps",
        "steps": [0, 10],
        "series": {"success_rate": [0.0, 0.1], "success_robot_1_crashed": [0.5, 0.5]},
    }
    now[0] = 4.0
    assert curves.pages() == {}
    path.write_text("".join(lines))
    now[0] = 6.0
    assert curves.pages()["curves"]["steps"] == [0, 10, 20]
    path.with_name("metrics.jsonl.gz").write_bytes(gzip.compress("".join(lines).encode()))
    path.unlink()
    assert read_rows(path) == rows
    many = curves_of([{"env_steps": k, "success_rate": 1.0} for k in range(10 * MOST_POINTS)])
    assert len(many["steps"]) <= MOST_POINTS
    assert many["steps"][-1] == 10 * MOST_POINTS - 1
