"""QMIX's compiled mixer against its own text in float64, and its two builds against each other."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from policy_pkg import native
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.mixer import Qmix

BUILDS = [name for name in native.FLAGS if native.FLAGS[name] <= native._flags()]

# (robots, state size, mixing layer, hypernetworks, rows): odd sizes, one row, blocks of rows
CASES = [(2, 5, 20, 33, 1), (3, 7, 32, 64, 37), (8, 216, 32, 64, 900), (5, 8, 40, 70, 300)]


def mixer(case: int) -> Qmix:
    robots, states, mixing, hypernet, _ = CASES[case]
    sizes = Sizes(robots, n_actions=3, obs_size=4, state_size=states, episode_limit=6)
    torch.manual_seed(case)
    return Qmix(sizes, LearnerConfig(mixing_hidden=mixing, hypernet_hidden=hypernet))


def problem(case: int) -> tuple[Tensor, Tensor, Tensor]:
    """Values, states, and the gradient of the loss by the team's values."""
    robots, states, _, _, rows = CASES[case]
    torch.manual_seed(case)
    return 3 * torch.randn(rows, robots), torch.randn(rows, states), torch.randn(rows).abs() / rows


def solved(net: nn.Module, case: int, dtype: torch.dtype) -> dict[str, Tensor]:
    """The team's values, and the gradients of the robots' and of the parameters."""
    values, state, grad = (x.to(dtype) for x in problem(case))
    net.to(dtype).zero_grad()
    values.requires_grad_()
    total = net(values, state)
    total.backward(grad)
    found = {name: p.grad for name, p in net.named_parameters()}
    return {"total": total.detach(), "values": values.grad, **found}  # type: ignore[dict-item]


@pytest.mark.parametrize("case", range(len(CASES)))
@pytest.mark.parametrize("build", BUILDS)
def test_values_and_gradients_are_those_of_float64(
    monkeypatch: pytest.MonkeyPatch, build: str, case: int
) -> None:
    monkeypatch.setenv(native.VARIABLE, build)
    found = solved(mixer(case), case, torch.float32)
    for name, expected in solved(mixer(case), case, torch.float64).items():
        most = 2e-6 * float(expected.abs().max())
        torch.testing.assert_close(found[name].double(), expected, rtol=0, atol=most, msg=name)


@pytest.mark.parametrize("case", range(len(CASES)))
def test_both_builds_have_the_same_bits(monkeypatch: pytest.MonkeyPatch, case: int) -> None:
    if len(BUILDS) < 2:
        pytest.skip("this processor has no AVX-512: there is one build to run")
    results = []
    for build in BUILDS:
        monkeypatch.setenv(native.VARIABLE, build)
        results.append(solved(mixer(case), case, torch.float32))
    for name, found in results[0].items():
        assert torch.equal(found, results[1][name]), name


@pytest.mark.parametrize("build", BUILDS)
def test_a_row_alone_has_the_bits_it_has_in_a_batch(
    monkeypatch: pytest.MonkeyPatch, build: str
) -> None:
    monkeypatch.setenv(native.VARIABLE, build)
    net, (values, state, _) = mixer(3), problem(3)
    together = net(values, state).detach()
    with torch.no_grad():
        assert torch.equal(net(values, state), together)  # with a tape and without
        for row in (0, 7, 8, 299):
            alone = net(values[row : row + 1], state[row : row + 1])
            assert torch.equal(alone, together[row : row + 1])


@pytest.mark.parametrize("build", BUILDS)
def test_what_is_not_a_number_is_not_lost(monkeypatch: pytest.MonkeyPatch, build: str) -> None:
    monkeypatch.setenv(native.VARIABLE, build)
    values, state, _ = problem(1)
    for name, parameter in mixer(1).named_parameters():
        net = mixer(1)
        net.get_parameter(name).data = torch.full_like(parameter, torch.nan)
        assert torch.isnan(net(values, state)).all(), name
    values[4, 1] = torch.nan
    assert torch.isnan(mixer(1)(values, state)).nonzero().flatten().tolist() == [4]


def test_a_tape_is_used_once() -> None:
    values, state, grad = problem(1)
    total: Any = mixer(1)(values, state)
    total.backward(grad, retain_graph=True)
    with pytest.raises(RuntimeError, match="tape is used up"):
        total.backward(grad)
