"""Every mode against what its line in the docs says, on random streams of commands and sights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.faults import (
    fault_mode,
    make_fault,
)
from crash_coach_pkg.faults.action_tools import ActionTools
from crash_coach_pkg.faults.base import CommandFault, Step
from crash_coach_pkg.faults.schema import parameters_of
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.plan import CrashPlan, Fault

ACTIONS = 5
Commands = list[tuple[int, list[bool]]]  # what the policy wants, and what is available
SEEDS = st.integers(0, 2**63 - 1)


@st.composite
def commands(draw: st.DrawFn, steps: int = 24) -> Commands:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    available = rng.random((steps, ACTIONS)) < 0.6
    available[np.arange(steps), rng.integers(ACTIONS, size=steps)] = True
    wanted = [int(rng.choice(np.flatnonzero(mask))) for mask in available]
    return list(zip(wanted, available.tolist(), strict=True))


def passed(
    mode: str,
    stream: Commands,
    start: int = 0,
    duration: int = 0,
    seed: int = 0,
    worst: int = -1,
    parameters: Mapping[str, float] = MappingProxyType({}),
) -> list[int | None]:
    """What robot 1 of 2 gets of ``stream`` under one fault."""
    fault = Fault(1, mode, start, duration, tuple(parameters.items()))
    team: TeamFaults[int] = TeamFaults(CrashPlan(4, 0, seed, 0.0, 2, (fault,)), 2)
    got = []
    for step, (wanted, mask) in enumerate(stream):
        team.enter(step)
        effect = team.command(1, wanted, ActionTools(np.array(mask), worst))
        end = start + duration if duration else len(stream)
        assert effect.mode == (mode if start <= step < end else "")
        got.append(effect.passed)
    return got


def wanted(stream: Commands) -> list[int]:
    return [action for action, _ in stream]


@settings(max_examples=40)
@given(commands(), st.integers(0, 10), st.integers(1, 10))
def test_mute_withholds_its_steps_and_only_them(stream: Commands, start: int, steps: int) -> None:
    got = passed("mute", stream, start, steps)
    assert got[start : start + steps] == [None] * steps
    assert got[:start] == wanted(stream)[:start]
    assert got[start + steps :] == wanted(stream)[start + steps :]


@settings(max_examples=40)
@given(commands(), SEEDS)
def test_random_is_available_and_follows_from_the_seed(stream: Commands, seed: int) -> None:
    got = passed("random", stream, seed=seed)
    assert len(got) == len(stream)
    for action, (_, mask) in zip(got, stream, strict=True):
        assert action is not None
        assert mask[action]
    assert got == passed("random", stream, seed=seed)
    assert got != passed("random", stream, seed=seed ^ 1)


@settings(max_examples=40)
@given(commands(), st.integers(0, 10))
def test_freeze_repeats_the_last_command_where_it_is_available(
    stream: Commands, start: int
) -> None:
    held = stream[start - 1][0] if start else None
    expected = [held if held is not None and mask[held] else None for _, mask in stream[start:]]
    assert passed("freeze", stream, start)[start:] == expected


@settings(max_examples=40)
@given(commands(), st.integers(0, 8), st.integers(1, 30), st.integers(1, 12))
def test_delay_passes_on_what_was_wanted_so_many_steps_ago(
    stream: Commands, start: int, late: int, steps: int
) -> None:
    got = passed("delay", stream, start, steps, parameters={"steps": late})
    for step in range(start, start + steps):
        sent = stream[step - late][0] if step - late >= start else None
        fits = sent is not None and stream[step][1][sent]
        assert got[step] == (sent if fits else None)
    assert got[start + steps :] == wanted(stream)[start + steps :]


def test_delay_lets_a_superseded_command_go_and_sends_nothing_twice() -> None:
    """As at a gate whose robots do not command in every step."""
    delay = make_fault("delay", {"steps": 3})
    assert isinstance(delay, CommandFault)
    tools = ActionTools(np.ones(100, dtype=np.bool_), -1)

    def at(step: int, command: int) -> object:
        return delay.apply(Step(0, 0, step, 0), command, None, tools)

    assert [at(0, 10), at(1, 11), delay.idle(Step(0, 0, 2, 0))] == [None] * 3
    assert delay.idle(Step(0, 0, 3, 0)) == 10
    assert at(3, 13) is None  # 10 has gone out
    assert at(5, 15) == 11
    assert delay.idle(Step(0, 0, 9, 0)) == 15  # 13 is superseded
    assert delay.idle(Step(0, 0, 20, 0)) is None


def losses(seed: int, steps: int, **odds: float) -> np.ndarray:
    stream = [(0, [True])] * steps
    got = passed("drop", stream, seed=seed, parameters=odds)
    return np.array([action is None for action in got])


@settings(max_examples=10)
@given(SEEDS)
def test_drop_in_single_steps_loses_its_share(seed: int) -> None:
    assert not losses(seed, 50, probability=0.0).any()
    assert losses(seed, 50, probability=1.0).all()


@pytest.mark.parametrize("p", [0.2, 0.5, 0.9])
def test_drop_is_binomial_and_steps_are_independent(p: float, fits: Callable[..., bool]) -> None:
    lost = losses(3, 3000, probability=p)
    pairs = np.bincount(2 * lost[:-1:2] + lost[1::2], minlength=4)
    assert fits(pairs, 1500 * np.outer([1 - p, p], [1 - p, p]).ravel())


def test_drop_in_bursts_follows_gilbert_and_elliott(fits: Callable[..., bool]) -> None:
    """Loss only in the bad state, and always there: lengths of both runs are geometric."""
    to_bad, to_good = 0.1, 0.3
    lost = losses(7, 8000, probability=0.0, burst_probability=1.0, to_bad=to_bad, to_good=to_good)
    assert not lost[0]  # it starts in the good state
    edges = np.flatnonzero(np.diff(lost)) + 1
    runs = np.diff(edges)
    bad = runs[lost[edges[:-1]]]
    assert bad.mean() == pytest.approx(1 / to_good, rel=0.1)
    assert runs[~lost[edges[:-1]]].mean() == pytest.approx(1 / to_bad, rel=0.15)
    counts = [np.sum(bad == k) for k in (1, 2, 3)] + [np.sum(bad > 3)]
    law = [to_good * (1 - to_good) ** k for k in range(3)] + [(1 - to_good) ** 3]
    assert fits(counts, len(bad) * np.array(law))


def test_the_example_of_drop_loses_commands_in_bursts() -> None:
    odds = {info.name: info.example for info in parameters_of(fault_mode("drop"))}
    lost = losses(5, 6_000, **odds)
    lasting = (lost[1:] & lost[:-1]).sum() / lost[:-1].sum()  # lost again in the next step
    assert lasting > 0.5 > 2 * lost.mean()


class Velocities:
    """Tools whose commands are vectors themselves."""

    def usable(self, command: tuple[float, ...]) -> bool:
        return True

    def sample(self, bits: int) -> tuple[float, ...] | None:
        return None

    def worst(self) -> tuple[float, ...] | None:
        return None

    def vector(self, command: tuple[float, ...]) -> np.ndarray:
        return np.array(command)

    def with_vector(self, command: tuple[float, ...], vector: np.ndarray) -> tuple[float, ...]:
        return tuple(vector.tolist())


SPEEDS = st.floats(-10, 10, allow_subnormal=False)


def vector_passed(mode: str, command: tuple[float, ...], **parameters: float) -> Any:
    plan = CrashPlan(0, 0, 0, 0.0, 1, (Fault(0, mode, parameters=tuple(parameters.items())),))
    team: TeamFaults[tuple[float, ...]] = TeamFaults(plan, 1)
    team.enter(0)
    return team.command(0, command, Velocities()).passed


@given(st.tuples(*[SPEEDS] * 6), SPEEDS, SPEEDS, SPEEDS)
def test_bias_adds_to_three_velocities(
    command: tuple[float, ...], x: float, y: float, turn: float
) -> None:
    got = vector_passed("bias", command, linear_x_m_s=x, linear_y_m_s=y, angular_z_rad_s=turn)
    a, b, c, d, e, f = command
    assert got == (a + x, b + y, c, d, e, f + turn)


@given(st.tuples(*[SPEEDS] * 6), SPEEDS, SPEEDS)
def test_scale_multiplies_linear_and_angular(
    command: tuple[float, ...], linear: float, angular: float
) -> None:
    got = vector_passed("scale", command, linear=linear, angular=angular)
    assert got == tuple(v * (linear if i < 3 else angular) for i, v in enumerate(command))


@given(commands(), st.integers(0, ACTIONS - 1))
def test_adversarial_passes_on_what_the_policy_values_least(stream: Commands, worst: int) -> None:
    assert passed("adversarial", stream, 2, worst=worst)[2:] == [worst] * (len(stream) - 2)
    assert passed("adversarial", stream, 2)[2:] == [None] * (len(stream) - 2)


def seen(mode: str, sights: np.ndarray, start: int, steps: int, **parameters: float) -> np.ndarray:
    """What robot 0 sees of (T, O) sights, each of which comes in the same, reused buffer."""
    fault = Fault(0, mode, start, steps, tuple(parameters.items()))
    team: TeamFaults[int] = TeamFaults(CrashPlan(4, 0, 9, 0.0, 1, (fault,)), 1)
    buffer = np.empty_like(sights[0])
    got = []
    for step, sight in enumerate(sights):
        buffer[:] = sight
        team.enter(step)
        got.append(team.observation(0, buffer).copy())
        np.testing.assert_array_equal(buffer, sight)
        assert team.observation_mode(0) == (mode if start <= step < start + steps else "")
    return np.stack(got)


@settings(max_examples=40)
@given(
    st.sampled_from(["blind", "stale", "noise"]),
    st.integers(0, 2**32),
    st.integers(0, 8),
    st.integers(1, 8),
)
def test_observation_faults_change_what_is_seen_in_their_steps(
    mode: str, draw: int, start: int, steps: int
) -> None:
    sights = np.random.default_rng(draw).uniform(-1, 1, (16, 3)).astype(np.float32)
    got = seen(mode, sights, start, steps)
    assert got.dtype == np.float32
    during = slice(start, start + steps)
    after = [*range(start), *range(start + steps, 16)]
    np.testing.assert_array_equal(got[after], sights[after])
    before = sights[start - 1] if start else np.zeros(3)
    if mode == "blind":
        assert not got[during].any()
    elif mode == "stale":
        np.testing.assert_array_equal(got[during], np.tile(before, (steps, 1)))
    else:
        assert (got[during] != sights[during]).any(axis=1).all()
        np.testing.assert_array_equal(got, seen(mode, sights, start, steps))


def test_noise_is_gaussian_of_the_given_spread_and_new_in_each_step() -> None:
    sights = np.full((2000, 4), 0.5, dtype=np.float32)
    noise = seen("noise", sights, 0, 2000, stddev=0.2).astype(np.float64) - 0.5
    assert noise.mean() == pytest.approx(0.0, abs=0.01)
    assert noise.std() == pytest.approx(0.2, rel=0.03)
    assert np.mean(np.abs(noise) < 0.2) == pytest.approx(0.6827, abs=0.02)
    assert np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1] == pytest.approx(0, abs=0.05)
    np.testing.assert_array_equal(seen("noise", sights[:3], 0, 3, stddev=0.0), sights[:3])
