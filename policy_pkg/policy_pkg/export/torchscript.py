"""The agent network as a TorchScript module."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from crash_coach_common.contract import FloatArray, IntArray
from policy_pkg.export.about import ABOUT, About
from policy_pkg.export.check import Step
from policy_pkg.policy import WeightArrays


class TeamPolicy(nn.Module):
    """One step of any number of rows; as policy.RecurrentPolicy, from a network of torch's own."""

    def __init__(self, about: About) -> None:
        super().__init__()
        inputs = about.obs_size + about.n_actions + len(about.robots)
        self.fc1 = nn.Linear(inputs, about.hidden_size)
        self.rnn = nn.GRUCell(about.hidden_size, about.hidden_size)
        self.fc2 = nn.Linear(about.hidden_size, about.n_actions)
        self.action_numbers = torch.nn.Buffer(torch.arange(about.n_actions), persistent=False)
        self.robot_numbers = torch.nn.Buffer(torch.arange(len(about.robots)), persistent=False)

    def forward(
        self, observation: Tensor, last_action: Tensor, robot: Tensor, hidden: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As policy.json says: (rows, O) float32, (rows,) int64 twice, (rows, H) float32 to
        (rows, A) action values and (rows, H) the next hidden state."""
        acted = torch.eq(last_action.unsqueeze(1), self.action_numbers)  # of -1 no one
        which = torch.eq(robot.unsqueeze(1), self.robot_numbers)
        x = torch.cat([observation, acted.to(torch.float32), which.to(torch.float32)], dim=1)
        next_hidden = self.rnn(torch.relu(self.fc1(x)), hidden)
        return self.fc2(next_hidden), next_hidden


@contextmanager
def _deprecated() -> Iterator[None]:
    """torch advises against TorchScript at every call; who asks for it by name has his reason."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning, message=".*torch.jit")
        yield


def to_torchscript(weights: WeightArrays, about: About) -> bytes:
    """The module's file, which carries policy.json along as an extra file."""
    module = TeamPolicy(about).eval()
    module.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    file = io.BytesIO()
    with _deprecated():
        scripted = torch.jit.script(module)
        torch.jit.save(scripted, file, _extra_files={ABOUT: about.model_dump_json()})
    return file.getvalue()


def run_torchscript(path: Path) -> Step:
    """The module in ``path``."""
    with _deprecated():
        module = torch.jit.load(path)  # type: ignore[no-untyped-call]

    def step(
        observation: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        indices = (torch.from_numpy(each.astype(np.int64)) for each in (last_action, robot))
        with torch.no_grad():
            q, next_hidden = module(
                torch.from_numpy(observation), *indices, torch.from_numpy(hidden)
            )
        return q.numpy(), next_hidden.numpy()

    return step
