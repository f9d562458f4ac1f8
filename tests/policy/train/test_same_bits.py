"""The same seed trains the same team on every x86-64 machine with AVX2."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import small

from policy_pkg.checkpoint import find_checkpoint
from policy_pkg.kernels import kernels
from policy_pkg.native import TORCH, VARIABLE, build_name
from policy_pkg.train.run import train

NO_AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
TRAIN = """
import sys
from pathlib import Path
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run import train
train(TrainConfig.model_validate_json(sys.argv[2]), Path(sys.argv[1]))
assert "torch._dynamo" not in sys.modules, "torch's compiler is slower to load than all the rest"
"""
ROWS = """
import numpy as np
from policy_pkg.policy import RecurrentPolicy, weight_shapes
rng = np.random.default_rng(0)
shapes = weight_shapes(12, 64, 5)
weights = {k: rng.standard_normal(s, dtype=np.float32) for k, s in shapes.items()}
policy = RecurrentPolicy(weights, 2, 5)
obs, hidden = (rng.standard_normal((203, size), dtype=np.float32) for size in (5, 64))
last, robot = (rng.integers(0, high, 203).astype(np.int32) for high in (5, 2))
together = policy.forward(obs, last, robot, hidden)[0]
for size in (1, 2, 7, 8, 9, 16, 24, 33, 100):
    for start in (0, 1, 5, 203 - size):
        part = slice(start, start + size)
        alone = policy.forward(obs[part], last[part], robot[part], hidden[part])[0]
        assert np.array_equal(alone, together[part]), (size, start)
"""


def machine(**variables: str) -> dict[str, str]:
    """An environment in which libraries take this machine for another one."""
    pinned = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "ATEN_CPU_CAPABILITY", "MKL_CBWR")
    kept = {key: value for key, value in os.environ.items() if key not in pinned}
    return {**kept, **variables}


def run(code: str, env: dict[str, str], *arguments: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=env, capture_output=True, timeout=800
    )
    assert done.returncode == 0, done.stderr.decode()


def disabled() -> str:
    """The features of NO_AVX512 that this processor has: numpy refuses to disable others."""
    has = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    dispatched = np._core._multiarray_umath.__cpu_dispatch__  # type: ignore[attr-defined]
    return " ".join(name for name in NO_AVX512.split() if has.get(name) and name in dispatched)


@pytest.mark.parametrize(
    "numba",
    [False, pytest.param(True, marks=(pytest.mark.soak, pytest.mark.timeout(900)))],
    ids=["", "numba"],
)
def test_training_has_the_same_bits_on_other_processors(tmp_path: Path, numba: bool) -> None:
    """Libraries forced to what they do on a machine with AVX2 and without AVX-512; numba's kernels
    too in the soak test, since all of them are compiled anew for that."""
    target = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    config = small(explore_hold=6, replay_strata="outcome", learner={"td_lambda": 0.8}, n_envs=8)
    older = machine(
        **{VARIABLE: "avx2"},
        NPY_DISABLE_CPU_FEATURES=disabled(),
        ATEN_CPU_CAPABILITY="avx2",
        MKL_CBWR="COMPATIBLE",  # other kernels than this machine's: nothing may go through MKL
        **(target if numba else {}),
    )
    train(config, tmp_path / "this")
    run(TRAIN, older, str(tmp_path / "older"), config.model_dump_json())
    found = {}
    for name, learner in (("this", build_name() or TORCH), ("older", "avx2")):
        agent = find_checkpoint(tmp_path / name) / "agent.safetensors"
        metrics = (tmp_path / name / "metrics.jsonl").read_bytes()
        found[name] = hashlib.sha256(agent.read_bytes() + metrics).hexdigest()
        described = json.loads((tmp_path / name / "run.json").read_text())
        assert described["kernels"] == {"openblas": "Haswell", "learner": learner}
    assert found["this"] == found["older"]


@pytest.mark.parametrize("kernel", ["Haswell", "Zen", "SkylakeX", "Sandybridge"])
def test_a_row_has_the_same_bits_in_every_batch_whatever_the_kernels(kernel: str) -> None:
    run(ROWS, machine(OPENBLAS_CORETYPE=kernel, **{VARIABLE: TORCH}))  # numpy's step


def test_kernels_names_what_is_loaded() -> None:
    assert kernels()["openblas"] == os.environ.get("OPENBLAS_CORETYPE", kernels()["openblas"])
