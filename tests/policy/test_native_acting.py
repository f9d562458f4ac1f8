"""The compiled step of robots that act against numpy's: the same bits, in both builds."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import numpy.typing as npt
import pytest
from policy_weights import random_weights

from policy_pkg import native
from policy_pkg.kernels import kernels
from policy_pkg.policy import RecurrentPolicy

BUILDS = [name for name in native.FLAGS if native.FLAGS[name] <= native._flags()]
SAME_ORDER = ("Haswell", "Zen")  # OpenBLAS' kernels that add up in the order of the compiled step
Weights = dict[str, npt.NDArray[np.float32]]

# observation, actions, robots, hidden; up to eight terms and columns, no multiple of eight, many
CASES = [
    (1, 2, 1, 8),
    (5, 8, 2, 64),
    (12, 5, 3, 64),
    (70, 11, 8, 64),
    (131, 14, 8, 104),
    (255, 16, 1, 64),
    (320, 33, 5, 24),
]


def weights_of(obs: int, actions: int, robots: int, hidden: int, seed: int = 0) -> Weights:
    return random_weights(obs + actions + robots, hidden, actions, seed)


def policy(
    monkeypatch: pytest.MonkeyPatch, build: str, weights: Weights, robots: int, actions: int
) -> RecurrentPolicy:
    monkeypatch.setenv(native.VARIABLE, build)
    return RecurrentPolicy(weights, robots, actions)


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_it_has_numpys_bits_for_any_number_of_rows(
    build: str, case: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    if kernels()["openblas"] not in SAME_ORDER:
        pytest.skip(f"numpy multiplies in another order: {kernels()['openblas']}")
    obs, actions, robots, _ = case
    weights = weights_of(*case)
    compiled = policy(monkeypatch, build, weights, robots, actions)
    by_numpy = policy(monkeypatch, native.TORCH, weights, robots, actions)
    assert compiled._compiled is not None
    assert by_numpy._compiled is None
    rng = np.random.default_rng(1)
    for rows in (1, 3, 8, 13, 300, 2):
        mine = theirs = compiled.initial_hidden(rows)
        for _ in range(3):
            seen = rng.standard_normal((rows, obs), dtype=np.float32)
            seen[rng.random(seen.shape) < 0.3] = 0.0
            last = rng.integers(-1, actions, rows).astype(np.int32)
            robot = rng.integers(0, robots, rows).astype(np.int32)
            q, mine = compiled.forward(seen, last, robot, mine)
            expected, theirs = by_numpy.forward(seen, last, robot, theirs)
            np.testing.assert_array_equal(q, expected)
            np.testing.assert_array_equal(mine, theirs)
        assert np.ptp(q) > 0


@pytest.mark.parametrize("build", BUILDS)
def test_newer_weights_count(build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = (12, 5, 3, 64)
    other = weights_of(*case, seed=1)
    changed = policy(monkeypatch, build, weights_of(*case), 3, 5)
    fresh = policy(monkeypatch, build, other, 3, 5)
    row = np.ones((1, 12), dtype=np.float32), np.zeros(1, np.int32), np.zeros(1, np.int32)
    before, _ = changed.forward(*row, changed.initial_hidden(1))
    changed.set_weights(other)
    after, _ = changed.forward(*row, changed.initial_hidden(1))
    assert not np.array_equal(before, after)
    np.testing.assert_array_equal(after, fresh.forward(*row, fresh.initial_hidden(1))[0])


@pytest.mark.parametrize("build", [*BUILDS, native.TORCH])
def test_it_goes_to_another_process(build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = policy(monkeypatch, build, weights_of(12, 5, 3, 64), 3, 5)
    found.set_weights(weights_of(12, 5, 3, 64, seed=1))
    there = deepcopy(found)  # as pickle: processes are given policies
    row = np.ones((1, 12), dtype=np.float32), np.zeros(1, np.int32), np.zeros(1, np.int32)
    expected, _ = found.forward(*row, found.initial_hidden(1))
    np.testing.assert_array_equal(there.forward(*row, there.initial_hidden(1))[0], expected)


@pytest.mark.parametrize("case", [(321, 5, 2, 64), (12, 5, 2, 20), (12, 5, 2, 112)], ids=str)
def test_sizes_whose_order_it_does_not_have_are_numpys(case: tuple[int, int, int, int]) -> None:
    obs, actions, robots, _ = case
    found = RecurrentPolicy(weights_of(*case), robots, actions)
    assert found._compiled is None
    none = np.zeros(1, dtype=np.int32)
    q, _ = found.forward(np.ones((1, obs), np.float32), none, none, found.initial_hidden(1))
    assert np.isfinite(q).all()


@pytest.mark.parametrize("build", [*BUILDS, native.TORCH])
@pytest.mark.parametrize(("last", "robot"), [(6, 0), (0, 3)])
def test_what_does_not_exist_is_refused(
    build: str, last: int, robot: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = policy(monkeypatch, build, weights_of(12, 5, 3, 64), 3, 5)
    rows = np.ones((2, 12), np.float32), np.array([-1, last], np.int32)
    with pytest.raises(IndexError):
        found.forward(*rows, np.array([0, robot], np.int32), found.initial_hidden(2))


@pytest.mark.parametrize("build", [*BUILDS, native.TORCH])
def test_what_is_not_finite_comes_through(build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The agent refuses it, and says whose it was."""
    found = policy(monkeypatch, build, weights_of(12, 5, 3, 64), 3, 5)
    seen = np.ones((2, 12), np.float32)
    seen[1, 4] = np.nan
    none = np.zeros(2, dtype=np.int32)
    q, _ = found.forward(seen, none, none, found.initial_hidden(2))
    assert np.isfinite(q).all(axis=1).tolist() == [True, False]
