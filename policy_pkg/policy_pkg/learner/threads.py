"""How many threads torch takes."""

from __future__ import annotations

import torch


def use_one_thread() -> None:
    """For this process: a second core is better used by a second run."""
    torch.set_num_threads(1)
