"""The metrics as TensorBoard events."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from policy_pkg.train.metrics import Value


class TensorBoard:
    """Writes every number of a metrics line under its key.

    purge_step: events from this environment step on, of a killed run, are hidden.
    """

    def __init__(self, folder: Path, purge_step: int) -> None:
        self._writer = SummaryWriter(str(folder), purge_step=purge_step)

    def write(self, line: Mapping[str, Value], env_steps: int) -> None:
        """Raises OSError where events could not be written."""
        for key, value in line.items():
            if isinstance(value, int | float) and key != "env_steps":
                self._writer.add_scalar(key, value, env_steps)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
