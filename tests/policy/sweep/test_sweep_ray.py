"""A sweep on a real Ray cluster of two nodes, one of which is lost while it works."""

from __future__ import annotations

from pathlib import Path

import pytest
from sweep_cases import assert_same_results, processes_of, tiny_runs, train_alone

from policy_pkg.sweep.folder import RunFiles
from policy_pkg.sweep.sweep import Snapshot, Sweep
from policy_pkg.train.run_dir import RunError


@pytest.fixture(autouse=True)
def _as_nice_as_this(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray gives its workers 15 more, with which little is left beside other work."""
    monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_a_lost_node_loses_no_run_and_repeats_none(tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    from policy_pkg.sweep.ray_engine import RayEngine

    runs, out = tiny_runs(tmp_path, total_steps=6000, seeds=[0, 1, 2]), tmp_path / "out"
    train_alone(runs, tmp_path / "alone")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    doomed = cluster.add_node(num_cpus=2)
    lost: list[str] = []

    def lose(now: Snapshot) -> None:
        begun = [name for name, each in now.running.items() if each and each.env_steps > 400]
        if len(begun) >= 2 and not lost:
            lost.extend(begun)
            cluster.remove_node(doomed, allow_graceful=False)

    try:
        sweep = Sweep(runs, out)
        sweep.work(RayEngine(out, len(runs), cluster.address), watch=lose)
    finally:
        cluster.shutdown()
    assert lost
    assert sweep.failed == {}
    assert not processes_of(out)
    assert_same_results(runs, out, tmp_path / "alone")
    trained = [RunFiles(out, run.name).log.read_text() for run in runs]
    assert sum(text.count(" trains ") for text in trained) > len(runs), "no run was hit"
    for text in trained:  # nothing is trained after it was finished
        assert " trains " not in text[text.index(" finished") :]
    assert not Sweep(runs, out).left


@pytest.mark.soak
@pytest.mark.timeout(300)
def test_a_cluster_that_cannot_do_runs_is_refused(tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    from policy_pkg.sweep.ray_engine import RayEngine

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        with pytest.raises(RunError, match="the Ray cluster has no node with a CPU"):
            RayEngine(tmp_path, 1, cluster.address)
        with pytest.raises(RunError, match=r"--address 127.0.0.1:9: no Ray cluster"):
            RayEngine(tmp_path, 1, "127.0.0.1:9")
    finally:
        cluster.shutdown()
