"""Runs on recorded episodes: their files, resuming bit for bit, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from offline_recordings import (
    Recording,
    buttons_recordings,
    random_recordings,
    recording,
    with_crashes,
)
from offline_runs import SMALL, small, train_offline

from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import CheckpointError, find_checkpoint, load_policy, read_manifest
from policy_pkg.checkpoint import read_tensors as tensors_of
from policy_pkg.learner.learner import Learner
from policy_pkg.play.conditions import crash_free
from policy_pkg.play.evaluate import evaluate
from policy_pkg.statistics import binomial_weights
from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.offline.data import load_data
from policy_pkg.train.offline.session import MEANS, OfflineSession
from policy_pkg.train.progress import ProgressReport
from policy_pkg.train.run import EndedEarly, TrainError
from policy_pkg.train.run_dir import RunError

DOCUMENT = Path(__file__).resolve().parents[4] / "docs" / "algorithms.md"
CONSERVATIVE = {**SMALL["learner"], "conservative_weight": 1.0}


METHODS = {
    "plain": small(),
    "conservative": small(learner=CONSERVATIVE, crash_weighting="resample", crash_rate=0.3),
    "cloning": small(
        method="behaviour_cloning", scenario=None, crash_weighting="reweight", crash_rate=0.3
    ),
}


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return buttons_recordings(40)


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def test_a_run_writes_what_it_promises(tmp_path: Path, recordings: list[Recording]) -> None:
    config, run = (
        small(learner=CONSERVATIVE, loggers={"tensorboard": True}),
        tmp_path / "runs" / "x",
    )
    reports: list[ProgressReport] = []
    summary = train_offline(config, recordings, run, progress=reports.append, sources=["bags/one"])
    blocks = lines(run)
    assert [line["gradient_steps"] for line in blocks] == [0, 10, 20, 30, 40, 50]
    played = {
        f"{figure}_{condition}"
        for figure in ("success", "return")
        for condition in ("crash_free", "1_crashed")
    }
    assert set(blocks[0]) == {"gradient_steps", "epochs", *played, *MEANS}
    table = DOCUMENT.read_text().split("| key of `metrics.jsonl` |")[1].split("\n\n")[0]
    first_cells = [row.split("|")[1] for row in table.splitlines()[2:]]
    assert set(re.findall(r"`(\w+)`", "".join(first_cells))) == set(blocks[0])
    assert blocks[-1]["epochs"] == 50 * 8 / 40
    assert blocks[0]["loss"] is None
    assert blocks[-1]["agreement"] is None
    assert blocks[-1]["conservative"] > 0
    assert all(blocks[-1][name] is not None for name in played)

    described = json.loads((run / "run.json").read_text())
    assert OfflineConfig.model_validate(described["config"]) == config
    data = described["data"]
    assert (data["sources"], data["episodes"]) == (["bags/one"], 40)
    assert sum(data["episodes_by_crashed"].values()) == 40
    assert list((run / "tensorboard").iterdir())
    assert [p.name for p in sorted((run / "checkpoints").iterdir())] == [
        "step_000000040",
        "step_000000050",
    ]
    assert summary.checkpoint == run / "checkpoints" / "step_000000050"
    assert (summary.episodes, summary.gradient_steps) == (40, 50)
    assert summary.last_block == blocks[-1]
    assert (reports[-1].phase, reports[-1].steps) == ("finished", 50)


@pytest.mark.parametrize("method", ["plain", "cloning"])
def test_the_result_plays(tmp_path: Path, recordings: list[Recording], method: str) -> None:
    train_offline(METHODS[method], recordings, tmp_path / "x")
    bundle = load_policy(tmp_path / "x")
    assert bundle.scenario == ("buttons" if method == "plain" else "unknown")
    assert evaluate(bundle, "buttons", crash_free(), 3, seed=0).robots == bundle.robots


def test_weight_0_is_plain_q_learning_on_the_same_batches(
    tmp_path: Path, recordings: list[Recording]
) -> None:
    """The run against a loop by hand: same seed, same draws, no conservative term."""
    session = OfflineSession(small(scenario=None), load_data(recordings, None, 100), None)
    learner = Learner(session.config.learner, session.data.sizes, seed=0)
    draws = OfflineSession(session.config, session.data, None).sampling
    for step in range(30):
        session.advance()
        slots = draws.choice(40, size=8, replace=False, shuffle=False)
        learner.update(session.data.episodes.gather(slots), episodes=step + 1)
    mine, theirs = session.learner.state_dict()[0], learner.state_dict()[0]
    assert all(np.array_equal(mine[name], theirs[name]) for name in theirs)


class Stopped(Exception):
    pass


def assert_same_run(run: Path, other: Path) -> None:
    assert (run / "metrics.jsonl").read_bytes() == (other / "metrics.jsonl").read_bytes()
    folders = find_checkpoint(run), find_checkpoint(other)
    one, two = (read_manifest(folder) for folder in folders)
    assert one.progress == two.progress
    assert set(one.files) == {"agent", "learner"}
    for stem in one.files:
        mine, theirs = (tensors_of(f, m, stem) for f, m in zip(folders, (one, two), strict=True))
        assert mine.keys() == theirs.keys()
        for name, array in mine.items():
            np.testing.assert_array_equal(array, theirs[name], err_msg=f"{stem}: {name}")
    states = [{k: v for k, v in m.training.items() if k != "logged"} for m in (one, two)]
    assert states[0] == states[1]


@pytest.mark.parametrize("method", list(METHODS))
def test_stopping_anywhere_and_resuming_changes_no_bit(
    tmp_path: Path, recordings: list[Recording], method: str
) -> None:
    whole, config = tmp_path / "whole", METHODS[method]
    train_offline(config, recordings, whole)
    for phase, steps in (("evaluation", 10), ("checkpoint", 40), ("training", 47)):

        def stop(report: ProgressReport, phase: str = phase, steps: int = steps) -> None:
            if report.phase == phase and report.steps >= steps:
                raise Stopped

        run, ticks = tmp_path / f"{phase}-{steps}", iter(range(10**9))
        clock = lambda ticks=ticks: float(next(ticks))  # noqa: E731 - every step is worth a report
        with pytest.raises(Stopped):
            train_offline(config, recordings, run, progress=stop, clock=clock)
        train_offline(config, recordings[::-1], run, resume=True)
        assert_same_run(run, whole)


def test_stopping_by_request_saves_where_it_stands(
    tmp_path: Path, recordings: list[Recording]
) -> None:
    config, asked = METHODS["conservative"], iter(range(10**9))
    train_offline(config, recordings, tmp_path / "whole")
    with pytest.raises(EndedEarly):
        train_offline(config, recordings, tmp_path / "run", stopped=lambda: next(asked) >= 33)
    assert (tmp_path / "run" / "checkpoints" / "step_000000033").is_dir()
    train_offline(config, recordings, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def test_another_seed_gives_another_run(tmp_path: Path, recordings: list[Recording]) -> None:
    for seed in (0, 1):
        train_offline(small(seed=seed), recordings, tmp_path / str(seed))
    assert lines(tmp_path / "0")[-1]["loss"] != lines(tmp_path / "1")[-1]["loss"]


def test_resuming_needs_the_same_recordings_and_config(
    tmp_path: Path, recordings: list[Recording]
) -> None:
    run = tmp_path / "x"
    train_offline(small(), recordings, run)
    with pytest.raises(RunError, match="x already holds a run"):
        train_offline(small(), recordings, run)
    with pytest.raises(RunError, match=r"other recordings \(40 episodes, now 39\)"):
        train_offline(small(), recordings[1:], run, resume=True)
    with pytest.raises(RunError, match=r"was started with batch_episodes = 8, not 7"):
        train_offline(small(batch_episodes=7), recordings, run, resume=True)
    assert train_offline(small(), recordings, run, resume=True).gradient_steps == 50
    (find_checkpoint(run) / "learner.safetensors").write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"learner\.safetensors has 1 bytes"):
        train_offline(small(), recordings, run, resume=True)


def test_crash_weights_are_logged_and_what_is_missing_is_told(
    tmp_path: Path, recordings: list[Recording]
) -> None:
    crashed = [one for one in recordings if one.episode.faults.any(0).sum() < 2]
    reports: list[ProgressReport] = []
    config = METHODS["cloning"].model_copy(update={"crash_rate": 0.5})
    run = tmp_path / "x"
    train_offline(config, [*crashed, crashed[0]], run, progress=reports.append)
    told = [report.warning for report in reports if report.warning]
    assert len(told) == 2
    assert told[0].startswith(f"1 of {len(crashed) + 1} episodes repeat another one")
    assert "no episode with 2 robots crashed was recorded, but at crash_rate 0.5" in told[1]
    found = json.loads((run / "run.json").read_text())["data"]["crash_weights"]["conditions"]
    assert [c["target"] for c in found] == binomial_weights(2, 0.5)
    assert found[2]["weight"] is None
    assert sum(c["weight"] * c["share"] for c in found[:2]) == pytest.approx(1)


def test_resampled_batches_follow_the_wanted_law(recordings: list[Recording]) -> None:
    """Five standard errors of 20,000 draws."""
    victims: list[list[int]] = [[]] * 32 + [[1]] * 7 + [[0, 1]]
    data = load_data(
        [
            recording(with_crashes(one.episode, crashed), one.number)
            for one, crashed in zip(recordings, victims, strict=True)
        ],
        None,
        100,
    )
    config = small(scenario=None, crash_weighting="resample", crash_rate=0.4, batch_episodes=20)
    session = OfflineSession(config, data, None)
    drawn = np.concatenate([session._draw() for _ in range(1000)])
    share = np.bincount(data.crashed[drawn], minlength=3) / len(drawn)
    np.testing.assert_allclose(share, binomial_weights(2, 0.4), atol=5 * 0.5 / np.sqrt(20_000))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"batch_episodes": 41}, "batch_episodes 41 is more than the 40 recorded episodes"),
        ({"test_crashed": [3]}, "test_crashed 3: the team has 2 robots"),
        ({"test_crash_mode": "mutter"}, "test_crash_mode 'mutter'"),
        ({"scenario": "button"}, "buttons"),
        ({"scenario": "transport"}, "has 2 robots .*, scenario 'transport' has 3"),
        (
            {"scenario": None, "learner": {"crashed_target": "stay"}},
            "crashed_target stay needs a scenario",
        ),
    ],
)
def test_what_does_not_fit_is_named_and_nothing_is_written(
    tmp_path: Path, recordings: list[Recording], changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(UserError, match=expected):
        train_offline(small(**changes), recordings, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_divergence_names_the_batch(tmp_path: Path) -> None:
    recordings = random_recordings(9)
    for one in recordings:
        one.episode.reward[:] = 3e38
    with pytest.raises(TrainError, match=r"update 1 diverged: .*diverged_000000000\.safetensors"):
        train_offline(small(scenario=None), recordings, tmp_path / "x")
    assert (tmp_path / "x" / "diverged_000000000.safetensors").exists()
