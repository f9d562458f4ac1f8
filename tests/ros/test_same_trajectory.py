"""One seed, one checkpoint, one plan: the same trajectory in the core and in every ROS layout."""

from __future__ import annotations

from pathlib import Path

import pytest

from crash_coach_bringup.ros.evaluation import evaluate_via_ros
from crash_coach_bringup.ros.graph import Layout
from policy_pkg.checkpoint import load_policy
from policy_pkg.train.evaluate import Condition, at_rate, crash_free, evaluate, named
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


def compare(
    checkpoint: Path,
    condition: Condition,
    layout: Layout,
    episodes: int,
    scenario: str = "buttons",
) -> None:
    expected = evaluate(load_policy(checkpoint), scenario, condition, episodes, SEED)
    got = evaluate_via_ros(checkpoint, scenario, condition, episodes, SEED, layout)
    assert got.summary() == expected.summary()
    assert (got.condition, got.robots, got.seed) == (
        expected.condition,
        expected.robots,
        expected.seed,
    )
    for mine, theirs in zip(got.episodes, expected.episodes, strict=True):
        assert (mine.episode, mine.success, mine.steps) == (
            theirs.episode,
            theirs.success,
            theirs.steps,
        )
        assert mine.trajectory_hash == theirs.trajectory_hash
        assert mine.crashed == theirs.crashed
        assert mine.episode_return == theirs.episode_return


@pytest.mark.parametrize(
    ("layout", "condition"),
    [("single", "rate"), ("team", "stay"), ("nodes", "random"), ("nodes", "crash-free")],
)
def test_core_and_ros_give_the_same_bits(checkpoint: Path, layout: Layout, condition: str) -> None:
    compare(checkpoint, CONDITIONS[condition], layout, episodes=4)


@pytest.mark.parametrize("scenario", ["coverage", "transport", "skirmish/3s_vs_3z", "skirmish/8m"])
def test_every_kind_of_scenario(tmp_path: Path, scenario: str) -> None:
    checkpoint = untrained(tmp_path, scenario)
    compare(checkpoint, CONDITIONS["rate"], "single", episodes=2, scenario=scenario)


@pytest.mark.soak
@pytest.mark.parametrize("layout", ["single", "team", "nodes"])
@pytest.mark.parametrize("condition", sorted(CONDITIONS))
def test_64_episodes_give_the_same_bits(checkpoint: Path, layout: Layout, condition: str) -> None:
    compare(checkpoint, CONDITIONS[condition], layout, episodes=64)
