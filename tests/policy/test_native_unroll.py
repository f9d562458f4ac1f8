"""The compiled unroll against torch's in float64, its two builds against each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from crash_coach_common.contract import UserError
from policy_pkg import native
from policy_pkg.episode import Sizes
from policy_pkg.learner.agent_net import AgentNet
from policy_pkg.policy import weight_shapes

Arrays = dict[str, npt.NDArray[Any]]
BUILDS = [name for name in native.FLAGS if native.FLAGS[name] <= native._flags()]

# (input size, hidden, actions, rows at each time, share of inputs not zero): odd sizes, one row,
# several blocks of rows, zeros that are left out
CASES = [
    (7, 8, 5, [3, 3, 2, 1], 1.0),
    (4, 20, 3, [1], 1.0),
    (9, 64, 5, [64] * 6 + [37] * 5 + [5], 1.0),
    (33, 70, 33, [13, 12, 12, 9, 9, 9, 2], 1.0),
    (150, 64, 14, [300, 257, 256, 65], 0.3),
    (131, 100, 3, [70, 64, 33], 0.1),
]


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Any:
    def use(name: str) -> None:
        monkeypatch.setenv(native.VARIABLE, name)

    return use


def problem(case: int) -> tuple[Arrays, npt.NDArray[Any], npt.NDArray[Any], list[int]]:
    inputs, hidden, actions, rows, share = CASES[case]
    rng = np.random.default_rng(case)
    shapes = weight_shapes(inputs, hidden, actions)
    params = {k: 0.3 * rng.standard_normal(s).astype(np.float32) for k, s in shapes.items()}
    x = rng.standard_normal((sum(rows), inputs)).astype(np.float32)
    x[rng.random(x.shape) >= share] = 0.0
    grad = rng.standard_normal((sum(rows), actions)).astype(np.float32) / len(x)
    return params, x, grad, rows


def net_of(params: Arrays, dtype: type) -> AgentNet:
    (hidden, inputs), actions = params["fc1.weight"].shape, len(params["fc2.bias"])
    net = AgentNet(Sizes(1, actions, inputs - actions - 1, 1, 9), hidden)
    cast = {name: torch.from_numpy(array.astype(dtype)) for name, array in params.items()}
    net.to(cast["fc1.bias"].dtype).load_state_dict(cast)
    return net


def values(params: Arrays, x: npt.NDArray[Any], rows: list[int]) -> npt.NDArray[Any]:
    with torch.no_grad():
        q = net_of(params, np.float32)(torch.from_numpy(x), torch.tensor(rows).int())
    return np.asarray(q.numpy())


def solved(
    params: Arrays, x: npt.NDArray[Any], grad: npt.NDArray[Any], rows: list[int], dtype: type
) -> tuple[npt.NDArray[Any], Arrays]:
    net = net_of(params, dtype)
    q = net(torch.from_numpy(x.astype(dtype)), torch.tensor(rows).int())
    q.backward(torch.from_numpy(grad.astype(dtype)))
    gradients = {k: p.grad.numpy() for k, p in net.named_parameters() if p.grad is not None}
    return q.detach().numpy(), gradients


@pytest.mark.parametrize("case", range(len(CASES)))
@pytest.mark.parametrize("name", BUILDS)
def test_values_and_gradients_are_those_of_float64(kernel: Any, name: str, case: int) -> None:
    params, x, grad, rows = problem(case)
    expected_q, expected = solved(params, x, grad, rows, np.float64)
    kernel(name)
    q, found = solved(params, x, grad, rows, np.float32)
    np.testing.assert_allclose(q, expected_q, atol=2e-6 * np.abs(expected_q).max())
    for key, array in expected.items():
        most = 2e-6 * np.abs(array).max()  # 0 where there is no step before: then exactly 0
        np.testing.assert_allclose(found[key], array, rtol=0, atol=most, err_msg=key)


@pytest.mark.parametrize("case", range(len(CASES)))
def test_both_builds_have_the_same_bits(kernel: Any, case: int) -> None:
    if len(BUILDS) < 2:
        pytest.skip("this processor has no AVX-512: there is one build to run")
    results = []
    for name in BUILDS:
        kernel(name)
        results.append(solved(*problem(case), np.float32))
    (one_q, one), (other_q, other) = results
    np.testing.assert_array_equal(one_q, other_q)
    for key, array in one.items():
        np.testing.assert_array_equal(array, other[key], err_msg=key)


@pytest.mark.parametrize("name", BUILDS)
def test_a_sequence_alone_has_the_bits_it_has_in_a_batch(kernel: Any, name: str) -> None:
    kernel(name)
    params, x, _, rows = problem(2)
    together = values(params, x, rows)
    starts = np.cumsum([0, *rows[:-1]]).tolist()
    for row in (0, 4, 36, 63):
        own = [start + row for start, size in zip(starts, rows, strict=True) if row < size]
        alone = values(params, x[own], [1] * len(own))
        np.testing.assert_array_equal(alone, together[own])


@pytest.mark.parametrize("name", BUILDS)
def test_zeros_left_out_and_zeros_added_give_the_same_bits(kernel: Any, name: str) -> None:
    """Where most of some rows is zero the kernel leaves zeros out; with a full row alone not."""
    kernel(name)
    params, x, _, _ = problem(4)
    x[:31], x[31] = 0.0, np.where(x[31] == 0.0, 1.0, x[31])
    x[31, 7] = 0.0
    together = values(params, x[:32], [32])
    np.testing.assert_array_equal(values(params, x[31:32], [1]), together[31:])


@pytest.mark.parametrize("name", BUILDS)
def test_what_is_not_a_number_is_not_lost(kernel: Any, name: str) -> None:
    kernel(name)
    params, x, grad, rows = problem(0)
    for key in params:
        broken = {**params, key: np.full_like(params[key], np.nan)}
        q, _ = solved(broken, x, grad, rows, np.float32)
        assert np.isnan(q).all(), key
    x[0, 0] = np.inf
    q, _ = solved(params, x, grad, rows, np.float32)
    assert not np.isfinite(q[0]).all() or np.abs(q[0]).max() < 1e3  # saturated gates are finite


def test_torch_does_it_where_there_is_no_build(
    kernel: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    params, x, grad, rows = problem(2)
    native_q, _ = solved(params, x, grad, rows, np.float32)
    monkeypatch.delenv(native.VARIABLE, raising=False)
    monkeypatch.setattr(native, "FOLDER", tmp_path)
    assert native.build_name() is None
    q, _ = solved(params, x, grad, rows, np.float32)
    np.testing.assert_allclose(q, native_q, atol=1e-5 * np.abs(q).max())
    kernel("avx2")
    with pytest.raises(UserError, match="CRASH_COACH_KERNEL=avx2: this machine has torch"):
        native.build_name()
