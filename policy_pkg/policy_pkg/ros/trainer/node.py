"""Executable ``trainer``: learns from the episodes that running graphs play."""

from __future__ import annotations

import os
import sys

from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.loading import loading
from crash_coach_common.ros.run_node import run
from policy_pkg.ros.recorder_node import PROFILE, PROFILE_VARIABLE
from policy_pkg.ros.trainer.params import TrainerParameters, read_parameters
from policy_pkg.train.config import TrainConfig, load_train_config


def load_config(parameters: TrainerParameters) -> TrainConfig:
    """Raises UserError as load_train_config, or for another number of graphs than domains."""
    overrides = [] if parameters.overrides == ["none"] else parameters.overrides
    seed = None if parameters.seed < 0 else parameters.seed
    config = load_train_config(parameters.config, overrides, seed)
    if len(parameters.domains) != config.n_envs:
        raise UserError(
            f"n_envs = {config.n_envs} graphs, but parameter domains has "
            f"{len(parameters.domains)}: {parameters.domains}"
        )
    return config


def _parameters() -> TrainerParameters:
    node = Node("trainer", start_parameter_services=False)
    try:
        return read_parameters(node)
    finally:
        node.destroy_node()


def _train(received: list[int]) -> None:
    parameters = _parameters()
    config = load_config(parameters)
    # Only now: it loads torch, which takes longer than finding out what is wrong.
    with loading():
        from policy_pkg.ros.trainer.trainer import Trainer

    Trainer(parameters, config).run(received)


def main() -> int:
    """Exit code 0 at the end or on SIGINT or SIGTERM; 1 after one line of error."""
    # Read when the first node is made. Whoever set it knows better. As the recorder's: a deep queue
    # for what comes while this process is busy.
    os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))
    return run(_train, "trainer")


if __name__ == "__main__":
    sys.exit(main())
