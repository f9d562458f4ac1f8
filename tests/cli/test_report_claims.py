"""What a claim is shown with: Holm, paired p values, profiles, last blocks, compute, marl-eval."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crash_coach_bringup.cli.report.other_tables import as_csv, as_latex
from crash_coach_bringup.cli.report.time_left import TimeLeft
from policy_pkg.play.conditions import crash_free, exactly
from policy_pkg.report.coping import coping
from policy_pkg.report.finished_runs import Run
from policy_pkg.report.kept_evaluations import Outcome, Result
from policy_pkg.report.marl_eval import as_marl_eval
from policy_pkg.report.rows import Row, rows
from policy_pkg.report.training import Training, training_of
from policy_pkg.statistics import Estimate, holm, paired_p_value, performance_profile


def test_holm() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_paired_p_values() -> None:
    # t = 0.1 / (0.2 / sqrt(3)) = 0.8660 with two degrees of freedom: p = 1 - t / sqrt(t^2 + 2).
    assert paired_p_value(np.array([0.3, 0.1, -0.1])) == pytest.approx(1 - 0.866025 / 2.75**0.5)
    assert paired_p_value(np.full(5, 0.25)) == 2.0**-4
    assert paired_p_value(np.zeros(3)) == 1.0
    with pytest.raises(ValueError, match="1 difference"):
        paired_p_value(np.array([0.1]))


def test_a_performance_profile_falls_from_task_to_task() -> None:
    scores = [np.array([0.2, 0.6, 1.0, 1.0]), np.array([0.0, 0.0, 0.0, 0.0])]
    marks = np.array([0.0, 0.5, 0.99])
    share, low, high = performance_profile(scores, marks, np.random.default_rng(0))
    assert share.tolist() == [0.5, 0.375, 0.25]
    assert (low <= share).all()
    assert (share <= high).all()
    assert low[0] == high[0] == 0.5  # every run of the first task scores, none of the second


def run_of(folder: Path, lines: list[dict[str, Any]], **settings: Any) -> Run:
    folder.mkdir(parents=True)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return Run(
        path=folder,
        checkpoint=folder / "checkpoints" / "step_000000100",
        method="qmix",
        scenario="buttons",
        source="buttons",
        seed=3,
        settings=settings,
        steps=100,
        total_steps=100,
        agent="",
    )


def block(steps: int, success: float, **more: Any) -> dict[str, Any]:
    return {
        "env_steps": steps, "episodes": steps // 10, "block_crashed": 0.0,
        "success_crash_free": success, "return_crash_free": 2 * success, **more,
    }  # fmt: skip


def test_last_blocks_and_what_the_blocks_played(tmp_path: Path) -> None:
    lines = [block(10 * k, k / 20, block_crashed=0.1 * (k > 4)) for k in range(1, 13)]
    settings = {"test_episodes": 8, "test_crash_free": True}
    found = training_of(run_of(tmp_path / "a", lines, **settings))
    assert found.last_blocks == pytest.approx(sum(range(3, 13)) / 200)
    # The crash-free half of a block without crashes is the block itself.
    assert (found.episodes, found.evaluation_episodes) == (12, 4 * 8 + 8 * 16)
    few = training_of(run_of(tmp_path / "b", lines[:9], **settings))
    assert few.last_blocks is None
    victims = {"success_robot_1_crashed": 0.5, "success_robot_2_crashed": 0.5}
    with_victims = [block(10, 0.5, **victims)]
    found = training_of(run_of(tmp_path / "c", with_victims, **settings, test_victim_episodes=3))
    assert found.evaluation_episodes == 8 + 2 * 3


def test_when_a_team_copes_block_by_block(tmp_path: Path) -> None:
    def probe(steps: int, *victims: float | None, free: float = 1.0) -> dict[str, Any]:
        names = ("success_robot_1_crashed", "success_robot_2_crashed")
        return block(steps, free, **dict(zip(names, victims, strict=True)))

    copes, one_fails, untested = (1.0, 0.8), (1.0, 0.79), (None, None)
    late = [probe(10, *one_fails), *(probe(10 * k, *copes) for k in range(2, 13))]
    lost = [probe(10, *copes), probe(20, *copes, free=0.5), probe(30, *untested), block(40, 1.0)]
    recordings = [block(10, 1.0, success_1_crashed=1.0)]  # so many robots, not a robot
    runs = {"late": late, "lost": lost, "never": [probe(10, *one_fails)], "none": [block(10, 1.0)]}
    runs["offline"] = recordings
    results = []
    for seed, (name, lines) in enumerate(runs.items()):
        run = replace(run_of(tmp_path / name, lines, test_episodes=8), seed=seed)
        results.append(Result(run, [], training_of(run)))
    (found,) = coping(results[::-1])
    assert found.seeds == (0, 1, 2)  # nothing is known of those without victims
    assert found.at_end == (True, False, False)
    assert (found.last, found.last_blocks) == ((10, 1, 0), 10 + 2 + 1)
    assert found.first_steps == (20, 10, None)


def outcome(successes: int) -> Outcome:
    return Outcome(successes, 8, False, successes / 2, 5.0, "")


def test_marl_eval(tmp_path: Path) -> None:
    run = run_of(tmp_path / "a", [])
    training = Training(((10, 0.25, 1.0), (20, 0.5, 2.0)), (), 2, 8)
    result = Result(run, [(crash_free(), outcome(6)), (exactly(1), outcome(2))], training)
    found = as_marl_eval([result])
    assert found["crash_coach, crash-free"]["buttons"]["qmix"]["seed_3"] == {
        "step_1": {"step_count": 10, "win_rate": [0.25], "mean_episode_return": [1.0]},
        "step_2": {"step_count": 20, "win_rate": [0.5], "mean_episode_return": [2.0]},
        "absolute_metrics": {"win_rate": [0.75], "mean_episode_return": [3.0]},
    }
    crashed = found["crash_coach, 1 crashed"]["buttons"]["qmix"]["seed_3"]
    assert list(crashed) == ["step_1", "absolute_metrics"]
    assert crashed["step_1"]["step_count"] == 100


def test_the_mean_of_the_last_blocks_is_a_row_of_its_own(tmp_path: Path) -> None:
    lines = [block(10 * k, 0.5) for k in range(1, 11)]
    run = run_of(tmp_path / "a", lines, test_episodes=8)
    found = rows([Result(run, [(crash_free(), outcome(6))], training_of(run))], [])
    assert [(row.condition, row.success) for row in found] == [
        ("crash-free", (0.75,)), ("crash-free, last 10 blocks", (0.5,)),
    ]  # fmt: skip


def test_tables_for_other_tools() -> None:
    interval = Estimate(0.75, 0.0, 1.0)
    row = Row("a_map", "1 crashed", "fix_0.1", (0, 1), (0.5, 1.0), interval, None, (1.0, 3.0))
    lines = as_csv([row]).splitlines()
    assert lines[1].startswith("a_map,1 crashed,fix_0.1,0 1,0.75,0.3535")
    assert lines[1].endswith(",0.0,1.0,,,,2.0,0.5 1.0")
    text = as_latex([row])
    assert r"fix\_0.1 & 75.0 $\pm$ 35.4 \\" in text
    assert text.count(r"\toprule") == 1


def test_time_left() -> None:
    now = [0.0]
    clock = TimeLeft(4, lambda: now[0])
    assert clock.next() == "[1/4]"
    now[0] = 50.0
    assert clock.next() == "[2/4, 2 min left]"
    now[0] = 60.0
    assert clock.next() == "[3/4, 60 s left]"
