"""The checkpoint that a run keeps as its best one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_run import small

from policy_pkg.checkpoint import BEST, list_checkpoints, load_policy, read_manifest
from policy_pkg.play.evaluate import EpisodeResult, Evaluation
from policy_pkg.train.blocks import Block
from policy_pkg.train.run import train


def played(successes: int, crashed: tuple[int, ...] = (), episodes: int = 10) -> Evaluation:
    results = tuple(
        EpisodeResult(number, number < successes, 0.0, 1, crashed, "", "")
        for number in range(episodes)
    )
    return Evaluation("", ("a", "b"), 0, results)


def test_the_worst_condition_decides() -> None:
    steady = Block(played(6, (0,)), played(7), (played(6, (0,)), played(6, (1,))))
    uneven = Block(played(9, (0,)), played(10), (played(10, (0,)), played(5, (1,))))
    assert steady.worst_success == 0.6
    assert uneven.worst_success == 0.5
    assert steady.rank > uneven.rank


def test_a_block_that_crashed_nobody_is_never_better_than_one_that_did() -> None:
    spared = Block(played(10), played(10))
    assert spared.rank < Block(played(1, (0,)), played(10)).rank


def test_equals_are_ordered_by_the_mean() -> None:
    assert Block(played(5, (0,)), played(9)).rank > Block(played(5, (0,)), played(8)).rank


def test_a_run_keeps_the_best_of_its_blocks(tmp_path: Path) -> None:
    """Of equals the last one; and what is kept acts as the learner did then."""
    run = tmp_path / "run"
    train(small(test_victim_episodes=1), run)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    keys = ("success_crash_free", "success_robot_1_crashed", "success_robot_2_crashed")
    for line in lines:
        assert line["success_worst"] == min(line["success_rate"], *(line[key] for key in keys))
    (best,) = list_checkpoints(run / BEST)
    assert set(read_manifest(best).files) == {"agent"}
    at = int(best.name.removeprefix("step_"))
    worst = {line["env_steps"]: line["success_worst"] for line in lines}
    assert worst[at] == max(worst.values())
    policy = load_policy(best).policy
    obs = np.zeros((2, policy.sizes.obs), dtype=np.float32)
    index = np.arange(2, dtype=np.int32)
    values, _ = policy.forward(obs, index * 0 - 1, index, policy.initial_hidden(2))
    assert np.isfinite(values).all()


def test_settings_that_graphs_cannot_keep_are_refused() -> None:
    from crash_coach_common.contract import UserError
    from policy_pkg.train.live.session import LiveSession
    from sim_pkg.env import make_env

    spec = make_env("buttons", 1).spec
    for settings, message in (
        ({"explore_hold": 6}, "explore_hold 6: must be 1 in live training"),
        ({"test_victim_episodes": 2}, "test_victim_episodes 2: must be 0 in live training"),
    ):
        with pytest.raises(UserError, match=message):
            LiveSession(small(**settings), spec)
