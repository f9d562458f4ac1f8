"""The checkpoints that the repository keeps: all load, and three play as they did when trained."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import pytest

from policy_pkg.checkpoint import (
    AGENT,
    CheckpointError,
    list_checkpoints,
    load_policy,
    read_manifest,
)
from policy_pkg.play.conditions import crash_free
from policy_pkg.play.evaluate import evaluate
from policy_pkg.train.session import TEST_KEY

RESULTS = Path(__file__).resolve().parents[3] / "results"
CHECKPOINTS = sorted(path.parent for path in RESULTS.rglob("checkpoint.json"))
WEIGHTLESS = RESULTS / "recipe/ablation"
"""Of whose runs the page tells the blocks alone: but for seed 0 they keep the weights' SHA-256."""
PLAYED = ("gridworld/adaptive-s0", "skirmish/2s3z-s0", "skirmish/3m-s0")


def test_all_load() -> None:
    assert len(CHECKPOINTS) > 100
    for folder in CHECKPOINTS:
        run = folder.parent.parent
        if run.parent != WEIGHTLESS or run.name.endswith("-s0"):
            assert load_policy(folder).robots
        else:
            assert len(read_manifest(folder).files[AGENT].sha256) == 64
            with pytest.raises(CheckpointError, match=r"agent\.safetensors is missing$"):
                load_policy(folder)


def lines(run: Path) -> list[dict[str, Any]]:
    text = gzip.decompress((run / "metrics.jsonl.gz").read_bytes()).decode()
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.parametrize("name", PLAYED)
def test_the_last_block_is_played_as_it_was(name: str) -> None:
    """The very episodes without crashes of the run's last evaluation block: the same figures."""
    run = RESULTS / name
    config = json.loads((run / "run.json").read_text())["config"]
    blocks, count = lines(run), config["test_episodes"]
    first, last = (len(blocks) - 1) * count, blocks[-1]
    bundle = load_policy(list_checkpoints(run / "checkpoints")[-1])
    assert bundle.meta["progress"]["env_steps"] == last["env_steps"]
    episodes = range(first, first + count)
    seed = config["seed"] ^ TEST_KEY
    played = evaluate(bundle, config["scenario"], crash_free(), episodes, seed)
    assert (played.success_rate, played.return_mean) == (
        last["success_crash_free"],
        last["return_crash_free"],
    )
