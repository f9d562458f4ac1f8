"""A profile: every moment is one part's, every seam is found, and the run is the same run."""

from __future__ import annotations

import json
from itertools import count
from pathlib import Path

import pytest
from small_run import small

from crash_coach_common.contract import UserError
from policy_pkg.train.profile import EVALUATION, PARTS, REST, Profile, Stopwatch, profile
from policy_pkg.train.run import train


class Team:
    """Calls that take a known time on a clock of their own: as many seconds as they are told."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def clock(self) -> float:
        return self.now_s

    def inner(self, seconds: float) -> float:
        self.now_s += seconds
        return seconds

    def outer(self) -> None:
        self.now_s += 1
        self.inner(10)
        self.now_s += 2

    def fail(self) -> None:
        self.now_s += 5
        raise ValueError("on purpose")

    def block(self) -> None:
        self.outer()


def watched() -> tuple[Team, Stopwatch]:
    team = Team()
    stopwatch = Stopwatch(team.clock, lambda: team.now_s / 4)
    for method, part in (
        ("inner", "physics"),
        ("outer", "simulator"),
        ("fail", "learner"),
        ("block", EVALUATION),
    ):
        stopwatch.watch(team, method, part)
    return team, stopwatch


def spent(stopwatch: Stopwatch) -> tuple[dict[str, float], dict[str, float], dict[str, int]]:
    seconds, cpu, calls = stopwatch.taken()
    return (
        {part: value for part, value in seconds.items() if value},
        {part: value for part, value in cpu.items() if value},
        {part: value for part, value in calls.items() if value},
    )


def test_time_inside_another_part_counts_once() -> None:
    team, stopwatch = watched()
    team.now_s += 100
    team.outer()
    assert team.inner(7) == 7
    expected = {REST: 100.0, "simulator": 3.0, "physics": 17.0}
    quarter = {part: value / 4 for part, value in expected.items()}
    assert spent(stopwatch) == (expected, quarter, {"simulator": 1, "physics": 2})
    assert sum(expected.values()) == team.now_s
    assert spent(stopwatch) == ({}, {}, {})  # taken


def test_an_evaluation_block_is_one_part_and_an_error_ends_its_part() -> None:
    team, stopwatch = watched()
    team.block()
    with pytest.raises(ValueError, match="on purpose"):
        team.fail()
    team.now_s += 1
    assert spent(stopwatch)[0] == {EVALUATION: 13.0, "learner": 5.0, REST: 1.0}


def test_a_method_that_is_gone_is_noticed() -> None:
    team, stopwatch = watched()
    with pytest.raises(AttributeError, match="outher"):
        stopwatch.watch(team, "outher", "simulator")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Profile, Path, list[str]]:
    """A profile of a whole run, its directory, and what was told."""
    run, told = tmp_path_factory.mktemp("profile") / "run", list[str]()
    return profile(small(), 600, told.append, run), run, told


def test_every_seam_is_hit(whole: tuple[Profile, Path, list[str]]) -> None:
    result, run, told = whole
    assert set(result.seconds) == set(result.cpu_seconds) == set(result.calls) == set(PARTS)
    assert [part for part in PARTS if not result.calls[part]] == [REST]
    assert all(result.seconds[part] > 0 for part in PARTS)
    assert sum(result.share(part) for part in PARTS) == pytest.approx(1, abs=1e-9)
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    # It began behind the first gradient step, or the first two: a step in all arenas may owe two.
    assert last["gradient_steps"] - result.gradient_steps in (1, 2)
    assert result.calls["learner"] == result.gradient_steps
    assert 0 < result.env_steps < 1200
    assert result.calls["physics"] >= result.calls["rollout"] == result.env_steps / 4
    assert result.calls[EVALUATION] == result.blocks == 4
    assert result.blocks * result.block_s == pytest.approx(result.seconds[EVALUATION], rel=0.05)
    assert 0 < result.timers_s < result.cpu_s
    assert told


def test_a_profiled_run_is_the_same_run(
    whole: tuple[Profile, Path, list[str]], tmp_path: Path
) -> None:
    train(small(), tmp_path / "plain")
    for name in ("metrics.jsonl", "checkpoints/step_000001200/agent.safetensors"):
        assert (tmp_path / "plain" / name).read_bytes() == (whole[1] / name).read_bytes()


def test_it_ends_when_enough_was_measured_and_keeps_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ticks = count()
    config = small(total_steps=10**9, test_interval_steps=10**9)
    result = profile(config, 2.0, clock=lambda: 1e-3 * next(ticks))
    assert list(tmp_path.iterdir()) == []
    assert 2.0 <= result.wall_s < 2.2
    # None fell into it, so one was played afterwards.
    assert (result.blocks, result.seconds[EVALUATION]) == (0, 0.0)
    assert result.block_s > 0
    assert 0 < result.evaluation_share(1000) < 1


def test_a_run_that_is_over_too_soon_is_refused() -> None:
    with pytest.raises(UserError, match=r"ended after 8 steps.*total_steps"):
        profile(small(total_steps=8), 60)
