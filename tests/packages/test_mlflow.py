"""MLflow itself, in a folder, as one of a run's loggers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from small_run import small

from crash_coach_common.contract import UserError
from policy_pkg.train.run import EndedEarly, train
from policy_pkg.train.run_dir import read_run

pytest.importorskip("mlflow", reason="make mlflow installs it")

TOLD = {"tensorboard": False, "mlflow": {"experiment": "mine"}}


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run that was stopped, and MLflow's store."""
    folder, asked = tmp_path_factory.mktemp("begun"), iter([False] * 100 + [True])
    config = small(loggers=TOLD, total_steps=600)
    with pytest.raises(EndedEarly):
        train(config, folder / "run", stopped=lambda: next(asked))
    return folder


def test_mlflow_keeps_configuration_metrics_and_end(begun: Path, tmp_path: Path) -> None:
    """Stopped, moved with the store beside it, resumed: one run of MLflow's."""
    from mlflow.tracking import MlflowClient

    def found(folder: Path) -> Any:
        client = MlflowClient(f"sqlite:///{folder / 'mlflow.db'}")
        experiment = client.get_experiment_by_name("mine")
        (run,) = client.search_runs([experiment.experiment_id])
        return client, run

    _, run = found(begun)
    assert run.info.status == "KILLED"
    shutil.copytree(begun, tmp_path / "b")
    train(small(loggers=TOLD, total_steps=600), tmp_path / "b" / "run", resume=True)
    client, again = found(tmp_path / "b")
    assert (again.info.run_id, again.info.status) == (run.info.run_id, "FINISHED")
    assert again.info.run_name == "run"
    assert again.data.params["coach.adaptive.rho"] == "0.2"
    assert again.data.params["torch"] == read_run(tmp_path / "b" / "run")["versions"]["torch"]
    lines = [json.loads(x) for x in (tmp_path / "b/run/metrics.jsonl").read_text().splitlines()]
    for key in ("alpha", "return_mean", "env_steps"):
        told = client.get_metric_history(run.info.run_id, key)
        assert [(m.step, m.value) for m in told] == [(x["env_steps"], x[key]) for x in lines]
    losses = client.get_metric_history(run.info.run_id, "loss")
    assert [m.step for m in losses] == [300, 600]  # null before anything was learned


@pytest.mark.soak
def test_runs_that_begin_side_by_side_share_a_store(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "train", "buttons/qmix"]
    command += ["--out", str(tmp_path), "--seed", "1", "2", "3", "--set", "loggers.mlflow=true"]
    command += ["loggers.tensorboard=false", "total_steps=300", "test_episodes=2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("crash-coach").experiment_id])
    assert {(r.info.run_name, r.info.status) for r in runs} == {
        (f"qmix-s{seed}", "FINISHED") for seed in (1, 2, 3)
    }


def test_a_store_that_lost_the_run_and_one_that_cannot_be_are_named(
    begun: Path, tmp_path: Path
) -> None:
    def told(store: str) -> dict[str, Any]:
        return {"tensorboard": False, "mlflow": {"tracking_uri": store}}

    with pytest.raises(UserError, match=r"loggers\.mlflow: MLflow's store nothing://here: "):
        train(small(loggers=told("nothing://here")), tmp_path / "a")
    nowhere = f"sqlite:///{tmp_path}/no/folder/mlflow.db"
    with pytest.raises(UserError, match=r"MLflow's store sqlite:///.*mlflow\.db: .*No such file"):
        train(small(loggers=told(nowhere)), tmp_path / "b")
    shutil.copytree(begun, tmp_path / "moved")
    run = tmp_path / "moved" / "run"
    (run / "mlflow.json").write_text(json.dumps({"run_id": "0" * 32}))
    with pytest.raises(UserError, match=r"has no run 0{32}, which .*mlflow\.json says this run is"):
        train(small(loggers=TOLD, total_steps=600), run, resume=True)
