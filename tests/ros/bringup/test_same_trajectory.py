"""One seed, one checkpoint, one plan: the same trajectory in the core and in every ROS layout."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from os import cpu_count
from pathlib import Path

import pytest
from fault_files import (
    MODES,
    SCENARIO,
    TRIGGERS,
    entry,
    one_after_the_other,
    when,
    with_triggers,
    write,
)

from crash_coach_bringup.ros.evaluation import evaluate_via_ros
from crash_coach_bringup.ros.graph import Layout
from crash_coach_pkg.coach.fault_scenario import ScenarioPlanner, load_fault_scenario
from crash_coach_pkg.team import TeamSpec
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import Condition, Planned, at_rate, crash_free, named
from policy_pkg.play.evaluate import Evaluation, evaluate
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

SEED = 11
CONDITIONS = {
    "crash-free": crash_free(),
    "stay": named(("robot_2",), "stay"),
    "random": named(("robot_1",), "random"),
    "rate": at_rate(0.5, "random"),
}


def untrained(folder: Path, scenario: str) -> Path:
    write_untrained(folder / "step_0", make_env(scenario, 1).spec, seed=4)
    return folder / "step_0"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("team"), "buttons")


@pytest.fixture(scope="module")
def coverage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("coverage"), SCENARIO)


def in_core(
    checkpoint: Path, condition: Condition | Path, episodes: int, scenario: str
) -> Evaluation:
    if isinstance(condition, Condition):
        return evaluate(load_policy(checkpoint), scenario, condition, episodes, SEED, effects=True)
    faults = load_fault_scenario(condition)
    draws = ScenarioPlanner(faults, TeamSpec.of(make_env(scenario, 1).spec), SEED).draws
    planned = Planned(condition.stem, lambda team, seed: ScenarioPlanner(faults, team, seed), draws)
    return evaluate(load_policy(checkpoint), scenario, planned, episodes, SEED, effects=True)


def compare(
    checkpoint: Path,
    condition: Condition | Path,
    layout: Layout,
    episodes: int,
    scenario: str = "buttons",
) -> Evaluation:
    expected = in_core(checkpoint, condition, episodes, scenario)
    got = evaluate_via_ros(checkpoint, scenario, condition, episodes, SEED, layout)
    assert got.summary() == expected.summary()
    assert got.effects == expected.effects
    assert got == expected
    return got


@contextmanager
def busy_cores() -> Iterator[None]:
    """A busy loop per core."""
    loops = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(cpu_count() or 1)
    ]
    try:
        yield
        assert all(loop.poll() is None for loop in loops), "the machine was not loaded"
    finally:
        for loop in loops:
            loop.kill()
            loop.wait(timeout=10)


@pytest.mark.parametrize(
    "scenario",
    [
        "skirmish/3s_vs_3z",
        *(pytest.param(name, marks=pytest.mark.soak) for name in ("transport", "skirmish/8m")),
    ],
)
def test_every_kind_of_scenario(tmp_path: Path, scenario: str) -> None:
    checkpoint = untrained(tmp_path, scenario)
    compare(checkpoint, CONDITIONS["rate"], "single", episodes=2, scenario=scenario)


def modes_of(evaluation: Evaluation) -> set[str]:
    return {row.mode for row in evaluation.effects if row.kind == "EFFECT"}


def test_every_mode_has_the_same_effects(coverage: Path, tmp_path: Path) -> None:
    file = write(tmp_path / "modes.yaml", one_after_the_other())
    got = compare(coverage, file, "nodes", 2, SCENARIO)
    assert modes_of(got) == set(MODES)


@pytest.mark.soak
def test_every_trigger_has_the_same_effects(coverage: Path, tmp_path: Path) -> None:
    file = write(tmp_path / "triggers.yaml", with_triggers("hazard", "near", "return"))
    got = compare(coverage, file, "team", 2, SCENARIO)
    assert len(modes_of(got)) > len(MODES) / 2


@pytest.mark.soak
def test_a_loaded_machine_changes_nothing(coverage: Path, tmp_path: Path) -> None:
    file = write(tmp_path / "triggers.yaml", with_triggers("hazard", "near", "return"))
    with busy_cores():
        compare(coverage, file, "single", 2, SCENARIO)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_by_every_trigger(
    coverage: Path, tmp_path: Path, mode: str, trigger: str
) -> None:
    faults = [entry(mode, robot, **when(trigger, 10 * robot)) for robot in range(3)]
    got = compare(coverage, write(tmp_path / "one.yaml", faults), "single", 2, SCENARIO)
    assert modes_of(got) == {mode}


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("layout", ["single", "team", "nodes"])
@pytest.mark.parametrize("condition", sorted(CONDITIONS))
def test_64_episodes_give_the_same_bits(checkpoint: Path, layout: Layout, condition: str) -> None:
    compare(checkpoint, CONDITIONS[condition], layout, episodes=64)
