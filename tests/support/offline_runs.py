"""Short runs on recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offline_recordings import Recording

from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.offline.run import read_data
from policy_pkg.train.offline.run import train_offline as train_on
from policy_pkg.train.progress import RunSummary

SMALL: dict[str, Any] = {
    "scenario": "buttons",
    "gradient_steps": 50,
    "batch_episodes": 8,
    "test_interval_steps": 10,
    "test_episodes": 4,
    "checkpoint_interval_steps": 20,
    "loggers": {"tensorboard": False},
    "learner": {
        "hidden": 16,
        "mixing_hidden": 8,
        "hypernet_hidden": 8,
        "target_update_interval_episodes": 15,
    },
}


def small(**changes: Any) -> OfflineConfig:
    return OfflineConfig.model_validate({**SMALL, **changes})


def train_offline(
    config: OfflineConfig, recordings: list[Recording], run: Path, **rest: Any
) -> RunSummary:
    return train_on(config, read_data(config, recordings), run, **rest)
