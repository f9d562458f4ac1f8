"""The gate as a process: relay, intent and effect, lease, random actions, ends and bad input."""

from __future__ import annotations

import re
import signal
import time

import numpy as np
import pytest
from coach_graph import ROBOTS, WAIT_S, graph, process, run_to_end, team
from crash_coach_interfaces.msg import Action, FaultEvent
from shared_memory import strike

from crash_coach_common.keyed_random import random_bits
from crash_coach_pkg.faults.batch_faults import random_available

AVAILABLE = np.array([[True, True, True, True, False]])


def test_intent_and_effect_on_faulted_steps_and_only_there(ros_env: dict[str, str]) -> None:
    config = {"victims": ("robot_2",), "start_step": 3, "duration_steps": 4}
    with graph(ros_env, **config) as g:
        for episode in range(3):
            for step in range(10):
                g.team.step(episode, step)
        g.team.serve(0.2)
        muted = 0
        for (_, step, robot), outcome in g.team.outcomes.items():
            if robot == 1 and 3 <= step < 7:
                muted += 1
                assert outcome.command is None
                assert [e.applied for e in outcome.effects] == [-1]
                effect = outcome.effects[0]
                assert (effect.mode, effect.intent) == ("mute", outcome.raw.action)
                assert effect.header == outcome.raw.header
            else:
                assert outcome.command == outcome.raw
                assert not outcome.effects
        assert muted == 3 * 4
        assert len(g.team.outcomes) == 3 * 10 * 3


def test_random_actions_are_keyed_by_seed_episode_step_robot(ros_env: dict[str, str]) -> None:
    config = {"victims": ("robot_1", "robot_3"), "crash_mode": "random", "seed": 21}
    with graph(ros_env, **config) as g:
        for episode in range(2):
            for step in range(20):
                g.team.step(episode, step)
        g.team.serve(0.2)
        differ = 0
        for (episode, step, robot), outcome in g.team.outcomes.items():
            assert outcome.command is not None
            if robot == 1:
                assert outcome.command == outcome.raw
                continue
            expected = random_available(random_bits(21, episode, step, robot), AVAILABLE)[0]
            assert outcome.command.action == expected
            assert outcome.command.fault == Action.FAULT_RANDOM
            assert outcome.command.header == outcome.raw.header
            assert [(e.intent, e.applied) for e in outcome.effects] == [
                (outcome.raw.action, expected)
            ]
            differ += outcome.command.action != outcome.raw.action
        assert differ > 40


def test_a_killed_coach_leaves_no_fault_behind(ros_env: dict[str, str]) -> None:
    lease_s = 0.6
    with graph(ros_env, victims=("robot_1",), lease_s=lease_s) as g:
        for step in range(20):
            assert g.team.step(0, step)[0].faulted
        strike(g.coach.pid)
        killed_s, step = time.monotonic(), 20
        begun_s = killed_s
        while g.team.step(0, step)[0].faulted:
            # When it was begun, not when its answer came: the machine may be busy.
            assert begun_s - killed_s < lease_s + 0.5
            begun_s, step = time.monotonic(), step + 1
        assert FaultEvent.EXPIRED in g.team.kinds()
        # The next episodes need no plan: nobody holds them.
        for episode in (1, 2):
            assert not any(outcome.faulted for outcome in g.team.step(episode, 0))
        assert g.team.kinds().count(FaultEvent.EXPIRED) == 1


def test_duplicates_are_answered_alike_and_decided_once(ros_env: dict[str, str]) -> None:
    with graph(ros_env, victims=("robot_2",), crash_mode="random") as g:
        first = [outcome.command for outcome in g.team.step(0, 0)]
        for _ in range(3):
            for outcome in g.team.outcomes.values():
                outcome.command = None
            g.team.publish(0, 0)
            g.team.until(lambda: all(o.command for o in g.team.outcomes.values()), "duplicates")
            assert [o.command for o in g.team.outcomes.values()] == first
        assert [len(o.effects) for o in g.team.outcomes.values()] == [0, 1, 0]


def test_without_a_coach_lock_step_goes_on_after_the_first_lease(ros_env: dict[str, str]) -> None:
    with process(ros_env, "gate", robots=ROBOTS, first_lease_s=0.5), team(ros_env) as t:
        t.meet(coach=False)
        started = time.monotonic()
        assert not any(outcome.faulted for outcome in t.step(0, 0))
        assert time.monotonic() - started >= 0.5
        assert t.kinds() == [FaultEvent.EXPIRED]


def test_in_real_time_nothing_is_held(ros_env: dict[str, str]) -> None:
    parameters = {"robots": ROBOTS, "lockstep": False, "first_lease_s": 600.0}
    with process(ros_env, "gate", **parameters), team(ros_env) as t:
        t.meet(coach=False)
        assert not any(outcome.faulted for outcome in t.step(4, 2, timeout_s=5.0))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", ["gate", "coach"])
def test_signals_end_it_cleanly(ros_env: dict[str, str], name: str, number: int) -> None:
    with process(ros_env, name, robots=ROBOTS) as child, team(ros_env) as t:
        t.meet(gate=name == "gate", coach=name == "coach")
        child.send_signal(number)
        _, errors = child.communicate(timeout=WAIT_S)
        assert child.returncode == 0
        assert re.fullmatch(r"\[INFO\] \[[\d.]+\] \[" + name + r"\]: ready: .+\n", errors)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "parameter 'robots' of gate is missing"),
        ({"robots": ("robot 1",)}, "robot name 'robot 1' is not a valid ROS name"),
        (
            {"robots": ("a",), "lockstp": True},
            "unknown parameter 'lockstp' (did you mean 'lockstep'?) of gate; known: cmd_timeout_s",
        ),
        ({"robots": ("a",), "first_lease_s": -1.0}, "first_lease_s"),
    ],
)
def test_bad_parameters_end_it_with_one_line(
    ros_env: dict[str, str], parameters: dict[str, object], message: str
) -> None:
    code, errors = run_to_end(ros_env, "gate", **parameters)
    assert code == 1
    assert message in errors
    assert errors.startswith("gate: error: ")
    assert errors.count("\n") == 1
