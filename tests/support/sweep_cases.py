"""Sweeps that are trained in seconds, and what two ways of doing one have to share."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from policy_pkg.checkpoint import find_checkpoint
from policy_pkg.sweep.config import SweepRun, load_sweep

TINY: dict[str, Any] = {
    "config": "buttons/qmix",
    "set": {
        "total_steps": 2000,
        "n_envs": 5,
        "updates_per_episode": 0.7,
        "batch_episodes": 4,
        "replay_episodes": 30,
        "test_interval_steps": 200,
        "test_episodes": 4,
        "checkpoint_interval_steps": 400,
        "loggers.tensorboard": False,
        "learner.hidden": 16,
        "learner.mixing_hidden": 8,
        "learner.hypernet_hidden": 8,
    },
    "scenarios": ["buttons"],
    "seeds": [0],
    "methods": {
        "qmix": {"coach.strategy": "none"},
        "adaptive": {
            "coach.strategy": "adaptive",
            "coach.adaptive.beta": 0.0,
            "coach.adaptive.rho": 0.3,
        },
    },
}


def write_sweep(path: Path, **changes: Any) -> Path:
    """TINY with other values at the top, or in ``set``."""
    inside = {key: changes.pop(key) for key in list(changes) if key in TINY["set"]}
    content = {**TINY, "set": {**TINY["set"], **inside}, **changes}
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def tiny_runs(folder: Path, **changes: Any) -> list[SweepRun]:
    return load_sweep(write_sweep(folder / "sweep.yaml", **changes))


def train_alone(runs: Sequence[SweepRun], out: Path) -> None:
    """Every run once, in this process, without a sweep."""
    from policy_pkg.train.run import train

    for run in runs:
        train(run.config, out / run.name)


def assert_same_results(runs: Sequence[SweepRun], out: Path, alone: Path) -> None:
    """The same metrics and the same weights, byte for byte."""
    for run in runs:
        mine, theirs = out / run.name, alone / run.name
        name = "metrics.jsonl"
        assert (mine / name).read_bytes() == (theirs / name).read_bytes(), run.name
        one, other = (find_checkpoint(path) for path in (mine, theirs))
        assert one.name == other.name
        name = "agent.safetensors"
        assert (one / name).read_bytes() == (other / name).read_bytes(), run.name


def processes_of(out: Path) -> list[int]:
    """Processes that have a file below ``out`` open: logs and locks of runs at work."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            links = [os.readlink(link) for link in (process / "fd").iterdir()]
        except OSError:  # it ended
            continue
        if any(link.startswith(f"{out}/") for link in links):
            found.append(int(process.name))
    return sorted(set(found) - {os.getpid()})
