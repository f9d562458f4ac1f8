"""The console without ROS, server or browser: boards, episodes, costs, teams, requests, access."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crash_coach_common.contract import UserError
from crash_coach_console.access import Access
from crash_coach_console.board import KEPT_EVENTS, Board, Cursor
from crash_coach_console.episodes import MOST_GROUPS, Costs, EpisodeBook, Played
from crash_coach_console.operating import OperatorError, victims_left, with_others
from crash_coach_console.requests import Clear, Inject, RequestError, parse_request
from crash_coach_console.team import LiveTeam, Plan, PlannedFault
from crash_coach_pkg.coach.injection import injection
from crash_coach_pkg.coach.parameters import parameter_specs
from policy_pkg.statistics import mean_interval, wilson


def told(board: Board, cursor: Cursor) -> list[dict[str, Any]]:
    return [json.loads(message) for message in board.since(cursor)]


def test_a_board_gives_the_newest_of_each_topic_and_every_event_once() -> None:
    board, cursor = Board(3), Cursor()
    for step in range(5):
        board.post("state", {"step": step})
    board.log({"kind": "armed"})
    assert told(board, cursor) == [
        {"type": "state", "source": 3, "step": 4},
        {"type": "events", "source": 3, "entries": [{"kind": "armed"}]},
    ]
    assert told(board, cursor) == []
    board.post("state", {"step": 9})
    board.log({"kind": "cleared"})
    assert [m.get("step", m.get("entries")) for m in told(board, cursor)] == [
        9,
        [{"kind": "cleared"}],
    ]


def test_a_page_that_slept_gets_what_is_kept_and_nothing_piles_up() -> None:
    board, cursor = Board(0), Cursor()
    for k in range(10 * KEPT_EVENTS):
        board.log({"k": k})
    (message,) = told(board, cursor)
    assert [e["k"] for e in message["entries"]] == list(range(9 * KEPT_EVENTS, 10 * KEPT_EVENTS))


def test_values_that_are_no_json_are_refused_not_sent() -> None:
    board = Board(0)
    board.post("state", {"x": float("nan")})
    with pytest.raises(ValueError, match="JSON"):
        board.since(Cursor())


def test_an_episode_counts_with_whom_it_had_crashed_once_it_is_settled() -> None:
    book = EpisodeBook()
    book.end(6, True, 1.0, 9, 0.0)  # its beginning was not seen
    book.begin(7)
    book.faulted(7, "robot_10", "mute")
    book.end(7, False, -1.5, 20, 10.0)
    book.begin(8)
    book.faulted(7, "robot_2", "mute")  # its event was on the way for longer
    assert list(book.settled(10.2)) == []
    assert list(book.settled(10.6)) == [
        Played(7, ("robot_2", "robot_10"), ("mute",), False, -1.5, 20)
    ]
    book.faulted(7, "robot_3", "mute")  # too late for 7, and not for 8
    book.end(8, True, 2.0, 5, 11.0)
    assert list(book.settled(12.0)) == [Played(8, (), (), True, 2.0, 5)]


def test_a_sim_that_starts_anew_is_counted_anew() -> None:
    book = EpisodeBook()
    for start_s in (0.0, 10.0):
        book.begin(0)
        book.faulted(0, "robot_1", "mute")
        book.end(0, True, 1.0, 3, start_s)
        assert [played.crashed for played in book.settled(start_s + 1)] == [("robot_1",)]


def test_costs_are_those_of_wilson_and_student_by_who_was_crashed() -> None:
    costs = Costs()
    returns = [1.0, 2.0, 4.0]
    for k, value in enumerate(returns):
        costs.add(Played(k, (), (), True, value, 10))
    costs.add(Played(3, ("robot_1",), ("mute",), False, -1.0, 30))
    free, muted, every = costs.rows()
    success = wilson(3, 3)
    assert free["crashed"] == []
    assert free["success"] == [1.0, success.low, success.high]
    mean = mean_interval(np.array(returns))
    assert free["return"] == pytest.approx([mean.value, mean.low, mean.high])
    assert muted["crashed"] == ["robot_1"]
    assert muted["return"] == [-1.0, None, None]
    assert (every["crashed"], every["episodes"], every["steps"]) == (None, 4, 15.0)
    assert [row["alike"] for row in (free, muted, every)] == [False, False, False]
    costs.forget()
    assert costs.rows() == []


def test_one_episode_again_and_again_and_the_same_robots_crashed_otherwise() -> None:
    costs = Costs()
    for k in range(5):
        costs.add(Played(k, ("robot_1",), ("mute",), True, 2.0, 7))
        costs.add(Played(10 + k, ("robot_1",), ("random",), k > 2, 2.0 - k, 7))
    mute, random = costs.rows(together=False)
    assert (mute["modes"], mute["alike"], mute["return"]) == (["mute"], True, [2.0, None, None])
    assert (random["modes"], random["alike"]) == (["random"], False)


def test_many_different_victims_are_counted_by_number() -> None:
    costs = Costs()
    for k in range(MOST_GROUPS + 1):
        costs.add(Played(k, (f"robot_{k}",), ("mute",), k % 2 == 0, 0.0, 1))
    costs.add(Played(99, ("robot_1", "robot_2"), ("mute",), True, 0.0, 1))
    assert [(row["crashed"], row["episodes"]) for row in costs.rows()] == [
        (1, MOST_GROUPS + 1),
        (2, 1),
        (None, MOST_GROUPS + 2),
    ]


def states(team: LiveTeam) -> dict[str, tuple[str, str]]:
    return {robot["name"]: (robot["state"], robot["mode"]) for robot in team.value()["robots"]}


def test_a_team_knows_faulted_from_lost() -> None:
    team = LiveTeam()
    team.name(("robot_1", "robot_2"))
    team.episode(4)
    team.active("robot_1", "mute", 4)
    team.diagnosed("gate", "robot_2", "lost", "lost: no command in time", "")
    assert states(team) == {"robot_1": ("faulted", "mute"), "robot_2": ("lost", "")}
    team.diagnosed("gate", "robot_2", "ok", "ok", "")
    team.cleared("robot_1")
    assert states(team) == {"robot_1": ("ok", ""), "robot_2": ("ok", "")}
    team.effect("robot_2", "random", (4, 7), 3, 1)  # it came before ACTIVE did
    assert states(team)["robot_2"] == ("faulted", "random")
    team.episode(5)
    assert states(team)["robot_2"] == ("ok", "")
    team.active("robot_1", "mute", 4)  # of the episode that is over
    assert states(team)["robot_1"] == ("ok", "")


def test_a_page_that_comes_late_learns_of_a_fault_from_the_gate() -> None:
    team = LiveTeam()
    team.name(("robot_1",))
    team.diagnosed("gate", "robot_1", "muted", "muted by plan (freeze)", "freeze")
    assert states(team) == {"robot_1": ("faulted", "freeze")}
    team.in_force(Plan(0, 5, 0.0, ()))
    assert states(team) == {"robot_1": ("ok", "")}
    # A line that was written before the clear came behind it.
    team.diagnosed("gate", "robot_1", "muted", "muted by plan (freeze)", "freeze")
    assert states(team) == {"robot_1": ("ok", "")}


def test_wanted_and_done_of_the_last_steps() -> None:
    team = LiveTeam()
    team.name(("robot_1", "robot_2"))
    team.executed(2, 0, (-1, -1))
    team.executed(2, 1, (3, 4))
    team.effect("robot_1", "mute", (2, 1), 2, -1)
    team.executed(2, 2, (0, 1))
    one, two = (robot["steps"] for robot in team.value()["robots"])
    assert one == [[2, 0, 3, 3, ""], [2, 1, 2, -1, "mute"]]
    assert two == [[2, 0, 4, 4, ""], [2, 1, 1, 1, ""]]


def test_a_plan_is_told_per_robot() -> None:
    team = LiveTeam()
    team.name(("robot_1", "robot_2"))
    fault = PlannedFault("robot_2", "delay", 2**32 - 1, 5, {"steps": 3.0}, "step")
    team.plan(Plan(1, 9, 0.25, (fault,)))
    value = team.value()
    assert (value["rate"], value["revision"]) == (0.25, 9)
    assert value["robots"][0]["planned"] == []
    assert value["robots"][1]["planned"] == [
        {
            "mode": "delay",
            "start": None,
            "duration": 5,
            "parameters": {"steps": 3.0},
            "trigger": "step",
        }
    ]


def wanted(*victims: str, mode: str = "mute", **parameters: float) -> dict[str, Any]:
    return injection(victims, mode, "next_step", 0, 0, parameters)


def settings(**changed: Any) -> dict[str, Any]:
    return {**{spec.name: spec.default for spec in parameter_specs()}, **changed}


def test_robots_that_crash_alike_already_go_on_and_others_are_replaced() -> None:
    before = settings(**wanted("robot_1"))
    assert with_others(wanted("robot_2"), before)["victims"] == ("robot_1", "robot_2")
    assert with_others(wanted("robot_2", "robot_1"), before)["victims"] == ("robot_1", "robot_2")
    assert with_others(wanted("robot_2", mode="freeze"), before)["victims"] == ("robot_2",)
    slow = settings(**wanted("robot_1", mode="delay", steps=3))
    assert with_others(wanted("robot_2", mode="delay", steps=4), slow)["victims"] == ("robot_2",)
    off = {**before, "enabled": False}
    assert with_others(wanted("robot_2"), off)["victims"] == ("robot_2",)


def test_clearing_one_leaves_the_others() -> None:
    before = settings(**wanted("robot_1", "robot_2"))
    assert victims_left(("robot_1",), before) == ("robot_2",)
    assert victims_left((), before) == ()
    with pytest.raises(OperatorError, match="robot_3 is not among the coach's victims"):
        victims_left(("robot_3",), before)


def test_requests_are_read_strictly() -> None:
    text = '{"type": "inject", "id": 4, "source": 0, "victims": ["robot_1"], "mode": "mute"}'
    assert parse_request(text) == Inject(
        type="inject", id=4, source=0, victims=("robot_1",), mode="mute"
    )
    assert parse_request('{"type": "clear", "id": 0, "source": 1}') == Clear(
        type="clear", id=0, source=1
    )


@pytest.mark.parametrize(
    ("text", "reason", "request_id"),
    [
        ("", "request ''", -1),
        ("{}", "type", -1),
        ('{"type": "inject", "id": 7, "source": 0, "mode": "mute"}', "victims", 7),
        ('{"type": "explode", "id": 7, "source": 0}', "explode", 7),
        ('{"type": "clear", "id": true, "source": 0}', "id", -1),
        ('{"type": "clear", "id": 1, "source": "0"}', "source", 1),
        ('{"type": "clear", "id": 1, "source": 0, "robot": "robot_1"}', "robot", 1),
        ('{"type": "pause", "id": 1, "source": 0, "on": 1}', "on 1", 1),
        ('{"type": "pace", "id": 1, "source": 0, "speed": 1e999}', "speed", 1),
        ("[" * 9000, "recursion limit|Invalid JSON", -1),
        ("x" * 20_000, "20000 characters", -1),
    ],
)
def test_what_is_no_request_is_named(text: str, reason: str, request_id: int) -> None:
    with pytest.raises(RequestError, match=reason) as found:
        parse_request(text)
    assert found.value.request_id == request_id
    assert len(str(found.value)) < 300


@given(
    st.text()
    | st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    ).map(json.dumps)
)
def test_any_text_is_a_request_or_a_request_error(text: str) -> None:
    with contextlib.suppress(RequestError):
        parse_request(text)


HERE = {"host": "127.0.0.1:8642"}


@pytest.mark.parametrize(
    ("headers", "reason"),
    [
        (HERE, ""),
        ({"host": "localhost:9"}, ""),
        ({"host": "[::1]:8642"}, ""),
        ({**HERE, "origin": "http://127.0.0.1:8642"}, ""),
        ({}, "host ''"),
        ({"host": "evil.example:8642"}, "host 'evil.example:8642'"),
        ({**HERE, "origin": "http://evil.example"}, "origin 'http://evil.example'"),
        ({**HERE, "origin": "http://localhost:8642"}, "another page's"),
        ({**HERE, "origin": "http://127.0.0.1:3000"}, "another page's"),
        ({**HERE, "origin": "null"}, "another page's"),
    ],
)
def test_who_may_open_the_console(headers: dict[str, str], reason: str) -> None:
    refusal = Access().refusal(headers, "")
    assert reason in refusal
    assert bool(refusal) == bool(reason)


def test_another_address_needs_a_token() -> None:
    with pytest.raises(UserError, match=r"--host 0\.0\.0\.0: .*--token"):
        Access("0.0.0.0")
    with pytest.raises(UserError, match="at least 16"):
        Access("0.0.0.0", "short")
    access = Access("0.0.0.0", "x" * 16)
    there = {"host": "robot.lan:8642"}
    assert "token" in access.refusal(there, "")
    assert "token" in access.refusal(there, "token=wrong")
    assert access.refusal(there, f"token={'x' * 16}") == ""
    cookie = {**there, "cookie": f"crash_coach_token={'x' * 16}"}
    assert access.refusal(cookie, "") == ""
    assert "origin" in access.refusal({**cookie, "origin": "http://evil.example"}, "")
