"""Pausing: which steps may be made, and how old commands are afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from sim_pkg.lockstep import Health
from sim_pkg.pause import Pause
from sim_pkg.realtime import NewestCommands


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_time_stands_in_a_pause_and_goes_on_with_every_step_granted() -> None:
    clock = Clock()
    pause = Pause(0.5, clock)
    assert pause.may_step()
    assert pause.now_s() == 100.0
    pause.set(True)
    clock.now_s = 130.0
    assert (pause.on, pause.may_step(), pause.now_s()) == (True, False, 100.0)
    pause.grant()
    pause.grant()
    assert [pause.may_step() for _ in range(3)] == [True, True, False]
    assert pause.now_s() == 101.0
    pause.set(True)  # again: it goes on standing
    pause.grant()
    pause.forget()
    assert not pause.may_step()
    pause.grant()
    clock.now_s = 140.0
    pause.set(False)
    pause.set(False)
    assert (pause.on, pause.may_step(), pause.now_s()) == (False, True, 101.0)
    clock.now_s = 140.5
    assert pause.now_s() == 101.5
    pause.set(True)
    assert not pause.may_step(), "a step granted in the pause before"


@pytest.mark.parametrize("granted", [0, 2, 4])
def test_only_steps_make_commands_old(granted: int) -> None:
    clock = Clock()
    pause = Pause(1.0, clock)
    newest = NewestCommands(("robot_1", "robot_2"), cmd_timeout_s=3.0)
    newest.open(0)
    newest.command(0, 0, 0, action=1, fault=0, now_s=pause.now_s())
    newest.mute(1, 0, now_s=pause.now_s())
    pause.set(True)
    for _ in range(granted):
        clock.now_s += 100.0
        pause.grant()
        assert pause.may_step()
    clock.now_s += 100.0
    pause.set(False)
    newest.sample(np.full(2, 4, dtype=np.int32), np.ones((2, 5), dtype=np.bool_), pause.now_s())
    known = [Health.OK, Health.MUTED] if granted < 3 else [Health.LOST, Health.LOST]
    assert newest.health == known
