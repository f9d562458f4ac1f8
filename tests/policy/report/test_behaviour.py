"""What a team does, measured on episodes small enough to be counted by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from policy_pkg.report.behaviour import averaged, compare, measured
from policy_pkg.report.finished_runs import Run
from sim_pkg.render.frames import Actor, Frames, Side
from sim_pkg.scenarios.base import Scene

# Four robots on a line, the last one crashed, and two opponents; nobody moves for two steps.
AT_M = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (4.0, 0.0), (0.0, 3.0), (9.0, 0.0)]


def fight(crashed: bool = True) -> Frames:
    steps, n, d = 2, 4, len(AT_M)
    actors = tuple(
        Actor(f"a{i}", "marine", Side.ROBOTS if i < n else Side.OPPONENTS, 0.4) for i in range(d)
    )
    damage = np.zeros((steps, d, d), np.float32)
    damage[0, 4, 0] = damage[0, 4, 1] = damage[0, 5, 2] = 6.0  # two of three hit the same
    damage[0, 5, 3] = 6.0  # the crashed robot's hit does not count
    damage[1, 4, 0] = 6.0  # alone: nothing is shared
    damage[0, 2, 4] = 8.0  # a neighbour of the crashed robot
    damage[1, 0, 4] = 2.0  # the one further away
    health = np.ones((steps + 1, d), np.float32)
    health[1:, 3] = 0.0  # the crashed robot dies in the first step
    health[1:, 5] = 0.0
    faults = np.zeros((steps, n), np.uint8)
    faults[:, 3] = crashed
    positions = np.broadcast_to(np.array(AT_M, np.float32), (steps + 1, d, 2)).copy()
    return Frames(
        scenario="fight", seed=0, episode=0, dt_s=0.5,
        scene=Scene((32.0, 32.0), 0.0, (0.4,) * n, ()), walled_m=(0.0, 0.0, 32.0, 32.0),
        actors=actors, positions_m=positions, angles_rad=np.zeros((steps + 1, d), np.float32),
        health=health, shield=np.zeros((steps + 1, d), np.float32), damage=damage,
        sites_done=np.zeros((steps + 1, 0), np.bool_),
        intents=np.zeros((steps, n), np.int32), actions=np.zeros((steps, n), np.int32),
        faults=faults, returns=np.zeros(steps + 1), success=True, trajectory_hash="ab",
    )  # fmt: skip


def test_each_measure_as_counted_by_hand() -> None:
    found = measured(fight())
    assert found["focus"] == pytest.approx(2 / 3)
    nearest = [3.0, math.sqrt(10), math.sqrt(13)]  # the far opponent is nobody's nearest
    assert found["opponent distance"] == pytest.approx(np.mean(nearest))
    assert found["spread"] == pytest.approx(math.sqrt(2 / 3))
    assert found["crashed distance"] == pytest.approx(np.mean([4, 3, 2]))  # first step alone
    assert found["crashed life"] == 0.5
    assert found["neighbour damage"] == pytest.approx((8 + 0) / 2 / 0.5)
    assert found["other damage"] == 0.0  # what it takes later, no crashed robot lives


def test_without_a_crash_nothing_is_said_of_crashed_robots() -> None:
    found = measured(fight(crashed=False))
    lacking = {name for name, value in found.items() if math.isnan(value)}
    assert lacking == {"crashed distance", "crashed life", "neighbour damage", "other damage"}


def test_an_average_leaves_out_episodes_without_the_measure() -> None:
    found = averaged([measured(fight()), measured(fight(crashed=False))])
    assert found["crashed life"] == 0.5
    assert found["focus"] == pytest.approx(np.mean([2 / 3, 1 / 2]))


def run(method: str, seed: int) -> Run:
    at = Path(f"{method}-s{seed}")
    return Run(at, at, method, "fight", seed, {}, 1, 1, "", "fight")


def values(focus: float) -> dict[str, float]:
    return {**dict.fromkeys(measured(fight()), math.nan), "focus": focus}


def test_differences_are_paired_by_seed_to_the_first_method() -> None:
    found = [(run("plain", seed), values(0.4 + 0.1 * seed)) for seed in range(3)]
    found += [(run("coached", seed), values(0.5 + 0.1 * seed + 0.01 * seed)) for seed in (1, 2)]
    plain, coached = compare(found)  # the other measures are nobody's
    assert (plain.method, plain.seeds, plain.difference, plain.p) == (
        "plain",
        (0, 1, 2),
        None,
        None,
    )
    assert coached.difference is not None
    assert coached.difference.value == pytest.approx(0.115)
    assert coached.p is not None
    assert 0 < coached.p < 0.05
    (alone,) = compare(found[:1])
    assert alone.interval is None
