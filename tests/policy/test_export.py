"""Exported policies against the numpy policy that they were made from."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from policy_pkg.checkpoint import CheckpointError, load_policy
from policy_pkg.export.check import STEPS, compare
from policy_pkg.export.export import Exported, ExportError, Format, export
from policy_pkg.export.onnx_model import METADATA, run_onnx
from policy_pkg.export.torchscript import run_torchscript
from policy_pkg.play.target import load_target
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

ROOT = Path(__file__).resolve().parents[2]
TRAINED = {
    "buttons": ROOT / "results/recipe/robust/robust-s0",
    "3m": ROOT / "results/skirmish/3m-s0",
    "2s3z": ROOT / "results/skirmish/2s3z-s0",
}


def exported(run: str | Path, kind: Format, out: Path) -> Exported:
    bundle = load_policy(run)
    return export(bundle, make_env(bundle.scenario, 1).spec, kind, out)


@pytest.mark.parametrize("team", TRAINED)
def test_onnx_is_the_numpy_policy(team: str, tmp_path: Path) -> None:
    """1,000 steps, each with its own memory: rounding of 7 digits, in the memory a little more."""
    assert STEPS == 1000
    exported(TRAINED[team], Format.onnx, tmp_path / "out")
    policy = load_policy(TRAINED[team]).policy
    found = compare(policy, run_onnx(tmp_path / "out/policy.onnx"), own_memory=True)
    print(f"{team}: {found}")
    assert 0 < found.values < 1e-6
    assert found.hidden < 3e-6


def test_torchscript_is_the_numpy_policy(tmp_path: Path) -> None:
    exported(TRAINED["3m"], Format.torchscript, tmp_path / "out")
    step = run_torchscript(tmp_path / "out/policy.pt")
    found = compare(load_policy(TRAINED["3m"]).policy, step, own_memory=True)
    assert 0 < found.values < 1e-6
    assert found.hidden < 3e-6


def test_safetensors_is_it_bit_for_bit_and_evaluates_as_the_run(tmp_path: Path) -> None:
    run = f"{TRAINED['buttons']}@best"
    done = exported(run, Format.safetensors, tmp_path / "out")
    assert done.difference.largest == 0
    mine, theirs = load_target(run, None), load_target(str(tmp_path / "out"), None)
    assert (theirs.scenario, theirs.robots) == (mine.scenario, mine.robots)
    assert theirs.team.meta == mine.team.meta
    sizes = {path.name: path.stat().st_size for path in done.files}
    assert list(sizes) == ["agent.safetensors", "checkpoint.json", "policy.json"]
    assert sum(sizes.values()) < 150_000


def test_one_step_by_hand_and_what_the_description_says(tmp_path: Path) -> None:
    """policy.json is all that somebody who knows nothing of us has."""
    write_untrained(tmp_path / "run/step_0", make_env("skirmish/3m", 1).spec, seed=3)
    exported(tmp_path / "run/step_0", Format.onnx, tmp_path / "out")
    about = json.loads((tmp_path / "out/policy.json").read_text())
    assert about["action_names"][:2] == ["no_op", "stop"] or len(about["action_names"]) == 9
    assert (about["robots"], about["obs_size"]) == (["robot_1", "robot_2", "robot_3"], 30)
    given = {
        port["name"]: np.zeros(
            [4 if size == "rows" else size for size in port["shape"]], port["dtype"]
        )
        for port in about["inputs"]
    }
    given["last_action"][:] = [-1, 0, 8, -1]
    given["robot"][:] = [0, 1, 2, 2]
    session = onnxruntime.InferenceSession(tmp_path / "out" / about["model"])
    got = dict(zip(("q", "next_hidden"), session.run(["q", "next_hidden"], given), strict=True))
    assert {port["name"]: [4, *port["shape"][1:]] for port in about["outputs"]} == {
        name: list(array.shape) for name, array in got.items()
    }
    q, hidden = load_policy(tmp_path / "run/step_0").policy.forward(*given.values())
    np.testing.assert_allclose(got["q"], q, atol=1e-5)
    np.testing.assert_allclose(got["next_hidden"], hidden, atol=1e-6)
    assert np.abs(q[2] - q[3]).max() > 0.01  # the last action matters
    assert np.abs(q[0] - q[1]).max() > 0.01


def test_the_models_carry_the_description(tmp_path: Path) -> None:
    for kind in (Format.onnx, Format.torchscript):
        exported(TRAINED["buttons"], kind, tmp_path / kind)
    texts = [
        json.loads((tmp_path / kind / "policy.json").read_text())
        for kind in ("onnx", "torchscript")
    ]
    model = onnx.load(tmp_path / "onnx/policy.onnx")
    (inside,) = [entry.value for entry in model.metadata_props if entry.key == METADATA]
    assert json.loads(inside) == texts[0]
    extra = {"policy.json": ""}
    torch.jit.load(tmp_path / "torchscript/policy.pt", _extra_files=extra)
    assert json.loads(extra["policy.json"]) == texts[1]


@pytest.mark.parametrize("kind", list(Format))
def test_a_place_that_is_taken_or_cannot_be_written_is_left_as_it_is(
    kind: Format, tmp_path: Path
) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/mine.txt").write_text("mine")
    with pytest.raises(ExportError, match="taken is there already"):
        exported(TRAINED["buttons"], kind, tmp_path / "taken")
    assert os.listdir(tmp_path / "taken") == ["mine.txt"]
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="inside cannot be written"):
        exported(TRAINED["buttons"], kind, tmp_path / "file/inside")
    (tmp_path / "empty").mkdir()
    exported(TRAINED["buttons"], kind, tmp_path / "empty")
    assert sorted(os.listdir(tmp_path)) == ["empty", "file", "taken"]


def test_a_damaged_checkpoint_leaves_nothing(tmp_path: Path) -> None:
    shutil.copytree(TRAINED["buttons"], tmp_path / "run")
    bundle = load_policy(tmp_path / "run")
    (bundle.path / "agent.safetensors").write_bytes(b"x")
    with pytest.raises(CheckpointError, match="truncated or changed"):
        export(bundle, None, Format.onnx, tmp_path / "out")
    assert not list(tmp_path.glob("out*"))


def test_onnx_and_safetensors_need_no_torch(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom policy_pkg.checkpoint import load_policy\n"
        "from policy_pkg.export.export import Format, export\n"
        f"for kind in (Format.onnx, Format.safetensors):\n"
        f"    export(load_policy({str(TRAINED['buttons'])!r}), None, kind, "
        f"Path({str(tmp_path)!r}) / kind)\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0
    assert json.loads((tmp_path / "onnx/policy.json").read_text())["action_names"] is None
