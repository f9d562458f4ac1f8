"""Training runs: schedule, files, refusals, and surviving what goes wrong."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from small_run import SMALL, small

from crash_coach_common.contract import EnvSpec, IntArray, StepResult, UserError
from policy_pkg.checkpoint import load_policy
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import __doc__ as METRICS_DOC
from policy_pkg.train.progress import ProgressReport
from policy_pkg.train.run import TrainError, train
from policy_pkg.train.run_dir import RunError, locked, prepare_run
from policy_pkg.train.session import TrainSession
from sim_pkg.env import Env, make_env


def lines(run: Path, name: str = "metrics.jsonl") -> list[dict[str, object]]:
    return [json.loads(line) for line in (run / name).read_text().splitlines()]


def test_a_run_writes_what_it_promises(tmp_path: Path) -> None:
    config = small(loggers={"tensorboard": True})
    run = tmp_path / "runs" / "x"
    reports: list[ProgressReport] = []
    summary = train(config, run, progress=reports.append)

    blocks = lines(run)
    assert [line["env_steps"] for line in blocks] == [0, 300, 600, 900, 1200]
    table = METRICS_DOC.split("=\n")[2].split("\n=")[0]
    documented = {row.split()[0] for row in table.splitlines()}
    assert set(blocks[0]) == documented
    assert [line["env_steps"] for line in lines(run, "timing.jsonl")] == [0, 300, 600, 900, 1200]
    # beta 0: every block passes, so alpha follows the formula.
    alpha = [float(str(line["alpha"])) for line in blocks]
    assert alpha == pytest.approx([1 - 0.8**k for k in range(5)])
    assert blocks[0]["loss"] is None
    assert isinstance(blocks[-1]["loss"], float)
    assert blocks[-1]["success_crash_free"] is not None

    described = json.loads((run / "run.json").read_text())
    assert TrainConfig.model_validate(described["config"]) == config
    assert set(described["versions"]) == {"python", "numpy", "torch", "pymunk", "numba"}
    assert sorted(p.name for p in (run / "checkpoints").iterdir()) == [
        "step_000000900",
        "step_000001200",
    ]
    assert list((run / "tensorboard").iterdir())
    assert load_policy(run).meta["progress"]["env_steps"] == 1200
    assert summary.checkpoint == run / "checkpoints" / "step_000001200"
    assert summary.last_block == blocks[-1]
    last = reports[-1]
    assert (last.phase, last.steps, last.eta_s) == ("finished", 1200, 0.0)
    assert last.alpha == pytest.approx(1 - 0.8**5)


def test_the_same_config_gives_the_same_metrics_and_another_seed_does_not(tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(small(seed=seed, total_steps=600), tmp_path / name)
    a, b, c = ((tmp_path / name / "metrics.jsonl").read_bytes() for name in "abc")
    assert a == b
    assert a != c


@pytest.mark.parametrize("per_episode", [0.25, 1.0, 2.0])
def test_gradient_steps_follow_the_finished_episodes(per_episode: float) -> None:
    """Credit is given per finished episode from the first full batch on, as PyMARL trains."""
    config = small(updates_per_episode=per_episode)
    session = TrainSession(config, make_env("buttons", 4), make_env("buttons", 4))
    for _ in range(150):
        session.advance()
        credited = max(0, session.counters.episodes - config.batch_episodes + 1)
        assert session.learner.updates == int(credited * per_episode)
    assert session.counters.env_steps == 600
    assert session.counters.episodes >= 25


def test_the_acting_policy_is_the_learners() -> None:
    session = TrainSession(small(), make_env("buttons", 4), make_env("buttons", 4))
    obs, index = np.ones((2, session.env.spec.obs_size), np.float32), np.arange(2, dtype=np.int32)
    hidden = session.policy.initial_hidden(2)
    before, _ = session.policy.forward(obs, index, index, hidden)
    while session.learner.updates < 3:
        session.advance()
    acting, _ = session.policy.forward(obs, index, index, hidden)
    session.policy.set_weights(session.learner.agent_weights())
    learners, _ = session.policy.forward(obs, index, index, hidden)
    np.testing.assert_array_equal(acting, learners)
    assert not np.array_equal(acting, before)


def test_curriculum_crashes_robots_in_training_and_in_the_blocks(tmp_path: Path) -> None:
    coach = {"strategy": "curriculum", "curriculum": {"alpha_max": 0.8}}
    train(small(coach=coach), tmp_path / "x")
    blocks = lines(tmp_path / "x")
    assert blocks[0]["crashed_fraction"] is None
    assert float(str(blocks[-1]["crashed_fraction"])) > 0.3
    assert float(str(blocks[-1]["block_crashed"])) > 0.2


class NoSuccess(Env):
    @property
    def spec(self) -> EnvSpec:
        return replace(super().spec, reports_success=False)


class Broken(Env):
    """Rewards become NaN, as those of a simulator that exploded."""

    steps = 0

    def step(self, actions: IntArray) -> StepResult:
        result = super().step(actions)
        self.steps += 1
        if self.steps > 100:
            result.reward[:] = np.nan
        return result


def in_world(world: type[Env]):  # type: ignore[no-untyped-def]
    def make(scenario: str | Path, arenas: int) -> Env:
        env = make_env(scenario, arenas)
        env.__class__ = world
        return env

    return make


def test_an_environment_without_success_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    with pytest.raises(UserError, match=r"'buttons' reports no success, which coach\.str"):
        train(small(), tmp_path / "x", environment=in_world(NoSuccess))
    assert not (tmp_path / "x").exists()
    train(small(coach={}, total_steps=100), tmp_path / "x", environment=in_world(NoSuccess))
    assert lines(tmp_path / "x")[-1]["success_rate"] is None


def test_divergence_stops_the_run_and_saves_the_batch(tmp_path: Path) -> None:
    with pytest.raises(TrainError, match=r"diverged: loss nan.* the batch is in .*safetensors"):
        train(small(), tmp_path / "x", environment=in_world(Broken))
    (saved,) = (tmp_path / "x").glob("diverged_*.safetensors")
    assert np.isnan(load_file(saved)["reward"]).any()
    assert load_policy(tmp_path / "x").meta["progress"]["env_steps"] == 300


@contextmanager
def full_disk() -> Iterator[None]:
    """No file can grow beyond 100 bytes: the kernel's refusal is real, as that of a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_at_checkpoint_time_loses_nothing(tmp_path: Path) -> None:
    undisturbed, run = tmp_path / "a", tmp_path / "b"
    train(small(), undisturbed)
    disk = full_disk()
    warnings: list[str] = []
    kept: list[list[str]] = []

    def meddle(report: ProgressReport) -> None:
        if report.phase == "checkpoint" and report.steps == 600 and not report.warning:
            disk.__enter__()
        elif report.warning:
            disk.__exit__(None, None, None)
            warnings.append(report.warning)
            kept.append([p.name for p in (run / "checkpoints").iterdir()])

    train(small(), run, progress=meddle)
    assert len(warnings) == 1
    assert "checkpoint at 600 steps was not written" in warnings[0]
    assert kept == [["step_000000300"]]
    assert sorted(p.name for p in (run / "checkpoints").iterdir())[0] == "step_000000900"
    assert (run / "metrics.jsonl").read_bytes() == (undisturbed / "metrics.jsonl").read_bytes()


