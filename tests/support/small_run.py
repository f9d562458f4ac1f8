"""A training run of a few seconds, with a coach that raises the crash rate."""

from __future__ import annotations

from policy_pkg.train.config import TrainConfig

SMALL = {
    "scenario": "buttons",
    "total_steps": 1200,
    "n_envs": 4,
    "updates_per_episode": 0.5,
    "batch_episodes": 4,
    "replay_episodes": 20,
    "epsilon_anneal_steps": 600,
    "test_interval_steps": 300,
    "test_episodes": 4,
    "checkpoint_interval_steps": 300,
    "loggers": {"tensorboard": False},
    "learner": {"hidden": 16, "mixing_hidden": 8, "hypernet_hidden": 8},
    "coach": {"strategy": "adaptive", "adaptive": {"rho": 0.2, "beta": 0.0}},
}


def small(**changes: object) -> TrainConfig:
    return TrainConfig.model_validate({**SMALL, **changes})
