"""Checkpoints: what was written comes back; whatever is wrong with one is named."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from policy_pkg.checkpoint import (
    CheckpointError,
    Manifest,
    find_checkpoint,
    load_policy,
    read_manifest,
    read_tensors,
    write_checkpoint,
)
from policy_pkg.episode import Sizes
from policy_pkg.policy import weight_shapes

SIZES = Sizes(n_robots=2, n_actions=5, obs_size=3, state_size=4, episode_limit=9)


def weights(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = weight_shapes(SIZES.input_size, 8, SIZES.n_actions)
    return {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}


def manifest() -> Manifest:
    return Manifest(
        scenario="buttons",
        robots=("robot_1", "robot_2"),
        n_actions=SIZES.n_actions,
        obs_size=SIZES.obs_size,
        config={"seed": 3},
        progress={"env_steps": 10},
        training={"rng": {"state": 2**127 + 1}, "alpha": 0.1},
    )


def write(run: Path, steps: int, seed: int = 0) -> Path:
    folder = run / "checkpoints" / f"step_{steps:09d}"
    learner = {"scalar": np.array(3.0), "strided": np.arange(12.0).reshape(3, 4).T}
    write_checkpoint(folder, manifest(), {"agent": weights(seed), "learner": learner}, 2)
    return folder


def test_what_was_written_comes_back(tmp_path: Path) -> None:
    folder = write(tmp_path, 10)
    read = read_manifest(folder)
    assert read.training == {"rng": {"state": 2**127 + 1}, "alpha": 0.1}
    learner = read_tensors(folder, read, "learner")
    assert learner["scalar"].shape == ()
    np.testing.assert_array_equal(learner["strided"], np.arange(12.0).reshape(3, 4).T)
    bundle = load_policy(folder)
    assert (bundle.scenario, bundle.robots) == ("buttons", ("robot_1", "robot_2"))
    assert (bundle.n_actions, bundle.obs_size) == (5, 3)
    assert bundle.meta["progress"] == {"env_steps": 10}


def test_a_run_directory_stands_for_its_newest_checkpoint(tmp_path: Path) -> None:
    for steps in (5, 200, 30):
        write(tmp_path, steps)
    # A killed process left this one; it is not complete.
    (tmp_path / "checkpoints" / "step_000000999.partial").mkdir()
    assert find_checkpoint(tmp_path).name == "step_000000200"
    assert load_policy(tmp_path).path.name == "step_000000200"


def test_run_at_best_stands_for_the_best(tmp_path: Path) -> None:
    run = tmp_path / "run"
    write(run, 30)
    with pytest.raises(CheckpointError, match=r"run@best: .*run/best/step_\*/ is not there"):
        find_checkpoint(tmp_path / "run@best")
    shutil.copytree(run / "checkpoints", run / "best")
    (run / "best" / "step_000000030").rename(run / "best" / "step_000000020")
    assert find_checkpoint(tmp_path / "run@best") == run / "best" / "step_000000020"
    assert load_policy(f"{run}@best").path == run / "best" / "step_000000020"
    assert find_checkpoint(run).name == "step_000000030"
    # A folder that is called so is itself.
    write(tmp_path / "run@best", 7)
    assert find_checkpoint(tmp_path / "run@best").name == "step_000000007"
    with pytest.raises(CheckpointError, match="none: no such file"):
        find_checkpoint(tmp_path / "none@best")


def test_only_the_newest_are_kept_and_leftovers_go(tmp_path: Path) -> None:
    (tmp_path / "checkpoints" / "step_000000001.partial").mkdir(parents=True)
    for steps in (1, 2, 3, 4):
        write(tmp_path, steps)
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["step_000000003", "step_000000004"]


def test_a_failed_write_leaves_the_older_checkpoint_alone(tmp_path: Path) -> None:
    write(tmp_path, 1)
    blocked = tmp_path / "checkpoints" / "step_000000002"
    blocked.mkdir()
    (blocked / "in the way").touch()
    with pytest.raises(OSError, match="step_000000002"):
        write(tmp_path, 2)
    shutil.rmtree(blocked)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["step_000000001"]
    assert load_policy(tmp_path).path.name == "step_000000001"


def edit(change: Callable[[dict[str, object]], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        path = folder / "checkpoint.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def truncate(folder: Path) -> None:
    path = folder / "agent.safetensors"
    path.write_bytes(path.read_bytes()[:-7])


def flip(folder: Path) -> None:
    path = folder / "agent.safetensors"
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(bytes(content))


def swap(folder: Path) -> None:
    """Another agent, whole and with its right digest, but not of these sizes."""
    content = json.loads((folder / "checkpoint.json").read_text())
    shutil.rmtree(folder)
    other = Manifest.model_validate({**content, "obs_size": 4, "files": {}})
    write_checkpoint(folder, other, {"agent": weights()}, 2)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate, r"agent\.safetensors has \d+ bytes, \d+ were written: truncated"),
        (flip, r"agent\.safetensors is damaged: its sha256 is"),
        (swap, r"agent\.safetensors is for 3 observation features, checkpoint\.json says 4"),
        (lambda f: (f / "agent.safetensors").unlink(), r"agent\.safetensors is missing"),
        (lambda f: (f / "checkpoint.json").unlink(), r"holds no checkpoint"),
        (lambda f: (f / "checkpoint.json").write_text("{"), r"checkpoint\.json cannot be read"),
        (lambda f: (f / "checkpoint.json").write_bytes(b"\xff\xfe"), r"cannot be read"),
        (lambda f: (f / "checkpoint.json").write_text('{"a": 1}'), r"not a Crash Coach checkpoint"),
        (lambda f: (f / "checkpoint.json").write_text("[1]"), r"not a Crash Coach checkpoint"),
        (edit(lambda c: c.update(version=2)), r"has version 2, this program reads version 1"),
        (edit(lambda c: c.pop("robots")), r"checkpoint\.json: robots: Field required"),
        (edit(lambda c: c.update(n_actions="x")), r"checkpoint\.json: n_actions"),
        (edit(lambda c: c.update(n_actions=4)), r"agent\.safetensors: fc2\.weight has shape"),
        (edit(lambda c: c["files"].pop("agent")), r"lists no agent\.safetensors"),  # type: ignore[attr-defined]
    ],
)
def test_every_damage_is_named(
    tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    folder = write(tmp_path, 10)
    damage(folder)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_policy(folder)
    assert str(folder) in str(caught.value)


def test_a_path_without_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        load_policy(tmp_path)
    with pytest.raises(CheckpointError, match="no such file or directory"):
        load_policy(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        load_policy(tmp_path / "file")


def test_loading_needs_no_torch(tmp_path: Path) -> None:
    write(tmp_path, 1)
    code = (
        "import sys; from policy_pkg.checkpoint import load_policy; "
        f"load_policy({str(tmp_path)!r}); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0
