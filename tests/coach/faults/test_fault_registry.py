"""The catalogue of modes, what it refuses, and modes of one's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import Field

from crash_coach_common.contract import UserError
from crash_coach_pkg import faults
from crash_coach_pkg.faults import (
    check_parameters,
    fault_mode,
    is_observation_mode,
    mode_names,
    register,
    unmet_needs,
)
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS
from crash_coach_pkg.faults.base import FaultParameters, ObservationFault, Step
from crash_coach_pkg.faults.schema import parameters_of
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.plan import CrashPlan, Fault


def test_the_catalogue() -> None:
    codes = {name: fault_mode(name).code for name in mode_names()}
    assert codes == {
        "mute": 1, "random": 2, "freeze": 3, "delay": 4, "drop": 5, "bias": 6, "scale": 7,
        "adversarial": 8, "blind": 20, "stale": 21, "noise": 22,
    }  # fmt: skip
    assert fault_mode("stay") is fault_mode("mute")
    assert {name for name in codes if is_observation_mode(name)} == {"blind", "stale", "noise"}
    refused = {name for name in codes if unmet_needs(name, ACTION_OFFERS)}
    assert refused == {"bias", "scale"}
    opaque = frozenset(("availability",))
    assert {name for name in codes if unmet_needs(name, opaque)} == refused | {
        "random",
        "adversarial",
    }
    for name in codes:
        assert fault_mode(name).summary.endswith(".")
        for info in parameters_of(fault_mode(name)):
            assert info.low <= info.default <= info.high
            assert info.low <= info.example <= info.high
            assert info.unit in ("1", "steps", "m/s", "rad/s")
        check_parameters(name, {i.name: i.example for i in parameters_of(fault_mode(name))})


def test_wrong_names_and_values_are_named() -> None:
    with pytest.raises(UserError, match=r"unknown crash mode 'mut'; one of: mute, random.*stay"):
        fault_mode("mut")
    with pytest.raises(UserError, match=r"delay: parameter steps = 2\.5: .*its parameters: steps"):
        check_parameters("delay", {"steps": 2.5})
    with pytest.raises(UserError, match=r"drop: parameter probability = 1\.5: .*less than or equ"):
        check_parameters("drop", {"probability": 1.5})
    with pytest.raises(UserError, match=r"mute: no parameter 'p' \(its parameters: none\)"):
        check_parameters("mute", {"p": 1})
    with pytest.raises(UserError, match="parameter stddev = nan"):
        TeamFaults(CrashPlan(0, 0, 0, 0, 1, (Fault(0, "noise", 9, 0, (("stddev", np.nan),)),)), 1)


class Mirror(ObservationFault):
    name = "mirror"
    code = 200
    summary = "Everything is seen with the other sign."

    def apply(self, step: Step, features: Any, last: Any) -> Any:
        return -features


class NoUnit(FaultParameters):
    size: float = Field(default=1.0, ge=0, le=1, description="How much.")


def of(**changes: object) -> Any:
    return type("Changed", (Mirror,), changes)


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is known to no other test."""
    mode_names()
    monkeypatch.setattr(faults, "_modes", dict(faults._modes))


@pytest.mark.usefixtures("registry")
def test_own_modes_are_registered_and_checked() -> None:
    register(Mirror)
    assert mode_names()[-1] == "mirror"
    plan = CrashPlan(0, 0, 0, 0.0, 1, (Fault(0, "mirror", start_step=1, duration_steps=1),))
    team: TeamFaults[int] = TeamFaults(plan, 1)
    sights = []
    for step in range(3):
        team.enter(step)
        sights.append(team.observation(0, np.ones(2, np.float32)).tolist())
    assert sights == [[1, 1], [-1, -1], [1, 1]]
    for changed, text in [
        (of(), "taken by 'mirror'"),
        (of(code=201), "taken by 'mirror'"),
        (of(name="other"), "taken by 'mirror'"),
        (of(name="stay", code=201), "taken by"),
        (of(name="other", code=9), "code 9 is not in 128..255"),
        (of(name="Other", code=201), "lower-case"),
        (of(name="other", code=201, Parameters=NoUnit), "parameter 'size' has no unit"),
        (int, "neither a CommandFault nor"),
    ]:
        with pytest.raises(ValueError, match=text):
            register(changed)
    assert mode_names()[-1] == "mirror"