def test_a_disk_full_at_the_end_says_how_to_get_the_result(tmp_path: Path) -> None:
    disk = full_disk()

    def fill(report: ProgressReport) -> None:
        if report.phase == "checkpoint" and report.steps == 1200:
            disk.__enter__()

    try:
        with pytest.raises(TrainError, match=r"checkpoint at 1200 steps .* make room and resume"):
            train(small(), tmp_path / "x", progress=fill)
    finally:
        disk.__exit__(None, None, None)
    assert train(small(), tmp_path / "x", resume=True).steps == 1200


def test_directories_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    config = small(total_steps=4)
    train(config, tmp_path / "x")
    with pytest.raises(RunError, match="x already holds a run"):
        train(config, tmp_path / "x")
    changed = small(total_steps=4, learner={**SMALL["learner"], "lr": 0.1})  # type: ignore[dict-item]
    with pytest.raises(RunError, match=r"x was started with learner\.lr = 0\.0005, not 0\.1"):
        train(changed, tmp_path / "x", resume=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(RunError, match="other is not empty and holds no run"):
        train(config, tmp_path / "other", resume=True)
    with pytest.raises(RunError, match=r"thesis\.tex is a file"):
        train(config, tmp_path / "other" / "thesis.tex")
    (tmp_path / "x" / "run.json").write_text("{}")
    with pytest.raises(RunError, match=r"run\.json does not describe a run"):
        train(config, tmp_path / "x", resume=True)


def test_two_processes_cannot_train_in_one_directory(tmp_path: Path) -> None:
    prepare_run(tmp_path / "x", small(), resume=False)
    with locked(tmp_path / "x"), pytest.raises(RunError, match="trained by another process"):
        train(small(), tmp_path / "x", resume=True)


def test_a_coach_that_does_not_fit_the_team_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown robot 'robot_7' in victims"):
        train(small(coach={"strategy": "fixed", "victims": ["robot_7"]}), tmp_path / "x")
    assert not (tmp_path / "x").exists()
