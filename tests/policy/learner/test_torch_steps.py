"""The optimisers' functional forms are the classes of torch.optim."""

from __future__ import annotations

import pytest
import torch

from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.torch_steps import Adam, RMSprop, UpdateRule

CONFIG = LearnerConfig(lr=3e-3, optim_eps=1e-6, optim_alpha=0.95)


def of_torch(kind: type[UpdateRule], tensor: torch.Tensor) -> torch.optim.Optimizer:
    if kind is Adam:
        return torch.optim.Adam([tensor], lr=CONFIG.lr, eps=CONFIG.optim_eps)
    return torch.optim.RMSprop(
        [tensor], lr=CONFIG.lr, alpha=CONFIG.optim_alpha, eps=CONFIG.optim_eps
    )


@pytest.mark.parametrize("kind", [RMSprop, Adam])
def test_steps_are_the_classes_bit_for_bit(kind: type[UpdateRule]) -> None:
    torch.manual_seed(5)
    mine = torch.randn(1000).requires_grad_()
    theirs = mine.detach().clone().requires_grad_()
    steps, optimiser = kind(CONFIG, mine), of_torch(kind, theirs)
    for _ in range(7):
        mine.grad = torch.randn(1000)
        theirs.grad = mine.grad.clone()
        steps.step()
        optimiser.step()
        assert torch.equal(mine, theirs)
    state = optimiser.state[theirs]
    assert set(steps.state) == set(state)
    assert all(torch.equal(steps.state[name], state[name]) for name in state)
