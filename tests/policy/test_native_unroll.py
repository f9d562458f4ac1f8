"""The compiled unroll against numpy's in float64, its two builds against each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from crash_coach_common.contract import UserError
from policy_pkg.episode import Sizes
from policy_pkg.learner import agent_net, native
from policy_pkg.learner.packed_gru import Schedule

Arrays = dict[str, npt.NDArray[Any]]
BUILDS = [name for name in native.FLAGS if native.FLAGS[name] <= native._flags()]

# (input size, hidden, actions, rows at each time): odd sizes, one row, several blocks of rows
CASES = [
    (7, 8, 5, [3, 3, 2, 1]),
    (4, 20, 3, [1]),
    (9, 64, 5, [64] * 6 + [37] * 5 + [5]),
    (33, 70, 33, [13, 12, 12, 9, 9, 9, 2]),
]


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Any:
    def use(name: str) -> None:
        monkeypatch.setenv(native.VARIABLE, name)

    return use


def problem(case: int) -> tuple[Arrays, npt.NDArray[Any], npt.NDArray[Any], Schedule]:
    inputs, hidden, actions, rows = CASES[case]
    rng = np.random.default_rng(case)
    sizes = Sizes(1, actions, inputs - actions - 1, 1, 9)
    shapes, _ = agent_net.shapes(sizes, hidden)
    params = {k: 0.3 * rng.standard_normal(s).astype(np.float32) for k, s in shapes.items()}
    x = rng.standard_normal((sum(rows), inputs)).astype(np.float32)
    grad = rng.standard_normal((sum(rows), actions)).astype(np.float32) / len(x)
    return params, x, grad, Schedule(rows)


def solved(
    params: Arrays, x: npt.NDArray[Any], grad: npt.NDArray[Any], schedule: Schedule, dtype: type
) -> tuple[npt.NDArray[Any], Arrays]:
    cast = {name: array.astype(dtype) for name, array in params.items()}
    q, tape = agent_net.values_and_tape(cast, x.astype(dtype), schedule)
    out = {name: np.full_like(array, np.nan) for name, array in cast.items()}
    agent_net.gradients(cast, tape, grad.astype(dtype), out)
    return q, out


@pytest.mark.parametrize("case", range(len(CASES)))
@pytest.mark.parametrize("name", BUILDS)
def test_values_and_gradients_are_those_of_float64(kernel: Any, name: str, case: int) -> None:
    params, x, grad, schedule = problem(case)
    expected_q, expected = solved(params, x, grad, schedule, np.float64)
    kernel(name)
    q, found = solved(params, x, grad, schedule, np.float32)
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
    params, x, _, schedule = problem(2)
    together = agent_net.values(params, x, schedule).copy()
    starts = [rows.start for rows in schedule.slices()]
    for row in (0, 4, 36, 63):
        own = [
            start + row for start, size in zip(starts, schedule.sizes, strict=True) if row < size
        ]
        alone = agent_net.values(params, x[own], Schedule([1] * len(own)))
        np.testing.assert_array_equal(alone, together[own])


@pytest.mark.parametrize("name", BUILDS)
def test_what_is_not_a_number_is_not_lost(kernel: Any, name: str) -> None:
    kernel(name)
    params, x, grad, schedule = problem(0)
    for key in params:
        broken = {**params, key: np.full_like(params[key], np.nan)}
        q, _ = solved(broken, x, grad, schedule, np.float32)
        assert np.isnan(q).all(), key
    x[0, 0] = np.inf
    q, _ = solved(params, x, grad, schedule, np.float32)
    assert not np.isfinite(q[0]).all() or np.abs(q[0]).max() < 1e3  # saturated gates are finite


def test_numpy_does_it_where_there_is_no_build(
    kernel: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    params, x, grad, schedule = problem(2)
    native_q, _ = solved(params, x, grad, schedule, np.float32)
    monkeypatch.delenv(native.VARIABLE, raising=False)
    monkeypatch.setattr(native, "FOLDER", tmp_path)
    assert native.build_name() is None
    q, _ = solved(params, x, grad, schedule, np.float32)
    np.testing.assert_allclose(q, native_q, atol=1e-5 * np.abs(q).max())
    kernel("avx2")
    with pytest.raises(UserError, match="CRASH_COACH_KERNEL=avx2: this machine has numpy"):
        native.unroll()
