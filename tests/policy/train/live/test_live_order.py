"""Live training without ROS: order, lag, blocks, losses, resuming."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_player import SPEC, InProcess, Player, StoppedError, live, small, wait

from crash_coach_common.contract import UserError
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.checkpoint import CheckpointError, load_policy
from policy_pkg.train.live.order import LAG, RealTime, Task
from policy_pkg.train.live.run import LiveRun
from policy_pkg.train.live.session import LiveSession
from policy_pkg.train.run import train
from policy_pkg.train.run_dir import RunError


@pytest.mark.parametrize("graphs", [1, 3])
def test_the_order_of_arrival_changes_nothing(graphs: int) -> None:
    config = small(n_envs=graphs, coach={"strategy": "fixed", "crash_rate": 0.3})
    straight, shuffled = InProcess(config), InProcess(config, shuffle=5)
    straight.go()
    shuffled.go()
    assert straight.lines == shuffled.lines
    assert straight.session.agent == shuffled.session.agent
    assert straight.session.learner.updates > 10
    assert straight.lines[0]["env_steps"] == 0
    assert straight.session.finished


def test_another_seed_is_another_run() -> None:
    one, other = InProcess(small()), InProcess(small(seed=1))
    one.go()
    other.go()
    assert one.session.agent != other.session.agent


def test_an_episode_is_played_with_what_was_learned_before_the_one_under_way() -> None:
    run = InProcess(small(total_steps=200, test_interval_steps=1000, updates_per_episode=1.0))
    after: list[bytes] = []  # the net after each training episode
    learn = run.session.learn

    def noting(recorded: RecordedEpisode) -> None:
        learn(recorded)
        after.append(run.session.agent)

    run.session.learn = noting  # type: ignore[method-assign]
    run.go()
    first = after[0]
    played = [task.agent for task in run.tasks if not task.test]
    assert len(played) == len(after) > 4
    for number, agent in enumerate(played):
        before = number - 1 - LAG
        assert agent == (after[before] if before >= 0 else first)
    assert len(set(after)) > 3


def test_a_block_has_the_metrics_of_train(tmp_path: Path) -> None:
    run = InProcess(small())
    run.go()
    summary = train(small(n_envs=4), tmp_path / "run")
    assert list(run.lines[-1]) == list(summary.last_block)
    first, last = run.lines[0], run.lines[-1]
    assert first["epsilon"] == 1.0
    assert last["success_crash_free"] == last["success_rate"]  # nobody crashed
    assert last["decision"] is None
    tests = [task for task in run.tasks if task.test]
    assert len(tests) == 3 * len(run.lines)
    assert {task.epsilon for task in tests} == {0.0}


def test_crashes_are_counted_as_the_coach_planned_them() -> None:
    run = InProcess(small(coach={"strategy": "fixed", "crash_rate": 0.5}))
    run.go()
    assert {line["alpha"] for line in run.lines} == {0.5}
    assert run.lines[0]["crashed_fraction"] is None
    fractions = [line["crashed_fraction"] for line in run.lines[1:]]
    assert all(isinstance(f, float) and 0 < f < 1 for f in fractions)
    assert {line["success_crash_free"] for line in run.lines if line["block_crashed"]} == {None}


def test_a_lost_episode_is_left_out_and_a_lost_test_played_again() -> None:
    config = small()
    whole, robbed = InProcess(config), InProcess(config)
    whole.go()
    robbed.go(lose=frozenset((1, 6)))  # a test of the first block, and a training episode
    assert robbed.tasks[3].test
    assert not whole.tasks[3].test
    assert robbed.lines[0]["env_steps"] == 0
    assert len(robbed.lines) == len(whole.lines)
    assert robbed.session.agent != whole.session.agent


def test_real_time_shares_a_block_among_the_graphs_and_ends_it_without_what_was_lost() -> None:
    config = small(n_envs=2, test_episodes=3)
    session = LiveSession(config, SPEC)
    order = RealTime(session)
    players = [Player(config, graph) for graph in range(2)]
    tests = order.begin()
    assert [(t.graph, t.episodes, t.test, t.epsilon) for t in tests] == [
        (0, 2, True, 0.0),
        (1, 1, True, 0.0),
    ]
    assert order.played(tests[0], players[0].play(tests[0])) == []
    assert order.played(tests[1], None) == []
    assert order.played(tests[0], players[0].play(tests[0])) == []
    assert len(order.block) == 2
    session.counters.close(0, config.test_interval_steps, config.total_steps)
    after = order.begin()
    assert [(t.graph, t.episodes, t.test) for t in after] == [(0, 0, False), (1, 0, False)]
    newest = order.played(after[1], players[1].play(after[1]))
    assert [t.graph for t in newest] == [0, 1]
    assert newest[0].epsilon < after[0].epsilon
    assert order.played(after[1], None) == []


def test_an_episode_of_another_team_is_refused() -> None:
    run = InProcess(small())
    run.session.advance()
    recorded = run.players[0].play(run.tasks[0])
    run.session.played(run.tasks[0], replace(recorded, robots=("robot_1", "robot_9")))
    with pytest.raises(UserError, match="an episode of"):
        run.session.advance()
    cut = replace(recorded.episode, obs=recorded.episode.obs[..., :1])
    with pytest.raises(UserError, match=r"does not fit scenario 'buttons': episode\.obs"):
        run.session.learn(replace(recorded, episode=cut))


# --- with files and a thread ----------------------------------------------------------------


def test_a_run_directory_serves_every_verb_and_resumes_bit_for_bit(tmp_path: Path) -> None:
    config = small()
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    blocks = live(config, whole, resume=False)
    with pytest.raises(StoppedError):
        live(config, killed, resume=False, die_after_blocks=3)
    assert live(config, killed, resume=True) == blocks[3:]
    assert (killed / "metrics.jsonl").read_bytes() == (whole / "metrics.jsonl").read_bytes()
    nets = [sorted(run.glob("checkpoints/*/agent.safetensors"))[-1] for run in (whole, killed)]
    assert nets[0].read_bytes() == nets[1].read_bytes()
    assert load_policy(whole).scenario == "buttons"
    assert json.loads((whole / "run.json").read_text())["config"] == config.model_dump(mode="json")
    assert live(config, whole, resume=True) == []  # nothing is left to do
    with pytest.raises(RunError, match="already holds a run"):
        live(config, whole, resume=False)


def test_runs_of_train_and_of_train_live_are_not_confused(tmp_path: Path) -> None:
    config = small()
    live(config, tmp_path / "live", resume=False)
    with pytest.raises(CheckpointError, match="is of a run of train-live"):
        train(config, tmp_path / "live", resume=True)
    train(config, tmp_path / "in_process")
    with pytest.raises(CheckpointError, match="is of a run of train, which has to continue it"):
        live(config, tmp_path / "in_process", resume=True)


def test_divergence_is_told_and_its_batch_kept(tmp_path: Path) -> None:
    config, out = small(), tmp_path / "run"

    def on_tasks(tasks: list[Task]) -> None:
        for task in tasks:
            recorded = player.play(task)
            if not task.test:
                recorded.episode.reward[0] = np.inf
            run.session.played(task, recorded)

    run = LiveRun(config, SPEC, out, False, "lockstep", on_tasks, lambda *_: None, print)
    player = Player(config)
    with run:
        run.start()
        with pytest.raises(UserError, match=r"diverged.*the batch is in"):
            wait(run)
    assert len(list(out.glob("diverged_*.safetensors"))) == 1
